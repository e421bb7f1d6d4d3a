"""The map of one particle by ascending id, whole or as an outline."""

from typing import Any

import numpy as np

from slam_backend import _kernels
from slam_backend._particle_maps import ParticleMaps
from slam_backend.errors import FloatArray, IntArray
from slam_backend.landmark_map import OutlineRows


def write_outline(maps: ParticleMaps, m: int, min_count: int, rows: OutlineRows, first: int) -> int:
    """Write the outline of `best_map`, which takes the same: the same landmarks in the same order.

    Args:
        maps: Of all particles.
        m: Which of them.
        min_count: What it measured fewer times is left out.
        rows: Written to, as far as there are rows.
        first: From this row on.

    Returns:
        The row after the last, be it there or not.
    """
    last, ascending = _kernels.outline(maps.table, maps.maps, maps.values, maps.counts, m, min_count, *rows, first)
    if not ascending:
        order = first + np.argsort(rows.names[first:last, 1])
        for column in rows:
            column[first:last] = column[order]
    return last


def slots_held(maps: ParticleMaps, m: int, min_count: int) -> IntArray:
    """Return the slots (n,) of `best_map`, which takes the same, by ascending id."""
    slots, ascending = _kernels.hold(maps.table, maps.maps, maps.counts, m, min_count)
    return slots if ascending else slots[np.argsort(maps.ids[slots])]


def best_map(maps: ParticleMaps, m: int, min_count: int) -> tuple[FloatArray, FloatArray, Any, IntArray, IntArray]:
    """Return what one particle holds, by ascending id.

    Args:
        maps: Of all particles.
        m: Which of them.
        min_count: What it measured fewer times is left out.

    Returns:
        Means (n, 3) [m], covariances (n, 3, 3) [m^2], map frame, descriptors (n, d) float32, counts (n,) and ids (n,):
        all fresh.
    """
    slots = slots_held(maps, m, min_count)
    means, covariances, times, names = _kernels.gather(slots, maps.table, maps.maps, maps.values, maps.counts, m)
    return means, covariances, maps.descriptors[slots], times, names
