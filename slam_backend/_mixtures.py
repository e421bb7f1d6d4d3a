"""What all particles together say: mixtures of their Gaussians, of a robot's pose and of landmarks."""

from typing import Any

import numpy as np

from slam_backend import _kernels
from slam_backend._best_map import slots_held
from slam_backend._jit import any_order, jit, lanes_inlined
from slam_backend._kernels import LANES
from slam_backend._kernels.layout import IDS, MAP_OF, ROW_OF
from slam_backend._particle_maps import ParticleMaps
from slam_backend.errors import FloatArray, IntArray
from slam_backend.reports import PoseEstimates


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


@any_order
def _sum(weights: FloatArray, one: FloatArray, two: FloatArray, count: int) -> float:
    """Return the weighted sum of the products of two rows, up to `count`."""
    total = 0.0
    for i in range(count):
        total += weights[i] * one[i] * two[i]
    return total


@lanes_inlined
def widen(scatter: FloatArray, x: float, y: float, covariance: FloatArray) -> None:
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
def _mix(
    slots: Any, table: Any, maps: Any, values: Any, counts: Any, best: int, weights: FloatArray, scatter: FloatArray,
    lanes: int,
) -> tuple[FloatArray, FloatArray, IntArray, IntArray]:  # fmt: skip
    """Return means (n, 3), covariances (n, 3, 3), counts (n,) and ids (n,) of landmarks, see `map_mixture`.

    The number of lanes is an argument, for a compiled kernel would not notice that it changed in another file.
    """
    row_of, map_of, ids = table[ROW_OF], table[MAP_OF], table[IDS]
    padded, size = counts.shape[1], len(weights)
    means, covariances = np.empty((len(slots), 3)), np.empty((len(slots), 3, 3))
    times, names = np.empty(len(slots), np.int64), np.empty(len(slots), np.int64)
    shares, own, ones = np.empty(size), np.empty((9, size)), np.ones(size)
    at = np.empty(size, np.int64)
    offsets = np.empty(padded, np.int64)  # of each particle's values in a row: a table, as divisions are dear
    for place in range(padded):
        offsets[place] = place // lanes * 9 * lanes + place % lanes
    for i in range(len(slots)):
        row, ancestors = row_of[slots[i]], map_of[slots[i]]
        times[i], names[i] = counts[row, maps[ancestors, best] if ancestors > 0 else best], ids[slots[i]]
        holders = 0
        for m in range(size):
            place = maps[ancestors, m] if ancestors > 0 else m
            if counts[row, place] > 0:
                at[holders], shares[holders] = row * 9 * padded + offsets[place], weights[m]
                holders += 1
        for c in range(9):
            for h in range(holders):
                own[c, h] = values[at[h] + c * lanes]
        whole = max(_sum(shares, ones, ones, holders), 1e-300)
        for h in range(holders):
            shares[h] /= whole
        for axis in range(3):
            means[i, axis] = _sum(shares, own[axis], ones, holders)
            for h in range(holders):
                own[axis, h] -= means[i, axis]
        entry = 3
        for j in range(3):
            for k in range(j, 3):
                mixed = _sum(shares, own[entry], ones, holders) + _sum(shares, own[j], own[k], holders)
                covariances[i, j, k] = covariances[i, k, j] = mixed
                entry += 1
        widen(scatter, means[i, 0], means[i, 1], covariances[i])
    return means, covariances, times, names


def map_mixture(
    maps: ParticleMaps, best: int, log_weights: FloatArray, scatter: FloatArray, min_count: int
) -> tuple[FloatArray, FloatArray, Any, IntArray, IntArray]:
    """Return the landmarks of one particle with mean and covariance over all that hold them, by ascending id.

    The covariance is sum w_m (Sigma_m + (mu_m - mu)(mu_m - mu)^T), with the weights of those particles scaled to sum
    to 1 (Sec. 3.2, see `docs/errata.md`): Sigma_m alone is conditioned on the path of particle m. To it comes what the
    particles do not show of the map's frame.

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
    slots, weights = slots_held(maps, best, min_count), np.exp(log_weights)
    means, covariances, times, names = _mix(
        slots, maps.table, maps.maps, maps.values, maps.counts, best, weights, scatter, LANES
    )
    return means, covariances, maps.descriptors[slots], times, names
