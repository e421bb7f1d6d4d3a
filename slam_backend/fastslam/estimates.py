"""Estimates over all particles: Gaussian mixtures of the pose of a robot and of landmarks."""

from typing import Any

import numpy as np

from slam_backend.core.jit import device, jit, simd_inline, simd_sum
from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.fastslam import _kernels
from slam_backend.fastslam._kernels import LANES
from slam_backend.fastslam._kernels.layout import IDS, MAP_OF, ROW_OF
from slam_backend.fastslam.particle_maps import ParticleMaps, present_slots
from slam_backend.fastslam.reports import PoseEstimates


def pose_mixtures(means: FloatArray, covariances: FloatArray, weights: FloatArray) -> PoseEstimates:
    """Return means and covariances of weighted mixtures of Gaussian poses; headings are averaged on the circle.

    Args:
        means: (K, 3, P) float64 [m, m, rad], P >= M whole blocks of lanes.
        covariances: (K, 6, P) float64: xx, xy, xt, yy, yt, tt of each.
        weights: (M,) float64, summing to 1; lanes beyond M mean nothing.

    Returns:
        All in the frame of `means`. Fresh arrays.
    """
    mixed = PoseEstimates(np.empty((len(means), 3)), np.empty((len(means), 3, 3)))
    for robot in range(len(means)):
        _kernels.mixture(means[robot], covariances[robot], weights, mixed.means[robot], mixed.covariances[robot])
    return mixed


@simd_sum
def _shared_mean(shares: FloatArray, tile: FloatArray) -> tuple[float, float, float]:
    """Return the weighted sums of the means in a block of lanes (9, lanes); what has no share may be anything."""
    x, y, z = 0.0, 0.0, 0.0
    for i in range(len(shares)):
        share, own_x, own_y, own_z = shares[i], tile[0, i], tile[1, i], tile[2, i]
        x += share * own_x if share > 0.0 else 0.0
        y += share * own_y if share > 0.0 else 0.0
        z += share * own_z if share > 0.0 else 0.0
    return x, y, z


@simd_sum
def _shared_spread(
    shares: FloatArray, tile: FloatArray, x: float, y: float, z: float
) -> tuple[float, float, float, float, float, float]:
    """Return the weighted sums (6) of covariances, and of products of what means are off (x, y, z), likewise."""
    xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(len(shares)):
        share, dx, dy, dz = shares[i], tile[0, i] - x, tile[1, i] - y, tile[2, i] - z
        own_xx, own_xy, own_xz, own_yy, own_yz, own_zz = (
            tile[3, i] + dx * dx, tile[4, i] + dx * dy, tile[5, i] + dx * dz,
            tile[6, i] + dy * dy, tile[7, i] + dy * dz, tile[8, i] + dz * dz,
        )  # fmt: skip
        xx += share * own_xx if share > 0.0 else 0.0
        xy += share * own_xy if share > 0.0 else 0.0
        xz += share * own_xz if share > 0.0 else 0.0
        yy += share * own_yy if share > 0.0 else 0.0
        yz += share * own_yz if share > 0.0 else 0.0
        zz += share * own_zz if share > 0.0 else 0.0
    return xx, xy, xz, yy, yz, zz


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


@device
@jit
def _slot_weights(ancestors: Any, weights: FloatArray, places: FloatArray) -> None:
    """Write the weight of each place (P,) of a row: that of all particles that read there by a map of ancestors."""
    places[:] = 0.0
    for m in range(len(weights)):
        places[ancestors[m]] += weights[m]


@jit
def _mix(
    slots: Any, table: Any, maps: Any, values: Any, counts: Any, best: int, weights: FloatArray, scatter: FloatArray,
    lanes: int,
) -> tuple[FloatArray, FloatArray, IntArray, IntArray]:  # fmt: skip
    """Return means (n, 3), covariances (n, 3, 3), counts (n,) and ids (n,) of landmarks, see `map_mixture`.

    Values are read where they lie, each weighed once for all particles whose ancestor left it there. The number of
    lanes is an argument, for a compiled kernel would not notice that it changed in another file.
    """
    row_of, map_of, ids = table[ROW_OF], table[MAP_OF], table[IDS]
    padded, identity = counts.shape[1], np.arange(counts.shape[1]).astype(np.int32)
    means, covariances = np.empty((len(slots), 3)), np.zeros((len(slots), 3, 3))
    times, names = np.empty(len(slots), np.int64), np.empty(len(slots), np.int64)
    of_maps, is_weighed = np.empty((len(maps), padded)), np.zeros(len(maps), np.bool_)
    shares = np.empty(padded)
    for i in range(len(slots)):
        row, e = row_of[slots[i]], map_of[slots[i]]
        names[i], times[i] = ids[slots[i]], counts[row, maps[e, best] if e > 0 else best]
        if not is_weighed[e]:
            is_weighed[e] = True
            _slot_weights(maps[e] if e > 0 else identity, weights, of_maps[e])
        whole = 0.0
        for place in range(padded):
            shares[place] = of_maps[e, place] if counts[row, place] > 0 else 0.0
            whole += shares[place]
        scale = 1.0 / max(whole, 1e-300)
        tiles = values[9 * row * padded : 9 * (row + 1) * padded].reshape((-1, 9, lanes))
        x, y, z = 0.0, 0.0, 0.0
        for block in range(len(tiles)):
            sums = _shared_mean(shares[block * lanes : (block + 1) * lanes], tiles[block])
            x, y, z = x + scale * sums[0], y + scale * sums[1], z + scale * sums[2]
        means[i, 0], means[i, 1], means[i, 2] = x, y, z
        covariance = covariances[i]
        for block in range(len(tiles)):
            spread = _shared_spread(shares[block * lanes : (block + 1) * lanes], tiles[block], x, y, z)
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


def map_mixture(
    maps: ParticleMaps, best: int, log_weights: FloatArray, scatter: FloatArray, min_count: int
) -> tuple[FloatArray, FloatArray, Any, IntArray, IntArray]:
    """Return the landmarks of one particle with mean and covariance over all that hold them, by ascending id.

    The covariance is sum w_m (Sigma_m + (mu_m - mu)(mu_m - mu)^T), with the weights of those particles scaled to sum
    to 1 (Sec. 3.2, see `docs/reference/errata.md`): Sigma_m alone is conditioned on the path of particle m. To it comes
    what the particles do not show of the map's frame.

    Args:
        maps: Of all particles; only looked at.
        best: The particle that says which landmarks there are.
        log_weights: (M,) normalised.
        scatter: (3, 3) covariance of the map's frame about its origin [m, m, rad]; 0 where particles show all.
        min_count: Landmarks that it measured fewer times are left out.

    Returns:
        Means (n, 3) [m] and covariances (n, 3, 3) [m^2], map frame, descriptors (n, d) float32, counts (n,) of
        particle `best`, and ids (n,): all fresh.
    """
    slots, weights = present_slots(maps, best, min_count), np.exp(log_weights)
    means, covariances, times, names = _mix(
        slots, maps.table, maps.maps, maps.values, maps.counts, best, weights, scatter, LANES
    )
    return means, covariances, maps.descriptors[slots], times, names
