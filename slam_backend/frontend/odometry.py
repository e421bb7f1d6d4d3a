"""Visual odometry: the motion of a stereo camera between two frames."""

from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.frontend.descriptors import nearest
from slam_backend.geometry3d import ransac_rigid
from slam_backend.models.camera import StereoCamera
from slam_backend.models.measurements import Measurements

AGREE = 3.0  # standard deviations within which two points agree
HUBER = 1.5  # standard deviations beyond which a residual loses weight
LEAST = 6  # minimum number of inliers; fewer may agree by chance


@short_repr
class CameraMotion(NamedTuple):
    """The motion of a camera from an earlier to a later frame.

    Attributes:
        rotation: (3, 3) float64. Rotation from later to earlier camera axes.
        translation: (3,) float64 [m]. Position of the later camera, earlier camera frame.
        pairs: (n, 2) int64. Matched rows of the earlier and the later frame.
        inliers: (n,) bool. Mask of the pairs that agree with the motion.
    """

    rotation: FloatArray
    translation: FloatArray
    pairs: IntArray
    inliers: BoolArray

    @property
    def planar(self) -> FloatArray:
        """Planar motion (3,) [m, m, rad] of a level camera, x ahead and y left, in the format of odometry."""
        heading = np.arctan2(-self.rotation[0, 2], self.rotation[2, 2])
        return np.array([self.translation[2], -self.translation[0], heading])


def match_frames(earlier: Measurements, later: Measurements, gate: float) -> IntArray:
    """Return pairs of rows (n, 2) int64 whose descriptors are mutual nearest neighbours within `gate`."""
    if not len(earlier) or not len(later):
        return np.empty((0, 2), dtype=np.int64)
    there, squares = nearest(earlier.descriptors, later.descriptors)
    back, _ = nearest(later.descriptors, earlier.descriptors)
    kept = np.flatnonzero((back[there] == np.arange(len(there))) & (squares <= gate * gate))
    return np.column_stack([kept, there[kept]])


def camera_motion(
    earlier: Measurements,
    later: Measurements,
    camera: StereoCamera,
    gate: float,
    rng: np.random.Generator,
    iterations: int = 500,
) -> CameraMotion | None:
    """Estimate the motion of a camera between two frames.

    Points are matched by descriptors, outliers are rejected by RANSAC on rigid motions in space, and the motion
    minimises the reprojection error of the inliers in columns, rows and disparities of both frames.

    Args:
        earlier: Points with descriptors, earlier camera frame.
        later: Points with descriptors, later camera frame.
        camera: Stereo camera with its standard deviations of pixels and disparities.
        gate: Largest L2 distance of descriptors of one point [-].
        rng: Source of RANSAC's samples.
        iterations: Number of RANSAC iterations.

    Returns:
        The motion; None if there are fewer than six inliers.
    """
    pairs = match_frames(earlier, later, gate)
    a, b = earlier.points[pairs[:, 0]], later.points[pairs[:, 1]]
    variances = [np.trace(camera.covariance(points), axis1=1, axis2=2) for points in (a, b)]
    fit = ransac_rigid(a, b, AGREE * np.sqrt(variances[0] + variances[1]), rng, iterations)
    if fit is None or fit.inliers.sum() < LEAST:
        return None
    turn, shift = _least_reprojection(a[fit.inliers], b[fit.inliers], camera, fit.rotation, fit.translation)
    return CameraMotion(turn, shift, pairs, fit.inliers)


def _least_reprojection(
    a: FloatArray, b: FloatArray, camera: StereoCamera, rotation: FloatArray, translation: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the motion with the smallest reprojection error in both frames, in standard deviations of pixels."""
    sigmas = np.array([camera.sigma_px, camera.sigma_px, camera.sigma_disparity_px]) * np.sqrt(2.0)
    seen_a, seen_b = camera.project(a), camera.project(b)

    def residuals(parameters: FloatArray) -> FloatArray:
        turn, shift = Rotation.from_rotvec(parameters[:3]).as_matrix(), parameters[3:]
        in_a, in_b = b @ turn.T + shift, (a - shift) @ turn
        in_a[:, 2], in_b[:, 2] = np.maximum(in_a[:, 2], 1e-3), np.maximum(in_b[:, 2], 1e-3)
        both = np.stack([camera.project(in_a) - seen_a, camera.project(in_b) - seen_b]) / sigmas
        return np.asarray(both.ravel())

    start = np.concatenate([Rotation.from_matrix(rotation).as_rotvec(), translation])
    found = least_squares(residuals, start, loss="huber", f_scale=HUBER).x
    return Rotation.from_rotvec(found[:3]).as_matrix(), found[3:]
