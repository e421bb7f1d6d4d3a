"""Landmarks of all particles of two filters: extraction and transfer into one map."""

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.packed_symmetric import UNPACK_INDEX, UPPER
from slam_backend.core.validation import BoolArray, FloatArray, IntArray, argument_error
from slam_backend.fastslam._kernels import LANES
from slam_backend.fastslam.existence import ExistenceModel
from slam_backend.fastslam.particle_maps import ParticleMaps
from slam_backend.geometry import cosine_sine, rotation
from slam_backend.maps.fusion import fuse_landmarks


class Landmarks(NamedTuple):
    """Landmarks of one filter in selected particles.

    Attributes:
        maps: Maps of the filter.
        slots: (n,) slots of the landmarks.
        chosen: (M,) particles.
        places: (n, M) places of the particles in the rows of the landmarks.
        counts: (n, M), 0 where the particle lacks the landmark.
    """

    maps: ParticleMaps
    slots: IntArray
    chosen: IntArray
    places: IntArray
    counts: IntArray

    @classmethod
    def of(cls, maps: ParticleMaps, chosen: IntArray | None = None, ids: IntArray | None = None) -> Self:
        """Return all landmarks by ascending id, or those with given ids (n,); in all particles or the chosen ones."""
        slots = maps.used_slots()
        if ids is not None:
            slots = slots[np.searchsorted(maps.ids[slots], ids)]
        chosen = np.arange(maps.num_particles) if chosen is None else chosen
        rows, ancestors = maps.row_of[slots][:, None], maps.map_of[slots][:, None]
        places = np.where(ancestors > 0, maps.maps[ancestors, chosen], chosen)
        return cls(maps, slots, chosen, places, maps.counts[rows, places].astype(np.int64))

    @property
    def where(self) -> IntArray:
        """(n, M) index of the first value of each landmark and particle in `maps.values`."""
        rows, (blocks, lanes) = self.maps.row_of[self.slots][:, None], np.divmod(self.places, LANES)
        return np.asarray(9 * (rows * self.maps.padded + blocks * LANES) + lanes)

    @property
    def values(self) -> FloatArray:
        """(n, 9, M) float64 [m, m^2]: means and upper triangles of covariances. A copy."""
        return np.asarray(self.maps.values[self.where[:, None] + LANES * np.arange(9)[:, None]])

    @property
    def values_by_particle(self) -> FloatArray:
        """(M, n, 9) float64, as `values`. A copy."""
        return np.ascontiguousarray(self.values.transpose(2, 0, 1))

    @property
    def held_by_particle(self) -> BoolArray:
        """(M, n) whether each particle holds each landmark. A copy."""
        return np.ascontiguousarray((self.counts > 0).T)

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
        """(n, d) descriptors."""
        return np.asarray(self.maps.descriptors[self.slots])

    def odds(self, model: ExistenceModel) -> FloatArray:
        """Return the log-odds of existence (n, M): the prior, if the filter does not estimate them."""
        if self.maps.log_odds_prior is None:
            return np.full(self.counts.shape, model.log_odds_prior)
        return np.asarray(self.maps.odds[self.slots[:, None], self.places])


def merge_by_identity(a: ParticleMaps, b: ParticleMaps, pairs: IntArray) -> tuple[IntArray, IntArray]:
    """Decide by the caller's names which landmarks of two filters are the same, where both sides have names.

    Args:
        a: Landmarks of one filter.
        b: Landmarks of the other.
        pairs: (k, 2) int64 rows (id in a, id in b) matched by an alignment, one-to-one.

    Returns:
        The rows of `pairs` that no name contradicts; and the rows of further landmarks with a common name.
    """
    (ids_a, names_a), (ids_b, names_b) = ((maps.ids[slots], maps.identities[slots]) for maps, slots in _used(a, b))
    known = np.intersect1d(names_a[names_a >= 0], names_b[names_b >= 0])
    of_a, of_b = names_a[np.searchsorted(ids_a, pairs[:, 0])], names_b[np.searchsorted(ids_b, pairs[:, 1])]
    differ = (of_a != of_b) & (np.isin(of_a, known) | np.isin(of_b, known) | ((of_a >= 0) & (of_b >= 0)))
    fitting = pairs[~differ]
    named = []
    for name in known.tolist():
        free_a = np.setdiff1d(ids_a[names_a == name], fitting[:, 0]).tolist()
        free_b = np.setdiff1d(ids_b[names_b == name], fitting[:, 1]).tolist()
        named += list(zip(free_a, free_b, strict=False))  # particles may hold one name under several ids, each once
    return fitting, np.array(named, dtype=np.int64).reshape(-1, 2)


def renaming(a: ParticleMaps, b: ParticleMaps, pairs: IntArray) -> IntArray:
    """Return the ids of b's landmarks in the joint map with a: (n, 2) int64 rows (id in b, id in the joint map).

    Common landmarks, the first rows, have the id of a; the others get new ones.

    Args:
        a, b: Landmarks of the filters.
        pairs: (k, 2) int64 rows (id in a, id in b) of the common landmarks, one-to-one.
    """
    others = np.setdiff1d(b.ids[b.used_slots()], pairs[:, 1])
    new = np.column_stack([others, a.next_id + np.arange(len(others))])
    return np.concatenate([pairs[:, ::-1], new]).astype(np.int64)


def _used(*both: ParticleMaps) -> list[tuple[ParticleMaps, IntArray]]:
    """Return maps with the slots of their landmarks, by ascending id."""
    return [(maps, maps.used_slots()) for maps in both]


def drop_repeated_identities(counts: IntArray, identities: IntArray) -> None:
    """Keep in each particle only the first of several landmarks with one name.

    Args:
        counts: (n, M) measurements of landmarks in particles, set to 0 where a particle loses one.
        identities: (n,) the caller's own, -1 = none.
    """
    repeated, times = np.unique(identities[identities >= 0], return_counts=True)
    for identity in repeated[times > 1].tolist():
        rows = np.flatnonzero(identities == identity)
        held = counts[rows] > 0
        counts[rows] *= held & (np.cumsum(held, axis=0) == 1)


def joint_counts(a: Landmarks, b: Landmarks, rows_a: IntArray, rows_b: IntArray) -> IntArray:
    """Return the number of measurements of joint landmarks in each of M particles (n, M), summed over both sides.

    Args:
        a, b: Landmarks of each filter, in M particles.
        rows_a, rows_b: (n,) rows of each joint landmark in a and in b, -1 if missing there.
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
    """Transform the landmarks of two filters into the map frame of the first, and fuse the common ones.

    Args:
        a, b, rows_a, rows_b: Arguments of `joint_counts`.
        motion: (M, 3) motion of b's landmarks in each particle.
        extra: Variance added to each side first [m^2].
        scales: (n,) factors of the covariances, applied next [-].
        blocks: (>= n, P / lanes, 9, lanes) of the joint map, see `MapStore`, or (n, 1, 9, 1) for a single particle; the
            first n are written.

    Raises:
        ValueError: If two estimates of a landmark are exact along one direction.
    """
    (in_a,), (in_b,) = np.nonzero(rows_a >= 0), np.nonzero(rows_b >= 0)
    joint = np.zeros((len(rows_a), 9, len(motion)))
    joint[in_a] = _widened(a, rows_a[in_a], extra, scales[in_a])
    ours, theirs = joint[in_b], _moved(_widened(b, rows_b[in_b], extra, scales[in_b]), motion)
    held_a, held_b = np.zeros((len(rows_a), len(motion)), np.bool_), b.counts[rows_b[in_b]] > 0
    held_a[in_a] = a.counts[rows_a[in_a]] > 0
    joint[in_b] = np.where(held_a[in_b][:, None], ours, theirs * held_b[:, None])
    both = np.nonzero(held_a[in_b] & held_b)
    one, two = ours.transpose(0, 2, 1)[both], theirs.transpose(0, 2, 1)[both]
    try:
        means, spreads = fuse_landmarks(
            one[:, :3], one[:, 3:][:, UNPACK_INDEX], two[:, :3], two[:, 3:][:, UNPACK_INDEX]
        )
    except ValueError as error:
        cure = "Give each landmark some uncertainty in every direction."
        raise argument_error("landmarks in common", "positive definite covariances", "singular ones", cure) from error
    joint[in_b[both[0]], :, both[1]] = np.column_stack([means, spreads[:, *UPPER]])
    _, count, _, lanes = blocks.shape
    padded = np.zeros((len(rows_a), 9, count * lanes))
    padded[:, :, : len(motion)] = joint
    blocks[: len(rows_a)] = padded.reshape(-1, 9, count, lanes).transpose(0, 2, 1, 3)


def _widened(side: Landmarks, rows: IntArray, extra: float, scales: FloatArray) -> FloatArray:
    """Return some landmarks (n, 9, M) with `extra` added to their variances, then times `scales` (n,); zeros: lacking.

    The nine numbers are those of `Landmarks.values`.
    """
    values = side.values[rows]
    values[:, [3, 6, 8]] += extra
    values[:, 3:] *= scales[:, None, None]
    return np.where((side.counts[rows] > 0)[:, None], values, 0.0)


def _moved(landmarks: FloatArray, motion: FloatArray) -> FloatArray:
    """Return landmarks (n, 9, M), moved by the motion (M, 3) of each particle."""
    x, y, z, xx, xy, xz, yy, yz, zz = landmarks.transpose(1, 0, 2)
    c, s = cosine_sine(motion[:, 2])
    parts = (
        c * x - s * y + motion[:, 0], s * x + c * y + motion[:, 1], z,
        c * c * xx - 2.0 * c * s * xy + s * s * yy, c * s * (xx - yy) + (c * c - s * s) * xy, c * xz - s * yz,
        s * s * xx + 2.0 * c * s * xy + c * c * yy, s * xz + c * yz, zz,
    )  # fmt: skip
    return np.stack(parts, axis=1)  # Eq. 16 *


def birge_ratios(a: Landmarks, b: Landmarks, motion: FloatArray, extra: float) -> FloatArray:
    """Return the Birge ratios (n,) [-] of landmarks shared by two filters, for too small covariances.

    The Birge ratio is the median of chi^2 / 3 over the particles that hold the landmark on both sides, at least 1.

    Args:
        a: Landmarks of one filter, in M particles.
        b: The same landmarks of the other.
        motion: (M, 3) motion of b's landmarks in each particle.
        extra: Variance added to each side first [m^2].
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
    """Fuse the log-odds of existence (n, M) of b's rows into a's, in place; copy them where a particle lacks a's.

    The evidence of both filters is independent given the existence of the landmark: log-odds add up, and the common
    prior counts once. Sums below the floor are raised to it: the landmark stays until the next miss.
    """
    in_a, in_b = counts_a[rows_a] > 0, counts_b[rows_b] > 0
    one, two = odds_a[rows_a], odds_b[rows_b]
    both = np.clip(one + two - model.log_odds_prior, model.log_odds_floor, model.log_odds_cap)
    odds_a[rows_a] = np.where(in_a & in_b, both, np.where(in_b, two, one))


def stack_descriptors(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float32]:
    """Stack the descriptors of two maps; an empty one may have another width."""
    if not len(a) or not len(b):
        return np.array(a if len(a) else b)
    return np.concatenate([a, b])
