"""Maps over all particles, of the best one, and of pairs of them: compiled as in the plain definition."""

import math

import numpy as np
import pytest
from builders.filters import filter_after_some_steps, filter_with_gaps, load_landmarks

from slam_backend import FastSlam, Measurements
from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.fastslam._kernels import LANES
from slam_backend.fastslam._kernels.layout import ROW_OF
from slam_backend.fastslam.estimates import map_mixture
from slam_backend.fastslam.particle_maps import ParticleMaps, best_map, write_summary
from slam_backend.maps.fusion import fuse_landmarks
from slam_backend.maps.landmark_map import LandmarkMap, MapSummaryRows
from slam_backend.team.filter_merging.landmarks import Landmarks, joint_counts, write_joint
from slam_backend.team.filter_merging.pairing import MIN_PAIRS, fit, reduced_chi2

UNPACK = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
SCATTER = np.array([[3e-2, 1e-3, 2e-3], [1e-3, 2e-2, -1e-3], [2e-3, -1e-3, 5e-3]])  # of the frame [m, m, rad]


def plain_mixture(slam: FastSlam, min_count: int) -> LandmarkMap:
    """Return the same map by sums over all that `dense` copies."""
    maps, best = slam.maps, slam.best_particle
    slots = maps.used_slots()
    counts = maps.of_particle(best, slots)[1]
    slots, counts = slots[counts >= min_count], counts[counts >= min_count]
    dense, times = maps.dense(slots)
    weights = np.exp(slam.log_weights) * (times > 0)
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
            raw = map_mixture(slam.maps, slam.best_particle, slam.log_weights, SCATTER, least)
            np.testing.assert_array_equal(raw[1], raw[1].transpose(0, 2, 1))
            found = LandmarkMap(*raw)
            plain = plain_mixture(slam, least)
            np.testing.assert_array_equal(found.ids, plain.ids)
            np.testing.assert_array_equal(found.counts, plain.counts)
            np.testing.assert_array_equal(found.descriptors, plain.descriptors)
            np.testing.assert_allclose(found.means, plain.means, rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(found.covariances, plain.covariances, rtol=1e-9, atol=1e-15)
            assert len(plain) > (5 if least == 1 else 0)


def test_computing_a_mixture_changes_nothing() -> None:
    """Maps that wait to be brought up to date still wait afterwards."""
    slam = filter_with_gaps(33, 8)
    before = slam.maps.compact()
    assert before.map_of.any()
    slam.map("mixture")
    after = slam.maps.compact()
    for name in ("map_of", "maps", "counts", "values"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))


def test_slots_that_no_particle_holds_are_not_read() -> None:
    """Slots with a count of zero may hold any values."""
    slam = filter_with_gaps(33, 9)
    asked = slam.maps, slam.best_particle, slam.log_weights, SCATTER, 1
    before = map_mixture(*asked)
    counts = slam.maps.counts
    tiles = slam.maps.values.reshape(len(counts), -1, 9, LANES)
    unheld = np.broadcast_to(counts.reshape(len(counts), -1, 1, LANES) == 0, tiles.shape)
    assert unheld[slam.maps.table[ROW_OF, slam.maps.used_slots()]].any()
    tiles[unheld] = np.nan
    for one, other in zip(before, map_mixture(*asked), strict=True):
        np.testing.assert_array_equal(one, other)


def _filter_after_some_steps() -> FastSlam:
    """Return a filter that has resampled, and in which landmarks came and went."""
    slam, points, looks = filter_after_some_steps(70, seed=3)
    slam.maps.release(slam.maps.used_slots()[[2, 5]])
    extra = Measurements(points[:2] + np.array([0.0, 0.0, 3.0]), -looks[:2])
    slam.step([None], [extra])
    return slam


def test_the_gather_agrees_with_fancy_indexing() -> None:
    """For each of 70 particles and any least count: the same landmarks, by ascending id, with the same bits."""
    slam = _filter_after_some_steps()
    maps = slam.maps
    slots = maps.used_slots()
    assert not (np.diff(slots) > 0).all()  # slots were used again: ids do not ascend with them
    for m in range(70):
        values, counts = maps.of_particle(m, slots)
        for least in (1, 2, 5):
            means, covariances, looks, times, ids = best_map(maps, m, least)
            held = counts >= least
            np.testing.assert_array_equal(means, values[held, :3])
            np.testing.assert_array_equal(covariances, values[held][:, 3:][:, UNPACK])
            np.testing.assert_array_equal(looks, maps.descriptors[slots[held]])
            np.testing.assert_array_equal(times, counts[held])
            np.testing.assert_array_equal(ids, maps.ids[slots[held]])


def test_a_map_summary_agrees_with_the_map() -> None:
    """It has the map's landmarks in the map's order, with the same bits, whatever the least count."""
    slam = _filter_after_some_steps()
    for least in (0, 1, 3, 9):
        for got, expected in zip(slam.map_summary(least), slam.map(min_count=least).summary, strict=True):
            np.testing.assert_array_equal(got, expected)
    assert len(FastSlam(num_particles=3).map_summary().ids) == 0


@pytest.mark.parametrize("room", [0, 5, 9, 100])
def test_a_map_summary_reports_its_number_of_rows(room: int) -> None:
    """It returns the number of rows that are needed, and writes none beyond those of the map."""
    slam = _filter_after_some_steps()
    expected = slam.map_summary(2)
    size = len(expected.ids)
    assert 9 - 3 < size < 100 - 3
    rows = MapSummaryRows(np.full((room, 4), -7.0), np.full((room, 2), -7))
    assert write_summary(slam.maps, slam.best_particle, 2, rows, 3) == 3 + size
    for got in rows:
        assert (got[:3] == -7).all()
        assert (got[3 + size :] == -7).all()
    if room >= 3 + size:
        for got, own in zip(rows.part(3, 3 + size), expected, strict=True):
            np.testing.assert_array_equal(got, own)


UPPER = np.triu_indices(3)
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
    maps = [filter_with_gaps(size, 11 + size).maps for size in sizes]
    rng = np.random.default_rng(3)
    a, b = (Landmarks.of(side, rng.integers(0, side.num_particles, 40)) for side in maps)
    rows_a, rows_b = np.array([*range(len(a.slots)), -1, -1]), np.full(len(a.slots) + 2, -1)
    rows_b[[1, 2, 3, 4, -2, -1]] = [5, 0, 1, 4, 2, 3]
    motion = rng.uniform(-2.0, 2.0, (40, 3))
    before = [side.compact() for side in maps]
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
        np.testing.assert_array_equal(side.compact().map_of, state.map_of)


def test_landmarks_are_read_wherever_they_lie() -> None:
    """Values of some landmarks in any order, of all particles: those of the copies that each particle gives."""
    maps = filter_with_gaps(33, 21).maps
    names = maps.ids[maps.used_slots()][[4, 0, 3]]
    some = Landmarks.of(maps, ids=names)
    np.testing.assert_array_equal(some.ids, names)
    for m in range(33):
        values, counts = maps.of_particle(m, some.slots)
        np.testing.assert_array_equal(some.values[:, :, m], values)
        np.testing.assert_array_equal(some.values_by_particle[m], values)
        np.testing.assert_array_equal(some.held_by_particle[m], counts > 0)
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


START = np.array([1.05, 1.95, 0.69])
Common = tuple[FloatArray, BoolArray, FloatArray, BoolArray, IntArray, IntArray]


def common_landmarks(seed: int, count: int, pairs: int) -> Common:
    """Return the landmarks that two filters share, which of their particles hold them, and pairs of these."""
    rng = np.random.default_rng(seed)
    c, s = math.cos(0.7), math.sin(0.7)
    turn, shift = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.array([1.0, 2.0, 0.0])
    truth = rng.uniform(-9.0, 9.0, (count, 3)) * [1.0, 1.0, 0.1]
    sides = []
    for points, particles in ((truth, 11), ((truth - shift) @ turn, 7)):
        roots = 0.03 * rng.standard_normal((count, particles, 3, 3))
        spread = roots @ roots.transpose(0, 1, 3, 2) + 1e-4 * np.eye(3)
        values = np.empty((count, 9, particles))
        values[:, :3] = points[:, :, None] + rng.normal(0.0, 0.04, (count, 3, particles))
        values[:, 3:] = spread[..., *UPPER].transpose(0, 2, 1)
        held = rng.random((count, particles)) < 0.8
        sides += [np.ascontiguousarray(values.transpose(2, 0, 1)), np.ascontiguousarray(held.T)]
    return sides[0], sides[1], sides[2], sides[3], rng.integers(0, 11, pairs), rng.integers(0, 7, pairs)


def plain_fit(
    common: Common, pair: int, motion: FloatArray, extra: float, iterations: int
) -> tuple[FloatArray, FloatArray, float, float, int, float]:
    """Return what `fit` says of one pair of particles, and how fast chi^2 falls with tau^2, by matrices."""
    a, held_a, b, held_b, from_a, from_b = common
    m, n = from_a[pair], from_b[pair]
    both = held_a[m] & held_b[n]
    ours, theirs = a[m, both], b[n, both]
    motion = motion.copy()
    for iteration in range(iterations + 1):
        c, s = math.cos(motion[2]), math.sin(motion[2])
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        turned = theirs[:, :3] @ turn.T
        spread = ours[:, 3:][:, UNPACK] + turn @ theirs[:, 3:][:, UNPACK] @ turn.T + extra * np.eye(3)
        information = np.linalg.inv(spread)
        residuals = ours[:, :3] - turned - [motion[0], motion[1], 0.0]
        jacobian = np.zeros((len(ours), 3, 3))
        jacobian[:, 0, 0] = jacobian[:, 1, 1] = 1.0
        jacobian[:, 0, 2], jacobian[:, 1, 2] = -turned[:, 1], turned[:, 0]
        normal = np.einsum("kia,kij,kjb->ab", jacobian, information, jacobian)
        weighted = np.einsum("kij,kj->ki", information, residuals)
        if iteration < iterations and both.sum() >= MIN_PAIRS:
            motion += np.linalg.solve(normal, np.einsum("kia,ki->a", jacobian, weighted))
    log_det = float(np.linalg.slogdet(2.0 * np.pi * spread)[1].sum())
    return motion, normal, float((weighted * residuals).sum()), log_det, int(both.sum()), float((weighted**2).sum())


@pytest.mark.parametrize(("count", "pairs"), [(20, 1), (12, 16), (4, 19), (0, 2)])
def test_the_fit_agrees_with_matrices(count: int, pairs: int) -> None:
    """Of each pair of particles, whatever it shares: motion, information, chi^2, log-determinants, how many."""
    common = common_landmarks(count, count, pairs)
    for extra in (0.0, 0.02):
        found = fit(common[:4], *common[4:], START, extra, 3)
        for pair in range(pairs):
            plain = plain_fit(common, pair, START, extra, 3)
            for one, other in zip(found, plain, strict=False):
                np.testing.assert_allclose(one[pair], other, rtol=1e-9, atol=1e-9)
    if count == 4:  # there are pairs on either side of what is enough
        assert found[4].min() < MIN_PAIRS <= found[4].max()


def test_unexplained_variance_agrees_with_newtons_method() -> None:
    """tau^2 of each pair is what the plain rounds come to; where it is not 0, chi^2 is its degrees of freedom then."""
    common = common_landmarks(3, 15, 21)
    extra, shared = reduced_chi2(common[:4], *common[4:], START, 8)
    for pair in range(21):
        motion, plain = START, 0.0
        for _ in range(8):
            motion, _, chi2, _, k, slope = plain_fit(common, pair, motion, plain, 1)
            freedom = 3.0 * k - 3.0
            plain = max(plain + chi2 * (chi2 - freedom) / (freedom * slope), 0.0)
        assert shared[pair] == k
        assert extra[pair] == pytest.approx(plain, rel=1e-9)
        chi2 = plain_fit(common, pair, motion, plain, 5)[2]
        assert chi2 == pytest.approx(freedom, rel=1e-4) if plain > 0.0 else chi2 <= freedom
    assert np.count_nonzero(extra) > 8
    exact = (common[0], common[1], common[0], common[1])
    assert not reduced_chi2(exact, common[4], common[4], np.zeros(3), 8)[0].any()  # a map agrees with itself


def test_landmarks_at_one_place_do_not_change_the_motion() -> None:
    """Where all that is shared lies at one place the motion stays as it began, and nothing is infinite."""
    values, held = np.zeros((1, 5, 9)), np.ones((1, 5), np.bool_)
    values[:, :, [3, 6, 8]] = 0.01
    none = np.zeros(2, np.int64)
    motions = fit((values, held, values, held), none, none, np.array([0.3, 0.2, 0.1]), 0.0, 3)[0]
    np.testing.assert_allclose(motions, [[0.3, 0.2, 0.1]] * 2, atol=1e-12)
