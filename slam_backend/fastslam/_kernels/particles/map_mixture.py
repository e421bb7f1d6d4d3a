"""Gaussian mixtures of landmarks over all particles that hold them."""

import numpy as np

from slam_backend.core.jit import device, jit, simd, simd_inline, stack_array
from slam_backend.core.simd_math import NARROW, WIDE, added_up, added_up_narrow
from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.fastslam._kernels import layout as L
from slam_backend.fastslam._kernels.layout import LANES
from slam_backend.fastslam._kernels.records import MapArrays


@device
@simd
def _weighed(shares: FloatArray, values: FloatArray, wide: int) -> float:
    """Return the weighted sum of values, in a fixed order: all processors round alike.

    Args:
        shares: Weights (n,).
        values: Values (n,); what has no share may be anything.
        wide: Terms taken at a time, `WIDE` or half as many; what is left is taken `NARROW` at a time, then one by one.
    """
    sums, size = stack_array(WIDE), len(shares)
    rest, last = size - size % wide, size - size % NARROW
    for i in range(WIDE):
        sums[i] = 0.0
    for j in range(0, rest, wide):
        for i in range(wide):
            more = sums[i] + shares[j + i] * values[j + i]
            sums[i] = more if shares[j + i] > 0.0 else sums[i]
    sums[0] = added_up(sums)
    for i in range(1, NARROW):
        sums[i] = 0.0
    for j in range(rest, last, NARROW):
        for i in range(NARROW):
            more = sums[i] + shares[j + i] * values[j + i]
            sums[i] = more if shares[j + i] > 0.0 else sums[i]
    total = added_up_narrow(sums)
    for j in range(last, size):
        more = total + shares[j] * values[j]
        total = more if shares[j] > 0.0 else total
    return total


@simd_inline
def _shared_mean(shares: FloatArray, tile: FloatArray) -> tuple[float, float, float]:
    """Return the weighted sums of the means in a block of lanes (9, lanes); what has no share may be anything."""
    return _weighed(shares, tile[0], WIDE), _weighed(shares, tile[1], WIDE), _weighed(shares, tile[2], WIDE)


@simd_inline
def _shared_spread(
    shares: FloatArray, tile: FloatArray, x: float, y: float, z: float
) -> tuple[float, float, float, float, float, float]:
    """Return the weighted sums (6) of covariances, and of products of the deviations from (x, y, z)."""
    own_xx, own_xy, own_xz = stack_array(LANES), stack_array(LANES), stack_array(LANES)
    own_yy, own_yz, own_zz = stack_array(LANES), stack_array(LANES), stack_array(LANES)
    for i in range(LANES):
        dx, dy, dz = tile[0, i] - x, tile[1, i] - y, tile[2, i] - z
        own_xx[i], own_xy[i], own_xz[i] = tile[3, i] + dx * dx, tile[4, i] + dx * dy, tile[5, i] + dx * dz
        own_yy[i], own_yz[i], own_zz[i] = tile[6, i] + dy * dy, tile[7, i] + dy * dz, tile[8, i] + dz * dz
    half = WIDE // 2
    return (
        _weighed(shares, own_xx, half), _weighed(shares, own_xy, half), _weighed(shares, own_xz, half),
        _weighed(shares, own_yy, half), _weighed(shares, own_yz, half), _weighed(shares, own_zz, half),
    )  # fmt: skip


@simd_inline
def add_gauge_to_landmarks(scatter: FloatArray, x: float, y: float, covariance: FloatArray) -> None:
    """Add to the covariance (3, 3) of a point what a scattered motion of the whole map gives it, to first order.

    J C J^T with J = [[1, 0, -y], [0, 1, x]]: heights stay.
    """
    ahead_turn, left_turn = scatter[0, 2] - y * scatter[2, 2], scatter[1, 2] + x * scatter[2, 2]
    both = scatter[0, 1] - y * scatter[2, 1] + x * ahead_turn
    covariance[0, 0] += scatter[0, 0] - y * scatter[2, 0] - y * ahead_turn
    covariance[1, 1] += scatter[1, 1] + x * scatter[2, 1] + x * left_turn
    covariance[0, 1] += both
    covariance[1, 0] += both


@jit
def mix(
    slots: IntArray, maps: MapArrays, best: int, weights: FloatArray, scatter: FloatArray
) -> tuple[FloatArray, FloatArray, IntArray, IntArray]:
    """Return means (n, 3), covariances (n, 3, 3), counts (n,) and ids (n,) of landmarks, see `map_mixture`.

    Values are read where they lie, each weighed once for all particles whose ancestor left it there.

    Args:
        slots: (n,) the landmarks.
        maps: Storage of the landmarks; they need not be up to date.
        best: The particle whose counts are returned.
        weights: (M,), summing to 1.
        scatter: (3, 3) covariance of the map's frame about its origin [m, m, rad].
    """
    row_of, map_of, ids, counts = maps.table[L.ROW_OF], maps.table[L.MAP_OF], maps.table[L.IDS], maps.counts
    padded, identity = counts.shape[1], np.arange(counts.shape[1]).astype(np.int32)
    means, covariances = np.empty((len(slots), 3)), np.zeros((len(slots), 3, 3))
    times, names = np.empty(len(slots), np.int64), np.empty(len(slots), np.int64)
    of_maps, is_weighed = np.empty((len(maps.maps), padded)), np.zeros(len(maps.maps), np.bool_)
    shares = np.empty(padded)
    for i in range(len(slots)):
        row, e = row_of[slots[i]], map_of[slots[i]]
        names[i], times[i] = ids[slots[i]], counts[row, maps.maps[e, best] if e > 0 else best]
        if not is_weighed[e]:
            is_weighed[e] = True
            ancestors, of_places = maps.maps[e] if e > 0 else identity, of_maps[e]
            of_places[:] = 0.0
            for m in range(len(weights)):  # a place weighs as much as all particles that read there
                of_places[ancestors[m]] += weights[m]
        whole = 0.0
        for place in range(padded):
            shares[place] = of_maps[e, place] if counts[row, place] > 0 else 0.0
            whole += shares[place]
        scale = 1.0 / max(whole, 1e-300)
        tiles = maps.values[9 * row * padded : 9 * (row + 1) * padded].reshape((-1, 9, LANES))
        x, y, z = 0.0, 0.0, 0.0
        for block in range(len(tiles)):
            sums = _shared_mean(shares[block * LANES : (block + 1) * LANES], tiles[block])
            x, y, z = x + scale * sums[0], y + scale * sums[1], z + scale * sums[2]
        means[i, 0], means[i, 1], means[i, 2] = x, y, z
        covariance = covariances[i]
        for block in range(len(tiles)):
            spread = _shared_spread(shares[block * LANES : (block + 1) * LANES], tiles[block], x, y, z)
            xx, xy, xz, yy, yz, zz = spread
            covariance[0, 0] += scale * xx
            covariance[1, 1] += scale * yy
            covariance[2, 2] += scale * zz
            covariance[0, 1] += scale * xy
            covariance[0, 2] += scale * xz
            covariance[1, 2] += scale * yz
        covariance[1, 0], covariance[2, 0], covariance[2, 1] = covariance[0, 1], covariance[0, 2], covariance[1, 2]
        add_gauge_to_landmarks(scatter, x, y, covariance)
    return means, covariances, times, names
