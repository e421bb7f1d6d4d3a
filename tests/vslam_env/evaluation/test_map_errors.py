"""Map errors, pose errors and coverage."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from builders.environments import MEETING, scored, small_env, standing_at, turning, wander

from slam_backend.core.validation import IntArray
from slam_backend.fastslam.reports import Associations
from slam_backend.geometry import compose, inverse, transform_points, wrap_angle
from slam_backend.maps.landmark_map import LandmarkMap, TeamMapSummaries
from slam_backend.metrics import map_error, map_rmse
from slam_backend.state import restore, take
from slam_backend.team.reports import LandmarkIdMap, LandmarksCreated, MapForked, MapReleased, TeamReport
from vslam_env.evaluation.coverage import CoverageCells, CoverageTracker
from vslam_env.evaluation.map_scores import GroundTruthAssociation
from vslam_env.navigation import FREE, OccupancyGrid, TeamGrids, cell_of

TRUTHS = np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.3], [0.0, 6.0, -0.2], [7.0, 7.0, 0.0], [9.0, 1.0, 0.0]])
COUNTABLE = np.array([True, True, False, True, True])
STAY = np.zeros(3)
MAP_SCORES = ("map_errors", "map_rmses", "map_recalls", "map_precisions", "accurate_recalls")


def _ids(*values: int) -> IntArray:
    return np.array(values, dtype=np.int64)


def _report(created: tuple[IntArray, ...], renamings: tuple[LandmarkIdMap, ...] = ()) -> TeamReport:
    robots = tuple(range(len(created)))
    entries = (*(LandmarksCreated(r, r, 0, ids) for r, ids in enumerate(created) if len(ids)), *renamings)
    associations = Associations.from_arrays(created, created)
    return TeamReport(0, associations, tuple((r,) for r in robots), (), renamings, robots, entries, 1)


def _map(means: np.ndarray, ids: IntArray) -> LandmarkMap:
    return LandmarkMap(means, np.tile(np.eye(3), (len(means), 1, 1)), np.zeros((len(means), 2)), ids=ids)


def _ground_truth() -> GroundTruthAssociation:
    """Return claims of two robots: the first holds 0, 1 and a false point, the second 1, 3 and what does not count."""
    ground_truth = GroundTruthAssociation(2, TRUTHS, COUNTABLE, 1.0)
    ground_truth.record(_report((_ids(0, 1, -1, 2), _ids(0, 1, 2))), np.array([[0, 1, 3, -1], [1, 3, 2, -1]]))
    return ground_truth


def _score(
    ground_truth: GroundTruthAssociation, robot: int, held: LandmarkMap, world_from_group: np.ndarray
) -> SimpleNamespace:
    """Score one robot's map, the others having none."""
    robots = len(ground_truth._map_of)
    maps, poses = [LandmarkMap.empty(2)] * robots, np.zeros((robots, 3))
    maps[robot], poses[robot] = held, world_from_group
    summaries = TeamMapSummaries.from_maps([each.summary for each in maps])
    scores = scored(ground_truth, summaries, standing_at(poses), np.zeros((robots, 3)), np.zeros((robots, 3)))
    return SimpleNamespace(**{name: getattr(scores, name)[robot] for name in MAP_SCORES})


def test_claims_follow_creation() -> None:
    """A landmark claims the true one whose measurement created it: -1 if that was false, -2 if it does not count."""
    ground_truth = _ground_truth()
    assert ground_truth.true_ids(0, _ids(0, 1, 2)).tolist() == [0, 1, -1]
    assert ground_truth.true_ids(1, _ids(2, 1, 0)).tolist() == [-2, 2, 1]  # of the four that count, 3 is the third


def test_maps_are_scored_at_the_true_start() -> None:
    """From the true start on; whatever the order of the parts, and whether robots share one."""
    rng = np.random.default_rng(100)
    ground_truth = _ground_truth()
    starts, true_starts = rng.uniform(-2.0, 2.0, (2, 2, 3))
    held = [_map(rng.normal(TRUTHS[:3], 0.1), np.arange(3)), _map(rng.normal(TRUTHS[:2], 0.1), np.arange(2))]
    there = inverse(compose(true_starts, starts))
    summaries = [
        each.summary._replace(means=transform_points(pose, each.means)) for each, pose in zip(held, there, strict=True)
    ]
    rows, parts = TeamMapSummaries.from_maps(summaries[::-1])
    nowhere = np.zeros((2, 3))
    scores = scored(ground_truth, TeamMapSummaries(rows, parts[::-1].copy()), standing_at(starts), true_starts, nowhere)
    for robot in range(2):
        expected = vars(_score(ground_truth, robot, held[robot], np.zeros(3)))
        for name in MAP_SCORES:
            np.testing.assert_allclose(getattr(scores, name)[robot], expected[name], atol=1e-12)
    ground_truth.merge(LandmarkIdMap((0,), (1,), np.array([[0, 1], [1, 3], [2, 4]]), (0, 1, 2)))
    joint = TeamMapSummaries(rows, np.array([parts[1], parts[1]]))
    scores = scored(ground_truth, joint, standing_at(starts[[0, 0]]), true_starts[[0, 0]], nowhere)
    expected = vars(_score(ground_truth, 0, held[0], np.zeros(3)))
    for robot in range(2):
        for name in MAP_SCORES:
            np.testing.assert_allclose(getattr(scores, name)[robot], expected[name], atol=1e-12)


def test_claims_follow_a_merge() -> None:
    """At a merge landmarks of a keep their claims, fused ones too, and those of b bring theirs under their new ids."""
    ground_truth = _ground_truth()
    ground_truth.merge(LandmarkIdMap((0,), (1,), np.array([[0, 1], [1, 3], [2, 4]]), (0, 1, 2)))
    assert ground_truth.true_ids(0, _ids(0, 1, 2, 3, 4)).tolist() == [0, 1, -1, 2, -2]


def test_claims_follow_copies_deletions_and_snapshots() -> None:
    """Whatever is copied, dropped or filled, a map claims what its landmarks were created as; so from a snapshot on."""
    rng = np.random.default_rng(8)
    ground_truth, numbers = GroundTruthAssociation(2, TRUTHS, COUNTABLE, 1.0), [0, 1]
    plain: dict[int, dict[int, int]] = {0: {}, 1: {}}
    for turn in range(2, 200):
        into, step = int(rng.choice(numbers)), 2 * turn
        true_ids = rng.integers(-1, 5, 2)
        ids = max(plain[into], default=-1) + np.array([1, 2 + rng.integers(3)])
        entries: list[Any] = [LandmarksCreated(into, 0, step, ids)]
        claims = [-1 if true < 0 else (0, 1, -2, 2, 3)[true] for true in true_ids]
        plain[into] |= dict(zip(ids.tolist(), claims, strict=True))
        if turn % 3 == 0:
            entries.append(MapForked(into, turn))
            plain[turn] = dict(plain[into])
            numbers.append(turn)
        if len(numbers) > 4:
            entries.append(MapReleased(numbers.pop(0)))
        maps = tuple(rng.choice(numbers, 2).tolist())
        associations = Associations.from_arrays([ids, _ids()], [ids, _ids()])
        report = TeamReport(step, associations, ((0,), (1,)), (), (), maps, tuple(entries), step + 1)
        ground_truth.record(report, np.vstack([true_ids, true_ids]))
        if turn % 50 == 0:
            state, ground_truth = take(ground_truth), GroundTruthAssociation(2, TRUTHS, COUNTABLE, 1.0)
            restore(ground_truth, state)
        for robot, number in enumerate(maps):
            expected = plain[number]
            assert ground_truth.true_ids(robot, np.array([*expected], np.int64)).tolist() == [*expected.values()]


def test_a_fused_false_landmark_stays_false() -> None:
    """What a false point created is false, even if the other map's landmark fused into it was a true one."""
    ground_truth = _ground_truth()
    ground_truth.merge(LandmarkIdMap((0,), (1,), np.array([[0, 2], [1, 3], [2, 4]]), (0, 1, 2)))
    assert ground_truth.true_ids(0, _ids(2)).tolist() == [-1]


def test_scores_agree_with_the_metrics() -> None:
    """The compiled score is that of `map_error` and `map_rmse`, whatever is claimed, twice or not at all."""
    rng = np.random.default_rng(3)
    for _ in range(50):
        truths, countable = rng.uniform(-5.0, 5.0, (9, 3)), rng.random(9) < 0.8
        countable[0] = True
        ground_truth = GroundTruthAssociation(1, truths, countable, 0.8)
        held = rng.integers(-1, 9, 13)
        ids = np.arange(13)
        ground_truth.record(_report((ids,)), held[None])
        pose = rng.uniform(-3.0, 3.0, 3)
        means = transform_points(pose, truths[held] + rng.normal(0.0, 0.4, (13, 3)))
        claims = ground_truth.true_ids(0, ids)
        score = _score(ground_truth, 0, _map(means, ids), inverse(pose))
        placed = transform_points(inverse(pose), means)
        matched = map_rmse(placed, ground_truth.true_positions, claims=claims)
        assert np.isclose(score.map_errors, map_error(placed, claims, ground_truth.true_positions, 0.8))
        assert np.isclose(score.map_rmses, matched.rmse if len(matched.matched) else 0.8)
        assert np.allclose((score.map_recalls, score.map_precisions), (matched.recall, matched.precision))
        nothing = _score(ground_truth, 0, LandmarkMap.empty(2), STAY)
        assert np.isclose(nothing.map_errors, 0.8 * np.sqrt(0.5))
        assert (nothing.map_rmses, nothing.map_recalls, nothing.map_precisions) == (0.8, 0.0, 0.0)
        errors = np.linalg.norm(
            placed[matched.matched[:, 0]] - ground_truth.true_positions[matched.matched[:, 1]], axis=1
        )
        assert np.isclose(score.accurate_recalls, np.count_nonzero(errors < 0.5) / len(ground_truth.true_positions))


def test_pose_errors_are_differences_of_placed_poses() -> None:
    """An estimated pose, laid at the true start, is compared with the true pose; beside it stands the own sigma."""
    rng = np.random.default_rng(4)
    starts, estimated, true = rng.uniform(-4.0, 4.0, (3, 20, 3))
    team_poses = standing_at(np.zeros((20, 3)))
    team_poses.own[:], team_poses.sigmas[:] = estimated, rng.random((20, 20))
    ground_truth = GroundTruthAssociation(20, TRUTHS, COUNTABLE, 1.0)
    summaries = TeamMapSummaries.from_maps([LandmarkMap.empty(2).summary] * 20)
    scores = scored(ground_truth, summaries, team_poses, starts, true)
    placed = compose(starts, estimated)
    np.testing.assert_allclose(scores.pose_errors, np.linalg.norm(placed[:, :2] - true[:, :2], axis=1))
    np.testing.assert_allclose(scores.heading_errors, np.abs(wrap_angle(placed[:, 2] - true[:, 2])))
    np.testing.assert_array_equal(scores.pose_sigmas, team_poses.sigmas.diagonal())


def test_infos_agree_with_the_own_start_frame() -> None:
    """In a running episode E is that of the belief's own map, laid at the true start pose, before and after a merge."""
    env = small_env(max_cycles=400)
    env.reset(seed=5, options={"start_poses": MEETING})
    for step in range(120):
        infos = env.step(turning(env.agents))[4]
        if step % 40 == 39:
            for robot, agent in enumerate(env.agents):
                belief, ground_truth = env.belief(agent), env.episode.ground_truth
                placed = belief.map.moved(env.true_start_poses[robot])
                score = _score(ground_truth, robot, placed, STAY)
                assert np.isclose(infos[agent]["map_error"], score.map_errors)
    assert any(event.kind == "merge" for event in env.events)


def _plain_share(centres: np.ndarray, starts: np.ndarray, grids: list[OccupancyGrid]) -> float:
    """Return the coverage by looking up each place in each grid."""
    seen = np.zeros(len(centres), np.bool_)
    for start, grid in zip(starts, grids, strict=True):
        size = len(grid.cells)
        cells = cell_of(transform_points(inverse(start), centres), size)
        inside = ((cells >= 0) & (cells < size)).all(axis=1)
        seen[inside] |= grid.cells[tuple(cells[inside].T)] == FREE
    return float(seen.mean())


def test_coverage_is_a_union() -> None:
    """Floor counts once however many robots see it, whatever happens to their grids, as a plain look-up says."""
    rng = np.random.default_rng(6)
    centres = rng.uniform(-35.0, 35.0, (2000, 2))  # some lie outside a robot's grid
    starts = rng.uniform(-3.0, 3.0, (3, 3))
    team = TeamGrids(3)
    grids = team.grids
    meter = CoverageCells(centres, starts)
    coverage, shares = CoverageTracker(meter), []
    kept = take(grids[1])
    angles = np.linspace(-0.6, 0.6, 32)
    for turn in range(40):
        for grid in grids:
            pose = rng.uniform(-25.0, 25.0, 3)
            if turn % 2:
                grid.clear_disc(pose, 2.0)
            else:
                grid.update_from_scan(pose, rng.uniform(2.0, 9.0, 32), angles)
        if turn % 7 == 3:
            grids[0].merge(grids[2], rng.uniform(-1.0, 1.0, 3))
        if turn in (20, 30):
            restore(grids[1], kept)
        coverage.update(team, starts)
        shares.append(coverage.share)
        assert shares[-1] == _plain_share(centres, starts, grids)
    assert shares[-1] > 0.1
    assert min(np.diff(shares)) < 0.0  # walls were seen where floor had been, and a grid was restored
    fresh = CoverageTracker(meter)
    assert fresh.share_now(team) == shares[-1]
    assert fresh.share == 0.0


SQUARES = np.stack(np.meshgrid(np.arange(0.1, 8.0, 0.2), np.arange(0.1, 4.0, 0.2)), -1).reshape(-1, 2)


def test_newly_covered_cells_agree_with_a_plain_count() -> None:
    """However grids change, each cell counts once, for the robot that is nearest when it is first seen."""
    rng = np.random.default_rng(2)
    starts = rng.uniform(0.0, 6.0, (3, 3))
    cells, team = CoverageCells(SQUARES, starts), TeamGrids(3)
    coverage = CoverageTracker(cells)
    ever, found, angles = np.zeros(len(SQUARES), np.bool_), np.zeros(3), np.linspace(-0.6, 0.6, 32)
    for turn in range(60):
        for grid in team.grids:
            pose = np.append(rng.uniform(-3.0, 3.0, 2), rng.uniform(-3.0, 3.0))
            grid.update_from_scan(pose, rng.uniform(0.5, 3.0, 32), angles)
        if turn == 30:
            restore(coverage, take(coverage))
        positions = rng.uniform(0.0, 8.0, (3, 2))
        said, seen = coverage.update(team, positions), cells.seen(team).any(axis=0)
        fresh = seen & ~ever
        nearest = np.hypot(*np.moveaxis(SQUARES[:, None] - positions, -1, 0)).argmin(axis=1)
        found += np.bincount(nearest[fresh], minlength=3) / len(SQUARES)
        ever |= fresh
        np.testing.assert_allclose(said, found)
        assert coverage.share == np.mean(seen)
    assert ever.mean() > 0.3


@pytest.mark.parametrize(("changes", "exact"), [
    ({"max_cycles": 37}, {10, 20, 30, 37}), ({"max_cycles": 13, "decision_ticks": 3}, {12, 21, 30, 39}),
    ({"max_cycles": 37, "reward": {"coverage": 1.0}}, set(range(1, 38))),
    ({"action_type": "goal", "max_cycles": 4}, {10, 20, 30, 40}),
])  # fmt: skip
def test_coverage_is_found_once_a_second_or_when_it_is_read(changes: dict[str, Any], exact: set[int]) -> None:
    """It is exact after the ticks named, also after a restore, and else that of the last of them; `state` always is."""
    env, twin = (small_env(**changes) for _ in range(2))
    expected = env.reset(seed=4)[1]["robot_0"]["coverage"]
    rng = np.random.default_rng(3)
    while env.agents:
        if env.episode.tick in (13, 15):
            twin.set_state(env.get_state())
            env, twin = twin, env
        infos = env.step(wander(env, rng))[4]
        episode = env.episode
        share = episode.coverage.share_now(episode.belief.grids)
        expected = share if episode.tick in exact else expected
        assert infos["robot_0"]["coverage"] == infos["robot_1"]["coverage"] == expected
        assert env.state()[-2] == np.float32(share)
    assert expected > 0.05


def test_own_coverage_sums_to_team_coverage_and_survives_snapshots() -> None:
    """Own coverage is never negative, sums over the robots to all that was covered, and goes on after a restore."""
    weights = {"own_coverage": 1.0, "coverage": 1.0}
    env, fresh = (small_env(max_cycles=60, reward=weights) for _ in range(2))
    env.reset(seed=4)
    actions = {agent: np.array([0.8, 0.3 - 0.4 * robot], np.float32) for robot, agent in enumerate(env.agents)}
    own, risen = [], []
    for step in range(60):
        if step == 30:
            fresh.set_state(env.get_state())
        infos = env.step(actions)[4]
        own.append([info["reward/own_coverage"] for info in infos.values()])
        risen.append(infos["robot_0"]["reward/coverage"])
    assert np.min(own) >= 0.0
    assert np.sum(risen) <= np.sum(own) < 1.05 * np.sum(risen)  # cells at its rim are lost and seen again
    later = [[info["reward/own_coverage"] for info in fresh.step(actions)[4].values()] for _ in range(30)]
    np.testing.assert_array_equal(later, own[30:])
