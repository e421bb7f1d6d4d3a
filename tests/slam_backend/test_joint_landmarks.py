"""The compiled join of two filters' landmarks agrees with one made of matrices, and touches neither filter."""

import numpy as np
import pytest
from filter_contents import load_landmarks
from gappy_filter import filter_with_gaps

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.fastslam._kernels import LANES
from slam_backend.fastslam.particle_maps import ParticleMaps
from slam_backend.maps.fusion import fuse_landmarks
from slam_backend.team.filter_merging.landmarks import Landmarks, joint_counts, write_joint

UPPER = np.triu_indices(3)
UNPACK = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
EXTRA, SCALE = 2e-4, 1.3


def plain_landmark(side: Landmarks, row: int, particle: int) -> tuple[FloatArray, FloatArray, int]:
    """Return mean, widened covariance and count of a landmark in a particle, from a copy of that particle's map."""
    values, counts = side.maps.of_particle(int(side.chosen[particle]), side.slots)
    spread = SCALE * (values[row, 3:][UNPACK] + EXTRA * np.eye(3))
    return values[row, :3], spread, int(counts[row])


def plain_join(
    a: Landmarks, b: Landmarks, rows_a: IntArray, rows_b: IntArray, motion: FloatArray
) -> tuple[FloatArray, IntArray]:
    """Return the joint landmarks (n, M, 9), zeros where a particle lacks one, and their counts (n, M)."""
    joint, counts = np.zeros((len(rows_a), len(motion), 9)), np.zeros((len(rows_a), len(motion)), np.int64)
    for p, (x, y, angle) in enumerate(motion):
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        for i, (j, k) in enumerate(zip(rows_a, rows_b, strict=True)):
            sides = [] if j < 0 else [plain_landmark(a, j, p)]
            if k >= 0:
                mean, spread, count = plain_landmark(b, k, p)
                sides.append((turn @ mean + [x, y, 0.0], turn @ spread @ turn.T, count))
            counts[i, p] = sum(side[2] for side in sides)
            held = [side[:2] for side in sides if side[2] > 0]
            if held:
                mean, spread = held[0] if len(held) == 1 else fuse_landmarks(*held[0], *held[1])
                joint[i, p] = np.concatenate([mean, spread[UPPER]])
    return joint, counts


@pytest.mark.parametrize("sizes", [(33, 70), (5, 5)])
def test_the_join_agrees_with_matrices(sizes: tuple[int, int]) -> None:
    """Of landmarks that both sides, one, or no particle of a side holds: the same numbers, with the same counts."""
    maps = [filter_with_gaps(size, 11 + size).state.maps for size in sizes]
    rng = np.random.default_rng(3)
    a, b = (Landmarks.of(side, rng.integers(0, side.num_particles, 40)) for side in maps)
    rows_a, rows_b = np.array([*range(len(a.slots)), -1, -1]), np.full(len(a.slots) + 2, -1)
    rows_b[[1, 2, 3, 4, -2, -1]] = [5, 0, 1, 4, 2, 3]
    motion = rng.uniform(-2.0, 2.0, (40, 3))
    before = [side.get_state() for side in maps]
    tiles = np.full((len(rows_a) + 1, 1, 9, LANES), np.nan)
    write_joint(a, b, rows_a, rows_b, motion, EXTRA, np.full(len(rows_a), SCALE), tiles)
    plain, plain_counts = plain_join(a, b, rows_a, rows_b, motion)
    found = tiles[:-1].transpose(0, 1, 3, 2).reshape(len(rows_a), -1, 9)
    np.testing.assert_array_equal(joint_counts(a, b, rows_a, rows_b), plain_counts)
    np.testing.assert_allclose(found[:, :40], plain, rtol=1e-9, atol=1e-12)
    assert not found[:, 40:].any()
    assert np.isnan(tiles[-1]).all()
    both = (a.counts[[1, 2, 3, 4]] > 0) & (b.counts[[5, 0, 1, 4]] > 0)
    assert both.any()
    for side, state in zip(maps, before, strict=True):
        np.testing.assert_array_equal(side.get_state()["map_of"], state["map_of"])


def test_landmarks_are_read_wherever_they_lie() -> None:
    """Values of some landmarks in any order, of all particles: those of the copies that each particle gives."""
    maps = filter_with_gaps(33, 21).state.maps
    names = maps.ids[maps.used_slots()][[4, 0, 3]]
    some = Landmarks.of(maps, ids=names)
    np.testing.assert_array_equal(some.ids, names)
    for m in range(33):
        values, counts = maps.of_particle(m, some.slots)
        np.testing.assert_array_equal(some.values[:, :, m], values)
        np.testing.assert_array_equal(some.counts[:, m], counts)


def test_two_exact_estimates_cannot_be_fused() -> None:
    """Landmarks without any uncertainty are refused, with a cure."""
    maps = ParticleMaps(2)
    exact = np.zeros((1, 9, 2))
    load_landmarks(
        maps, exact, np.ones((1, 2), np.int64), np.eye(1, 4, dtype=np.float32), np.arange(1), np.full(1, -1), 1
    )
    side, row = Landmarks.of(maps), np.zeros(1, np.int64)
    with pytest.raises(ValueError, match="landmarks in common: expected positive definite covariances, got 'singular"):
        write_joint(side, side, row, row, np.zeros((2, 3)), 0.0, np.ones(1), maps.blocks)
