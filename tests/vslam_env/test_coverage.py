"""Who found which floor: cells are found once, by the robot nearest to them, and snapshots keep it."""

import numpy as np

from slam_backend.core.validation import FloatArray
from tests.vslam_env.small_env import small_env
from vslam_env.evaluation.coverage import SEERS, Coverage, CoverageMeter
from vslam_env.navigation import TeamGrids

STARTS = np.array([[1.0, 2.0, 0.0], [7.0, 2.0, np.pi]])
SQUARES = np.stack(np.meshgrid(np.arange(0.1, 8.0, 0.2), np.arange(0.1, 4.0, 0.2)), -1).reshape(-1, 2)


def _looked(coverage: Coverage, team: TeamGrids, robot: int, x: float) -> FloatArray:
    """Let a robot see a disc around (x, 2), and return what each robot has found, robot 0 standing at x = 1."""
    own = x - STARTS[0, 0] if robot == 0 else STARTS[1, 0] - x  # robot 1 looks the other way
    team.grids[robot].clear_disc(np.array([own, 0.0, 0.0]), 0.5)
    found = np.empty(2)
    coverage.update(team, STARTS[:, :2], found)
    return found


def test_floor_is_found_once_by_the_nearest() -> None:
    """A cell counts once, for the robot nearest to it when it is first seen, whoever saw it."""
    coverage, team = Coverage(CoverageMeter(SQUARES, STARTS)), TeamGrids(2)
    disc = np.mean((np.hypot(*(SQUARES - [1.0, 2.0]).T)) < 0.5)
    first = _looked(coverage, team, robot=0, x=1.0)
    np.testing.assert_allclose(first, [disc, 0.0], rtol=0.2)
    assert np.array_equal(_looked(coverage, team, robot=1, x=1.0), first)
    np.testing.assert_allclose(_looked(coverage, team, robot=0, x=5.0), [first[0], first[0]], rtol=0.2)


def test_finds_are_those_of_a_plain_count() -> None:
    """However grids change, each cell counts once for the nearest robot, as a look at all cells every time says."""
    rng = np.random.default_rng(2)
    starts = rng.uniform(0.0, 6.0, (3, 3))
    coverage, team = Coverage(CoverageMeter(SQUARES, starts)), TeamGrids(3)
    ever, found, angles = np.zeros(len(SQUARES), np.bool_), np.zeros(3), np.linspace(-0.6, 0.6, 32)
    for turn in range(60):
        for grid in team.grids:
            pose = np.append(rng.uniform(-3.0, 3.0, 2), rng.uniform(-3.0, 3.0))
            grid.paint_scan(pose, rng.uniform(0.5, 3.0, 32), angles)
        if turn == 30:
            coverage.set_state(coverage.get_state())
        positions = rng.uniform(0.0, 8.0, (3, 2))
        said = np.empty(3)
        share = coverage.update(team, positions, said)
        fresh = (coverage._floor[SEERS] > 0) & ~ever
        nearest = np.hypot(*np.moveaxis(SQUARES[:, None] - positions, -1, 0)).argmin(axis=1)
        found += np.bincount(nearest[fresh], minlength=3) / len(SQUARES)
        ever |= fresh
        np.testing.assert_allclose(said, found)
        assert share == np.mean(coverage._floor[SEERS] > 0)
    assert ever.mean() > 0.3


def test_parts_sum_up_and_snapshots_keep_them() -> None:
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
