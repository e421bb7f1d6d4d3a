"""Landmarks around the origin and a stereo camera that measures them, with or without noise."""

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.geometry import inverse, transform_points
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
