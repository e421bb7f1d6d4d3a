"""The compiled inner loops of a joint map: landmarks of both sides read where they lie, moved, fused, written in tiles.

A landmark of a particle is nine numbers, x, y, z, Sxx, Sxy, Sxz, Syy, Syz, Szz, a number of lanes apart. The number of
lanes is an argument: a compiled kernel would not notice that it changed in another file.
"""

from typing import Any, NamedTuple

import numpy as np

from slam_backend.core.jit import device, inline, jit
from slam_backend.core.validation import FloatArray, IntArray


class Side(NamedTuple):
    """Landmarks of one filter.

    Attributes:
        values: All numbers of its map.
        where: (n, M) place of the first number of each landmark in each particle.
        counts: (n, M) measurements, 0 where a particle lacks the landmark.
        rows: (joint,) row of each joint landmark, -1 where this side lacks it.
    """

    values: Any
    where: IntArray
    counts: IntArray
    rows: IntArray


@jit
def by_particle(values: FloatArray, where: IntArray, lanes: int) -> FloatArray:
    """Return the landmarks (M, n, 9) of each particle, whose first numbers are at `where` (n, M)."""
    landmarks = np.empty((where.shape[1], len(where), 9))
    for k in range(len(where)):
        for m in range(where.shape[1]):
            for c in range(9):
                landmarks[m, k, c] = values[where[k, m] + c * lanes]
    return landmarks


@inline
def _widened(values: Any, at: int, lanes: int, extra: float, scale: float, landmark: Any) -> None:
    """Write a landmark to `landmark` (9,) with `extra` [m^2] added to its variances, all then times `scale`."""
    for c in range(9):
        landmark[c] = values[at + c * lanes]
    for c in (3, 6, 8):
        landmark[c] += extra
    for c in range(3, 9):
        landmark[c] *= scale


@device
@jit
def _fuse(one: FloatArray, two: FloatArray, work: FloatArray) -> bool:
    """Fuse landmark `two` (9,) into `one` (9,), Eqs. 13-15 *, with room (5, 3, 3); False if their sum is singular."""
    a, b, gain, rest, half = work[0], work[1], work[2], work[3], work[4]
    entry = 3
    for j in range(3):
        for k in range(j, 3):
            a[j, k] = a[k, j] = one[entry]
            b[j, k] = b[k, j] = two[entry]
            entry += 1
    xx, xy, xz = one[3] + two[3], one[4] + two[4], one[5] + two[5]
    yy, yz, zz = one[6] + two[6], one[7] + two[7], one[8] + two[8]
    half[0, 0], half[0, 1], half[0, 2] = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    det = xx * half[0, 0] + xy * half[0, 1] + xz * half[0, 2]
    if not det > 0.0:
        return False
    half[1, 1], half[1, 2], half[2, 2] = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    half[1, 0], half[2, 0], half[2, 1] = half[0, 1], half[0, 2], half[1, 2]
    for j in range(3):
        for k in range(3):
            gain[j, k] = (a[j, 0] * half[0, k] + a[j, 1] * half[1, k] + a[j, 2] * half[2, k]) / det  # Eq. 13
            rest[j, k] = (1.0 if j == k else 0.0) - gain[j, k]
    x, y, z = two[0] - one[0], two[1] - one[1], two[2] - one[2]
    for j in range(3):
        one[j] += gain[j, 0] * x + gain[j, 1] * y + gain[j, 2] * z  # Eq. 14 *
    for first, spread in ((rest, a), (gain, b)):  # Eq. 15 *, in the form that stays positive whatever the rounding
        for j in range(3):
            for k in range(3):
                half[j, k] = first[j, 0] * spread[0, k] + first[j, 1] * spread[1, k] + first[j, 2] * spread[2, k]
        for j in range(3):
            for k in range(3):
                spread[j, k] = half[j, 0] * first[k, 0] + half[j, 1] * first[k, 1] + half[j, 2] * first[k, 2]
    entry = 3
    for j in range(3):
        for k in range(j, 3):
            one[entry] = 0.5 * (a[j, k] + a[k, j] + b[j, k] + b[k, j])
            entry += 1
    return True


@jit
def join(a: Side, b: Side, motion: FloatArray, extra: float, scales: FloatArray, lanes: int, tiles: FloatArray) -> bool:
    """Write the landmarks of a joint map, those of b moved, those of both fused where a particle holds both.

    Args:
        a, b: Landmarks of either filter.
        motion: (M, 3) from b's map frame to a's, of each particle.
        extra: Added to all variances of either side first [m^2].
        scales: (n,) factor on the covariances of each then [-].
        lanes: Particles in a block of either side.
        tiles: (>= n, blocks, 9, width) for blocks of `width` particles, of which the first n are written; zeros where a
            particle holds neither.

    Returns:
        Whether all went well: not if two estimates are exact along one direction.
    """
    one, two, work = np.empty(9), np.empty(9), np.empty((5, 3, 3))
    cos, sin = np.cos(motion[:, 2]), np.sin(motion[:, 2])
    for i in range(len(a.rows)):
        j, k, scale = a.rows[i], b.rows[i], scales[i]
        for block in range(tiles.shape[1]):
            tile, first = tiles[i, block], block * tiles.shape[3]
            for lane in range(tiles.shape[3]):
                p = first + lane
                there = p < len(motion)
                in_a, in_b = there and j >= 0 and a.counts[j, p] > 0, there and k >= 0 and b.counts[k, p] > 0
                if in_b:
                    _widened(b.values, b.where[k, p], lanes, extra, scale, two)
                    x, y, c, s = two[0], two[1], cos[p], sin[p]
                    two[0], two[1] = c * x - s * y + motion[p, 0], s * x + c * y + motion[p, 1]
                    xx, xy, xz, yy, yz = two[3], two[4], two[5], two[6], two[7]
                    two[3] = c * c * xx - 2.0 * c * s * xy + s * s * yy  # R Sigma R^T, Eq. 16 *
                    two[4] = c * s * (xx - yy) + (c * c - s * s) * xy
                    two[5] = c * xz - s * yz
                    two[6] = s * s * xx + 2.0 * c * s * xy + c * c * yy
                    two[7] = s * xz + c * yz
                if in_a:
                    _widened(a.values, a.where[j, p], lanes, extra, scale, one)
                    if in_b and not _fuse(one, two, work):
                        return False
                for axis in range(9):
                    tile[axis, lane] = one[axis] if in_a else two[axis] if in_b else 0.0
    return True
