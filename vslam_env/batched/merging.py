"""Merging of two groups within one Gaussian: the motion between their frames, and landmarks that are held twice."""

import jax
import jax.numpy as jnp
from jax import Array

from vslam_env.batched.belief import ROBOT, START, Belief, conditioned, rotation, symmetric

EQUAL = 1e-2  # [m] standard deviation of the difference of both copies of a landmark; float32 needs as much


def moved_group(belief: Belief, group: Array, motion: Array) -> Belief:
    """Return the belief with a group in another frame, p' = R(theta) p + t.

    Args:
        group: () int32. First robot of the group.
        motion: (3,) [m, m, rad]. Motion (tx, ty, theta) from the group's frame to the new one.
    """
    shift, turn = motion[:2], motion[2]
    matrix = rotation(turn)
    robots = belief.groups == group
    rows = (belief.owners == group) & (belief.counts > 0)
    of_robot, turned = jnp.eye(ROBOT), belief.robots
    for first in (0, START):  # its pose and its start
        at = slice(first, first + 2)
        of_robot = of_robot.at[at, at].set(matrix)
        turned = turned.at[:, at].set(belief.robots[:, at] @ matrix.T + shift).at[:, first + 2].add(turn)
    by_robots = jnp.where(robots[:, None, None], of_robot, jnp.eye(ROBOT))
    by_places = jnp.where(rows[:, None, None], matrix, jnp.eye(2))
    half = _rotated(belief.covariance, by_robots, by_places)
    moved = _rotated(half.T, by_robots, by_places)
    return belief._replace(
        robots=jnp.where(robots[:, None], turned, belief.robots),
        places=jnp.where(rows[:, None], belief.places @ matrix.T + shift, belief.places),
        covariance=symmetric(moved),
    )


def lever_of(belief: Belief, group: Array, centre: Array) -> Array:
    """Return the derivatives (n, 3) of all variables by a group's motion: a shift, and a turn about a centre (2,)."""
    robots = jnp.zeros((len(belief.groups), ROBOT, 3))
    for first in (0, START):
        robots = robots.at[:, first : first + 2].set(levers(belief.robots[:, first : first + 2] - centre))
        robots = robots.at[:, first + 2, 2].set(1.0)
    of_robots = jnp.where((belief.groups == group)[:, None, None], robots, 0.0)
    rows = (belief.owners == group) & (belief.counts > 0)
    of_places = jnp.where(rows[:, None, None], levers(belief.places - centre), 0.0)
    return jnp.concatenate([of_robots.reshape(-1, 3), of_places.reshape(-1, 3)])


def levers(away: Array) -> Array:
    """Return the derivatives (m, 2, 3) of positions (m, 2), from the centre, by a motion."""
    by = jnp.zeros((len(away), 2, 3)).at[:, 0, 0].set(1.0).at[:, 1, 1].set(1.0)
    return by.at[:, 0, 2].set(-away[:, 1]).at[:, 1, 2].set(away[:, 0])


def _rotated(matrix: Array, by_robots: Array, by_places: Array) -> Array:
    """Return J M for a block-diagonal J with blocks (K, 8, 8) and (R, 2, 2)."""
    first, columns = by_robots.shape[0] * ROBOT, matrix.shape[1]
    robots = jnp.einsum("kij,kjn->kin", by_robots, matrix[:first].reshape(-1, ROBOT, columns))
    places = jnp.einsum("rij,rjn->rin", by_places, matrix[first:].reshape(-1, 2, columns))
    return jnp.concatenate([robots.reshape(-1, columns), places.reshape(-1, columns)])


def fused(belief: Belief, pairs: Array, valid: Array, lever: Array) -> Belief:
    """Return the belief with both copies of landmarks as one; the rows of the second copies become free.

    If a group has been moved to the frame of another one, the motion is unknown but for what the copies tell: its prior
    is flat, so that nothing is counted twice. Given the motion this is conditioning, and what the copies tell of it
    comes on top:

        y = H x - L m,  W = (H P H^T + R)^-1,  m = -(L^T W L)^-1 L^T W y.

    Args:
        pairs: (q, 2) int32. Rows of the copies, in one frame, one-to-one.
        valid: (q,) bool. Pairs that count.
        lever: (n, 3). Derivatives of the variables by the unknown motion, see `lever_of`; zeros without one.
    """
    rows, first = len(belief.counts), belief.first_place
    kept, other = (jnp.where(valid, column, rows) for column in pairs.T)
    is_valid = jnp.repeat(valid, 2)
    in_a, in_b = (jnp.where(is_valid, (first + 2 * column[:, None] + jnp.arange(2)).ravel(), 0) for column in pairs.T)
    gain = jnp.where(is_valid, belief.covariance[:, in_a] - belief.covariance[:, in_b], 0.0)  # P H^T, H = (1, -1)
    innovation = jnp.where(is_valid[:, None], gain[in_a] - gain[in_b], 0.0)
    innovation += jnp.diag(jnp.where(is_valid, EQUAL**2, 1.0))
    off = jnp.where(valid[:, None], belief.places[pairs[:, 1]] - belief.places[pairs[:, 0]], 0.0).ravel()
    by_motion = jnp.where(is_valid[:, None], lever[in_b] - lever[in_a], 0.0)  # L
    lower = jnp.linalg.cholesky(symmetric(innovation))
    inverse = jax.scipy.linalg.solve_triangular(lower, jnp.eye(len(lower)), lower=True)
    half = inverse @ by_motion
    is_known = 1.0 * ~(lever != 0.0).any()  # no motion: any regular matrix
    spread = jnp.linalg.inv(half.T @ half + is_known * jnp.eye(3))
    motion = -spread @ half.T @ (inverse @ off)
    after = conditioned(belief, gain, innovation, off + by_motion @ motion)
    by = gain @ (inverse.T @ half) + lever
    change, more = lever @ motion, by @ spread @ by.T
    free = jnp.zeros(rows, jnp.bool_).at[other].set(True, mode="drop")
    gone = jnp.concatenate([jnp.zeros(first, jnp.bool_), jnp.repeat(free, 2)])
    counts = belief.counts.at[kept].add(belief.counts[pairs[:, 1]], mode="drop")
    return after._replace(
        robots=after.robots + change[:first].reshape(-1, ROBOT), places=after.places + change[first:].reshape(-1, 2),
        covariance=jnp.where(gone[:, None] | gone, 0.0, after.covariance + symmetric(more)),
        heights=belief.heights.at[kept].set(_fused(belief.heights, pairs), mode="drop"),
        counts=jnp.where(free, 0, counts),
    )  # fmt: skip


def _fused(heights: Array, pairs: Array) -> Array:
    """Return heights (q, 2) and variances of pairs of independent estimates."""
    one, other = heights[pairs[:, 0]], heights[pairs[:, 1]]
    share = one[:, 1] / (one[:, 1] + other[:, 1])
    return jnp.stack([one[:, 0] + share * (other[:, 0] - one[:, 0]), share * other[:, 1]], axis=-1)
