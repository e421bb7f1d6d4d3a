"""Topology of a team (groups, filters, frames), and the poses of its robots."""

import copy
import pickle
from collections.abc import Callable

import numpy as np
import pytest
from builders.kernels import python_entry
from builders.teams import NEVER, SimulatedTeam, false_alignment, links, true_alignment

from slam_backend.core.packed_symmetric import UNPACK_INDEX
from slam_backend.fastslam._kernels import LANES, add_gauge_covariance
from slam_backend.fastslam._kernels.particles.pose_estimates import (
    AT_ORIGIN,
    KNOWN,
    SPREAD,
    relative_poses_from_starts,
    start_kind,
    write_team_poses,
)
from slam_backend.fastslam.estimates import pose_mixtures
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.relative_poses import SIGMAS, TeamPoses, membership_table
from slam_backend.geometry import between, compose, inverse, rotate_covariances, rotation, wrap_angle
from slam_backend.models.measurements import Measurements
from slam_backend.team.branches import Branch
from slam_backend.team.options import MergeOptions
from slam_backend.team.reports import TeamReport
from slam_backend.team.team import TeamSlam


def oldest_unknown(team: TeamSlam, branch: Branch, now: int) -> int:
    """Return the first step that a filter may still have to take in; the next one if there is none."""
    held = [1 + last for robot, last in branch.last_steps.items() if robot not in branch.active_robots]
    waiting, undone = list(branch.merge_numbers), []
    while waiting:
        joined = team._merges.joined[waiting.pop()].joined
        assert joined is not None
        undone.append(joined.oldest_step)
        waiting += [number for earlier in joined.earlier for number in earlier]
    return min([now + 1, *held, *undone])


def check(team: TeamSlam, report: TeamReport) -> None:
    """Check that a team's topology, and what its report says of that, are as the groups have it now."""
    assert team.topology == team._merges.topology()
    assert team.topology is team.topology
    branches = [branch for group in team._groups for branch in group.branches]
    for robot, (group, branch, place) in enumerate(team.topology.places):
        assert robot in branch.active_robots
        assert branch.robots[place] == robot
        assert branch in group.branches
    assert (report.groups, report.maps) == (team.groups, tuple(branch.number for _, branch, _ in team.topology.places))
    assert report.oldest_step == min(oldest_unknown(team, branch, report.step) for branch in branches)


def run(simulation: SimulatedTeam, team: TeamSlam, steps: int, contacts: object = None) -> list[str]:
    """Drive, check the topology after each step, and return what became of merges."""
    before = len(team.events)
    for _ in range(steps):
        check(team, simulation.run(team, 1, contacts)[0])
    return [event.kind for event in team.events[before:]]


def test_merges_forks_returns_undos_and_ends_of_monitoring_change_the_topology() -> None:
    """Each of these makes a new topology; steps between them do not."""
    simulation = SimulatedTeam(num_robots=3, seed=101)
    team = simulation.build(attempts=NEVER, merging=MergeOptions(watch_steps=60))
    alone = team.topology
    run(simulation, team, 80)
    assert team.topology is alone
    team.merge(0, 1, false_alignment(simulation, team, np.array([3.0, -2.0, 0.5])))
    assert team.topology == team._merges.topology()
    assert any("undo" in run(simulation, team, 1) for _ in range(100))
    assert team.topology.same_filter == ((0,), (1,), (2,))
    team.merge(0, 2, true_alignment(simulation, team, 0, 2))
    run(simulation, team, 10)
    run(simulation, team, 10, links(3, (0, 1)))
    assert team.topology.same_filter == ((0,), (1,), (2,))
    assert team.topology.known_robots == ((0, 2), (1,), (0, 2))
    run(simulation, team, 10)
    assert team.topology.same_filter == ((0, 2), (1,), (0, 2))
    watched = team.topology
    assert watched.oldest is not None
    run(simulation, team, 80)
    assert team.topology.oldest is None
    assert len(team.topology.numbers) < len(watched.numbers)


def test_a_restored_team_has_the_topology_of_its_state() -> None:
    """It does whether the team is the same or another one."""
    simulation = SimulatedTeam(num_robots=3, seed=102)
    team, other = (simulation.build(attempts=NEVER) for _ in range(2))
    simulation.run(team, 60)
    state = team.get_state()
    team.merge(0, 1, true_alignment(simulation, team, 0, 1))
    assert team.topology.groups == ((0, 1), (2,))
    for one in (team, other):
        one.set_state(state)
        assert one.topology == one._merges.topology()
        assert one.topology.groups == ((0,), (1,), (2,))


@pytest.mark.parametrize(("rows", "robots"), [(3, None), (1, 4)])
def test_all_beliefs_are_views_of_one_array(rows: int, robots: int | None) -> None:
    """What is written by name is in the rows that kernels take, once, and nothing else is."""
    points = TeamPoses(rows, robots)
    points.beliefs.fill(-1.0)
    named = points.own, points.starts, points.ess, points.covariances, points.sigmas
    known = rows if robots is None else robots
    assert points.poses.shape == (rows, known, 3)
    shapes = [(rows, 3), (rows, 3), (rows,), (rows, 3, 3), (rows, known)]
    assert [array.shape for array in named] == shapes
    numbers = iter(range(rows * (SIGMAS + known)))
    for array in named:
        array[...] = np.fromiter(numbers, np.float64, array.size).reshape(array.shape)
    assert sorted(points.beliefs.ravel()) == list(range(rows * (SIGMAS + known)))
    assert points.beliefs[:, 7:16].tobytes() == points.covariances.tobytes()


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda points: pickle.loads(pickle.dumps(points))])
def test_a_copy_has_views_of_its_own_array(copied: Callable[[TeamPoses], TeamPoses]) -> None:
    """What kernels write into a copy is visible in its fields, and not in the original."""
    points = TeamPoses(2)
    points.beliefs[:], points.poses[:] = 1.0, 2.0
    other = copied(points)
    assert (other.beliefs.tobytes(), other.poses.tobytes()) == (points.beliefs.tobytes(), points.poses.tobytes())
    other.beliefs[:] = 5.0
    for array in (other.own, other.starts, other.ess, other.covariances, other.sigmas):
        assert (array == 5.0).all()


def test_the_membership_table_lists_active_robots() -> None:
    """The robots of the filter, and of each whether it does."""
    assert membership_table((1, 2, 4), (4, 1)).tolist() == [[1, 2, 4], [1, 0, 1]]


relative_poses_from_starts, start_kind = map(python_entry, (relative_poses_from_starts, start_kind))

STARTS = np.array([[1.0, -2.0, 0.7], [4.0, 3.0, -2.0]])


def _moved(seed: int) -> FastSlam:
    """Return a filter of two robots that have driven a little, seeing two landmarks."""
    slam = FastSlam(num_robots=2, num_particles=13, seed=seed, initial_poses=STARTS)
    frame = Measurements([[0.2, 0.1, 3.0], [-0.5, 0.0, 2.0]], np.eye(2))
    for _ in range(5):
        slam.step([[0.1, 0.0, 0.05], [0.08, 0.0, -0.1]], [frame, None])
    return slam


def test_the_sample_size_is_written_for_active_robots() -> None:
    """Of those of its robots that are live, and of no other."""
    points = TeamPoses(4)
    points.ess.fill(-1.0)
    _moved(3).write_team_poses((3, 1), (0, 3), 0.5, points)
    assert points.ess.tolist() == [-1.0, -1.0, -1.0, 0.5]


def test_kinds_of_starts_are_distinguished() -> None:
    """All at the origin, all at one place, or spread: surplus lanes do not count."""
    starts = np.zeros((3, 8))
    starts[:, 5:] = 9.0
    assert start_kind(starts, 5) == AT_ORIGIN
    starts[1, :5] = 4.0
    assert start_kind(starts, 5) == KNOWN
    starts[2, 4] = 1e-9
    assert start_kind(starts, 5) == SPREAD


def test_uncertain_starts_do_not_widen_the_pose_in_the_start_frame() -> None:
    """Moving robot and start of each particle alike, as a merge does, leaves the pose in the start frame as it was."""
    slam = _moved(2)
    before, particles = slam.pose_from_start(1), slam.particles_from_start(1)
    state = copy.deepcopy(slam.get_state())
    motions = np.random.default_rng(5).normal(0.0, 0.5, (13, 3))
    for name in ("starts", "poses", "means"):  # (K, 3, P), P >= M
        state[name][1, :, :13] = compose(motions, state[name][1, :, :13].T).T
    turn = np.tile(np.eye(3), (13, 1, 1))
    turn[:, :2, :2] = np.array([[[np.cos(t), -np.sin(t)], [np.sin(t), np.cos(t)]] for t in motions[:, 2]])
    covariances = state["covariances"][1, :, :13].T[:, UNPACK_INDEX]
    state["covariances"][1, :, :13] = (turn @ covariances @ turn.transpose(0, 2, 1))[:, *np.triu_indices(3)].T
    slam.set_state(state)
    after = slam.pose_from_start(1)
    assert np.allclose(between(before.mean, after.mean), 0.0, atol=1e-3)  # resampling noise of the estimate before
    assert np.allclose(after.covariance, before.covariance, atol=1e-3)
    difference = slam.particles_from_start(1) - particles
    difference[:, 2] = wrap_angle(difference[:, 2])
    assert np.allclose(difference, 0.0, atol=1e-12)


def test_the_change_of_frame_is_that_of_matrices() -> None:
    """Each particle's mean and covariance, seen from its start, are what rotation matrices make of them."""
    rng = np.random.default_rng(7)
    starts, means = rng.uniform(-3.0, 3.0, (2, 3, 11))
    roots = rng.normal(0.0, 0.3, (11, 3, 3))
    covariances = roots @ roots.transpose(0, 2, 1)
    packed = covariances[:, *np.triu_indices(3)].T
    seen, spread = np.zeros((3, 11)), np.zeros((6, 11))
    relative_poses_from_starts(starts, means, np.ascontiguousarray(packed), 9, seen, spread)
    for m in range(9):
        np.testing.assert_allclose(seen[:, m], between(starts[:, m], means[:, m]), atol=1e-12)
        turn = np.eye(3)
        turn[:2, :2] = rotation(-starts[2, m])
        np.testing.assert_allclose(spread[UNPACK_INDEX, m], turn @ covariances[m] @ turn.T, atol=1e-12)
    assert not seen[:, 9:].any()
    assert not spread[:, 9:].any()


def test_poses_in_own_start_frames_agree_with_the_plain_definition() -> None:
    """Of robots that start at the origin, at a known place and at an unknown one; surplus lanes do not count.

    The team calls them 3, 0 and 2; robot 1 goes by another filter, and so does one that this filter knows as 4.
    """
    rng = np.random.default_rng(8)
    count, best = 9, 4
    starts, means = rng.uniform(-3.0, 3.0, (2, 3, 3, LANES))
    starts[0, :, :count], starts[1, :, :count] = 0.0, STARTS[1][:, None]
    roots = rng.normal(0.0, 0.3, (3, LANES, 3, 3))
    matrices = roots @ roots.transpose(0, 1, 3, 2)
    covariances = np.ascontiguousarray(matrices[:, :, *np.triu_indices(3)].transpose(0, 2, 1))
    weights = rng.dirichlet(np.ones(count))
    of_four = [np.concatenate([rows, rows[:1]]) for rows in (starts, means, covariances)]
    estimates = pose_mixtures(*of_four[1:], weights)
    of_four.insert(2, np.zeros((4, 3, LANES)))  # biases
    robots = np.concatenate([rows.reshape(-1, 4, 3, LANES) for rows in (np.zeros((4, 3, LANES)), *of_four)])
    names, live = np.array([3, 0, 2, 4]), np.array([1, 1, 1, 0])
    points = TeamPoses(5)
    points.poses.fill(7.0)
    points.beliefs.fill(7.0)
    write_team_poses(
        robots, np.zeros((4, 3, 3)), weights, best, *estimates, np.array([names, live]), points.poses, points.beliefs
    )

    for field in (points.poses, points.beliefs):
        assert (field[[1, 4]] == 7.0).all()
    poses, spreads, frames = points.own[names], points.covariances[names], points.starts[names[:3]]
    np.testing.assert_allclose(frames, inverse(starts[:, :, best]), atol=1e-15)
    np.testing.assert_array_equal(poses[0], estimates.means[0])
    np.testing.assert_array_equal(spreads[0], estimates.covariances[0])
    np.testing.assert_allclose(poses[1], between(STARTS[1], estimates.means[1]), atol=1e-12)
    np.testing.assert_allclose(spreads[1], rotate_covariances(-STARTS[1, 2], estimates.covariances[1]), atol=1e-12)
    for i, viewer in enumerate(names[:3]):
        for j, mate in enumerate(names):
            pose, spread = (
                (poses[i], spreads[i]) if i == j else (compose(frames[i], estimates.means[j]), estimates.covariances[j])
            )
            np.testing.assert_allclose(points.poses[viewer, mate], pose, atol=1e-12)
            np.testing.assert_allclose(points.sigmas[viewer, mate], np.sqrt(np.trace(spread[:2, :2]) / 2.0), atol=1e-12)
        assert np.isnan(points.poses[viewer, 1]).all()
        assert np.isnan(points.sigmas[viewer, 1])
    seen = between(starts[2].T, means[2].T)[:count]
    turned = np.array([rotate_covariances(-starts[2, 2, m], matrices[2, m]) for m in range(count)])
    mean = np.append(weights @ seen[:, :2], np.angle(weights @ np.exp(1j * seen[:, 2])))
    off = seen - mean
    off[:, 2] = wrap_angle(off[:, 2])
    np.testing.assert_allclose(poses[2], mean, atol=1e-12)
    covariance = np.einsum("m,mij->ij", weights, turned) + (weights * off.T) @ off
    np.testing.assert_allclose(spreads[2], covariance, atol=1e-12)


def test_a_held_start_widens_what_is_seen_from_it_and_the_frame_does_not() -> None:
    """The pose is the particles' mixture with the start's share, whatever the estimate has of the frame's."""
    rng = np.random.default_rng(9)
    count, start = 9, np.array([2.0, -1.0, 2.5])
    starts, means = np.repeat(start[:, None], LANES, axis=1)[None], rng.uniform(-3.0, 3.0, (1, 3, LANES))
    covariances = np.repeat(np.array([0.2, 0.05, 0.0, 0.3, 0.0, 0.01])[:, None], LANES, axis=1)[None]
    weights = rng.dirichlet(np.ones(count))
    parts = np.zeros((3, LANES)), starts, means, np.zeros((3, LANES)), covariances
    robots = np.concatenate([rows.reshape(-1, 1, 3, LANES) for rows in parts])
    shown = pose_mixtures(means, covariances, weights)
    estimates = shown.copy()
    estimates.covariances[:] += 7.0
    scatter = np.array([[0.04, 0.01, -0.02], [0.01, 0.09, 0.03], [-0.02, 0.03, 0.05]])
    points, members = TeamPoses(1), np.array([[0], [1]])
    write_team_poses(robots, scatter[None], weights, 4, *estimates, members, points.poses, points.beliefs)
    expected = rotate_covariances(-start[2], shown.covariances)
    add_gauge_covariance(scatter, (own := between(start, shown.means)), expected)
    np.testing.assert_allclose(points.own, own, atol=1e-12)
    np.testing.assert_allclose(points.covariances, expected, atol=1e-12)
