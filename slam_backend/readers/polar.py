"""Ranges and bearings in the plane become points of the camera with covariances."""

import numpy as np

from slam_backend.camera import ROBOT_FROM_CAMERA
from slam_backend.errors import FloatArray
from slam_backend.geometry import wrap_angle


def points_from_polar(
    ranges: FloatArray, bearings: FloatArray, variances: FloatArray, offsets: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return the points of range and bearing readings and their covariances, to first order.

    Zc = r cos b, Xc = -r sin b, Yc = 0: a planar sensor is a camera that sees everything at its own height.

    Args:
        ranges: (n,) float64 [m].
        bearings: (n,) float64 [rad], positive to the left of straight ahead.
        variances: (n, 3) float64 [m^2, rad^2, m^2]. Of range, bearing and height.
        offsets: (n, 3) float64 [m, m, rad]. Where the sensor was at each reading, frame of the step; None: there.

    Returns:
        Points (n, 3) [m] and covariances (n, 3, 3) [m^2], camera frame at the step.
    """
    n = len(ranges)
    moved = np.zeros((n, 3)) if offsets is None else offsets
    direction = wrap_angle(bearings + moved[:, 2])
    ahead, left = np.cos(direction), np.sin(direction)
    points = np.stack([ranges * ahead + moved[:, 0], ranges * left + moved[:, 1], np.zeros(n)], axis=-1)
    jacobian = np.zeros((n, 3, 3))  # of the point by (range, bearing, height)
    jacobian[:, 0, 0], jacobian[:, 0, 1] = ahead, -ranges * left
    jacobian[:, 1, 0], jacobian[:, 1, 1] = left, ranges * ahead
    jacobian[:, 2, 2] = 1.0
    covariances = (jacobian * variances[:, None, :]) @ jacobian.transpose(0, 2, 1)
    return points @ ROBOT_FROM_CAMERA, ROBOT_FROM_CAMERA.T @ covariances @ ROBOT_FROM_CAMERA
