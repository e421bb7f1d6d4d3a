"""Fixing the gauge of a map and the start poses of robots after a rejuvenation."""

from itertools import pairwise

import numpy as np
import pytest
from builders.kernels import python_entry
from builders.runs import small_run

from slam_backend.core.validation import FloatArray
from slam_backend.fastslam._kernels import add_gauge_covariance
from slam_backend.fastslam._kernels.particles.map_mixture import add_gauge_to_landmarks
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.options import FilterOptions
from slam_backend.fastslam.rejuvenation import RejuvenationScheduler
from slam_backend.geometry import between, compose, inverse, rotation, transform_points, wrap_angle
from slam_backend.smoother import rejuvenation
from slam_backend.smoother._kernels import LANES
from slam_backend.smoother.gauge import compute_gauge_fix, fix_gauge, fix_start, move
from slam_backend.smoother.graph import RIGID
from training.stereo_runs.runs import RunSpec, simulate_run

add_gauge_to_landmarks = python_entry(add_gauge_to_landmarks)

SCATTER = np.array([[0.04, 0.01, -0.02], [0.01, 0.09, 0.03], [-0.02, 0.03, 0.05]])
UPPER = ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])


def laned(values: FloatArray) -> FloatArray:
    """Return rows (n, 9, M) in blocks of lanes, the surplus ones copies of the first."""
    surplus = -values.shape[2] % LANES
    padded = np.concatenate([values, np.repeat(values[:, :, :1], surplus, axis=2)], axis=2)
    return np.ascontiguousarray(padded.reshape(len(values), 9, -1, LANES).transpose(0, 2, 1, 3))


def unlaned(tiles: FloatArray, count: int) -> FloatArray:
    """Return what `laned` took."""
    return tiles.transpose(0, 2, 1, 3).reshape(len(tiles), 9, -1)[:, :, :count]


def random_maps(landmarks: int, count: int, rng: np.random.Generator) -> FloatArray:
    """Return means and covariances (n, 9, M) of landmarks in a square of 10 m."""
    roots = 0.05 * rng.standard_normal((landmarks, count, 3, 3))
    spreads = (roots @ roots.transpose(0, 1, 3, 2))[..., *UPPER] + 1e-4 * np.eye(3)[UPPER]
    means = np.repeat(rng.uniform(-5.0, 5.0, (landmarks, 1, 3)), count, axis=1)
    return np.ascontiguousarray(np.concatenate([means, spreads], axis=2).transpose(0, 2, 1))


def moved_plainly(values: FloatArray, motions: FloatArray) -> FloatArray:
    """Return the landmarks (n, 9, M) of each particle, moved by its motion (M, 3), one by one."""
    result = values.copy()
    for m, motion in enumerate(motions):
        turn = np.eye(3)
        turn[:2, :2] = rotation(motion[2])
        for n in range(len(values)):
            spread = np.zeros((3, 3))
            spread[UPPER] = values[n, 3:, m]
            spread = spread + np.triu(spread, 1).T
            result[n, :3, m] = turn @ values[n, :3, m] + [*motion[:2], 0.0]
            result[n, 3:, m] = (turn @ spread @ turn.T)[UPPER]
    return result


def open_run(seed: int = 103) -> tuple[FastSlam, list[FloatArray], list[int]]:
    """Return a filter at the end of a coarse run, its poses step by step, and the steps in which it was rejuvenated."""
    run = simulate_run(RunSpec(length=40.0, landmarks=150, measurements=5, preset="coarse"), seed)
    slam = run.build_filter(60, "fastslam2", seed, rejuvenate_every=20)
    poses, drawn = [], []
    for step, reading in enumerate(run.readings()):
        if slam.step(**reading).rejuvenation is not None:
            drawn.append(step)
        poses.append(slam.pose().mean)
    return slam, poses, drawn


def off_by(poses: FloatArray, means: FloatArray) -> FloatArray:
    """Return how far off (M,) [m^2] poses (K, 3, M) are from means (K, 3), headings felt at 3 m."""
    off = poses - means[:, :, None]
    off[:, 2] = 3.0 * wrap_angle(off[:, 2])
    return np.asarray((off**2).sum(axis=(0, 1)))


def fitted_plainly(points: FloatArray, targets: FloatArray, shares: FloatArray) -> FloatArray:
    """Return the rigid motions (M, 3) of points (n, 2, M) to targets (n, 2) by the singular value decomposition."""
    motions = np.empty((points.shape[2], 3))
    for m, motion in enumerate(motions):
        centre, target = shares @ points[:, :, m], shares @ targets
        u, _, v = np.linalg.svd((shares[:, None] * (targets - target)).T @ (points[:, :, m] - centre))
        turn = u @ np.diag([1.0, np.linalg.det(u @ v)]) @ v
        motion[:2], motion[2] = target - turn @ centre, np.arctan2(turn[1, 0], turn[0, 0])
    return motions


@pytest.mark.parametrize("spread", [0.01, 1.0])
def test_the_gauge_fix_agrees_with_plain_arrays(spread: float):
    """Least squares one particle at a time, landmarks weighed by their scatter; poses moved; scatter by its sum."""
    rng = np.random.default_rng(4)
    count, seen = LANES + 9, np.array([4, 0, 3])
    values, landmarks, weights = random_maps(5, count, rng), rng.normal(size=(5, 3)), rng.dirichlet(np.ones(LANES + 9))
    values[:, :2] += spread * rng.normal(size=(5, 2, count))
    poses, means = rng.normal(size=(2, 3, count)), rng.normal(size=(2, 3))
    gained, held = compute_gauge_fix(laned(values), seen, landmarks, poses, means, weights, 3.0)
    off = values[seen, :2] - landmarks[seen, :2, None]
    squares = ((off**2).sum(axis=1) + values[seen, 3] + values[seen, 6]) @ weights
    motions = fitted_plainly(values[seen, :2], landmarks[seen, :2], 1.0 / squares / (1.0 / squares).sum())
    np.testing.assert_allclose(between(held.motions, motions), 0.0, atol=1e-12)
    moved = compose(motions, poses.transpose(0, 2, 1)).transpose(0, 2, 1)
    np.testing.assert_allclose(held.poses, moved, atol=1e-12)
    np.testing.assert_allclose(held.scatter, (weights * inverse(motions).T) @ inverse(motions), atol=1e-12)
    assert gained == pytest.approx((off_by(poses, means) - off_by(moved, means)) @ weights)
    helps = fix_gauge(laned(values), seen, landmarks, poses, means, weights) is not None
    assert helps == (gained > 0.0)
    np.testing.assert_array_equal(move(poses, held.motions), held.poses)


def test_a_scattered_frame_scatters_poses_and_points():
    """To first order: J C J^T with the derivatives of a moved pose, and of a moved point, by the motion."""
    rng = np.random.default_rng(2)
    poses, covariances = rng.normal(size=(4, 3)), np.zeros((4, 3, 3))
    add_gauge_covariance(SCATTER, poses, covariances)
    small = 1e-6 * np.eye(3)
    for pose, covariance in zip(poses, covariances, strict=True):
        slopes = np.array([(compose(by, pose) - compose(-by, pose)) / 2e-6 for by in small]).T
        np.testing.assert_allclose(covariance, slopes @ SCATTER @ slopes.T, atol=1e-8)
        point = np.array([*pose[:2], 0.7])
        slopes = np.array([(transform_points(by, point[:2]) - transform_points(-by, point[:2])) / 2e-6 for by in small])
        of_point = np.zeros((3, 3))
        add_gauge_to_landmarks(SCATTER, point[0], point[1], of_point)
        np.testing.assert_allclose(of_point[:2, :2], slopes.T @ SCATTER @ slopes, atol=1e-8)
        assert not of_point[2].any()


def test_particles_that_differ_by_a_motion_alone_are_brought_together():
    """Rigid copies of one map are moved back onto it, and the covariance is that of what had moved them."""
    rng = np.random.default_rng(3)
    motions, count = rng.normal(size=(50, 3)) * [0.3, 0.2, 0.1], 50
    values = random_maps(6, count, rng)
    landmarks, pose = values[:, :3, 0], np.array([1.0, 2.0, 0.5])
    poses = compose(motions, pose).T[None]
    weights = rng.uniform(0.5, 1.5, count)
    weights /= weights.sum()
    moved, seen = moved_plainly(values, motions), np.array([0, 1, 3, 5])
    moved[[2, 4], :3] += 7.0  # what is not seen has no say
    held = fix_gauge(laned(moved), seen, landmarks, poses, pose[None], weights)
    assert held is not None
    np.testing.assert_allclose(compose(held.motions, motions), 0.0, atol=1e-12)
    np.testing.assert_allclose(held.scatter, (weights * motions.T) @ motions, atol=1e-12)


@pytest.mark.parametrize("apart", [0.0, 0.01])
def test_landmarks_that_do_not_determine_the_rotation_fix_no_gauge(apart: float):
    """Landmarks in one place would turn particles at random, by which poses scatter more; one landmark says nothing."""
    rng = np.random.default_rng(4)
    values = random_maps(2, 80, rng)
    values[1, :3] = values[0, :3] + apart
    landmarks, pose = values[:, :3, 0].copy(), np.array([3.0, 1.0, 0.2])
    values[:, :2] += 0.05 * rng.standard_normal((2, 2, 80))
    poses = pose[None, :, None] + 0.05 * rng.standard_normal((1, 3, 80))
    weights = np.full(80, 1.0 / 80)
    for seen in ([0, 1], [0], []):
        rows = np.array(seen, dtype=np.int64)
        assert fix_gauge(laned(values), rows, landmarks, poses, pose[None], weights) is None


def test_a_start_is_fixed_if_the_pose_is_known_in_the_map():
    """All particles get that of the most probable path; what they differed by, seen from there, is the covariance."""
    rng = np.random.default_rng(5)
    start, pose, weights = np.array([2.0, -1.0, 2.5]), np.array([1.0, 2.0, 0.5]), rng.dirichlet(np.ones(40))
    apart = rng.normal(size=(40, 3)) * [0.3, 0.2, 0.1]
    starts, poses = compose(start, inverse(apart)).T, pose[:, None] + 0.01 * rng.standard_normal((3, 40))
    scatter = fix_start(starts, poses, start, pose, weights)
    np.testing.assert_array_equal(starts, np.repeat(start[:, None], 40, axis=1))
    np.testing.assert_allclose(scatter, (weights * apart.T) @ apart, atol=1e-12)


def test_a_start_is_not_fixed_if_the_path_from_it_is_known_better_than_the_map():
    """Of a robot that nothing but odometry knows, near its start, particles keep start and pose together."""
    rng = np.random.default_rng(6)
    start, way = np.array([2.0, -1.0, 2.5]), np.array([0.5, 0.1, 0.2])
    starts = compose(start, rng.normal(size=(40, 3)) * [0.3, 0.2, 0.1]).T
    poses, before = compose(starts.T, way + 0.01 * rng.standard_normal((40, 3))).T, starts.copy()
    scatter = fix_start(starts, poses, start, compose(start, way), np.full(40, 1.0 / 40))
    np.testing.assert_array_equal(starts, before)
    assert not scatter.any()


def test_reported_covariances_include_the_gauge_covariance():
    """Right after new particles their scatter and the frame's share are together what the smoother says of the pose."""
    run = small_run(length=8.0)
    slam = run.build_filter(2000, "fastslam2", 1)
    for reading in run.readings():
        slam.step(**reading)
    assert slam.rejuvenate().reason == ""
    said = slam.pose()
    off = slam.particles()[0] - said.mean
    off[:, 2] = wrap_angle(off[:, 2])
    shown = np.asarray(slam.weights * off.T @ off)
    both = shown[None].copy()
    add_gauge_covariance(slam.gauge_covariance, said.mean[None], both)
    assert np.trace(shown[:2, :2]) < np.trace(said.covariance[:2, :2])
    np.testing.assert_allclose(np.sqrt(np.diag(both[0])), np.sqrt(np.diag(said.covariance)), rtol=0.25)


def test_starts_that_are_given_stay_and_an_exact_pose_needs_no_share():
    """All particles keep given starts; once a pose is given as exact, the gauge covariance is zero."""
    slam, _, drawn = open_run()
    assert drawn
    assert slam.gauge_covariance.any()
    starts = slam.starts[0, :, : slam.num_particles]
    np.testing.assert_array_equal(starts, np.repeat(starts[:, :1], slam.num_particles, axis=1))
    slam.step([None], [None], poses=[np.array([1.0, 2.0, 0.3])])
    np.testing.assert_allclose(slam.pose().covariance, 0.0, atol=1e-12)


def test_groups_with_few_common_landmarks_add_both_gauge_covariances():
    """Where one group started in the other's map is as uncertain as both frames are, however alike the particles."""
    options = FilterOptions(rejuvenate_every=10)
    a, b, joint = (RejuvenationScheduler(options, robots) for robots in (1, 1, 2))
    motion = np.array([2.0, -1.0, 0.7])
    starts = np.repeat([[np.zeros(3)], [motion]], 5, axis=1).transpose(0, 2, 1)
    no_names = np.zeros((0, 2), dtype=np.int64)
    given = np.zeros(1, dtype=np.bool_)
    joint.join(a, b, (starts[:1], starts[:1], starts), (given, given), (SCATTER, 0.5 * SCATTER), no_names, np.zeros(7))
    graph = joint.graph
    slopes, turn = np.eye(3), np.eye(3)
    slopes[:2, 2] = -motion[1], motion[0]
    turn[:2, :2] = rotation(motion[2])
    expected = slopes @ SCATTER @ slopes.T + turn @ (0.5 * SCATTER) @ turn.T + RIGID**2 * np.eye(3)
    np.testing.assert_allclose(graph.odometry_covariances[graph.first_keys[1]], expected, atol=1e-12)
    np.testing.assert_allclose(graph.poses[graph.first_keys[1]], motion, atol=1e-12)


def test_mixture_maps_include_the_gauge_covariance():
    """Of the same particles a mixture claims more of each landmark by what the frame adds; its means are the same."""
    slam, _, _ = open_run()
    widened = slam.map("mixture")
    slopes = np.zeros((len(widened), 3, 3))
    slopes[:, 0, 0] = slopes[:, 1, 1] = 1.0
    slopes[:, 0, 2], slopes[:, 1, 2] = -widened.means[:, 1], widened.means[:, 0]
    share = slopes @ slam.gauge_covariance @ slopes.transpose(0, 2, 1)
    slam.gauge_covariance[:] = 0.0
    narrow = slam.map("mixture")
    np.testing.assert_array_equal(widened.means, narrow.means)
    np.testing.assert_allclose(widened.covariances - narrow.covariances, share, atol=1e-12)
    assert (np.trace(share, axis1=1, axis2=2) > 0.0).all()


def test_without_the_gauge_fix_the_frame_drifts_between_rejuvenations(monkeypatch: pytest.MonkeyPatch):
    """Poses are thrown back less at each draw where the frame is held than where survivors carry it along."""

    def thrown() -> float:
        squares = []
        for seed in range(102, 110):
            _, poses, drawn = open_run(seed)
            steps = [np.hypot(*between(a, b)[:2]) for a, b in pairwise(poses)]
            squares += [(steps[step - 1] - np.median(steps)) ** 2 for step in drawn]
        return float(np.sqrt(np.mean(squares)))

    held = thrown()
    monkeypatch.setattr(rejuvenation, "fix_gauge", lambda *arguments: None)
    assert held < 0.9 * thrown()
