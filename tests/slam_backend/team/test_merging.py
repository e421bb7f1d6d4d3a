from typing import Any

import numpy as np
import pytest
from builders.comparison import assert_same
from builders.filters import (
    A_FROM_B,
    LANDMARKS,
    MOVE,
    NAMES_A,
    NAMES_B,
    PAIRS,
    WIDE_MOTION,
    arrays_of,
    contents,
    dense,
    frame_of,
    known_alignment,
    load_landmarks,
    looks,
    map_once,
    names_of,
)
from hypothesis import given
from hypothesis import strategies as st

from slam_backend.core.packed_symmetric import UNPACK_INDEX
from slam_backend.core.validation import IntArray
from slam_backend.fastslam import particle_maps as _map_store
from slam_backend.fastslam.filter import FastSlam
from slam_backend.geometry import compose, inverse, rotate_covariances, rotation, transform_points, wrap_angle
from slam_backend.maps.alignment import Alignment
from slam_backend.maps.fusion import fuse_landmarks
from slam_backend.models.measurements import Measurements
from slam_backend.models.odometry import OdometryModel
from slam_backend.team.filter_merging.merging import inverse_alignment, merge_filters

NO_PAIRS = np.empty((0, 2), np.int64)


def both(sigma: float = 0.01, seed: int = 0, particles: tuple[int, int] = (7, 7)) -> tuple[FastSlam, FastSlam]:
    """Two filters that stand at their starts and share five landmarks."""
    rng = np.random.default_rng(seed)
    a = map_once(NAMES_A, np.zeros(3), sigma, rng, particles[0])
    return a, map_once(NAMES_B, A_FROM_B, sigma, rng, particles[1])


def new_frame() -> Measurements:
    """A frame with one landmark of a new look."""
    return frame_of(np.array([[2.5, 0.5, 0.1]]), np.array([11]), 0.05)


# ---------------------------------------------------------------------- the alignment seen from the other map


@given(st.floats(-20, 20), st.floats(-20, 20), st.floats(-3.1, 3.1), st.integers(0, 99))
def test_inverse_alignment_carries_the_covariance_through_the_numerical_jacobian(
    x: float, y: float, theta: float, seed: int
) -> None:
    """The covariance of the inverse motion is J Sigma J^T with J by finite differences, and the pairs are swapped."""
    root = np.random.default_rng(seed).normal(size=(3, 3))
    alignment = Alignment(True, "", x, y, theta, root @ root.T, np.array([[2, 5], [4, 1]]), 0.25)
    turned = inverse_alignment(alignment)
    step = 1e-6
    columns = []
    for axis in np.eye(3):
        change = inverse(alignment.transform + step * axis) - inverse(alignment.transform - step * axis)
        columns.append([*change[:2], wrap_angle(change[2])])
    jacobian = np.array(columns).T / (2 * step)
    expected = jacobian @ alignment.covariance @ jacobian.T
    np.testing.assert_allclose(turned.covariance, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())
    np.testing.assert_array_equal(turned.inliers, [[5, 2], [1, 4]])
    np.testing.assert_allclose(turned.transform, inverse(alignment.transform))
    assert turned.ratio == alignment.ratio
    np.testing.assert_allclose(inverse_alignment(turned).transform, alignment.transform, atol=1e-12)


# ---------------------------------------------------------------------- what a merge gives


@pytest.mark.parametrize("sigma", [1e-2, 1e-4, 1e-6])
def test_the_error_of_a_merge_vanishes_with_the_noise(sigma: float) -> None:
    """With noise sigma, b's pose and all landmarks land within 10 sigma of the truth, from an alignment far off."""
    a, b = both(sigma)
    joint, _ = merge_filters(a, b, known_alignment(offset=(0.1, -0.1, 0.05)), PAIRS, np.random.default_rng(1))
    names = names_of(joint)
    merged = joint.map()
    truth = LANDMARKS[[names[landmark] for landmark in merged.ids.tolist()]]
    assert np.abs(merged.means - truth).max() < 10 * sigma
    assert np.abs(joint.pose(1).mean - A_FROM_B).max() < 10 * sigma
    assert np.abs(joint.start_pose(1) - A_FROM_B).max() < 10 * sigma
    np.testing.assert_array_equal(joint.pose(0).mean, 0.0)


def test_ids_of_a_stay_and_those_of_b_are_renamed_one_to_one() -> None:
    """Each landmark of b gets one id of the joint map, its own or that of its partner in a; a's keep theirs.

    The joint map is the union, with counts added where both saw one; no id is given a second time.
    """
    a, b = both()
    joint, renamed = merge_filters(a, b, known_alignment(), PAIRS, np.random.default_rng(1))
    names_a, names_b, names = names_of(a), names_of(b), names_of(joint)
    assert {landmark: names[landmark] for landmark in names_a} == names_a
    assert sorted(renamed[:, 0]) == sorted(names_b)
    assert len(np.unique(renamed[:, 1])) == len(renamed)
    assert [names[new] for new in renamed[:, 1].tolist()] == [names_b[old] for old in renamed[:, 0].tolist()]
    merged = joint.map()
    held = [names[landmark] for landmark in merged.ids.tolist()]
    assert sorted(held) == list(range(9))
    np.testing.assert_array_equal(merged.counts, np.where(np.isin(held, NAMES_A[:5]), 2, 1))
    used = set(names) | set(renamed.ravel().tolist())
    report = joint.step([None, None], [new_frame(), None], identities=[np.array([11]), None])
    assert report.created[0][0] == max(used) + 1


def test_a_fused_landmark_keeps_the_callers_id() -> None:
    """Where a's landmark has no name of the caller's, the fused one takes that of b."""
    a, b = both()
    a.maps.identities[a.maps.ids == 2] = -1
    joint, _ = merge_filters(a, b, known_alignment(), PAIRS, np.random.default_rng(1))
    assert names_of(joint)[2] == NAMES_A[2]


@pytest.mark.parametrize("particles", [(7, 11), (11, 7)])
@pytest.mark.parametrize("wanted", [None, 3, 25])
def test_a_joint_filter_has_as_many_particles_as_said_or_as_the_larger(
    particles: tuple[int, int], wanted: int | None
) -> None:
    """Weights after a merge are uniform, whatever M."""
    joint, _ = merge_filters(*both(particles=particles), known_alignment(), PAIRS, np.random.default_rng(1), wanted)
    m = wanted or 11
    assert joint.num_particles == joint.options.num_particles == m
    np.testing.assert_allclose(joint.weights, 1 / m)
    ids, means, covariances, counts = dense(joint)
    assert (means.shape, covariances.shape, counts.shape) == ((9, 3, m), (9, 6, m), (len(ids), m))
    for robot in range(2):
        assert joint.particles(robot)[0].shape == joint.particles_from_start(robot).shape == (m, 3)


def test_a_joint_filter_shares_no_memory_with_the_old_ones() -> None:
    """Neither the merge nor steps of the joint filter change the two filters it was made of."""
    a, b = both()
    before = [contents(slam) for slam in (a, b)]
    joint, _ = merge_filters(a, b, known_alignment(), PAIRS, np.random.default_rng(1))
    for name, value in arrays_of(joint).items():
        for old in (a, b):
            for old_name, old_value in arrays_of(old).items():
                assert not np.shares_memory(value, old_value), (name, old_name)
    joint.step([np.array([0.1, 0.0, 0.1])] * 2, [new_frame(), new_frame()])
    for slam, kept in zip((a, b), before, strict=True):
        assert_same(contents(slam), kept)


def test_common_landmarks_are_fused_at_each_particle_s_own_motion() -> None:
    """A particle's common landmark is Eqs. 13-15 of a's and b's, the latter moved by that particle's draw (Eq. 16)."""
    a, b = both(sigma=0.3)  # wide, so that the draws of T differ visibly
    joint, _ = merge_filters(a, b, known_alignment(), PAIRS, np.random.default_rng(1))
    motions = joint.particles(1)[0]  # b stands at its start, so its poses are the motions a_from_b
    assert np.ptp(motions, axis=0).min() > 0.05
    map_a, map_b = a.map(), b.map()  # no robot moved: the same in all particles
    _, joint_means, joint_covariances, _ = dense(joint)
    scale = joint_covariances[5, 5] / map_a.covariances[5, 2, 2]  # of a landmark that only a has
    for m, motion in enumerate(motions):
        means_b = transform_points(motion, map_b.means[PAIRS[:, 1]])
        covariances_b = rotate_covariances(motion[2], map_b.covariances[PAIRS[:, 1]])
        means, covariances = fuse_landmarks(
            map_a.means[PAIRS[:, 0]], scale[m] * map_a.covariances[PAIRS[:, 0]], means_b, scale[m] * covariances_b
        )
        np.testing.assert_allclose(joint_means[:5, :, m], means, rtol=1e-10)
        np.testing.assert_allclose(joint_covariances[:5, :, m][:, UNPACK_INDEX], covariances, atol=1e-12)


def test_descriptors_are_averaged_by_counts_and_keep_their_length() -> None:
    """A landmark seen thrice by a, once by b, looks three quarters like a's, at unit length (Sec. 3.2, corrected)."""
    a, b = both()
    for _ in range(2):
        a.step([None], [frame_of(LANDMARKS[NAMES_A], NAMES_A, 0.01)], identities=[NAMES_A])
    b.maps.descriptors[b.maps.ids == 1] = looks(np.array([12]))  # b's view of landmark 4
    joint, _ = merge_filters(a, b, known_alignment(), PAIRS, np.random.default_rng(1))
    fused = joint.map().descriptors[4]
    expected = 3 * looks(np.array([4]))[0] + looks(np.array([12]))[0]
    np.testing.assert_allclose(fused, expected / np.sqrt(10), atol=1e-6)


@pytest.mark.parametrize("shared", [0, 2])
def test_without_enough_common_landmarks_the_alignment_s_own_covariance_is_used(shared: int) -> None:
    """The spread of the motions is that of the alignment.

    900 whitened draws: each mean is 0 +- 5 / 30, each variance 1 +- 5 sqrt(2 / 900); false alarm below 1e-5.
    """
    a, b = both(particles=(900, 5))
    root = np.array([[0.2, 0.0, 0.0], [-0.1, 0.3, 0.0], [0.02, -0.03, 0.05]])
    near_pi = np.array([1.0, -2.0, np.pi - 0.01])  # the draws of the heading cross the cut
    alignment = Alignment(True, "", *near_pi, root @ root.T, NO_PAIRS, 0.0)
    joint, renamed = merge_filters(a, b, alignment, PAIRS[:shared], np.random.default_rng(1))
    offsets = joint.particles(1)[0] - near_pi
    offsets[:, 2] = wrap_angle(offsets[:, 2])
    white = np.linalg.solve(root, offsets.T)
    assert np.abs(white.mean(axis=1)).max() < 5 / 30
    np.testing.assert_allclose(np.cov(white), np.eye(3), atol=5 * np.sqrt(2 / 900))
    assert len(joint.map()) == 14 - 5  # five have one name on both sides, listed or not
    assert len(renamed) == 7


def test_a_known_motion_is_taken_whatever_the_landmarks_say() -> None:
    """Landmarks in common correct an alignment that is off, however sure it claims to be, unless it is known."""
    off = (0.3, -0.2, 0.1)
    for known, moved in ((False, (0.0, 0.0, 0.0)), (True, off)):
        a, b = both()
        joint, _ = merge_filters(a, b, known_alignment(1e-6, off), PAIRS, np.random.default_rng(1), known=known)
        np.testing.assert_allclose(joint.start_pose(1), A_FROM_B + moved, atol=1e-4 if known else 0.05)
        assert len(joint.map()) == len(LANDMARKS)


@pytest.mark.parametrize("empty_first", [True, False])
def test_a_filter_without_landmarks_joins_by_the_alignment_alone(empty_first: bool) -> None:
    """A robot that has seen nothing yet brings its pose, and nothing is lost."""
    full, _ = both()
    blank = FastSlam(1, 7, seed=1)
    a, b = (blank, full) if empty_first else (full, blank)
    joint, _ = merge_filters(a, b, known_alignment(sigma=1e-6), NO_PAIRS, np.random.default_rng(1))
    assert len(joint.map()) == 7
    assert np.abs(joint.pose(1).mean - A_FROM_B).max() < 1e-4
    report = joint.step([None, None], [new_frame(), None])
    assert report.num_new == 1


def test_uninitialised_rows_are_never_read(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows are made without being written: whatever was there, a run and a merge come to the same bits."""
    states, make = [], _map_store.empty_aligned
    for byte in (0, 255):  # 0.0, or NaN and -1

        def filled(*kind: Any, byte: int = byte) -> Any:
            array = make(*kind)
            array.view(np.uint8).fill(byte)
            return array

        monkeypatch.setattr(_map_store, "empty_aligned", filled)
        a, b = both()
        joint = merge_filters(a, b, known_alignment(), PAIRS, np.random.default_rng(5))[0]
        merged = joint.get_state()
        for _ in range(3):
            joint.step([MOVE, MOVE], [new_frame(), new_frame()])
            joint.resample()
        joint.rejuvenate()
        joint.maps.reserve(len(joint.maps.ids), joint.descriptor_size)
        joint.step([MOVE, None], [new_frame(), None])
        states.append([a.get_state(), b.get_state(), merged, joint.get_state()])
    assert_same(*states)


def parents_of(joint: FastSlam, robot: int, slam: FastSlam) -> IntArray:
    """Return which particle of a one-robot filter each joint particle stems from, told by the path of that robot."""
    paths = joint.particles_from_start(robot)
    return np.abs(paths[:, None] - slam.particles()[0]).sum(axis=2).argmin(axis=1)


def test_particles_of_a_are_paired_with_any_of_b() -> None:
    """Pairs are drawn at random, not by index, so that either group's particles meet many of the other's.

    Of 50 pairs about one has equal indices; eight or more have a probability below 1e-4.
    """
    rng = np.random.default_rng(2)
    a = map_once(NAMES_A, np.zeros(3), 0.05, rng, 50, moves=1)
    b = map_once(NAMES_B, A_FROM_B, 0.05, rng, 50, moves=1)
    joint, _ = merge_filters(a, b, known_alignment(), PAIRS, np.random.default_rng(1))
    parents = [parents_of(joint, robot, slam) for robot, slam in enumerate((a, b))]
    assert len(np.unique(parents[0])) > 20
    assert len(np.unique(parents[1])) > 20
    assert np.count_nonzero(parents[0] == parents[1]) < 8


def test_the_uncertainty_of_b_s_pose_is_turned_with_its_map() -> None:
    """The covariance of b's pose before the merge, turned by the alignment, is that after it.

    Both are those of 400 particles: entries agree to a third of the largest variance of position.
    """
    b = FastSlam(1, 400, motion=OdometryModel(sigma_along=0.4, sigma_across=0.01), seed=3)
    names = np.array([4])
    b.step([None], [frame_of(LANDMARKS[names], names, 1.0)])
    b.step([np.array([1.0, 0.0, 0.0])], [frame_of(LANDMARKS[names] - [1.0, 0.0, 0.0], names, 1.0)])
    a, _ = both()
    joint, _ = merge_filters(a, b, known_alignment(sigma=1e-6), NO_PAIRS, np.random.default_rng(1))
    turn = np.eye(3)
    turn[:2, :2] = rotation(A_FROM_B[2])
    expected = turn @ b.pose().covariance @ turn.T
    position = np.s_[:2, :2]
    largest = np.abs(expected[position]).max()
    assert np.abs(b.pose().covariance - expected)[position].max() > 0.5 * largest  # turning matters here
    np.testing.assert_allclose(joint.pose(1).covariance[position], expected[position], atol=largest / 3)


def test_a_merge_does_not_sample_unsampled_motion() -> None:
    """Its Gaussians are those without the merge, rotated: a merge is no measurement, and samples nothing."""
    names = np.array([4])
    a, b = (FastSlam(1, 7, motion=WIDE_MOTION, seed=seed) for seed in range(2))
    for slam in (a, b):
        slam.step([None], [frame_of(LANDMARKS[names], names, 0.1)])
    b.step([MOVE], [None])
    joint, _ = merge_filters(a, b, known_alignment(sigma=1e-6), NO_PAIRS, np.random.default_rng(1))
    joint.step([None, MOVE], [None, None])
    b.step([MOVE], [None])
    turn = np.eye(3)
    turn[:2, :2] = rotation(A_FROM_B[2])
    np.testing.assert_allclose(joint.pose(1).covariance, turn @ b.pose().covariance @ turn.T, rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(joint.pose(1).mean, compose(A_FROM_B, b.pose().mean), atol=1e-5)


def test_accumulated_weights_of_both_filters_add_up() -> None:
    """Accumulated log-weights add (Eq. 12), up to the evidence, which is equal for pairs whose maps fit equally."""
    rng = np.random.default_rng(2)
    a = map_once(NAMES_A, np.zeros(3), 0.05, rng, 50, moves=1)
    b = map_once(NAMES_B, A_FROM_B, 0.05, rng, 50, moves=1)
    a.path_log_weights[:], b.path_log_weights[:] = rng.normal(size=(2, 50))
    joint, _ = merge_filters(a, b, known_alignment(), PAIRS, np.random.default_rng(1))
    pasts = a.path_log_weights[parents_of(joint, 0, a)] + b.path_log_weights[parents_of(joint, 1, b)]
    np.testing.assert_allclose(np.ptp(joint.path_log_weights - pasts), 0.0, atol=1e-6)


def test_pairs_whose_maps_fit_each_other_survive() -> None:
    """Particles of b in which a common landmark stands ten deviations off do not outlive the merge."""
    a, b = both(sigma=0.05, particles=(50, 50))
    maps = b.maps
    slots = maps.used_slots()
    values, counts = maps.dense(slots)
    values[1, 0, 35:] += 0.5  # landmark 1 of b is one of the common ones
    values[0, 2, 35:] += 9.0  # landmark 0 is b's alone: it tells which particles survive
    load_landmarks(maps, values, counts, maps.descriptors[slots], maps.ids[slots], maps.identities[slots], maps.next_id)
    joint, renamed = merge_filters(a, b, known_alignment(), PAIRS, np.random.default_rng(1))
    ids, means, _, _ = dense(joint)
    row = ids.tolist().index(dict(renamed.tolist())[0])
    assert np.abs(means[row, 2] - LANDMARKS[NAMES_B[0], 2]).max() < 1.0
