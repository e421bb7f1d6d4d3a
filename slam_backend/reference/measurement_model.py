"""Measurement model of the reference filter: predictions with explicit Jacobians, densities, and landmark EKFs.

Measurements are compared in their own space, (u, v, disparity) for a stereo camera and the camera frame for points with
given covariances. Densities per pixel^3 are multiplied by the camera's constant f^3 b, which makes them densities of
points in space, N(r; 0, S) Z^4, where r and S are measured in metres and Z is the predicted depth.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from slam_backend.core.validation import FloatArray
from slam_backend.fastslam._kernels import MIN_DEPTH
from slam_backend.models.camera import ROBOT_FROM_CAMERA, StereoCamera
from slam_backend.models.measurements import Measurements
from slam_backend.reference.pose_gaussian import turn_about_vertical

LOG_2PI = float(np.log(2.0 * np.pi))


@dataclass
class Landmark:
    """Landmark EKF: mean (3,) [m] and covariance (3, 3) [m^2] in the map frame, and number of measurements.

    The log-odds of existence are unused without an existence model.
    """

    mean: FloatArray
    covariance: FloatArray
    count: int = 1
    log_odds: float = 0.0


@dataclass(frozen=True)
class Innovation:
    """Difference of a measurement from its prediction, with its covariance.

    Attributes:
        innovation: (3,) measured minus predicted (z - z^), in the space of the measurement.
        covariance: (3, 3) S, covariance of the innovation.
        by_pose: (3, 3) H = dz^ / d pose.
        log_unit: Term added to log-densities of the innovation, to convert them to points in space.
    """

    innovation: FloatArray
    covariance: FloatArray
    by_pose: FloatArray
    log_unit: float

    @cached_property
    def distance(self) -> float:
        """Squared Mahalanobis distance D (l. 19)."""
        return float(self.innovation @ np.linalg.solve(self.covariance, self.innovation))

    @cached_property
    def log_det(self) -> float:
        """Log-determinant of S, for points in space."""
        return float(np.linalg.slogdet(self.covariance)[1]) - 2.0 * self.log_unit

    @property
    def log_density(self) -> float:
        """Log N(innovation; 0, S) (Eq. 11), for points in space."""
        return log_density(self.distance, self.log_det)

    def widened(self, pose_covariance: FloatArray) -> "Innovation":
        """Return the innovation with the uncertainty of the pose included: S + H P H^T.

        Args:
            pose_covariance: (3, 3) P of (x, y, theta) [m, m, rad], map frame.
        """
        return replace(self, covariance=self.covariance + self.by_pose @ pose_covariance @ self.by_pose.T)

    def in_terms_of(self, root: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the information of the measurement about xi, where pose = x + root xi, at xi = 0.

        Args:
            root: (3, 3) factor of the pose's covariance [m, m, rad].

        Returns:
            The information (3, 3) A^T S^-1 A, A = H root, and the gradient (3,) of D / 2, -A^T S^-1 (z - z^).
        """
        a = self.by_pose @ root
        solved = np.linalg.solve(self.covariance, np.column_stack([a, self.innovation]))
        return a.T @ solved[:, :3], -a.T @ solved[:, 3]


def log_density(distance: float, log_det: float) -> float:
    """Return the log of a Gaussian density in three dimensions.

    Args:
        distance: D, squared Mahalanobis distance from the mean.
        log_det: log|S| of the covariance.
    """
    return -0.5 * (distance + log_det + 3.0 * LOG_2PI)  # Eq. 11


class Frame:
    """Measurements of one robot in one step as vectors z (n, 3) with their noise covariances R (n, 3, 3).

    Args:
        measurements: Measurements of the camera; None: none.
        kept: Indices of the measurements in use.
        identities: Caller's identities of the measured landmarks; None: unknown.
        camera: Assumed model of the camera.

    Attributes:
        points: (n, 3) float64 [m], camera frame. Measured points.
        descriptors: (n, d) float64.
        in_image: Whether z is (u, v, disparity) [px]; otherwise it is `points`.
        z: (n, 3) float64, the measurements.
        noises: (n, 3, 3) float64, R of each, in the units of z.
        log_unit: See `Innovation`.
    """

    def __init__(
        self,
        measurements: Measurements | None,
        kept: Sequence[int],
        identities: Sequence[int] | None,
        camera: StereoCamera,
    ) -> None:
        seen = Measurements.empty() if measurements is None else measurements
        rows = list(kept)
        self.camera = camera
        self.identities = identities
        self.points = seen.points[rows]
        self.descriptors = seen.descriptors[rows].astype(np.float64)
        self.in_image = seen.covariances is None
        if seen.covariances is None:
            self.z = camera.project(self.points)
            sigmas = [camera.sigma_px, camera.sigma_px, camera.sigma_disparity_px]
            self.noises = np.tile(np.diag(np.square(sigmas)), (len(rows), 1, 1))
            self.log_unit = float(np.log(camera.focal_px**3 * camera.baseline))
        else:
            self.z = self.points
            self.noises = seen.covariances[rows]
            self.log_unit = 0.0

    def __len__(self) -> int:
        return len(self.z)

    def predict(self, pose: FloatArray, mean: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        """Predict the measurement of a landmark.

        Args:
            pose: (3,) of the robot [m, m, rad], map frame.
            mean: (3,) of the landmark [m], map frame.

        Returns:
            z^ (3,), and its Jacobians by landmark (G) and by pose (H), (3, 3) each, all in the units of `z`; None if
            the landmark is not visible, as it lies less than `MIN_DEPTH` ahead of a stereo camera.
        """
        turn = turn_about_vertical(pose[2])
        c, s = np.cos(pose[2]), np.sin(pose[2])
        by_heading = np.array([[-s, -c, 0.0], [c, -s, 0.0], [0.0, 0.0, 0.0]])  # of turn
        offset = mean - [pose[0], pose[1], 0.0]
        point = self.camera.camera_from_robot(turn.T @ offset)
        g = ROBOT_FROM_CAMERA.T @ turn.T
        h = np.column_stack([-g[:, :2], ROBOT_FROM_CAMERA.T @ by_heading.T @ offset])
        if not self.in_image:
            return point, g, h  # Eqs. 5, 6
        x, y, depth = point
        if depth < MIN_DEPTH:
            return None
        scale = self.camera.focal_px / depth
        by_point = scale * np.array(
            [[1.0, 0.0, -x / depth], [0.0, 1.0, -y / depth], [0.0, 0.0, -self.camera.baseline / depth]]
        )
        return self.camera.project(point), by_point @ g, by_point @ h  # Eqs. 5, 6

    def compare(self, pose: FloatArray, landmark: Landmark, b: int) -> Innovation | None:
        """Return the innovation of a measurement at an exact pose (Eqs. 5-7); None if the landmark is not visible.

        Args:
            pose: (3,) of the robot [m, m, rad], map frame.
            landmark: Candidate landmark.
            b: Number of the measurement.
        """
        prediction = self.predict(pose, landmark.mean)
        if prediction is None:
            return None
        z_hat, g, h = prediction
        covariance = g @ landmark.covariance @ g.T + self.noises[b]  # Eq. 7
        return Innovation(self.z[b] - z_hat, covariance, h, self.log_unit)

    def metres(self, pose: FloatArray, landmark: Landmark, b: int) -> float:
        """Return the distance of a measured point from a landmark [m], in images scaled to the landmark's depth.

        Args:
            pose: (3,) of the robot [m, m, rad], map frame.
            landmark: Any landmark.
            b: Number of the measurement.
        """
        offset = landmark.mean - [pose[0], pose[1], 0.0]
        point = self.camera.camera_from_robot(turn_about_vertical(pose[2]).T @ offset)
        scale = point[2] / self.points[b, 2] if self.in_image else 1.0
        return float(scale * np.linalg.norm(self.points[b] - point))

    def log_clutter(self, b: int, p0: float) -> float:
        """Return the log-density of an unmatched measurement, in its own space (l. 32).

        Args:
            b: Number of the measurement.
            p0: Density of new landmarks [1/m^3].
        """
        jacobian = 4.0 * np.log(self.points[b, 2]) if self.in_image else 0.0
        return float(np.log(p0) + jacobian)

    def new_landmark(self, pose: FloatArray, b: int, walk: float = 0.0) -> Landmark:
        """Start a landmark (l. 30-31): mean g^-1(x, v), covariance G^-1 R G^-T + walk I.

        The paper prints the inverse of G^-1 R G^-T; see `docs/reference/errata.md`.

        Args:
            pose: (3,) of the robot [m, m, rad], map frame.
            b: Number of the measurement.
            walk: Variance [m^2] of the landmark's random walk until its next measurement, along each axis.
        """
        turn = turn_about_vertical(pose[2])
        mean = turn @ self.camera.robot_from_camera(self.points[b]) + [pose[0], pose[1], 0.0]  # l. 30
        noise = self.camera.covariance(self.points[b]) if self.in_image else self.noises[b]
        to_map = turn @ ROBOT_FROM_CAMERA
        return Landmark(mean, to_map @ noise @ to_map.T + walk * np.eye(3))  # l. 31 *

    def update(self, pose: FloatArray, landmark: Landmark, b: int, walk: float = 0.0, iterations: int = 1) -> None:
        """Update a landmark by its measurement at an exact pose (iterated EKF); if it is not visible, only count it.

        Args:
            pose: (3,) of the robot [m, m, rad], map frame.
            landmark: The landmark, changed.
            b: Number of the measurement.
            walk: Variance of the random walk, see `new_landmark`.
            iterations: Number of linearisations, each at the estimate of the one before.
        """
        landmark.count += 1
        mean, sigma = landmark.mean, landmark.covariance
        here = mean
        for iteration in range(iterations):
            prediction = self.predict(pose, here)
            if prediction is None:
                return
            z_hat, g, _ = prediction
            s = g @ sigma @ g.T + self.noises[b]  # Eq. 7
            gain = np.linalg.solve(s, g @ sigma).T  # Eq. 8
            here = mean + gain @ (self.z[b] - z_hat - g @ (mean - here))  # Eq. 9
            if iteration == iterations - 1:
                keep = np.eye(3) - gain @ g
                landmark.mean = here
                landmark.covariance = keep @ sigma @ keep.T + gain @ self.noises[b] @ gain.T  # Eq. 10, Joseph form
                landmark.covariance += walk * np.eye(3)
