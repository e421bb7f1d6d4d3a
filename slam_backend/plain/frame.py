"""One robot's frame in the plain filter: predictions with explicit Jacobians, densities, landmark EKFs.

Measurements are compared in the space in which they are made, (u, v, disparity) for a stereo camera and the camera
frame for points with given covariances; the compiled kernels map innovations to metres in the map frame. Densities
per pixel^3 are multiplied by the camera's constant f^3 b, which turns them into those that the kernels quote.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from slam_backend._kernels import MIN_DEPTH
from slam_backend.camera import ROBOT_FROM_CAMERA, StereoCamera
from slam_backend.errors import FloatArray
from slam_backend.measurements import Measurements


def turn_about_vertical(theta: float) -> FloatArray:
    """Return the 3 x 3 rotation by theta about the vertical axis."""
    c, s = np.cos(theta), np.sin(theta)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


@dataclass
class Landmark:
    """One EKF: mean (3,) and covariance (3, 3) in the map frame, and how often it was measured."""

    mean: FloatArray
    covariance: FloatArray
    count: int = 1


@dataclass(frozen=True)
class Prior:
    """What is known of a pose: it is mean + root xi, xi ~ N(xi^, spread); N(0, 1) before any measurement."""

    mean: FloatArray
    root: FloatArray
    xi: FloatArray = field(default_factory=lambda: np.zeros(3))
    spread: FloatArray = field(default_factory=lambda: np.eye(3))

    @property
    def pose(self) -> FloatArray:
        """The most probable pose."""
        return self.mean + self.root @ self.xi

    @property
    def covariance(self) -> FloatArray:
        """Of the pose."""
        return self.root @ self.spread @ self.root.T


@dataclass(frozen=True)
class Innovation:
    """Measured minus predicted (3,), its covariance S (3, 3), and how the prediction moves with the pose (3, 3)."""

    innovation: FloatArray
    covariance: FloatArray
    by_pose: FloatArray
    log_unit: float
    cap: float = np.inf

    @cached_property
    def distance(self) -> float:
        """Squared Mahalanobis distance D (l. 19)."""
        return min(self.cap, float(self.innovation @ np.linalg.solve(self.covariance, self.innovation)))

    @cached_property
    def log_density(self) -> float:
        """The log of N(innovation; 0, S) (Eq. 11), for image coordinates in the unit of the kernels."""
        log_det = np.linalg.slogdet(2.0 * np.pi * self.covariance)[1]
        return float(-0.5 * (self.distance + log_det)) + self.log_unit

    @property
    def cost(self) -> float:
        """What choosing this landmark costs: -2 log density."""
        return -2.0 * self.log_density

    def within(self, cap: float) -> "Innovation":
        """Return the same with a distance of at most `cap`: by the caller's word the match is right."""
        return replace(self, cap=cap)


class Frame:
    """The measurements of one robot in one step as vectors z (n, 3) with their noise covariances R (n, 3, 3).

    Args:
        measurements: What the camera reported.
        kept: Indices of the measurements to be used.
        names: Of the landmarks measured, by the caller's word; None: unknown.
        camera: Its assumed model.
    """

    def __init__(
        self, measurements: Measurements, kept: Sequence[int], names: Sequence[int] | None, camera: StereoCamera
    ) -> None:
        self.camera = camera
        self.names = names
        self.points = measurements.points[list(kept)]
        self.descriptors = measurements.descriptors[list(kept)].astype(np.float64)
        self.in_image = measurements.covariances is None
        if measurements.covariances is None:
            self.z = camera.project(self.points)
            sigmas = [camera.sigma_px, camera.sigma_px, camera.sigma_disparity_px]
            self.noises = np.tile(np.diag(np.square(sigmas)), (len(kept), 1, 1))
            self.log_unit = float(np.log(camera.focal_px**3 * camera.baseline))
        else:
            self.z = self.points
            self.noises = measurements.covariances[kept]
            self.log_unit = 0.0

    def __len__(self) -> int:
        return len(self.z)

    def predict(self, pose: FloatArray, mean: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        """Return z^ (Eq. 5) and its Jacobians by landmark (G, Eq. 6) and by pose (H); None if it cannot be seen."""
        turn = turn_about_vertical(pose[2])
        c, s = np.cos(pose[2]), np.sin(pose[2])
        by_heading = np.array([[-s, -c, 0.0], [c, -s, 0.0], [0.0, 0.0, 0.0]])  # of turn
        offset = mean - [pose[0], pose[1], 0.0]
        point = self.camera.camera_from_robot(turn.T @ offset)
        g = ROBOT_FROM_CAMERA.T @ turn.T
        h = np.column_stack([-g[:, :2], ROBOT_FROM_CAMERA.T @ by_heading.T @ offset])
        if not self.in_image:
            return point, g, h
        x, y, depth = point
        if depth < MIN_DEPTH:
            return None
        scale = self.camera.focal_px / depth
        by_point = scale * np.array(
            [[1.0, 0.0, -x / depth], [0.0, 1.0, -y / depth], [0.0, 0.0, -self.camera.baseline / depth]]
        )
        return self.camera.project(point), by_point @ g, by_point @ h

    def linearise(self, prior: Prior, landmark: Landmark, b: int) -> Innovation | None:
        """Return the innovation of measurement b at the most probable pose, that pose taken as known (Eqs. 5-7)."""
        prediction = self.predict(prior.pose, landmark.mean)
        if prediction is None:
            return None
        z_hat, g, h = prediction
        covariance = g @ landmark.covariance @ g.T + self.noises[b]  # Eq. 7
        return Innovation(self.z[b] - z_hat, covariance, h, self.log_unit)

    def compare(self, prior: Prior, landmark: Landmark, b: int) -> Innovation | None:
        """Return the same with the uncertainty of the pose included: what a gate tests."""
        term = self.linearise(prior, landmark, b)
        if term is None:
            return None
        covariance = term.covariance + term.by_pose @ prior.covariance @ term.by_pose.T
        return replace(term, covariance=covariance)

    def metres(self, prior: Prior, landmark: Landmark, b: int) -> float:
        """Return how far a measured point lies from a landmark [m]; a camera's are scaled to the landmark's depth."""
        offset = landmark.mean - [prior.pose[0], prior.pose[1], 0.0]
        point = self.camera.camera_from_robot(turn_about_vertical(prior.pose[2]).T @ offset)
        scale = point[2] / self.points[b, 2] if self.in_image else 1.0
        return float(scale * np.linalg.norm(self.points[b] - point))

    def log_clutter(self, b: int, p0: float) -> float:
        """Return the log-density of a measurement that matches nothing: p0 per m^3, where it was measured (l. 32)."""
        jacobian = 4.0 * np.log(self.points[b, 2]) if self.in_image else 0.0
        return float(np.log(p0) + jacobian)

    def new_landmark(self, pose: FloatArray, b: int) -> Landmark:
        """Place what was never seen before (l. 30-31): mean g^-1(x, v), covariance G^-1 R G^-T."""
        turn = turn_about_vertical(pose[2])
        mean = turn @ self.camera.robot_from_camera(self.points[b]) + [pose[0], pose[1], 0.0]
        noise = self.camera.covariance(self.points[b]) if self.in_image else self.noises[b]
        to_map = turn @ ROBOT_FROM_CAMERA
        return Landmark(mean, to_map @ noise @ to_map.T)

    def update(self, pose: FloatArray, landmark: Landmark, b: int, iterations: int) -> None:
        """Improve a landmark by its measurement at a known pose: the EKF, linearised anew at each iteration."""
        landmark.count += 1
        prior, sigma = landmark.mean.copy(), landmark.covariance
        mean = prior.copy()
        for _ in range(iterations):
            prediction = self.predict(pose, mean)
            if prediction is None:
                return
            z_hat, g, _ = prediction
            s = g @ sigma @ g.T + self.noises[b]  # Eq. 7
            gain = np.linalg.solve(s, g @ sigma).T  # Eq. 8
            mean = prior + gain @ (self.z[b] - z_hat - g @ (prior - mean))  # Eq. 9
        keep = np.eye(3) - gain @ g
        landmark.mean = mean
        landmark.covariance = keep @ sigma @ keep.T + gain @ self.noises[b] @ gain.T  # Eq. 10, Joseph's form
