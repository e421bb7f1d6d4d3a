"""A ring of landmarks before a stereo camera, and small random worlds full of accidents."""

from dataclasses import dataclass

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.geometry import between, compose, inverse, transform_points
from slam_backend.models.camera import StereoCamera
from slam_backend.models.measurements import Measurements
from slam_backend.models.odometry import OdometryModel

EXACT_MOTION = OdometryModel(
    sigma_along=0.0, sigma_across=0.0, sigma_heading=0.0, sigma_turn=0.0, floor_position=0.0, floor_heading=0.0
)


class StereoWorld:
    """Landmarks on a ring, each with a look of its own.

    Args:
        rng: Draws the landmarks and the noise.
        num_landmarks: N.
        camera: Model of the camera, true and assumed.
    """

    def __init__(self, rng: np.random.Generator, num_landmarks: int = 17, camera: StereoCamera | None = None) -> None:
        self.rng = rng
        self.camera = StereoCamera(mount=(0.1, -0.04, 0.25)) if camera is None else camera
        angles = np.linspace(-np.pi, np.pi, num_landmarks, endpoint=False)
        radii = rng.uniform(3.0, 5.0, num_landmarks)
        heights = rng.uniform(-0.5, 1.0, num_landmarks)
        self.landmarks = np.column_stack([radii * np.cos(angles), radii * np.sin(angles), heights])
        self.descriptors = np.linalg.qr(rng.normal(size=(num_landmarks, num_landmarks)))[0].astype(np.float32)

    def visible(self, pose: FloatArray) -> IntArray:
        """Return the landmarks that a robot at `pose` (3,), world frame, sees."""
        return np.flatnonzero(self.camera.sees(self._points(pose)))

    def measure(self, pose: FloatArray, names: IntArray, noise: float = 1.0) -> Measurements:
        """Measure landmarks from `pose` with `noise` times the noise of the camera, whether visible or not."""
        pixels = self.camera.project(self._points(pose)[names])
        sigmas = [self.camera.sigma_px, self.camera.sigma_px, self.camera.sigma_disparity_px]
        pixels += noise * self.rng.standard_normal(pixels.shape) * sigmas
        return Measurements(self.camera.triangulate(pixels), self.descriptors[names])

    def _points(self, pose: FloatArray) -> FloatArray:
        return self.camera.camera_from_robot(transform_points(inverse(pose), self.landmarks))


LOOK_SIZE = 5


@dataclass
class Readings:
    """The arguments of `FastSlam.step` for one step."""

    odometry: list[FloatArray | None]
    frames: list[Measurements | None]
    names: list[IntArray | None] | None
    poses: list[FloatArray | None] | None


class SmallWorld:
    """Some landmarks, a few of them close together and alike, and robots that wander, slip and go blind among them.

    Args:
        rng: Draws everything.
        num_robots: K.
        most: Largest number of measurements in a frame.
        given: Share of frames with covariances of their own.
        named: Share of frames with names.
        exact: Share of poses that are given.
    """

    def __init__(
        self, rng: np.random.Generator, num_robots: int, most: int, given: float, named: float, exact: float
    ) -> None:
        self.rng, self.most, self.given, self.named, self.exact = rng, most, given, named, exact
        self.camera = StereoCamera(mount=(0.11, -0.05, 0.3), sigma_px=rng.uniform(0.2, 1.5), sigma_disparity_px=0.3)
        self.motion = OdometryModel(sigma_along=rng.uniform(0.0, 0.3), sigma_heading=rng.uniform(0.0, 0.2))
        num = int(rng.integers(8, 14)) if most <= 8 else 80
        centres = rng.uniform([-5.0, -5.0, -0.5], [5.0, 5.0, 1.5], (num, 3))
        self.landmarks = np.vstack([centres, centres[:6] + rng.normal(0.0, 0.15, (6, 3))])
        looks = rng.normal(0.0, 1.0, (num, LOOK_SIZE))
        looks = np.vstack([looks, looks[:6] + rng.normal(0.0, 0.05, (6, LOOK_SIZE))])
        self.descriptors = looks / np.linalg.norm(looks, axis=1, keepdims=True)
        self.descriptors[num - 2] = self.descriptors[num - 1]  # two that no descriptor tells apart
        self.look_noise = float(rng.choice([0.0, 0.05]))
        self.slips = float(rng.choice([0.0, 0.4]))
        self.poses = rng.uniform([-2.0, -2.0, -np.pi], [2.0, 2.0, np.pi], (num_robots, 3))
        self.start_poses = self.poses.copy()
        self.blind_for = np.zeros(num_robots, dtype=np.int64)

    def read(self) -> Readings:
        """Move the robots and return what they read."""
        robots = range(len(self.poses))
        odometry = [self._move(robot) for robot in robots]
        looks = [self._look(robot) for robot in robots]
        is_named = self.rng.random(len(self.poses)) < self.named
        names = [look[1] if name else None for look, name in zip(looks, is_named, strict=True)]
        told = [self._pose_from_start(robot) if self.rng.random() < self.exact else None for robot in robots]
        return Readings(
            odometry,
            [frame for frame, _ in looks],
            names if any(name is not None for name in names) else None,
            told if self.exact > 0.0 else None,
        )

    def _pose_from_start(self, robot: int) -> FloatArray:
        return between(self.start_poses[robot], self.poses[robot])

    def _move(self, robot: int) -> FloatArray | None:
        """Move a robot, or not; return its noisy odometry."""
        if self.rng.random() < 0.2:
            return None
        move = self.rng.normal([0.2, 0.0, 0.0], [0.3, 0.1, 0.3])
        self.poses[robot] = compose(self.poses[robot], move)
        if self.rng.random() < self.slips:  # which the odometry misses, and after which a filter has to recover
            self.poses[robot] = compose(self.poses[robot], self.rng.normal(0.0, [0.3, 0.3, 0.05]))
        return move + self.rng.standard_normal(3) * self.motion.sigmas(move)

    def _look(self, robot: int) -> tuple[Measurements | None, IntArray | None]:
        """Return a frame of what lies ahead, now and then with false points and wrong looks, and its true names."""
        rng = self.rng
        if self.blind_for[robot] == 0 and rng.random() < 0.08:
            self.blind_for[robot] = rng.integers(1, 9)
        if self.blind_for[robot] > 0:
            self.blind_for[robot] -= 1
            return (None if rng.random() < 0.5 else Measurements.empty(LOOK_SIZE)), None
        points = self.camera.camera_from_robot(transform_points(inverse(self.poses[robot]), self.landmarks))
        names = rng.permutation(np.flatnonzero((points[:, 2] > 0.5) & (np.abs(points[:, 0]) < points[:, 2])))
        names = names[: self.most]
        pixels = self.camera.project(points[names])
        pixels += rng.standard_normal(pixels.shape) * [self.camera.sigma_px, self.camera.sigma_px, 0.3]
        pixels[:, 2] = np.maximum(pixels[:, 2], 1.0)
        descriptors = self.descriptors[names] + rng.normal(0.0, self.look_noise, (len(names), LOOK_SIZE))
        measured = self.camera.triangulate(pixels)
        if len(names) and rng.random() < 0.2:  # a false point
            measured[-1] += np.abs(rng.normal(0.0, 0.5, 3))
            names[-1] = -1
        if len(names) and rng.random() < 0.1:  # a point that looks like another landmark
            descriptors[0] = self.descriptors[rng.integers(len(self.descriptors))]
        if len(names) and rng.random() < 0.1:  # a point under a wrong name
            names[0] = rng.integers(len(self.landmarks))
        covariances = None
        if rng.random() < self.given:
            covariances = self.camera.covariance(measured) + 1e-6 * np.eye(3)
        return Measurements(measured, descriptors, covariances), names
