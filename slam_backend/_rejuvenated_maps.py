"""How the landmarks of new particles are written into a filter's maps."""

import numpy as np

from slam_backend._best_map import slots_held
from slam_backend._jit import in_place
from slam_backend._particle_maps import ParticleMaps
from slam_backend.errors import FloatArray, IntArray
from slam_backend.smoothing.rejuvenation import Particles

NONE = -1  # no row of the new particles' landmarks
XX, YY, ZZ = 3, 6, 8  # the diagonal of a landmark's covariance, in the rows of a tile


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
    slots = slots_held(maps, best, 1)
    rows = np.empty_like(slots)
    find_rows(maps.ids[slots], particles.ids, particles.ids.argsort(), rows)
    supported = rows != NONE
    slots, rows = slots[supported], rows[supported]
    odds = maps.dense_odds(slots)
    if odds is not None:
        held = maps.dense(slots)[1] > 0
        mean = (odds * held).sum(axis=1) / np.maximum(held.sum(axis=1), 1)
        odds = mean[:, None]
    maps.load_names(
        particles.counts[rows, None], maps.descriptors[slots], maps.ids[slots], maps.identities[slots], maps.next_id,
        odds, maps.last_seen[slots],
    )  # fmt: skip
    write_tiles(particles.tiles, rows, walk, maps.blocks)


@in_place
def find_rows(names: IntArray, ids: IntArray, order: IntArray, rows: IntArray) -> None:
    """Write where the landmarks of some names lie among others.

    Args:
        names: (n,) ascending.
        ids, order: (l,), of the others, and their rows by ascending id.
        rows: (n,), result, `NONE` where there is none of that name.
    """
    at = 0
    for n in range(len(names)):
        while at < len(order) and ids[order[at]] < names[n]:
            at += 1
        rows[n] = order[at] if at < len(order) and ids[order[at]] == names[n] else NONE


@in_place
def write_tiles(tiles: FloatArray, rows: IntArray, walk: float, blocks: FloatArray) -> None:
    """Write some landmarks of new particles, with a variance [m^2] along each axis added to theirs.

    Args:
        tiles: (l, P / lanes, 9, lanes) means and covariances.
        rows: (n,) which of them.
        walk: The variance.
        blocks: (>= n, P / lanes, 9, lanes), of which the first are written.
    """
    for n in range(len(rows)):
        for b in range(tiles.shape[1]):
            tile, block = tiles[rows[n], b], blocks[n, b]
            for row in range(9):
                added = walk if row in (XX, YY, ZZ) else 0.0
                for lane in range(tiles.shape[3]):
                    block[row, lane] = tile[row, lane] + added  # (7) of docs/smoothing.md
