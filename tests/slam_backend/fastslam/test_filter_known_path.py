"""On a known path landmarks are independent EKFs; they stay exact and positive definite whatever the noise."""

from typing import Any

import numpy as np
import pytest
from builders.filters import plain_filter
from builders.linear_world import CAMERA, turn
from builders.worlds import StereoWorld

from slam_backend.core.validation import FloatArray
from slam_backend.fastslam._kernels import RELINEARISE_UP_TO
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.options import CALIBRATED_NOISE
from slam_backend.geometry import compose
from slam_backend.models.camera import ROBOT_FROM_CAMERA
from slam_backend.models.measurements import Measurements

PROPOSALS = pytest.mark.parametrize("proposal", ["fastslam2", "fastslam1"])


class StereoEkf:
    """An EKF of one landmark in (u, v, disparity), as textbooks have it; shares the camera's mount with ours."""

    def __init__(self, world: StereoWorld, pose: FloatArray, point: FloatArray) -> None:
        self.world = world
        self.noise = np.diag([world.camera.sigma_px, world.camera.sigma_px, world.camera.sigma_disparity_px]) ** 2
        self.sightings = 1
        self.mean = turn(pose[2]) @ world.camera.robot_from_camera(point) + [pose[0], pose[1], 0.0]
        inverse = np.linalg.inv(self.predict(pose, self.mean)[1])
        self.covariance = inverse @ self.noise @ inverse.T

    def predict(self, pose: FloatArray, mean: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return (u, v, d) of a landmark and their derivative by it."""
        f, b = self.world.camera.focal_px, self.world.camera.baseline
        to_camera = ROBOT_FROM_CAMERA.T @ turn(pose[2]).T
        x, y, z = to_camera @ (mean - [pose[0], pose[1], 0.0]) - ROBOT_FROM_CAMERA.T @ self.world.camera.mount
        by_point = np.array([[f / z, 0.0, -f * x / z**2], [0.0, f / z, -f * y / z**2], [0.0, 0.0, -f * b / z**2]])
        return np.array([f * x / z, f * y / z, f * b / z]), by_point @ to_camera

    def update(self, pose: FloatArray, point: FloatArray, iterated: bool) -> None:
        """Eqs. 5-10; `iterated`: linearised a second time where the first update leads."""
        f, b = self.world.camera.focal_px, self.world.camera.baseline
        measured = np.array([f * point[0], f * point[1], f * b]) / point[2]
        here = self.mean
        for _ in range(2 if iterated else 1):
            predicted, g = self.predict(pose, here)
            gain = self.covariance @ g.T @ np.linalg.inv(g @ self.covariance @ g.T + self.noise)
            here = self.mean + gain @ (measured - predicted - g @ (self.mean - here))
        self.mean, self.sightings = here, self.sightings + 1
        self.covariance = (np.eye(3) - gain @ g) @ self.covariance


@PROPOSALS
def test_stereo_on_a_known_path_makes_it_independent_ekfs(proposal: Any) -> None:
    """Two robots, 17 landmarks, exact poses: means to 1e-9 m and covariances to 1e-9 of their size are the EKFs'.

    Those of `fastslam2` are iterated for a landmark's first sightings.
    """
    world = StereoWorld(np.random.default_rng(21))
    slam = plain_filter(2, num_particles=3, camera=world.camera, proposal=proposal)
    filters: dict[int, StereoEkf] = {}
    poses = np.array([[0.0, 0.0, 0.0], [0.4, -0.3, 2.0]])
    for _ in range(40):
        poses = compose(poses, [[0.25, 0.02, 0.3], [0.1, 0.0, -0.2]])
        names = [world.visible(pose) for pose in poses]
        frames = [world.measure(pose, some) for pose, some in zip(poses, names, strict=True)]
        slam.step([None, None], frames, identities=names, poses=list(poses))
        for pose, some, frame in zip(poses, names, frames, strict=True):
            for name, point in zip(some.tolist(), frame.points, strict=True):
                if name in filters:
                    young = proposal == "fastslam2" and filters[name].sightings <= RELINEARISE_UP_TO
                    filters[name].update(pose, point, young)
                else:
                    filters[name] = StereoEkf(world, pose, point)
    result = slam.map()
    assert len(result) == len(filters) == 17
    for mean, covariance, look in zip(result.means, result.covariances, result.descriptors, strict=True):
        ekf = filters[int(np.argmax(world.descriptors @ look))]
        np.testing.assert_allclose(mean, ekf.mean, atol=1e-9)
        np.testing.assert_allclose(covariance, ekf.covariance, atol=1e-9 * ekf.covariance.max())


def watch_one_landmark(
    proposal: Any, sigma: float, landmark_noise: float | None, steps: int, **options: Any
) -> FastSlam:
    """Let a robot that stands at a known pose see one landmark again and again, with a covariance of sigma^2 I."""
    slam = plain_filter(1, num_particles=3, camera=CAMERA, proposal=proposal, landmark_noise=landmark_noise, **options)
    frame = Measurements([[0.1, 0.2, 3.0]], np.eye(1, 3), [sigma**2 * np.eye(3)])
    for _ in range(steps):
        slam.step([None], [frame], identities=[[0]], poses=[np.zeros(3)])
    return slam


@PROPOSALS
def test_landmark_process_noise_gives_the_variance_of_the_riccati_recursion(proposal: Any) -> None:
    """Sightings of variance r, and q^2 added after each: P = P r / (P + r) + q^2 from r + q^2 on, and P stays."""
    sigma, q = 0.1, 0.02
    r, variance = sigma**2, sigma**2 + q**2
    for steps in (1, 2, 7):
        found = watch_one_landmark(proposal, sigma, q, steps).map().covariances[0]
        np.testing.assert_allclose(found, variance * np.eye(3), rtol=1e-12, atol=1e-18)
        for _ in range({1: 1, 2: 5}.get(steps, 0)):
            variance = variance * r / (variance + r) + q**2
    fixed = 0.5 * (q**2 + np.sqrt(q**4 + 4.0 * q**2 * r))
    found = watch_one_landmark(proposal, sigma, q, 200).map().covariances[0]
    np.testing.assert_allclose(found, fixed * np.eye(3), rtol=1e-12, atol=1e-18)


@PROPOSALS
def test_landmark_process_noise_is_added_only_with_rejuvenation(proposal: Any) -> None:
    """By default nothing is added, to the last bit; with rejuvenation the calibrated noise is, unless another is."""
    still, default = (watch_one_landmark(proposal, 0.1, noise, 9).map().covariances for noise in (0.0, None))
    np.testing.assert_array_equal(still, default)
    walking, calibrated, told = (
        watch_one_landmark(proposal, 0.1, noise, 9, rejuvenate_every=every).map().covariances
        for noise, every in ((CALIBRATED_NOISE, None), (None, 100), (0.0, 100))
    )
    np.testing.assert_array_equal(walking, calibrated)
    np.testing.assert_array_equal(told, still)
    assert (np.diagonal(walking[0]) > np.diagonal(still[0])).all()


def extreme_variances(kind: str, step: int, rng: np.random.Generator) -> FloatArray:
    """Return the variances [m^2] of one measurement along three axes, from 1e-12 to 1e4."""
    if kind.endswith("needles"):
        return np.array([1.0, 1.1e-8, 1.1e-8])
    if kind.endswith("pancakes"):
        return np.array([1.0, 1.0, 1.1e-8])
    if kind == "alternating":
        return np.full(3, 1e4 if step % 2 else 1e-12)
    return np.asarray(10.0 ** (rng.uniform(-8.0, 0.0, 3) - 4.0 * rng.random()))


@PROPOSALS
@pytest.mark.parametrize("kind", ["needles", "pancakes", "steady needles", "steady pancakes", "alternating", "wild"])
def test_covariances_stay_positive_definite_whatever_the_noise(proposal: Any, kind: str) -> None:
    """Through 2,000 updates with measurements that are sharp in some directions and useless in others.

    The error in the end is not beyond its covariance either (chi-square, false alarm 1e-6), and the weights are finite.
    "Steady" measurements all look along the same axes, the others along axes turned at random.
    """
    rng = np.random.default_rng(4)
    landmark = np.array([3.0, 0.5, 0.2])
    slam = plain_filter(1, num_particles=2, camera=CAMERA, proposal=proposal, resample_threshold=0.0)
    for step in range(2000):
        pose = rng.uniform([-1.0, -1.0, -3.0], [1.0, 1.0, 3.0])
        axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        if kind.startswith("steady"):
            pose[2], axes = 0.7, np.linalg.qr(np.arange(9.0).reshape(3, 3) + np.eye(3))[0]
        variances = extreme_variances(kind, step, rng)
        noise = axes @ np.diag(variances) @ axes.T
        exact = CAMERA.camera_from_robot(turn(pose[2]).T @ (landmark - [pose[0], pose[1], 0.0]))
        point = exact + axes @ (np.sqrt(variances) * rng.standard_normal(3))
        slam.step(
            [None], [Measurements([point], np.eye(1, 3), [0.5 * (noise + noise.T)])], identities=[[0]], poses=[pose]
        )
        if step % 10 == 0 or step > 1900:
            covariance = slam.map().covariances[0]
            np.testing.assert_array_equal(covariance, covariance.T)
            np.linalg.cholesky(covariance)  # raises where it is not positive definite
    result = slam.map()
    assert len(result) == 1
    assert np.isfinite(slam.weights).all()
    error = result.means[0] - landmark
    assert error @ np.linalg.solve(result.covariances[0], error) < 30.7  # chi^2_3 at 1 - 1e-6
