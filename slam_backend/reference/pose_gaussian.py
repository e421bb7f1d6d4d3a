"""Gaussian pose of one robot, and its whitened form with unit covariance."""

from dataclasses import dataclass

import numpy as np

from slam_backend.core.validation import FloatArray
from slam_backend.geometry import wrap_angle

ZERO_PIVOT = 1e-12  # relative to the variance; below it a direction counts as exact


def turn_about_vertical(theta: float) -> FloatArray:
    """Return the 3 x 3 rotation by theta [rad] about the vertical axis."""
    c, s = np.cos(theta), np.sin(theta)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def wrapped(pose: FloatArray) -> FloatArray:
    """Return the pose (3,) with its heading in [-pi, pi)."""
    return np.array([pose[0], pose[1], wrap_angle(pose[2])])


def lower_root(covariance: FloatArray) -> FloatArray:
    """Return the lower triangular C (3, 3) with C C^T = covariance (Cholesky).

    A direction without uncertainty (a pivot that is negligible beside its diagonal element) gets a column of zeros.
    """
    root = np.zeros((3, 3))
    for j in range(3):
        pivot = covariance[j, j] - root[j] @ root[j]
        if pivot > ZERO_PIVOT * covariance[j, j]:
            root[j:, j] = (covariance[j:, j] - root[j:] @ root[j]) / np.sqrt(pivot)
    return root


@dataclass(frozen=True)
class GaussianPose:
    """Gaussian pose: mean (3,) [m, m, rad], map frame, heading on any branch; covariance (3, 3), 0 if exact."""

    mean: FloatArray
    covariance: FloatArray

    @classmethod
    def known(cls, pose: FloatArray) -> "GaussianPose":
        """Return an exact pose."""
        return cls(pose, np.zeros((3, 3)))

    def moved(self, odometry: FloatArray, sigmas: FloatArray, spread: FloatArray | None = None) -> "GaussianPose":
        """Predict the pose after a motion: F P F^T + T diag(sigmas^2) T^T, to first order.

        Args:
            odometry: (3,) [m, m, rad], in the robot's frame before the motion (u).
            sigmas: (3,) [m, m, rad], its standard deviations in the same frame.
            spread: (3, 3) covariance to add, in the robot's frame after the motion. None: nothing.
        """
        turn = turn_about_vertical(self.mean[2])
        x, y, _ = turn @ odometry
        by_previous = np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]])  # F = d(mean o u) / d mean
        carried = by_previous @ self.covariance @ by_previous.T
        mean, covariance = self.mean + turn @ odometry, carried + turn @ np.diag(sigmas**2) @ turn.T
        if spread is not None:
            turn = turn_about_vertical(mean[2])
            covariance = covariance + turn @ spread @ turn.T
        return GaussianPose(mean, covariance)


@dataclass(frozen=True)
class WhitenedPose:
    """Pose written as start + root xi, where xi ~ N(0, 1) before the measurements and N(xi, information^-1) now.

    Attributes:
        start: (3,) [m, m, rad], map frame, heading on any branch.
        root: (3, 3) [m, m, rad], factor of the covariance before the measurements.
        xi: (3,) [-].
        information: (3, 3) [-], of xi.
    """

    start: FloatArray
    root: FloatArray
    xi: FloatArray
    information: FloatArray

    @classmethod
    def before_measurements(cls, start: FloatArray, root: FloatArray) -> "WhitenedPose":
        """Return N(start, root root^T): xi = 0 with unit information; (3,) and (3, 3)."""
        return cls(start, root, np.zeros(3), np.eye(3))

    @classmethod
    def of(cls, belief: GaussianPose) -> "WhitenedPose":
        """Whiten a Gaussian along the robot's own axes, independent of the heading of the map frame."""
        turn = turn_about_vertical(belief.mean[2])
        return cls.before_measurements(belief.mean, turn @ lower_root(turn.T @ belief.covariance @ turn))

    def at(self, xi: FloatArray, information: FloatArray) -> "WhitenedPose":
        """Return the same prior with another estimate of xi: mean (3,) and information (3, 3)."""
        return WhitenedPose(self.start, self.root, xi, information)

    @property
    def pose(self) -> FloatArray:
        """The most probable pose (3,), heading on any branch."""
        return self.start + self.root @ self.xi

    @property
    def spread(self) -> FloatArray:
        """The covariance (3, 3) of xi."""
        return np.asarray(np.linalg.inv(self.information), dtype=np.float64)

    @property
    def covariance(self) -> FloatArray:
        """The covariance (3, 3) of the pose."""
        return self.root @ self.spread @ self.root.T

    def sample(self, normals: FloatArray) -> FloatArray:
        """Return the pose (3,) for standard normal numbers (3,), heading wrapped."""
        return wrapped(self.pose + self.root @ lower_root(self.spread) @ normals)
