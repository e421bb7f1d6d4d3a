"""The merge by mixture covariances: two maps are fused once, and all particles of the joint filter share the result.

Sec. 3.2 as it is printed fuses the covariances of the best particle's map, which are conditioned on one path and far
too small. Here they are mixture covariances over all particles (see `docs/errata.md`), so that the map's own
uncertainty is right. But that a particle's path and its map belong together is lost: `slam_backend.merging` keeps it,
and is the default.
"""

import numpy as np

from slam_backend._joint_landmarks import agreed
from slam_backend._joint_robots import finish, joined_robots
from slam_backend._packed import UPPER
from slam_backend.alignment import Alignment
from slam_backend.errors import IntArray
from slam_backend.filter import FastSlam
from slam_backend.fusion import fuse_maps
from slam_backend.resampling import systematic


def merge_mixtures(
    a: FastSlam,
    b: FastSlam,
    alignment: Alignment,
    pairs: IntArray,
    rng: np.random.Generator,
    num_particles: int | None = None,
) -> tuple[FastSlam, IntArray]:
    """Merge two filters into a joint one in a's map frame whose particles share one map (Sec. 3.2, Eqs. 13-17).

    Particles are paired at random. Each moves the poses of b by a motion of its own, drawn from the alignment; the
    common map has the alignment's uncertainty in its covariances.

    Args:
        a: Filter whose map frame and landmark ids stay.
        b: The other filter.
        alignment: Motion a_from_b of the maps, successful.
        pairs: (k, 2) int64 rows (landmark id in a, landmark id in b) in common, one-to-one; names that the caller has
            given decide, as in `merge_filters`.
        rng: For the pairing and the draws.
        num_particles: Of the joint filter; None: as many as the larger of the two.

    Returns:
        The joint filter, a's robots first; and (n, 2) int64 rows (id in b, id in the joint map) of the landmarks of b's
        most probable particle.
    """
    count = max(a.num_particles, b.num_particles) if num_particles is None else num_particles
    map_a, map_b = a.map("mixture"), b.map("mixture")
    pairs = np.concatenate(agreed(a._maps, b._maps, pairs))
    pairs = pairs[np.isin(pairs[:, 0], map_a.ids) & np.isin(pairs[:, 1], map_b.ids)]
    inliers = np.column_stack([np.searchsorted(map_a.ids, pairs[:, 0]), np.searchsorted(map_b.ids, pairs[:, 1])])
    matched = Alignment(
        True, "", alignment.tx, alignment.ty, alignment.theta, alignment.covariance, inliers, alignment.ratio
    )
    from_a = systematic(a.weights, rng, count)
    from_b = rng.permutation(systematic(b.weights, rng, count))
    motion = rng.multivariate_normal(alignment.transform, alignment.covariance, count, method="eigh")
    joint = joined_robots(a, from_a, b, from_b, motion, rng)
    joint._path_log_weights[:] = a._path_log_weights[from_a] + b._path_log_weights[from_b]

    own = np.setdiff1d(np.arange(len(map_b)), inliers[:, 1])
    next_id = a._maps.next_id
    new_ids = next_id + np.arange(len(own))
    names_a, names_b = _identities(a, map_a.ids), _identities(b, map_b.ids)
    names_a[inliers[:, 0]] = np.where(names_a[inliers[:, 0]] < 0, names_b[inliers[:, 1]], names_a[inliers[:, 0]])
    if len(map_a) and len(map_b):
        fused = fuse_maps(map_a, map_b, matched)  # a's rows, then b's that were not fused, in their order
    else:
        fused = map_a if len(map_a) else map_b.moved(alignment.transform)
    values = np.concatenate([fused.means, fused.covariances[:, *UPPER]], axis=1)
    joint._maps.load(
        np.repeat(values[:, :, None], count, axis=2),
        np.repeat(fused.counts[:, None], count, axis=1),
        fused.descriptors,
        np.concatenate([map_a.ids, new_ids]),
        np.concatenate([names_a, names_b[own]]),
        next_id + len(own),
    )
    renamed = np.concatenate([pairs[:, ::-1], np.column_stack([map_b.ids[own], new_ids])]).astype(np.int64)
    finish(joint, a, b, renamed)
    return joint, renamed


def _identities(slam: FastSlam, ids: IntArray) -> IntArray:
    """Return the caller's own names of landmarks by id, -1 = none."""
    slots = slam._maps.used_slots()
    return np.array(slam._maps.identities[slots][np.searchsorted(slam._maps.ids[slots], ids)])
