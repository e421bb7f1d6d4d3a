"""Odometry motion model p(x_t | x_{t-1}, u_t) of the filter (Eq. 4)."""

import math
from dataclasses import dataclass

import numpy as np

from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import FloatArray, check_float, known_names
from slam_backend.geometry import compose

LARGEST_SIGMA = 1e3  # [m, rad], or either per metre or radian; more carries no information


@short_repr
@known_names
@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryModel:
    """Gaussian noise of an odometry reading u = (dx, dy, dtheta) in the robot's previous frame.

    The three components are independent; the variance of each is the sum of a floor and a part that grows with the
    motion.

    A *bias* b = (scale of the translation, turn per metre travelled, turn per radian turned) is constant in a run and
    differs between robots, such as that of wheels of unequal size. It has a zero-mean Gaussian prior of the given
    standard deviations, by default zero, and is estimated with the path; the motion is u - J b to first order, see
    `bias_jacobians`. A drift per second, as of a gyro, is not modelled.

    Attributes:
        sigma_along: Standard deviation of dx per metre travelled [m/m].
        sigma_across: Standard deviation of dy per metre travelled [m/m].
        sigma_heading: Standard deviation of dtheta per metre travelled [rad/m].
        sigma_turn: Standard deviation of dtheta per radian turned [rad/rad].
        floor_position: Constant standard deviation of dx and dy [m].
        floor_heading: Constant standard deviation of dtheta [rad].
        bias_scale: Standard deviation of the relative error of dx and dy that is constant in a run [m/m].
        bias_heading: Standard deviation of the constant error of dtheta per metre travelled [rad/m].
        bias_turn: Standard deviation of the constant error of dtheta per radian turned [rad/rad].
    """

    sigma_along: float = 0.05
    sigma_across: float = 0.02
    sigma_heading: float = np.pi / 90.0
    sigma_turn: float = 0.02
    floor_position: float = 3e-4
    floor_heading: float = 3e-4
    bias_scale: float = 0.0
    bias_heading: float = 0.0
    bias_turn: float = 0.0

    def __post_init__(self) -> None:
        for name in self.__slots__:
            hint = "Give a standard deviation; 0 for no such bias." if "bias" in name else "Give a standard deviation."
            check_float(f"motion.{name}", getattr(self, name), hint, at_least=0.0, at_most=LARGEST_SIGMA)

    @property
    def is_noiseless(self) -> bool:
        """Whether all standard deviations are zero."""
        of_motion = self.sigma_along, self.sigma_across, self.sigma_heading, self.sigma_turn
        return not any((*of_motion, self.floor_position, self.floor_heading))

    @property
    def bias_covariance(self) -> FloatArray:
        """Prior covariance (3, 3) [m/m, rad/m, rad/rad] of the bias, diagonal; zeros without a bias."""
        return np.diag(np.square([self.bias_scale, self.bias_heading, self.bias_turn]))

    @property
    def is_biased(self) -> bool:
        """Whether a bias is estimated."""
        return self.bias_scale > 0.0 or self.bias_heading > 0.0 or self.bias_turn > 0.0

    def sigmas(self, odometry: FloatArray) -> FloatArray:
        """Return the standard deviations (3,) [m, m, rad] of an odometry reading (3,) [m, m, rad]."""
        dx, dy, turn = odometry.tolist()
        distance = math.hypot(dx, dy)
        return np.array(
            [
                math.hypot(self.sigma_along * distance, self.floor_position),
                math.hypot(self.sigma_across * distance, self.floor_position),
                math.hypot(self.sigma_heading * distance, self.sigma_turn * turn, self.floor_heading),
            ]
        )

    def variances(self, odometry: FloatArray) -> FloatArray:
        """Return the variances (n, 3) [m^2, m^2, rad^2] of n odometry readings (n, 3), previous robot frames."""
        result = np.empty((len(odometry), 3))
        dx, dy, turn = odometry[:, 0], odometry[:, 1], self.sigma_turn * odometry[:, 2]
        square = dx * dx + dy * dy
        result[:, 0] = self.sigma_along**2 * square + self.floor_position**2
        result[:, 1] = self.sigma_across**2 * square + self.floor_position**2
        result[:, 2] = self.sigma_heading**2 * square + turn * turn + self.floor_heading**2
        return result

    @staticmethod
    def bias_jacobians(odometry: FloatArray) -> FloatArray:
        """Return the derivatives J (n, 3, 3) of readings u by the bias b: the motion is u - J b.

        Half of an error of the turn arises before the midpoint of the motion, and rotates its direction.

        Args:
            odometry: (n, 3) [m, m, rad]. Readings, previous robot frames.
        """
        result = np.zeros((len(odometry), 3, 3))
        dx, dy, turn = odometry.T
        result[:, 2, 1], result[:, 2, 2] = np.hypot(dx, dy), turn
        result[:, 0], result[:, 1] = -0.5 * dy[:, None] * result[:, 2], 0.5 * dx[:, None] * result[:, 2]
        result[:, 0, 0], result[:, 1, 0] = dx, dy
        return result

    def sample(self, poses: FloatArray, odometry: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Draw x_t^[m] ~ p(x_t | x_{t-1}^[m], u_t) for each particle (Eq. 4).

        Args:
            poses: (M, 3) float64 [m, m, rad], map frame.
            odometry: (3,) float64 [m, m, rad], previous robot frame.
            rng: Source of the draws.

        Returns:
            (M, 3) new poses, map frame.
        """
        noise = rng.standard_normal((len(poses), 3)) * self.sigmas(odometry)
        return compose(poses, odometry + noise)  # Eq. 4
