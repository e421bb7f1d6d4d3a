"""What batched robots observe: the same keys, units and frames as in the environment, see `ExplorationEnv`."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from vslam_env.batched.belief import START, Belief, rotation, wrapped
from vslam_env.batched.grids import sample
from vslam_env.belief._observation_kernels import (
    COUNT_BINS,
    GRID_ON,
    MAP_STATS_LIMIT,
    MAX_POSITION,
    MAX_SECONDS_LEFT,
    MAX_TEAMMATES,
    POSE_LIMIT,
    SIZE,
)
from vslam_env.belief.observation_keys import DRIVER
from vslam_env.navigation import CELL

KEYS = (*DRIVER, "landmark_counts", "time_left")  # those that batched teams know


def relative(pose: Array, other: Array) -> Array:
    """Return a pose (3,) in the frame of another one."""
    return jnp.concatenate([rotation(-pose[2]) @ (other[:2] - pose[:2]), wrapped(other[2:] - pose[2:])])


def in_start_frame(robots: Array, robot: Array, other: Array) -> Array:
    """Return the pose (3,) of a robot of a team (K, 8) in the start frame of another one."""
    return relative(robots[robot, START:], robots[other, :3])


def observe(
    belief: Belief, grids: Array, scans: Array, seconds_left: Array, keys: tuple[str, ...], confirm_after: int
) -> dict[str, Array]:
    """Return what all robots observe, by key, arrays with a first dimension K.

    Args:
        belief: Belief of the team.
        grids: (K, S, S) int8. Evidence of the robots' grids; read for `local_grid` alone.
        scans: (K, R) [m].
        seconds_left: () [s]. Time until the episode is truncated.
        keys: Keys to observe, some of `KEYS`.
        confirm_after: Number of measurements after which a landmark belongs to a map.
    """
    count, size = len(belief.groups), belief.robots.size
    among = belief.covariance[:size, :size]

    def spread(robot: Array, other: Array) -> Array:
        """Return the covariance (3, 3) of a pose in a start frame."""
        by = jax.jacfwd(in_start_frame)(belief.robots, robot, other).reshape(3, size)
        return by @ among @ by.T

    robots = jnp.arange(count)
    every = partial(jax.vmap, in_axes=(0, None))
    poses = every(jax.vmap(partial(in_start_frame, belief.robots), (None, 0)))(robots, robots)
    spreads = every(jax.vmap(spread, (None, 0)))(robots, robots)
    held = (belief.counts >= confirm_after) & (belief.owners == belief.groups[:, None])
    own, mates = (robots, robots), jax.vmap(partial(_teammates, belief.groups))(robots, poses, spreads)
    of_key: dict[str, Callable[[], Array]] = {
        "pose": lambda: jnp.clip(poses[own], -POSE_LIMIT, POSE_LIMIT),
        "pose_std": lambda: jnp.clip(jnp.sqrt(jnp.diagonal(spreads[own], axis1=1, axis2=2)), 0.0, POSE_LIMIT),
        "map_stats": lambda: jax.vmap(partial(_map_stats, belief))(robots, held),
        "local_grid": lambda: jax.vmap(partial(_local_grid, belief))(robots, held, grids, poses[own]),
        "scan": lambda: scans,
        "teammates": lambda: mates[0],
        "teammates_mask": lambda: mates[1],
        "landmark_counts": lambda: jax.vmap(partial(_landmark_counts, belief))(held),
        "time_left": lambda: jnp.full((count, 1), jnp.minimum(seconds_left, MAX_SECONDS_LEFT)),
    }
    return {key: of_key[key]() for key in keys}


def _map_stats(belief: Belief, robot: Array, held: Array) -> Array:
    """Return the statistics (6,) of a robot's map; a Gaussian counts as a full effective sample."""
    first, count = belief.first_place, held.sum()
    variances = jnp.diagonal(belief.covariance)[first:].reshape(-1, 2).sum(axis=1) + belief.heights[:, 1]
    sigmas = jnp.where(held, jnp.sqrt(jnp.maximum(variances, 0.0) / 3.0), 0.0)
    shares = jnp.maximum(count, 1)
    stats = jnp.stack([
        count, sigmas.sum() / shares, sigmas.max(), jnp.where(held, belief.counts, 0).sum() / shares, 1.0,
        (belief.groups == belief.groups[robot]).sum(),
    ])  # fmt: skip
    return jnp.clip(stats.astype(jnp.float32), 0.0, MAP_STATS_LIMIT)


def _landmark_counts(belief: Belief, held: Array) -> Array:
    """Return how many landmarks (5,) were measured how often."""
    bins = jnp.searchsorted(jnp.asarray(COUNT_BINS), belief.counts, side="right") - 1
    counts = (held[:, None] & (bins[:, None] == jnp.arange(len(COUNT_BINS)))).sum(axis=0)
    return counts.astype(jnp.float32)


def _teammates(groups: Array, robot: Array, poses: Array, spreads: Array) -> tuple[Array, Array]:
    """Return the rows (7, 5) of the other robots, given all poses (K, 3) in the robot's start frame, and the mask."""
    count = len(groups)
    others = jnp.arange(count - 1) + (jnp.arange(count - 1) >= robot)
    seen = jax.vmap(relative, (None, 0))(poses[robot], poses[others])
    sigmas = jnp.sqrt(0.5 * (spreads[others, 0, 0] + spreads[others, 1, 1]))
    rows = jnp.column_stack([seen[:, :2], jnp.cos(seen[:, 2]), jnp.sin(seen[:, 2]), sigmas])
    present, empty = groups[others] == groups[robot], MAX_TEAMMATES - (count - 1)
    rows = jnp.where(present[:, None], jnp.clip(rows, -MAX_POSITION, MAX_POSITION), 0.0)
    return jnp.pad(rows, ((0, empty), (0, 0))), jnp.pad(present.astype(jnp.int8), (0, empty))


def _local_grid(belief: Belief, robot: Array, held: Array, grid: Array, pose: Array) -> Array:
    """Return the picture (3, 48, 48) uint8 of what a robot knows around it."""
    along = (0.5 * SIZE - 0.5 - np.arange(SIZE)) * CELL
    evidence = sample(grid, pose, jnp.asarray(np.stack(np.meshgrid(along, along, indexing="ij"), axis=-1)))
    away = (belief.places - belief.robots[robot, :2]) @ rotation(belief.robots[robot, 2])
    row, column = jnp.floor(0.5 * SIZE - away.T / CELL).astype(jnp.int32)
    inside = held & (jnp.minimum(row, column) >= 0)
    landmarks = jnp.zeros((SIZE, SIZE), jnp.bool_).at[jnp.where(inside, row, SIZE), column].set(True, mode="drop")
    return jnp.stack([evidence < 0, evidence > 0, landmarks]).astype(jnp.uint8) * jnp.uint8(GRID_ON)
