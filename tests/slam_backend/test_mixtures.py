"""The compiled mixture over all particles agrees with the plain sums, and reads maps without touching them."""

import numpy as np
from gappy_filter import filter_with_gaps

from slam_backend import FastSlam
from slam_backend.fastslam._kernels import LANES
from slam_backend.fastslam._kernels.layout import ROW_OF
from slam_backend.fastslam.estimates import map_mixture
from slam_backend.maps.landmark_map import LandmarkMap

UNPACK = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
SCATTER = np.array([[3e-2, 1e-3, 2e-3], [1e-3, 2e-2, -1e-3], [2e-3, -1e-3, 5e-3]])  # of the frame [m, m, rad]


def plain_mixture(slam: FastSlam, min_count: int) -> LandmarkMap:
    """Return the same map by sums over all that `dense` copies."""
    maps, best = slam.state.maps, slam.best_particle
    slots = maps.used_slots()
    counts = maps.of_particle(best, slots)[1]
    slots, counts = slots[counts >= min_count], counts[counts >= min_count]
    dense, times = maps.dense(slots)
    weights = np.exp(slam.state.log_weights) * (times > 0)
    weights /= weights.sum(axis=1, keepdims=True)
    mixed = np.einsum("ncm,nm->nc", dense, weights)
    offsets = dense[:, :3] - mixed[:, :3, None]
    covariances = mixed[:, 3:][:, UNPACK] + np.einsum("nim,njm,nm->nij", offsets, offsets, weights)
    slopes = np.zeros((len(mixed), 3, 3))
    slopes[:, 0, 0] = slopes[:, 1, 1] = 1.0
    slopes[:, 0, 2], slopes[:, 1, 2] = -mixed[:, 1], mixed[:, 0]
    covariances += slopes @ SCATTER @ slopes.transpose(0, 2, 1)
    return LandmarkMap(mixed[:, :3], covariances, maps.descriptors[slots], counts, maps.ids[slots])


def test_the_kernel_agrees_with_plain_sums() -> None:
    """Whatever the number of particles, and however often a landmark has to be seen: the same map, to rounding.

    Covariances hold what a scattered frame adds, and are symmetric to the last bit.
    """
    for num_particles, seed in ((1, 5), (8, 6), (70, 7)):
        slam = filter_with_gaps(num_particles, seed)
        for least in (1, 2):
            raw = map_mixture(slam.state.maps, slam.best_particle, slam.state.log_weights, SCATTER, least)
            np.testing.assert_array_equal(raw[1], raw[1].transpose(0, 2, 1))
            found = LandmarkMap(*raw)
            plain = plain_mixture(slam, least)
            np.testing.assert_array_equal(found.ids, plain.ids)
            np.testing.assert_array_equal(found.counts, plain.counts)
            np.testing.assert_array_equal(found.descriptors, plain.descriptors)
            np.testing.assert_allclose(found.means, plain.means, rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(found.covariances, plain.covariances, rtol=1e-9, atol=1e-15)
            assert len(plain) > (7 if least == 1 else 0)


def test_to_ask_for_a_mixture_changes_nothing() -> None:
    """Maps that wait to be brought up to date still wait afterwards."""
    slam = filter_with_gaps(33, 8)
    before = slam.state.maps.get_state()
    assert before["map_of"].any()
    slam.map("mixture")
    after = slam.state.maps.get_state()
    for name in ("map_of", "maps", "values", "counts"):
        np.testing.assert_array_equal(after[name], before[name])


def test_what_no_particle_holds_is_not_read() -> None:
    """Places that no count vouches for may hold anything at all."""
    slam = filter_with_gaps(33, 9)
    asked = slam.state.maps, slam.best_particle, slam.state.log_weights, SCATTER, 1
    before = map_mixture(*asked)
    counts = slam.state.maps.counts
    tiles = slam.state.maps.values.reshape(len(counts), -1, 9, LANES)
    unheld = np.broadcast_to(counts.reshape(len(counts), -1, 1, LANES) == 0, tiles.shape)
    assert unheld[slam.state.maps.table[ROW_OF, slam.state.maps.used_slots()]].any()
    tiles[unheld] = np.nan
    for one, other in zip(before, map_mixture(*asked), strict=True):
        np.testing.assert_array_equal(one, other)
