"""Stereo camera model: mounting, field of view, projection and measurement noise."""

from dataclasses import dataclass

import numpy as np

from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import FloatArray, argument_error, check_array, check_float, check_int, known_names

MAX_POINT_DISTANCE = 1e4  # [m]; beyond the range of any camera, and far below the overflow of covariances
FLATTEST = 1e4  # depth over breadth of a stereo point's covariance; more loses precision
LEAST, LARGEST = 1e-12, 1e6  # pixels and metres of a camera; keeps the precision of squares
WIDEST = 1 << 20  # px
MAX_MOUNT_DISTANCE = 1e3  # [m]
# Columns: the camera's X (right), Y (down), Z (ahead) axes in the robot's x (ahead), y (left), z (up).
ROBOT_FROM_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@short_repr
@known_names
@dataclass(frozen=True, slots=True, kw_only=True)
class StereoCamera:
    """A rectified stereo pair with its assumed noise.

    Attributes:
        focal_px: Focal length [px].
        baseline: Distance between the two cameras [m].
        width: Image width [px].
        height: Image height [px].
        max_range: Largest distance of reported points [m].
        mount: (x, y, z) of the left camera on the robot [m]; its axis points along robot x.
        sigma_px: Standard deviation of the image coordinates u and v [px].
        sigma_disparity_px: Standard deviation of the disparity [px].
    """

    focal_px: float = 320.0
    baseline: float = 0.12
    width: int = 320
    height: int = 240
    max_range: float = 8.0
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sigma_px: float = 0.2
    sigma_disparity_px: float = 0.1

    def __post_init__(self) -> None:
        for name in ("focal_px", "baseline", "max_range", "sigma_px", "sigma_disparity_px"):
            value = getattr(self, name)
            check_float(f"camera.{name}", value, "Give a positive number.", at_least=LEAST, at_most=LARGEST)
        for name in ("width", "height"):
            check_int(f"camera.{name}", getattr(self, name), 1, "Give a number of pixels.", WIDEST)
        hint = "Give (x, y, z) of the left camera on the robot."
        mount = check_array("camera.mount", self.mount, (3,), hint, within=MAX_MOUNT_DISTANCE)
        object.__setattr__(self, "mount", tuple(float(m) for m in mount))

    @property
    def half_fov(self) -> float:
        """Half of the horizontal field of view [rad]."""
        return float(np.arctan2(0.5 * self.width, self.focal_px))

    @property
    def half_vertical_fov(self) -> float:
        """Half of the vertical field of view [rad]."""
        return float(np.arctan2(0.5 * self.height, self.focal_px))

    @property
    def farthest_usable(self) -> float:
        """Largest coordinate [m] of a point with a well-conditioned covariance under this noise."""
        return min(MAX_POINT_DISTANCE, FLATTEST * self.baseline * self.sigma_px / self.sigma_disparity_px)

    def robot_from_camera(self, points: FloatArray) -> FloatArray:
        """Transform points (..., 3) [m] from the camera frame to the robot frame."""
        return np.asarray(points @ ROBOT_FROM_CAMERA.T + np.asarray(self.mount))

    def camera_from_robot(self, points: FloatArray) -> FloatArray:
        """Transform points (..., 3) [m] from the robot frame to the camera frame."""
        return np.asarray((points - np.asarray(self.mount)) @ ROBOT_FROM_CAMERA)

    def project(self, points: FloatArray) -> FloatArray:
        """Return (u, v, disparity) (..., 3) [px] of points (..., 3) [m], camera frame; u, v from the image centre."""
        x, y, z = points[..., 0], points[..., 1], points[..., 2]
        return np.stack([x, y, np.full_like(z, self.baseline)], axis=-1) * (self.focal_px / z)[..., None]

    def triangulate(self, pixels: FloatArray) -> FloatArray:
        """Return points (..., 3) [m], camera frame, of (u, v, disparity) (..., 3) [px]: the inverse of `project`.

        Raises:
            ValueError: If a disparity is not positive.
        """
        disparity = pixels[..., 2]
        if np.any(disparity <= 0.0):
            raise argument_error(
                "pixels", "disparities > 0 px", float(disparity.min()), "Drop points at infinity first."
            )
        scale = self.baseline / disparity
        return np.stack([pixels[..., 0] * scale, pixels[..., 1] * scale, self.focal_px * scale], axis=-1)

    def covariance(self, points: FloatArray) -> FloatArray:
        """Return the covariance of measured points, to first order, evaluated at `points`.

        Sigma = (Z/f)^2 diag(su^2, sv^2, 0) + sd^2 (Z/(f b))^2 P P^T with P = (X, Y, Z): the propagation of pixel and
        disparity noise through triangulation. Evaluate it at the predicted point, not at the measured one, or depth
        is under-estimated.

        Args:
            points: (..., 3) float64 [m], camera frame.

        Returns:
            (..., 3, 3) float64 [m^2], camera frame.
        """
        points = np.asarray(points, dtype=np.float64)
        scale = points[..., 2] / self.focal_px
        pixel = np.diag([self.sigma_px**2, self.sigma_px**2, 0.0])
        depth = (self.sigma_disparity_px * scale / self.baseline) ** 2
        return np.asarray(
            (scale**2)[..., None, None] * pixel + depth[..., None, None] * points[..., :, None] * points[..., None, :]
        )

    def sees(self, points: FloatArray) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """Return the mask of points (..., 3) [m], camera frame, in the image and within `max_range` (walls ignored)."""
        x, y, z = points[..., 0], points[..., 1], points[..., 2]
        ahead = z > 1e-6
        depth = np.where(ahead, z, 1.0)
        in_image = (np.abs(x) * self.focal_px <= 0.5 * self.width * depth) & (
            np.abs(y) * self.focal_px <= 0.5 * self.height * depth
        )
        return np.asarray(ahead & in_image & (np.sqrt(x * x + y * y + z * z) <= self.max_range))
