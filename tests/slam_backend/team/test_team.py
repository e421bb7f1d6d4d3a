"""Teams: what groups have in common, and whole runs of three robots."""

from itertools import permutations
from typing import Any

import numpy as np
import pytest
from builders.comparison import assert_same
from builders.filters import LANDMARKS, frame_of, plain_filter, starts_of
from builders.teams import SIGMA, STARTS, SimulatedTeam, hand_made, standing_team

from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.options import FilterOptions
from slam_backend.fastslam.reports import PoseEstimate
from slam_backend.geometry import between, compose, inverse, transform_points, wrap_angle
from slam_backend.maps.alignment import align_maps
from slam_backend.maps.alignment_types import REASONS
from slam_backend.team.merge_scheduler import AttemptOptions
from slam_backend.team.reports import TeamReport
from slam_backend.team.team import TeamSlam

ALONE = np.eye(3, dtype=bool)


def test_a_fresh_team_is_a_set_of_filters_at_their_own_starts() -> None:
    """Before the first step each robot is alone, at the origin of its own start frame, with an empty map."""
    team = TeamSlam(3, num_particles=7)
    assert team.groups == ((0,), (1,), (2,))
    assert team.num_robots == 3
    assert team.events == ()
    for robot in range(3):
        np.testing.assert_array_equal(team.start_from_group(robot), 0.0)
        np.testing.assert_array_equal(team.pose(robot).mean, 0.0)
        assert len(team.map(robot)) == 0
        assert team.particles(robot)[0].shape == (7, 3)
    assert [row["ess"] for row in team.diagnostics] == [7.0] * 3
    assert FilterOptions(num_particles=7) == team._find(0)[0].filter.options


ORDERS = [
    ((0, 1), (0, 2), (0, 3)),
    ((3, 2), (2, 1), (1, 0)),
    ((1, 2), (3, 0), (2, 3)),
    ((3, 1), (0, 2), (1, 2)),
    ((2, 1), (3, 2), (2, 0)),
]


@pytest.mark.parametrize("order", ORDERS)
def test_the_frame_of_a_group_is_the_start_of_its_lowest_robot_whatever_the_order(order: Any) -> None:
    """After each of the merges, poses, starts and maps are true in the start frame of the group's lowest robot."""
    team = standing_team(4)
    for robot_a, robot_b in order:
        joined = {group for group in team.groups if robot_a in group or robot_b in group}
        renaming = team.merge(robot_a, robot_b, hand_made(team, robot_a, robot_b))
        assert {renaming.robots_a, renaming.robots_b} == joined
        assert renaming.robots_a[0] < renaming.robots_b[0]
        for group in team.groups:
            for robot in group:
                true = between(STARTS[group[0]], STARTS[robot])
                assert np.abs(team.pose(robot).mean - true).max() < 10 * SIGMA
                assert np.abs(inverse(team.start_from_group(robot)) - true).max() < 10 * SIGMA
            held = team.map(group[0])
            truth = transform_points(inverse(STARTS[group[0]]), LANDMARKS[held.descriptors.argmax(axis=1)])
            assert np.abs(held.means - truth).max() < 20 * SIGMA
            assert len(held) == 5 + len(group)
    assert team.groups == ((0, 1, 2, 3),)
    np.testing.assert_array_equal(team.start_from_group(0), 0.0)


@pytest.mark.parametrize(("robot_a", "robot_b"), list(permutations(range(3), 2)))
def test_a_merge_gives_the_same_whichever_robot_is_named_first(robot_a: int, robot_b: int) -> None:
    """merge(a, b, T) and merge(b, a, T^-1) make the same groups, events and renamings, and maps that agree."""
    team, other = standing_team(), standing_team()
    renaming = team.merge(robot_a, robot_b, hand_made(team, robot_a, robot_b))
    turned = other.merge(robot_b, robot_a, hand_made(other, robot_b, robot_a))
    assert team.groups == other.groups
    np.testing.assert_array_equal(renaming.ids_b, turned.ids_b)
    event, mirrored = team.events[-1], other.events[-1]
    assert (event.kind, event.robots_a, event.robots_b) == ("merge", mirrored.robots_a, mirrored.robots_b)
    np.testing.assert_allclose(event.alignment.transform, mirrored.alignment.transform, atol=1e-9)
    np.testing.assert_allclose(team.map(robot_a).means, other.map(robot_a).means, atol=10 * SIGMA)


def test_an_id_map_covers_every_landmark_of_map_b() -> None:
    """A landmark of b's map before the merge, renamed, looks the same in the joint map; a's keep id and look."""
    team = standing_team()
    before = [team.map(robot) for robot in range(3)]
    renaming = team.merge(2, 1, hand_made(team, 2, 1))
    joint = team.map(1)
    looks = dict(zip(joint.ids.tolist(), joint.descriptors.argmax(axis=1).tolist(), strict=True))
    new_id = dict(renaming.ids_b.tolist())
    assert (renaming.robots_a, renaming.robots_b) == ((1,), (2,))
    for landmark, look in zip(before[2].ids.tolist(), before[2].descriptors.argmax(axis=1).tolist(), strict=True):
        assert looks[new_id[landmark]] == look
    for landmark, look in zip(before[1].ids.tolist(), before[1].descriptors.argmax(axis=1).tolist(), strict=True):
        assert looks[landmark] == look


def test_team_poses_agree_with_the_poses_of_each_robot() -> None:
    """Before, while and after two of three robots merge, one of which then loses contact; in the same arrays or not."""
    simulation = SimulatedTeam(num_robots=3, seed=5)
    team = simulation.build(num_particles=20, attempts=AttemptOptions(enabled=False))
    apart = np.eye(3, dtype=bool)
    points, outlines = team.team_poses(), team.map_summaries(2)
    for stage in range(4):
        if stage:
            simulation.run(team, 30, apart if stage == 3 else None)
        if stage == 2:
            team.merge(0, 1, align_maps(team.map(0, "mixture"), team.map(1, "mixture")))
        assert team.team_poses(points) is points
        outlines = team.map_summaries(2, outlines)
        assert team.map_summaries(2, outlines) is outlines
        fresh = team.team_poses()
        assert_same((points.poses, points.beliefs), (fresh.poses, fresh.beliefs))
        for robot in range(3):
            assert_same(team.topology.known_robots[robot], team.known_robots(robot))
            assert_same(team.topology.same_filter[robot], team.same_filter(robot))
            assert_same(points.poses[robot, robot], points.own[robot])
            assert_same(PoseEstimate(points.own[robot], points.covariances[robot]), team.pose_from_start(robot))
            np.testing.assert_allclose(points.starts[robot], team.start_from_group(robot), atol=1e-15)
            assert points.ess[robot] == team.ess(robot) / 20
            known = np.flatnonzero(~np.isnan(points.poses[robot, :, 0]))
            assert_same(tuple(known.tolist()), team.known_robots(robot))
            assert_same(np.flatnonzero(~np.isnan(points.sigmas[robot])), known)
            for mate in known:
                seen = team.pose_from_start(robot) if mate == robot else team.pose(int(mate), robot)
                np.testing.assert_allclose(points.sigmas[robot, mate], np.sqrt(np.trace(seen.covariance[:2, :2]) / 2.0))
                if mate != robot:
                    np.testing.assert_array_equal(points.poses[robot, mate], compose(points.starts[robot], seen.mean))
            for got, expected in zip(outlines.of(robot), team.map(robot, min_count=2).summary, strict=True):
                np.testing.assert_array_equal(got, expected)
    assert len(team.same_filter(0)) == 1 < len(team.known_robots(0))


def test_own_start_frames_do_not_jump_at_a_merge() -> None:
    """Seen in its own start frame, a robot's pose and map move by no more than their uncertainty.

    Poses: four standard deviations of the pose before and of the start's spread after. Maps: the median landmark
    by one deviation on average over three runs and by two in each, every landmark by five. (The most probable
    particles before and after are two draws of one posterior, which differ by sqrt(2) deviations if they are
    independent.) Particles are many, because few of them run out of pasts and understate these deviations.
    """
    medians = [median for seed in (1, 2, 3) for median in jumps_at_a_merge(seed)]
    assert np.mean(medians) < 1.0
    assert max(medians) < 2.0


def jumps_at_a_merge(seed: int) -> list[float]:
    """Check one run, and return by how many deviations the median landmark of each robot moved."""
    medians = []
    simulation = SimulatedTeam(seed=seed)
    team = simulation.build(num_particles=300)
    simulation.run(team, 100, ALONE)
    poses = [team.pose(robot) for robot in range(2)]
    own = [compose(team.start_from_group(robot), poses[robot].mean) for robot in range(2)]
    maps = [team.map(robot).moved(team.start_from_group(robot)) for robot in range(2)]
    mixtures = [team.map(robot, "mixture") for robot in range(2)]
    alignment = align_maps(*mixtures)
    assert alignment.success
    new_ids = [{}, dict(team.merge(0, 1, alignment).ids_b.tolist())]
    spread = np.cov(starts_of(team._find(1)[0].filter, 1).T)
    for robot in range(2):
        jump = compose(team.start_from_group(robot), team.pose(robot).mean) - own[robot]
        jump[2] = wrap_angle(jump[2])
        assert (np.abs(jump) < 4.0 * np.sqrt(np.diag(poses[robot].covariance + spread))).all()
        joint = team.map(robot).moved(team.start_from_group(robot))
        row_of = {landmark: row for row, landmark in enumerate(joint.ids.tolist())}
        moved = []
        for row, landmark in enumerate(maps[robot].ids.tolist()):
            after = row_of.get(new_ids[robot].get(landmark, landmark))
            if after is not None:
                distance = np.linalg.norm(joint.means[after] - maps[robot].means[row])
                moved.append(distance / np.sqrt(np.trace(mixtures[robot].covariances[row])))
        assert len(moved) > 0.8 * len(maps[robot])
        medians.append(float(np.median(moved)))
        assert max(moved) < 5.0
    return medians


def test_robots_without_contact_do_not_influence_each_other() -> None:
    """Robot 0 of a team that never meets does what it does in a team of one, bit for bit."""
    simulation = SimulatedTeam(seed=4)
    team = simulation.build()
    alone = SimulatedTeam(1, seed=4).build()
    for _ in range(40):
        odometry, frames = simulation.read()
        team.step(odometry, frames, ALONE)
        alone.step(odometry[:1], frames[:1])
    np.testing.assert_array_equal(team.particles(0)[0], alone.particles(0)[0])
    np.testing.assert_array_equal(team.map(0).means, alone.map(0).means)


def test_a_robot_matches_what_another_has_just_mapped() -> None:
    """In one step, a later robot of a joint filter finds the landmark that an earlier one has just created (l. 9)."""
    names = np.array([3])
    starts = np.array([[0.0, 0.0, 0.0], [0.5, -0.4, 0.2]])
    slam = FastSlam(2, num_particles=7, initial_poses=starts)
    frames = [frame_of(transform_points(inverse(start), LANDMARKS[names]), names, 0.02) for start in starts]
    report = slam.step([None, None], frames)
    assert report.num_new == 1
    np.testing.assert_array_equal(report.associations[0], report.associations[1])
    np.testing.assert_array_equal(report.created[1], [-1])
    assert slam.map().counts.tolist() == [2]


def test_weights_multiply_by_the_chain_rule() -> None:
    """Two robots' likelihoods multiply, the second taken in the map that the first has just updated (l. 9).

    With exact poses this is the joint density of both measurements of one landmark, whose errors are correlated
    through the landmark's own uncertainty.
    """
    names, sigma_map, sigma = np.array([3]), 0.3, 0.1
    rng = np.random.default_rng(5)
    starts = np.array([[0.0, 0.0, 0.0], [0.5, -0.4, 0.2]])
    local = [transform_points(inverse(start), LANDMARKS[names]) for start in starts]
    slam = plain_filter(2, num_particles=1, initial_poses=starts, proposal="fastslam1")
    still = np.zeros((2, 3))
    slam.step([None, None], [frame_of(local[0], names, sigma_map), None], identities=[names, None], poses=still)
    before = slam.path_log_weights[0]
    errors = sigma * rng.normal(size=(2, 1, 3))
    frames = [frame_of(points + error, names, sigma) for points, error in zip(local, errors, strict=True)]
    slam.step([None, None], frames, identities=[names, names], poses=still)
    turned = [transform_points([0.0, 0.0, start[2]], error) for start, error in zip(starts, errors, strict=True)]
    stacked = np.ravel(turned)
    joint = np.kron(np.full((2, 2), sigma_map**2), np.eye(3)) + sigma**2 * np.eye(6)
    expected = -0.5 * (stacked @ np.linalg.solve(joint, stacked) + np.linalg.slogdet(2 * np.pi * joint)[1])
    assert slam.path_log_weights[0] - before == pytest.approx(expected, rel=1e-9)


def test_a_joint_filter_takes_robots_in_the_order_of_the_team() -> None:
    """Whatever the order of merges, odometry of robot k moves robot k."""
    for order in permutations(range(3)):
        team = standing_team()
        team.merge(order[0], order[1], hand_made(team, order[0], order[1]))
        team.merge(order[1], order[2], hand_made(team, order[1], order[2]))
        before = [team.pose(robot).mean for robot in range(3)]
        moves = [np.array([0.1 * (robot + 1), 0.0, 0.0]) for robot in range(3)]
        team.step(moves, [None] * 3)
        for robot in range(3):
            assert between(before[robot], team.pose(robot).mean)[0] == pytest.approx(0.1 * (robot + 1), abs=0.02)


STEPS = 160


@pytest.fixture(scope="module", params=[0, 1, 2, 3])
def run(request: pytest.FixtureRequest) -> tuple[SimulatedTeam, TeamSlam, list[TeamReport]]:
    """A whole run, with what the team reported at each step."""
    simulation = SimulatedTeam(seed=request.param)
    team = simulation.build()
    return simulation, team, simulation.run(team, STEPS)


Run = tuple[SimulatedTeam, TeamSlam, list[TeamReport]]


def test_three_robots_become_one_group_without_a_false_merge(run: Run) -> None:
    """Both merges are right to within 0.5 m and 5 degrees, the contract's bounds, and all robots end together."""
    simulation, team, _ = run
    assert team.groups == ((0, 1, 2),)
    merges = [event for event in team.events if event.kind == "merge"]
    assert len(merges) == 2
    for event in merges:
        error = event.alignment.transform - simulation.true_motion(event.robots_a[0], event.robots_b[0])
        assert np.hypot(*error[:2]) < 0.5
        assert abs(wrap_angle(error[2])) < np.deg2rad(5.0)


def test_the_joint_filter_has_small_errors(run: Run) -> None:
    """At the end of 32 m each, every robot knows its place in its own start frame to 0.3 m, and the map is as good."""
    simulation, team, _ = run
    assert simulation.position_errors(team).max() < 0.3
    held = team.map(0).moved(simulation.starts[0])
    nearest = np.linalg.norm(held.means[:, None] - simulation.landmarks[0], axis=2).min(axis=1)
    assert np.sqrt(np.mean(nearest**2)) < 0.3
    assert len(held) < 1.2 * simulation.num_landmarks


def test_every_step_names_landmarks_that_exist(run: Run) -> None:
    """Ids created in a run, renamed at each merge, cover all ids of the final map; steps count from 0."""
    _, team, reports = run
    assert [report.step for report in reports] == list(range(STEPS))
    ids: list[set[int]] = [set() for _ in range(3)]  # per robot: landmarks ever created in the map it shares
    for report in reports:
        together = {robot: group for group in before_merges(report) for robot in group}
        for robot, created in enumerate(report.created):
            for mate in together[robot]:
                ids[mate] |= set(created[created >= 0].tolist())
        for robot, found in enumerate(report.associations):
            assert set(found[found >= 0].tolist()) <= ids[robot]
        for renaming in report.id_maps:
            new_id = dict(renaming.ids_b.tolist())
            joint = ids[renaming.robots_a[0]] | {new_id[old] for old in ids[renaming.robots_b[0]] if old in new_id}
            for robot in renaming.robots_a + renaming.robots_b:
                ids[robot] = set(joint)
    assert set(team.map(0).ids.tolist()) <= ids[0]


def before_merges(report: TeamReport) -> list[tuple[int, ...]]:
    """Return the groups as they were in the step, before its merge."""
    groups = list(report.groups)
    for renaming in reversed(report.id_maps):
        groups.remove(tuple(sorted(renaming.robots_a + renaming.robots_b)))
        groups += [renaming.robots_a, renaming.robots_b]
    return groups


def test_diagnostics_count_the_last_frame(run: Run) -> None:
    """Accepted, new and rejected measurements add up to the frame; robots of one group share ESS and landmarks."""
    _, team, reports = run
    rows = team.diagnostics
    for robot, row in enumerate(rows):
        assert row["accepted"] + row["new"] + row["rejected"] == len(reports[-1].associations[robot])
        assert 1.0 <= row["ess"] <= 30.0
        assert row["landmarks"] == len(team.map(robot))
    assert len({row["ess"] for row in rows}) == 1


@pytest.mark.parametrize(("aliased", "seed"), [(False, 5), (True, 6), (True, 7)])
def test_robots_without_overlap_never_merge(aliased: bool, seed: int) -> None:
    """Robots in separate rooms stay alone, whether or not the rooms repeat descriptors at other places."""
    simulation = SimulatedTeam(num_robots=2, seed=seed, separate=True, aliased=aliased)
    team = simulation.build()
    simulation.run(team, 150)
    assert team.groups == ((0,), (1,))
    assert all(event.kind == "attempt" and not event.alignment.success for event in team.events)
    if aliased:
        assert team.events  # there were candidates, so that the maps were compared
        assert {event.alignment.reason for event in team.events} <= set(REASONS)
