"""Landmarks of all particles of two filters: taken out, brought into one map."""

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from slam_backend._joint_map_kernels import join, places, read
from slam_backend._kernels import LANES
from slam_backend._particle_maps import ParticleMaps
from slam_backend.errors import FloatArray, IntArray, bad_argument
from slam_backend.existence import ExistenceModel


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
        where, counts = places(slots, maps.row_of, maps.map_of, maps.maps, maps.counts, chosen, LANES)
        return cls(maps, slots, chosen, where, counts)

    @property
    def values(self) -> FloatArray:
        """(n, 9, M) float64 [m, m^2]: means and upper triangles of covariances. A copy."""
        return read(self.maps.values, self.where, LANES)

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
    a: Landmarks, b: Landmarks, rows_a: IntArray, rows_b: IntArray, motion: FloatArray, extra: float, scale: float,
    blocks: FloatArray,
) -> None:  # fmt: skip
    """Bring the landmarks of two filters into the map frame of the first, and fuse those that both have.

    Args:
        a, b, rows_a, rows_b: As of `joint_counts`.
        motion: (M, 3) by which each particle moves those of b.
        extra: Added to all variances of either side before [m^2].
        scale: Factor on all covariances then [-].
        blocks: (>= n, P / lanes, 9, lanes) of the joint map, see `MapStore`, of which the first n are written.

    Raises:
        ValueError: If two estimates of a landmark are exact along one direction.
    """
    sides = a.maps.values, a.where, a.counts, b.maps.values, b.where, b.counts
    if not join(*sides, rows_a, rows_b, motion, extra, scale, LANES, blocks):
        cure = "Give each landmark some uncertainty in every direction."
        raise bad_argument("landmarks in common", "positive definite covariances", "singular ones", cure)


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
