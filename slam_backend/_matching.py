"""Which landmarks of two maps look alike: mutual nearest descriptors that no other place resembles."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from slam_backend import _look_kernels as kernels
from slam_backend.errors import BoolArray, Float32Array, FloatArray, IntArray

Scalar = TypeVar("Scalar", bound=np.generic)


def look_alikes(a: Float32Array, b: Float32Array, gate: float, most: int) -> IntArray:
    """Pair all descriptors within `gate`, but none that so pairs with more than `most`: those tell nothing.

    Args:
        a: (n, d) float32 [-].
        b: (m, d) float32 [-].
        gate: Largest L2 distance of a pair [-].
        most: Most partners of one.

    Returns:
        (k, 2) int64 rows (index in a, index in b), by rising index in a, then in b; k <= n `most`.
    """
    if not len(a) or not len(b):
        return np.empty((0, 2), np.int64)
    return kernels.pairs_alike(_fresh(a), _fresh(b.T), gate * gate, most)


def num_alike(a: Float32Array, b: Float32Array, gate: float) -> int:
    """Return how many pairs of descriptors (n, d) and (m, d) are no farther apart than `gate`."""
    return kernels.num_alike(_fresh(a), _fresh(b.T), gate * gate) if len(a) and len(b) else 0


def mutual_nearest(a: Float32Array, b: Float32Array, gate: float) -> IntArray:
    """Pair descriptors that are each other's nearest and no farther apart than `gate`.

    Args:
        a: (n, d) float32 [-].
        b: (m, d) float32 [-].
        gate: Largest L2 distance of a pair [-].

    Returns:
        (k, 2) int64 rows (index in a, index in b), by rising index in a; no index appears twice.
    """
    if not len(a) or not len(b):
        return np.empty((0, 2), np.int64)
    return kernels.mutual_pairs(_fresh(a), _fresh(b.T), gate * gate)


def unlike_other_places(
    descriptors: Float32Array,
    partners: IntArray,
    others: Float32Array,
    positions: FloatArray,
    same_place: float,
    ratio: float,
) -> BoolArray:
    """Tell which matches stand out from all landmarks that lie elsewhere (the ratio test).

    Args:
        descriptors: (k, d) float32 [-]. Of the matched landmarks in the one map.
        partners: (k,) int64. Their partners in the other map.
        others: (m, d) float32 [-]. All descriptors of the other map.
        positions: (m, 3) float64 [m]. All positions in the other map.
        same_place: Landmarks within this distance [m] of the partner do not compete: they may be its duplicates.
        ratio: A match must be closer than this times the best competitor [-].

    Returns:
        (k,) mask of the matches that pass. Without any competitor a match passes.
    """
    arrays = _fresh(descriptors), _fresh(partners), _fresh(others.T), _fresh(positions)
    return kernels.stands_out(*arrays, same_place, ratio)


def _fresh(array: NDArray[Scalar]) -> NDArray[Scalar]:
    """Return a copy of one kind of memory, because numba compiles a kernel again for each other kind."""
    return np.array(array, order="C")
