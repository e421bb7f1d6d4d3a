"""Alignment of two groups in arrays of fixed shape: the motion between their frames, or none (Sec. 3.1).

Hypotheses from pairs of landmarks that look alike in both maps are scored by the landmarks that agree, as in
`slam_backend.maps.align_maps`. The covariance of the motion is that of the whole Gaussian: it contains how uncertain
the paths of both groups to their common landmarks are.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from slam_backend.maps.alignment_types import DISTINCT_ROTATION, DISTINCT_TRANSLATION, AlignmentOptions
from vslam_env.batched.belief import Belief, rotation, symmetric, wrapped
from vslam_env.batched.merging import levers

CANDIDATES = 256  # pairs of landmarks that look alike
HYPOTHESES = 512
FUSED = 32  # landmarks that are fused at once
REFINED = 3  # Gauss-Newton iterations, each with the inliers of the last


class Found(NamedTuple):
    """The motion (3,) [m, m, rad] between two groups, its covariance (3, 3), and pairs of their landmarks.

    Attributes:
        success: () bool. Whether the alignment is clear, however uncertain.
        excess: () float32 [-]. Standard deviation of the motion over its limit, see `MergeOptions.min_sigmas`.
        motion, covariance: Motion from the frame of group b to that of group a, and its covariance.
        pairs: (FUSED, 2) int32. Rows of landmarks of a and b that agree, one-to-one.
        valid: (FUSED,) bool. Pairs that count.
    """

    success: Array
    excess: Array
    motion: Array
    covariance: Array
    pairs: Array
    valid: Array


def look_alikes(belief: Belief, gate: float) -> Array:
    """Return which landmarks look alike (R, R) bool, in whichever group."""
    squares = (belief.descriptors**2).sum(axis=1)
    distances = squares[:, None] + squares - 2.0 * belief.descriptors @ belief.descriptors.T
    held = belief.counts > 0
    return (distances < gate**2) & held[:, None] & held


def best_pair(belief: Belief, alike: Array, may_try: Array) -> tuple[Array, Array]:
    """Return the first robots of the two groups a < b that hold most landmarks that look alike; both 0 without any.

    Args:
        alike: (R, R) bool, see `look_alikes`.
        may_try: (K, K) bool. Pairs that count.
    """
    groups = jnp.arange(len(belief.groups))
    holds = (belief.owners[:, None] == groups).astype(jnp.float32)
    counts = holds.T @ alike.astype(jnp.float32) @ holds
    counts = jnp.where((groups[:, None] < groups) & may_try, counts, 0.0)
    a, b = jnp.divmod(jnp.argmax(counts), len(groups))
    return a, b


def align(
    belief: Belief, alike: Array, a: Array, b: Array, key: Array, options: AlignmentOptions,
    min_sigmas: float,
) -> Found:  # fmt: skip
    """Align two groups; a == b: no success.

    Args:
        alike: (R, R) bool, see `look_alikes`.
        a, b: () int32. First robots of the groups.
        key: Key of the random search.
        options, min_sigmas: Gates and limits.
    """
    between = alike & (belief.owners == a)[:, None] & (belief.owners == b)
    few = [between.sum(axis=axis, keepdims=True) <= options.max_similar for axis in (0, 1)]
    rows = jnp.stack(jnp.nonzero(between & few[0] & few[1], size=CANDIDATES, fill_value=len(belief.counts)), axis=-1)
    valid = rows[:, 0] < len(belief.counts)
    rows = jnp.where(valid[:, None], rows, 0)
    first, second = (belief.places[column] for column in rows.T)
    blocks = _blocks(belief)
    spreads = tuple(blocks[column] for column in rows.T)
    tall = _tall(belief, rows, options)

    def inliers(motion: Array) -> Array:
        """Return which candidates agree with a motion (C,)."""
        off, spread = _residuals(motion, first, second, spreads, options)
        return valid & (_squared(off, spread) + tall < options.position_gate)

    motions, apart = _hypotheses(first, second, valid, key, options)
    agree = jax.vmap(inliers)(motions) & apart[:, None]
    best = jnp.argmax(agree.sum(axis=1))
    motion = motions[best]
    for _ in range(REFINED):
        motion = _refined(motion, first, second, spreads, inliers(motion), options)
    inside = inliers(motion)
    pairs, kept = _one_to_one(rows, inside, _squared(*_residuals(motion, first, second, spreads, options)))
    covariance, motion = _whole(belief, motion, pairs, kept, options)
    count = kept.sum()
    centre = jnp.where(inside[:, None], second, 0.0).sum(axis=0) / jnp.maximum(inside.sum(), 1)
    rival = _is_different(motions, motion, centre)[:, None] & agree & ~inside
    exclusive = (inside & ~agree).sum(axis=1)
    ratio = rival.sum(axis=1) / jnp.maximum(jnp.maximum(exclusive, 0.5 * inside.sum()), 1.0)
    sigma = jnp.sqrt(jnp.linalg.eigvalsh(covariance[:2, :2])[1])
    success = (
        (a != b) & (count >= options.min_inliers) & (ratio.max() <= options.max_ratio)
        & (_extent(second, inside) >= options.min_spread) & jnp.isfinite(covariance).all() & jnp.isfinite(motion).all()
    )  # fmt: skip
    excess = min_sigmas * jnp.maximum(sigma / DISTINCT_TRANSLATION, jnp.sqrt(covariance[2, 2]) / DISTINCT_ROTATION)
    return Found(success, excess, motion, covariance, pairs, kept)


def _blocks(belief: Belief) -> Array:
    """Return the covariance (R, 2, 2) of each landmark."""
    first, rows = belief.first_place, len(belief.counts)
    each = jnp.arange(rows)
    return belief.covariance[first:, first:].reshape(rows, 2, rows, 2)[each, :, each]


def _hypotheses(
    first: Array, second: Array, valid: Array, key: Array, options: AlignmentOptions
) -> tuple[Array, Array]:  # fmt: skip
    """Return motions (h, 3) from pairs of candidates, and whether these are apart enough (h,)."""
    drawn = jax.random.randint(key, (HYPOTHESES, 2), 0, jnp.maximum(valid.sum(), 1))
    in_a, in_b = (part[drawn[:, 1]] - part[drawn[:, 0]] for part in (first, second))
    turns = jnp.arctan2(in_a[:, 1], in_a[:, 0]) - jnp.arctan2(in_b[:, 1], in_b[:, 0])
    middles = [0.5 * (part[drawn[:, 0]] + part[drawn[:, 1]]) for part in (first, second)]
    shifts = middles[0] - jnp.einsum("hij,hj->hi", jax.vmap(rotation)(turns), middles[1])
    lengths = [jnp.linalg.norm(part, axis=1) for part in (in_a, in_b)]
    return jnp.column_stack([shifts, turns]), jnp.minimum(*lengths) > 0.5 * options.min_spread


def _residuals(
    motion: Array, first: Array, second: Array, spreads: tuple[Array, Array], options: AlignmentOptions
) -> tuple[Array, Array]:
    """Return a - R b - t (C, 2) of all candidates, and the covariances (C, 2, 2)."""
    turned = rotation(motion[2])
    off = first - second @ turned.T - motion[:2]
    return off, spreads[0] + turned @ spreads[1] @ turned.T + options.position_floor**2 * jnp.eye(2)


def _tall(belief: Belief, rows: Array, options: AlignmentOptions) -> Array:
    """Return the squared Mahalanobis distances (C,) of the heights of pairs of rows (C, 2)."""
    one, other = belief.heights[rows[:, 0]], belief.heights[rows[:, 1]]
    return (one[:, 0] - other[:, 0]) ** 2 / (one[:, 1] + other[:, 1] + options.position_floor**2)


def _inverse(matrices: Array) -> Array:
    """Return the inverses of matrices (C, 2, 2)."""
    (a, b), (c, d) = jnp.moveaxis(matrices, 0, -1)
    return jnp.moveaxis(jnp.array([[d, -b], [-c, a]]) / (a * d - b * c), -1, 0)


def _squared(off: Array, spread: Array) -> Array:
    """Return squared Mahalanobis distances (C,)."""
    determinant = spread[:, 0, 0] * spread[:, 1, 1] - spread[:, 0, 1] ** 2
    quadratic = spread[:, 1, 1] * off[:, 0] ** 2 + spread[:, 0, 0] * off[:, 1] ** 2
    return (quadratic - 2.0 * spread[:, 0, 1] * off[:, 0] * off[:, 1]) / determinant


def _refined(
    motion: Array, first: Array, second: Array, spreads: tuple[Array, Array], inside: Array, options: AlignmentOptions
) -> Array:
    """Return the motion after one Gauss-Newton iteration over its inliers."""
    off, spread = _residuals(motion, first, second, spreads, options)
    lever = jnp.where(inside[:, None, None], levers(second @ rotation(motion[2]).T), 0.0)
    weighted = _inverse(spread) @ lever
    information = jnp.einsum("cia,cib->ab", lever, weighted) + 1e-6 * jnp.eye(3)
    return motion + jnp.linalg.solve(information, jnp.einsum("cia,ci->a", weighted, off))


def _one_to_one(rows: Array, inside: Array, distances: Array) -> tuple[Array, Array]:
    """Return up to `FUSED` pairs whose rows have no nearer partner, those of least distance, and which are valid."""
    costs = jnp.where(inside, distances, jnp.inf)
    same = [(column[:, None] == column) for column in rows.T]
    rank = jnp.arange(len(rows))
    before = (costs[None] < costs[:, None]) | ((costs[None] == costs[:, None]) & (rank[None] < rank[:, None]))
    taken = ((same[0] | same[1]) & before & inside[None]).any(axis=1)
    order = jnp.argsort(jnp.where(inside & ~taken, costs, jnp.inf))[:FUSED]
    return rows[order], (inside & ~taken)[order]


def _whole(
    belief: Belief, motion: Array, pairs: Array, kept: Array, options: AlignmentOptions
) -> tuple[Array, Array]:  # fmt: skip
    """Return covariance and motion by all pairs together, with the correlations within both groups."""
    first, each = belief.first_place, len(kept)
    columns = [(first + 2 * column[:, None] + jnp.arange(2)).ravel() for column in pairs.T]
    of_a, of_b = (belief.covariance[column[:, None], column] for column in columns)
    turned = jnp.kron(jnp.eye(each), rotation(motion[2]))
    is_kept = jnp.repeat(kept, 2)
    spread = of_a + turned @ of_b @ turned.T + options.position_floor**2 / 4.0 * jnp.eye(2 * each)
    spread = jnp.where(is_kept[:, None] & is_kept, spread, jnp.eye(2 * each))
    places = [belief.places[column] for column in pairs.T]
    lever = jnp.where(is_kept[:, None], levers(places[1] @ rotation(motion[2]).T).reshape(-1, 3), 0.0)
    off = jnp.where(kept[:, None], places[0] - places[1] @ rotation(motion[2]).T - motion[:2], 0.0).ravel()
    factor = jax.scipy.linalg.cho_factor(symmetric(spread), lower=True)
    weighted = jax.scipy.linalg.cho_solve(factor, lever)
    covariance = jnp.linalg.inv(lever.T @ weighted + 1e-6 * jnp.eye(3))
    return symmetric(covariance), motion + covariance @ weighted.T @ off


def _is_different(motions: Array, motion: Array, centre: Array) -> Array:
    """Return which motions (h,) move the centre of the inliers elsewhere, or turn it."""
    moved = jax.vmap(lambda each: rotation(each[2]) @ centre + each[:2])
    away = jnp.linalg.norm(moved(motions) - moved(motion[None]), axis=1)
    turn = wrapped(motions[:, 2] - motion[2])
    return (away > DISTINCT_TRANSLATION) | (jnp.abs(turn) > DISTINCT_ROTATION)


def _extent(points: Array, inside: Array) -> Array:
    """Return the extent [m] of the inliers along their main axis."""
    count = jnp.maximum(inside.sum(), 1)
    centred = jnp.where(inside[:, None], points - jnp.where(inside[:, None], points, 0.0).sum(axis=0) / count, 0.0)
    _, axes = jnp.linalg.eigh(centred.T @ centred)
    along = centred @ axes[:, 1]
    return jnp.where(inside, along, -jnp.inf).max() - jnp.where(inside, along, jnp.inf).min()


def copies(belief: Belief, alike: Array, options: AlignmentOptions) -> tuple[Array, Array]:
    """Return pairs (FUSED, 2) of rows that hold one landmark twice within a group, and which are valid (FUSED,)."""
    total = len(belief.counts)
    each = jnp.arange(total)
    close = jnp.linalg.norm(belief.places[:, None] - belief.places, axis=-1) < options.same_place
    together = alike & close & (belief.owners[:, None] == belief.owners) & (each[:, None] < each)
    rows = jnp.stack(jnp.nonzero(together, size=CANDIDATES, fill_value=total), axis=-1)
    valid = rows[:, 0] < total
    rows = jnp.where(valid[:, None], rows, 0)
    first = belief.first_place
    at = [first + 2 * column[:, None] + jnp.arange(2) for column in rows.T]

    def block(one: Array, other: Array) -> Array:
        return belief.covariance[one[:, :, None], other[:, None, :]]

    cross = block(at[0], at[1])
    spread = block(at[0], at[0]) + block(at[1], at[1]) - cross - cross.swapaxes(1, 2)
    spread += options.position_floor**2 * jnp.eye(2)
    tall = _tall(belief, rows, options)
    distances = _squared(belief.places[rows[:, 0]] - belief.places[rows[:, 1]], spread) + tall
    return _one_to_one(rows, valid & (distances < options.position_gate), distances)
