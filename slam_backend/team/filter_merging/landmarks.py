"""Landmarks of all particles of two filters: taken out, brought into one map."""

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.packed_symmetric import UNPACK_INDEX
from slam_backend.core.validation import FloatArray, IntArray, argument_error
from slam_backend.fastslam._kernels import LANES
from slam_backend.fastslam.existence import ExistenceModel
from slam_backend.fastslam.particle_maps import ParticleMaps
from slam_backend.geometry import rotation
from slam_backend.team.filter_merging._kernels.joint_map import Side, join


class Landmarks(NamedTuple):
    """The landmarks of one filter in some of its particles, wherever they lie.

    Attributes:
        maps: That hold them.
        slots: (n,) which.
        chosen: (M,) particles.
        where: (n, M) at which of the maps' numbers each begins.
        counts: (n, M), 0 where the particle lacks it.
    """

    maps: ParticleMaps
    slots: IntArray
    chosen: IntArray
    where: IntArray
    counts: IntArray

    @classmethod
    def of(cls, maps: ParticleMaps, chosen: IntArray | None = None, ids: IntArray | None = None) -> Self:
        """Return all by ascending id, or those of these ids (n,) in their order; in all particles or the chosen."""
        slots = maps.used_slots()
        if ids is not None:
            slots = slots[np.searchsorted(maps.ids[slots], ids)]
        chosen = np.arange(maps.num_particles) if chosen is None else chosen
        rows, ancestors = maps.row_of[slots][:, None], maps.map_of[slots][:, None]
        particles = np.where(ancestors > 0, maps.maps[ancestors, chosen], chosen)
        blocks, lanes = np.divmod(particles, LANES)
        where = 9 * (rows * maps.counts.shape[1] + blocks * LANES) + lanes
        return cls(maps, slots, chosen, where, maps.counts[rows, particles].astype(np.int64))

    @property
    def values(self) -> FloatArray:
        """(n, 9, M) float64 [m, m^2]: means and upper triangles of covariances. A copy."""
        return np.asarray(self.maps.values[self.where[:, None] + LANES * np.arange(9)[:, None]])

    @property
    def ids(self) -> IntArray:
        """(n,) names."""
        return np.asarray(self.maps.ids[self.slots])

    @property
    def identities(self) -> IntArray:
        """(n,) the caller's own names, -1 = none."""
        return np.asarray(self.maps.identities[self.slots])

    @property
    def descriptors(self) -> NDArray[np.float32]:
        """(n, d) looks."""
        return np.asarray(self.maps.descriptors[self.slots])

    def odds(self, model: ExistenceModel | None) -> FloatArray:
        """Return the log-odds of existence (n, M): the prior, where the filter does not keep them."""
        if self.maps.log_odds_prior is None:
            return np.full(self.counts.shape, 0.0 if model is None else model.log_odds_prior)
        ancestors = self.maps.map_of[self.slots][:, None]
        particles = np.where(ancestors > 0, self.maps.maps[ancestors, self.chosen], self.chosen)
        return np.asarray(self.maps.odds[self.slots[:, None], particles])


def merge_by_identity(a: ParticleMaps, b: ParticleMaps, pairs: IntArray) -> tuple[IntArray, IntArray]:
    """Let the caller's names decide which landmarks of two filters are the same, where there are names on both sides.

    Args:
        a: Landmarks of one filter.
        b: Landmarks of the other.
        pairs: (k, 2) int64 rows (id in a, id in b) that an alignment takes for the same, one-to-one.

    Returns:
        The rows of `pairs` that no name contradicts; and the rows of landmarks that have one name and are in none of
        these.
    """
    (ids_a, names_a), (ids_b, names_b) = ((maps.ids[slots], maps.identities[slots]) for maps, slots in _used(a, b))
    known = np.intersect1d(names_a[names_a >= 0], names_b[names_b >= 0])
    of_a, of_b = names_a[np.searchsorted(ids_a, pairs[:, 0])], names_b[np.searchsorted(ids_b, pairs[:, 1])]
    differ = (of_a != of_b) & (np.isin(of_a, known) | np.isin(of_b, known) | ((of_a >= 0) & (of_b >= 0)))
    kept = pairs[~differ]
    told = []
    for name in known.tolist():
        free_a = np.setdiff1d(ids_a[names_a == name], kept[:, 0]).tolist()
        free_b = np.setdiff1d(ids_b[names_b == name], kept[:, 1]).tolist()
        told += list(zip(free_a, free_b, strict=False))  # particles may hold it under several ids, each under one
    return kept, np.array(told, dtype=np.int64).reshape(-1, 2)


def _used(*both: ParticleMaps) -> list[tuple[ParticleMaps, IntArray]]:
    """Return maps with the slots of their landmarks, by ascending id."""
    return [(maps, maps.used_slots()) for maps in both]


def drop_repeated_identities(counts: IntArray, names: IntArray) -> None:
    """Let no particle hold two landmarks of one name: of those that it holds the first stays.

    Args:
        counts: (n, M) of landmarks in particles, changed: 0 where a particle lacks it now.
        names: (n,) the caller's own, -1 = none.
    """
    found, times = np.unique(names[names >= 0], return_counts=True)
    for name in found[times > 1].tolist():
        rows = np.flatnonzero(names == name)
        held = counts[rows] > 0
        counts[rows] *= held & (np.cumsum(held, axis=0) == 1)


def joint_counts(a: Landmarks, b: Landmarks, rows_a: IntArray, rows_b: IntArray) -> IntArray:
    """Return how often each of M particles measured joint landmarks (n, M): on both sides together.

    Args:
        a, b: Of either filter, in M particles each.
        rows_a: (n,) row in a of each joint landmark, -1 if only b has it; `rows_b` likewise.
    """
    counts = np.zeros((len(rows_a), a.counts.shape[1]), np.int64)
    for side, rows in ((a, rows_a), (b, rows_b)):
        there = rows >= 0
        counts[there] += side.counts[rows[there]]
    return counts


def write_joint(
    a: Landmarks, b: Landmarks, rows_a: IntArray, rows_b: IntArray, motion: FloatArray, extra: float,
    scales: FloatArray, blocks: FloatArray,
) -> None:  # fmt: skip
    """Bring the landmarks of two filters into the map frame of the first, and fuse those that both have.

    Args:
        a, b, rows_a, rows_b: As of `joint_counts`.
        motion: (M, 3) by which each particle moves those of b.
        extra: Added to all variances of either side before [m^2].
        scales: (n,) factor on the covariances of each then [-].
        blocks: (>= n, P / lanes, 9, lanes) of the joint map, see `MapStore`, of which the first n are written.

    Raises:
        ValueError: If two estimates of a landmark are exact along one direction.
    """
    one, two = (Side(each.maps.values, each.where, each.counts, rows) for each, rows in ((a, rows_a), (b, rows_b)))
    if not join(one, two, motion, extra, scales, LANES, blocks):
        cure = "Give each landmark some uncertainty in every direction."
        raise argument_error("landmarks in common", "positive definite covariances", "singular ones", cure)


def birge_ratios(a: Landmarks, b: Landmarks, motion: FloatArray, extra: float) -> FloatArray:
    """Return by how much the covariances of landmarks that two filters share understate their differences (n,) [-].

    It is the Birge ratio of each: the median over the particles that hold it on both sides of chi^2 / 3, at least 1.

    Args:
        a: Values of one filter, in M particles.
        b: The same landmarks of the other.
        motion: (M, 3) by which each particle moves those of b.
        extra: Added to all variances of either side before [m^2].
    """
    ratios = np.ones(len(a.slots))
    values_a, values_b, turns = a.values, b.values, rotation(motion[:, 2])
    for row, both in enumerate((a.counts > 0) & (b.counts > 0)):
        if not both.any():
            continue
        one, two, turn = values_a[row][:, both].T, values_b[row][:, both].T, np.tile(np.eye(3), (both.sum(), 1, 1))
        turn[:, :2, :2] = turns[both]
        moved = (turn @ two[:, :3, None])[..., 0]
        moved[:, :2] += motion[both, :2]
        covariance = one[:, 3:][:, UNPACK_INDEX] + turn @ two[:, 3:][:, UNPACK_INDEX] @ turn.transpose(0, 2, 1)
        apart = (one[:, :3] - moved)[..., None]
        chi2 = (apart * np.linalg.solve(covariance + 2.0 * extra * np.eye(3), apart)).sum(axis=(1, 2))
        ratios[row] = max(1.0, float(np.median(chi2)) / 3.0)
    return ratios


def fuse_odds(
    model: ExistenceModel, odds_a: FloatArray, counts_a: IntArray, rows_a: IntArray,
    odds_b: FloatArray, counts_b: IntArray, rows_b: IntArray,
) -> None:  # fmt: skip
    """Fuse the log-odds of existence (n, M) of b's rows into a's, in place; where a particle has b's alone, take that.

    What either filter saw is independent given whether the landmark exists: log-odds add up, and the prior that both
    hold counts once. What then lies below the floor is given one more chance: it stays there until the next miss.
    """
    in_a, in_b = counts_a[rows_a] > 0, counts_b[rows_b] > 0
    one, two = odds_a[rows_a], odds_b[rows_b]
    both = np.clip(one + two - model.log_odds_prior, model.log_odds_floor, model.log_odds_cap)
    odds_a[rows_a] = np.where(in_a & in_b, both, np.where(in_b, two, one))


def stack_descriptors(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float32]:
    """Stack the descriptors of two maps, one of which may still be empty and of unknown width."""
    if not len(a) or not len(b):
        return np.array(a if len(a) else b)
    return np.concatenate([a, b])
