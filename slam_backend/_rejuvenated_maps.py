"""How the landmarks of new particles are written into a filter's maps."""

import numpy as np

from slam_backend._particle_maps import ParticleMaps
from slam_backend.smoothing.rejuvenation import Particles

DIAGONAL = [3, 6, 8]  # of a landmark's covariance, in the rows of a tile


def write_maps(maps: ParticleMaps, best: int, particles: Particles, walk: float) -> None:
    """Give all particles the landmarks of their paths: those that the most probable one held and a sighting supports.

    What only others held was a mistake, as far as is known: the log's association is that of the most probable. Names,
    descriptors and odds stay; where a landmark's odds differ between particles, all get the mean of those that held it.
    To the smoother landmarks stand still; that they may move until they are seen the next time is added here.

    Args:
        maps: Of the filter, changed.
        best: Its most probable particle.
        particles: The new ones.
        walk: Variance [m^2] along each axis, see `FilterOptions.landmark_walk`.
    """
    slots = maps.used_slots()
    slots = slots[(maps.of_particle(best, slots)[1] > 0) & np.isin(maps.ids[slots], particles.ids)]
    rows = np.searchsorted(particles.ids[order := np.argsort(particles.ids)], maps.ids[slots])
    rows = order[rows]
    m = maps.num_particles
    odds = maps.dense_odds(slots)
    if odds is not None:
        held = maps.dense(slots)[1] > 0
        mean = (odds * held).sum(axis=1) / np.maximum(held.sum(axis=1), 1)
        odds = np.broadcast_to(mean[:, None], (len(mean), m))
    maps.load_tiles(
        particles.tiles, np.broadcast_to(particles.counts[rows, None], (len(rows), m)), maps.descriptors[slots],
        maps.ids[slots], maps.identities[slots], maps.next_id, odds, rows, maps.last_seen[slots],
    )  # fmt: skip
    for row in DIAGONAL:
        maps.blocks[: len(rows), :, row] += walk  # (7) of docs/smoothing.md
