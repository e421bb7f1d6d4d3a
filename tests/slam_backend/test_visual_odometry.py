import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slam_backend.frontend.odometry import camera_motion, match_frames
from slam_backend.geometry3d import fit_rigid
from slam_backend.models.camera import StereoCamera
from slam_backend.models.measurements import Measurements

CAMERA = StereoCamera(focal_px=300.0, baseline=0.2, sigma_px=0.3, sigma_disparity_px=0.2)


def _frames(seed: int, noise: float, wrong: int = 0) -> tuple[Measurements, Measurements, np.ndarray, np.ndarray]:
    """Return two frames of 60 points and the motion between; the last `wrong` ones are elsewhere in the second one."""
    rng = np.random.default_rng(seed)
    turn, shift = Rotation.from_rotvec([0.02, 0.15, -0.01]).as_matrix(), np.array([0.1, -0.03, 0.4])
    a = np.column_stack([rng.uniform(-2.0, 2.0, (60, 2)), rng.uniform(2.0, 7.0, 60)])
    b = (a - shift) @ turn
    b[60 - wrong :] += rng.uniform(0.5, 1.0, (wrong, 3))
    sigmas = noise * np.array([CAMERA.sigma_px, CAMERA.sigma_px, CAMERA.sigma_disparity_px])
    seen = [CAMERA.triangulate(CAMERA.project(points) + sigmas * rng.standard_normal((60, 3))) for points in (a, b)]
    looks = rng.standard_normal((60, 32))
    looks /= np.linalg.norm(looks, axis=1, keepdims=True)
    order = rng.permutation(60)
    return Measurements(seen[0], looks), Measurements(seen[1][order], looks[order]), turn, shift


def test_without_noise_the_motion_is_exact() -> None:
    """Points in another order, a quarter of them elsewhere: the motion comes out to rounding."""
    earlier, later, turn, shift = _frames(1, 0.0, wrong=15)
    motion = camera_motion(earlier, later, CAMERA, 0.5, np.random.default_rng(0))
    assert motion is not None
    np.testing.assert_allclose(motion.rotation, turn, atol=1e-6)
    np.testing.assert_allclose(motion.translation, shift, atol=1e-6)
    np.testing.assert_array_equal(np.sort(motion.pairs[motion.inliers, 0]), np.arange(45))
    heading = np.arctan2(-turn[0, 2], turn[2, 2])
    np.testing.assert_allclose(motion.planar, [0.4, -0.1, heading], atol=1e-6)
    assert motion.planar[2] == pytest.approx(-0.15, abs=0.01)  # Y points down: a turn about it is one to the right


def test_reprojection_beats_points() -> None:
    """Weighing pixels and disparities by their noise, the motion is better than that of equally weighed points."""
    ours, theirs = [], []
    for seed in range(12):
        earlier, later, _, shift = _frames(seed, 1.0, wrong=10)
        motion = camera_motion(earlier, later, CAMERA, 0.5, np.random.default_rng(seed))
        assert motion is not None
        pairs = motion.pairs[motion.inliers]
        _, plain = fit_rigid(earlier.points[pairs[:, 0]], later.points[pairs[:, 1]])
        ours.append(np.linalg.norm(motion.translation - shift))
        theirs.append(np.linalg.norm(plain - shift))
    assert np.mean(ours) < 0.02
    assert np.mean(ours) < 0.7 * np.mean(theirs)


def test_frames_that_share_nothing_have_no_motion() -> None:
    """Unrelated descriptors, empty frames and fewer than six pairs that agree give None."""
    earlier, later, _, _ = _frames(3, 1.0)
    assert camera_motion(earlier, later, CAMERA, 0.01, np.random.default_rng(0)) is not None
    other = Measurements(later.points, np.roll(later.descriptors, 1, axis=1))
    assert len(match_frames(earlier, other, 0.5)) == 0
    assert camera_motion(earlier, other, CAMERA, 0.5, np.random.default_rng(0)) is None
    nothing = Measurements.empty(32)
    assert camera_motion(nothing, later, CAMERA, 0.5, np.random.default_rng(0)) is None
    few = Measurements(earlier.points[:5], earlier.descriptors[:5])
    assert camera_motion(few, later, CAMERA, 0.5, np.random.default_rng(0)) is None


def test_partners_are_each_others_nearest() -> None:
    """A pair counts if it is mutual and within the gate; checked against all distances."""
    rng = np.random.default_rng(4)
    a, b = (Measurements(rng.normal(size=(n, 3)), rng.normal(size=(n, 6))) for n in (20, 17))
    apart = np.linalg.norm(a.descriptors[:, None] - b.descriptors[None], axis=2)
    gate = float(np.median(apart.min(axis=1)))
    expected = [
        (i, int(apart[i].argmin()))
        for i in range(20)
        if apart[i].min() <= gate and apart[:, apart[i].argmin()].argmin() == i
    ]
    assert 2 < len(expected) < 20
    assert match_frames(a, b, gate).tolist() == [list(pair) for pair in expected]
