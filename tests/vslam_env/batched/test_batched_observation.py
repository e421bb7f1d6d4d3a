"""Observations of batched teams: what the environment shows of the same belief, scans and grids."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from builders.batched import SIZE, jax, jnp, started

from slam_backend.fastslam.relative_poses import TeamPoses
from slam_backend.geometry import between, inverse, wrap_angle
from slam_backend.maps.landmark_map import MapSummary, TeamMapSummaries
from vslam_env.belief.belief import NO_FEATURES, BeliefBatch, position_sigma
from vslam_env.belief.observation import observe_team
from vslam_env.belief.observation_keys import key_spaces
from vslam_env.navigation import FREE, OCCUPIED, OccupancyGrid, TeamGrids, ray_directions
from vslam_env.navigation.global_grids import GlobalGrids

grids = pytest.importorskip("vslam_env.batched.grids")
observation = pytest.importorskip("vslam_env.batched.observation")
ANGLES, RANGE, RADIUS = tuple(np.linspace(-0.46, 0.46, 32).tolist()), 8.0, 0.2
ROBOTS, CONFIRM, KEYS = 3, 2, observation.KEYS


def painted(ranges: np.ndarray, poses: np.ndarray, bumps: np.ndarray) -> np.ndarray:
    """Return the evidence (S, S) of a batched grid after scans (T, R)."""

    @jax.jit
    def paint_all(evidence: Any, readings: Any) -> Any:
        def tick(so_far: Any, reading: Any) -> Any:
            pose, scan, bump = reading
            return grids.paint(so_far, pose, scan, bump, ANGLES, RANGE, RADIUS), None

        return jax.lax.scan(tick, evidence, readings)[0]

    empty = jnp.zeros((grids.GRID_SIZE, grids.GRID_SIZE), jnp.int8)
    return np.asarray(paint_all(empty, tuple(map(jnp.asarray, (poses, ranges, bumps)))))


def drawn_scans(seed: int, ticks: int = 60) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return scans (T, R) of straight walls with doors and of nothing, poses (T, 3), and bumps (T,)."""
    rng = np.random.default_rng(seed)
    ranges = np.empty((ticks, len(ANGLES)))
    for row in ranges:
        offset, slope = rng.uniform(1.0, 7.0), rng.uniform(-0.8, 0.8)
        wall = offset / (np.cos(ANGLES) + slope * np.sin(ANGLES))
        door = np.abs(np.arange(len(ANGLES)) - rng.integers(len(ANGLES))) < rng.integers(0, 6)
        row[:] = np.minimum(np.where(door, wall + rng.uniform(1.0, 9.0), wall), RANGE) * rng.normal(1.0, 0.01, len(row))
    poses = np.column_stack([rng.uniform(-20.0, 20.0, (ticks, 2)), rng.uniform(-np.pi, np.pi, ticks)])
    return np.minimum(ranges, RANGE), poses, rng.random(ticks) < 0.2


@pytest.mark.parametrize("seed", range(3))
def test_scans_are_painted_as_in_the_environment(seed: int) -> None:
    """Cells have the same state but for a few at the edges of rays, which rounding decides."""
    ranges, poses, bumps = drawn_scans(seed)
    exact, rays = TeamGrids(1), ray_directions(np.array(ANGLES))
    for scan, pose, bump in zip(ranges, poses, bumps, strict=True):
        exact.update(np.ones((1, 1), np.int64), pose[None, None], scan[None], np.array([bump]), rays, RANGE, RADIUS)
    expected = exact.arrays[1][0]
    found = painted(ranges, poses, bumps)
    states = np.where(found < 0, FREE, np.where(found > 0, OCCUPIED, 0))
    known = (expected > 0).sum()
    assert known > 10_000
    assert (states != expected).sum() < 2e-4 * known


def some_belief(seed: int) -> Any:
    """Return a belief of two robots that share a map and a third one, with random poses and landmarks."""
    rng = np.random.default_rng(seed)
    belief = started(ROBOTS, 32)
    robots = rng.normal(size=(ROBOTS, 8)) * [4.0, 4.0, 2.0, 0.02, 0.01, 3.0, 3.0, 2.0]
    size = len(belief.covariance)
    half = 0.05 * rng.normal(size=(size, size)) / np.sqrt(size)
    return belief._replace(
        robots=jnp.asarray(robots), places=jnp.asarray(rng.uniform(-6.0, 6.0, (32, 2))),
        covariance=jnp.asarray(half @ half.T), heights=jnp.asarray(rng.uniform(0.1, 0.4, (32, 2))),
        counts=jnp.asarray(rng.integers(0, 20, 32)), owners=jnp.asarray(rng.choice([0, 2], 32)),
        groups=jnp.asarray([0, 0, 2]), descriptors=jnp.ones((32, SIZE)),
    )  # fmt: skip


def seen_exactly(belief: Any, cells: np.ndarray, scans: np.ndarray, seconds_left: float) -> list[dict[str, Any]]:
    """Return what the environment shows of a belief."""
    robots, groups = np.asarray(belief.robots, float), np.asarray(belief.groups)
    among = np.asarray(belief.covariance, float)[: robots.size, : robots.size]
    told, maps = TeamPoses(ROBOTS), []
    told.poses.fill(np.nan)
    told.sigmas.fill(np.nan)
    for robot in range(ROBOTS):
        told.starts[robot], told.ess[robot] = inverse(robots[robot, 5:]), 1.0
        for other in np.flatnonzero(groups == groups[robot]).tolist():

            def place(values: np.ndarray, one: int = robot, two: int = other) -> np.ndarray:
                return between(values[one, 5:], values[two, :3])

            columns = []
            for i in range(robots.size):
                step = 1e-6 * np.eye(robots.size)[i].reshape(robots.shape)
                off = place(robots + step) - place(robots - step)
                off[2] = wrap_angle(off[2])
                columns.append(off / 2e-6)
            spread = np.column_stack(columns) @ among @ np.column_stack(columns).T
            told.poses[robot, other], told.sigmas[robot, other] = place(robots), position_sigma(spread)
            if other == robot:
                told.own[robot], told.covariances[robot] = place(robots), spread
        held = (np.asarray(belief.counts) >= CONFIRM) & (np.asarray(belief.owners) == groups[robot])
        variances = np.diagonal(np.asarray(belief.covariance))[robots.size :].reshape(-1, 2).sum(axis=1)
        heights = np.asarray(belief.heights)
        points = np.column_stack([np.asarray(belief.places), heights[:, 0]])
        counts = np.asarray(belief.counts, np.int64)
        summary = points, variances + heights[:, 1], counts, np.arange(len(counts))
        maps.append(MapSummary(*(values[held] for values in summary)))
    view = BeliefBatch(
        np.arange(ROBOTS), told, TeamMapSummaries.from_maps(maps), cells, GlobalGrids(ROBOTS),
        np.tile(NO_FEATURES, (ROBOTS, 1, 1)), scans, seconds_left,
    )  # fmt: skip
    return observe_team(view, KEYS)


@pytest.mark.parametrize("seed", range(3))
def test_the_environment_shows_the_same_of_a_belief(seed: int) -> None:
    """All keys agree within float32, pictures but for cells at edges, and lie in the spaces of the environment."""
    belief, rng = some_belief(seed), np.random.default_rng(seed)
    evidence = rng.integers(-8, 12, (ROBOTS, grids.GRID_SIZE, grids.GRID_SIZE)).astype(np.int8)
    scans = rng.uniform(0.0, RANGE, (ROBOTS, len(ANGLES)))
    states = np.where(evidence < 0, FREE, np.where(evidence > 0, OCCUPIED, 0)).astype(np.uint8)
    expected = seen_exactly(belief, states, scans, 42.0)
    see = jax.jit(partial(observation.observe, keys=KEYS, confirm_after=CONFIRM))
    found = see(belief, jnp.asarray(evidence), jnp.asarray(scans), jnp.asarray(42.0))
    spaces = key_spaces(len(ANGLES), RANGE)
    for key in KEYS:
        for robot in range(ROBOTS):
            value = np.asarray(found[key][robot])
            assert spaces[key].contains(value), key
            if key == "local_grid":
                assert (value != expected[robot][key]).mean() < 0.002
            else:
                np.testing.assert_allclose(value, expected[robot][key], rtol=2e-3, atol=2e-4, err_msg=key)


def test_cells_beyond_a_grid_are_unknown_and_none_is_written() -> None:
    """A robot far from its start neither reads nor writes the other side of its grid."""
    poses = np.array([[45.0, 0.0, 0.0], [29.9, 29.9, 0.8], [-29.9, -29.9, -2.4]])
    ranges = np.full((3, len(ANGLES)), 5.0)
    evidence = painted(ranges, poses, np.zeros(3, bool))
    assert (evidence[:140, 160:] == 0).all()
    assert (evidence[160:, :140] == 0).all()
    assert (np.asarray(grids.sample(jnp.asarray(evidence), jnp.asarray(poses[0]), jnp.zeros((1, 2)))) == 0).all()
    assert len(OccupancyGrid().cells) == grids.GRID_SIZE
