"""Merging of two groups within one Gaussian: the motion between their frames, and landmarks that both hold."""

import jax.numpy as jnp
from jax import Array

from vslam_env.batched.belief import ROBOT, Belief, conditioned

LOOSE = 10.0  # standard deviations of the alignment that are assumed of the motion before common landmarks tell it
EQUAL = 1e-3  # [m] standard deviation of the difference of both copies of a landmark


def moved_group(belief: Belief, group: Array, motion: Array, covariance: Array) -> Belief:
    """Return the belief with a group in another frame, p' = R(theta) p + t.

    Args:
        group: () int32. First robot of the group.
        motion: (3,) [m, m, rad]. Motion (tx, ty, theta) from the group's frame to the new one.
        covariance: (3, 3). Covariance of the motion, which is independent of all else.
    """
    x, y, turn = motion
    c, s = jnp.cos(turn), jnp.sin(turn)
    rotation = jnp.array([[c, -s], [s, c]])
    robots = belief.groups == group
    rows = (belief.owners == group) & (belief.counts > 0)
    positions = belief.robots[:, :2] @ rotation.T
    places = belief.places @ rotation.T
    poses = jnp.concatenate([positions + jnp.stack([x, y]), belief.robots[:, 2:3] + turn, belief.robots[:, 3:]], axis=1)
    of_robot = jnp.eye(ROBOT).at[:2, :2].set(rotation)
    by_robots = jnp.where(robots[:, None, None], of_robot, jnp.eye(ROBOT))
    by_places = jnp.where(rows[:, None, None], rotation, jnp.eye(2))
    half = _rotated(belief.covariance, by_robots, by_places)
    turned = _rotated(half.T, by_robots, by_places)
    lever = jnp.concatenate([_lever(positions, robots, ROBOT).reshape(-1, 3), _lever(places, rows, 2).reshape(-1, 3)])
    spread = lever @ covariance @ lever.T
    return belief._replace(
        robots=jnp.where(robots[:, None], poses, belief.robots),
        places=jnp.where(rows[:, None], places + jnp.stack([x, y]), belief.places),
        covariance=0.5 * (turned + turned.T) + 0.5 * (spread + spread.T),
    )


def _rotated(matrix: Array, by_robots: Array, by_places: Array) -> Array:
    """Return J M for a block-diagonal J with blocks (K, 5, 5) and (R, 2, 2)."""
    first, columns = by_robots.shape[0] * ROBOT, matrix.shape[1]
    robots = jnp.einsum("kij,kjn->kin", by_robots, matrix[:first].reshape(-1, ROBOT, columns))
    places = jnp.einsum("rij,rjn->rin", by_places, matrix[first:].reshape(-1, 2, columns))
    return jnp.concatenate([robots.reshape(-1, columns), places.reshape(-1, columns)])


def _lever(rotated: Array, used: Array, size: int) -> Array:
    """Return the derivatives (m, size, 3) by a motion of variables that begin with rotated positions (m, 2)."""
    by = jnp.zeros((len(rotated), size, 3)).at[:, 0, 0].set(1.0).at[:, 1, 1].set(1.0)
    by = by.at[:, 0, 2].set(-rotated[:, 1]).at[:, 1, 2].set(rotated[:, 0])
    if size == ROBOT:
        by = by.at[:, 2, 2].set(1.0)
    return jnp.where(used[:, None, None], by, 0.0)


def joined(
    belief: Belief, a: Array, b: Array, motion: Array, covariance: Array, pairs: Array, valid: Array
) -> Belief:  # fmt: skip
    """Return the belief with group b in the frame of group a, and both copies of each common landmark as one.

    The alignment serves as point of linearisation, with hardly any weight of its own: what is known of the motion is
    what the copies tell, so that nothing is counted twice. Rows of b's copies become free.

    Args:
        a, b: () int32. First robots of both groups.
        motion: (3,) [m, m, rad]. Motion from frame b to frame a, by an alignment of both maps.
        covariance: (3, 3). Covariance of the motion.
        pairs: (q, 2) int32. Rows of landmarks of a and of b, one-to-one.
        valid: (q,) bool. Pairs that count.
    """
    rows = len(belief.counts)
    moved = moved_group(belief, b, motion, LOOSE**2 * covariance)
    kept, other = (jnp.where(valid, column, rows) for column in pairs.T)
    first = belief.first_place
    columns = [first + 2 * column[:, None] + jnp.arange(2) for column in (kept, other)]
    in_a, in_b = (jnp.where(valid[:, None], column, 0).ravel() for column in columns)
    is_valid = jnp.repeat(valid, 2)
    gain = jnp.where(is_valid, moved.covariance[:, in_a] - moved.covariance[:, in_b], 0.0)  # P H^T, H = (1, -1)
    innovation = jnp.where(is_valid[:, None], gain[in_a] - gain[in_b], 0.0)
    innovation += jnp.diag(jnp.where(is_valid, EQUAL**2, 1.0))
    off = jnp.where(valid[:, None], moved.places[pairs[:, 1]] - moved.places[pairs[:, 0]], 0.0).ravel()
    after = conditioned(moved, gain, innovation, off)
    free = jnp.zeros(rows, jnp.bool_).at[other].set(True, mode="drop")
    gone = jnp.concatenate([jnp.zeros(first, jnp.bool_), jnp.repeat(free, 2)])
    counts = moved.counts.at[kept].add(moved.counts[pairs[:, 1]], mode="drop")
    heights = moved.heights.at[kept].set(_fused(moved.heights, pairs), mode="drop")
    return after._replace(
        covariance=jnp.where(gone[:, None] | gone, 0.0, after.covariance), heights=heights,
        counts=jnp.where(free, 0, counts), owners=jnp.where(moved.owners == b, a, moved.owners),
        groups=jnp.where(moved.groups == b, a, moved.groups),
    )  # fmt: skip


def _fused(heights: Array, pairs: Array) -> Array:
    """Return heights (q, 2) and variances of pairs of independent estimates."""
    one, other = heights[pairs[:, 0]], heights[pairs[:, 1]]
    share = one[:, 1] / (one[:, 1] + other[:, 1])
    return jnp.stack([one[:, 0] + share * (other[:, 0] - one[:, 0]), share * other[:, 1]], axis=-1)
