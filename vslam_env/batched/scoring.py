"""Errors of the maps of a team, see `vslam_env.evaluation.map_scores`."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from vslam_env.batched.belief import START, Belief


class Truth(NamedTuple):
    """What maps are compared with.

    Attributes:
        landmarks: (N, 3) float32 [m], world frame.
        observable: (N,) bool. Landmarks that count.
        starts: (K, 3) float32 [m, m, rad], world frame. True starts.
    """

    landmarks: Array
    observable: Array
    starts: Array


class Scores(NamedTuple):
    """Map error E (K,) [m], RMS error of the matched landmarks (K,) [m], and recall (K,) of each robot's map."""

    map_errors: Array
    map_rmses: Array
    map_recalls: Array


def score(belief: Belief, truth: Truth, confirm_after: int, cutoff: float) -> Scores:
    """Return the errors of the maps in the robots' own start frames, without a fit; see `slam_backend.metrics`.

    Args:
        confirm_after: Number of measurements after which a landmark belongs to a map.
        cutoff: c [m].
    """
    return Scores(*jax.vmap(_score, (None, 0, None, None, None))(
        belief, jnp.arange(len(belief.groups)), truth, confirm_after, cutoff
    ))  # fmt: skip


def _score(belief: Belief, robot: Array, truth: Truth, confirm_after: int, cutoff: float) -> tuple[Array, ...]:
    """Return the errors of one robot's map."""
    true_start, start = truth.starts[robot], belief.robots[robot, START:]
    turn = true_start[2] - start[2]
    c, s = jnp.cos(turn), jnp.sin(turn)
    away = belief.places - start[:2]
    x = true_start[0] + c * away[:, 0] - s * away[:, 1]
    y = true_start[1] + s * away[:, 0] + c * away[:, 1]
    counted = truth.observable[belief.true_ids] | (belief.true_ids < 0)
    held = (belief.counts >= confirm_after) & (belief.owners == belief.groups[robot]) & counted
    real = held & (belief.true_ids >= 0)
    off = jnp.column_stack([x, y, belief.heights[:, 0]]) - truth.landmarks[belief.true_ids]
    squares = jnp.where(real, (off**2).sum(axis=1), jnp.inf)
    total = len(truth.landmarks)
    smallest = jnp.full(total, jnp.inf).at[jnp.where(real, belief.true_ids, total)].min(squares, mode="drop")
    matched = jnp.isfinite(smallest)
    count, number = matched.sum(), truth.observable.sum()
    surplus = held.sum() - count  # false landmarks and duplicates
    within = jnp.where(matched, jnp.minimum(smallest, cutoff**2), 0.0).sum()
    error = jnp.sqrt((within + 0.5 * cutoff**2 * (surplus + number - count)) / number)
    rmse = jnp.sqrt(jnp.where(matched, smallest, 0.0).sum() / jnp.maximum(count, 1))
    return error, jnp.where(count > 0, rmse, cutoff), count / number
