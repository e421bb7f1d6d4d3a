"""Odometry motion model p(x_t | x_{t-1}, u_t) of the filter (Eq. 4)."""

import math
from dataclasses import dataclass

import numpy as np

from slam_backend.core.validation import FloatArray, check_float, known_names
from slam_backend.geometry import compose

LARGEST_SIGMA = 1e3  # [m, rad], or either per metre or radian; more carries no information


@known_names
@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryModel:
    """Gaussian noise of an odometry reading u = (dx, dy, dtheta) in the robot's previous frame.

    The three components are independent; the variance of each is the sum of a floor and a part that grows with the
    motion.

    Attributes:
        sigma_along: Standard deviation of dx per metre travelled [m/m].
        sigma_across: Standard deviation of dy per metre travelled [m/m].
        sigma_heading: Standard deviation of dtheta per metre travelled [rad/m].
        sigma_turn: Standard deviation of dtheta per radian turned [rad/rad].
        floor_position: Constant standard deviation of dx and dy [m].
        floor_heading: Constant standard deviation of dtheta [rad].
    """

    sigma_along: float = 0.05
    sigma_across: float = 0.02
    sigma_heading: float = np.pi / 90.0
    sigma_turn: float = 0.02
    floor_position: float = 3e-4
    floor_heading: float = 3e-4

    def __post_init__(self) -> None:
        for name in ("sigma_along", "sigma_across", "sigma_heading", "sigma_turn", "floor_position", "floor_heading"):
            hint = "Give a standard deviation."
            check_float(f"motion.{name}", getattr(self, name), hint, at_least=0.0, at_most=LARGEST_SIGMA)

    @property
    def is_noiseless(self) -> bool:
        """Whether all standard deviations are zero."""
        of_motion = self.sigma_along, self.sigma_across, self.sigma_heading, self.sigma_turn
        return not any((*of_motion, self.floor_position, self.floor_heading))

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
