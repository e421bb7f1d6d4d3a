"""Simulated odometry with true noise and bias."""

import math
from dataclasses import dataclass

import numpy as np

from slam_backend.core.jit import in_place
from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import FloatArray, check_float

LARGEST_SIGMA = 100.0  # per metre; limits the readings to what filters accept


@short_repr
@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryNoise:
    """True noise of odometry, proportional to the distance d travelled in a tick.

    Attributes:
        sigma_distance: Standard deviation of the measured distance, as a share of d [m/m].
        sigma_heading_per_metre: Standard deviation of the measured turn [rad/m].
        bias_distance: Standard deviation of a robot's relative distance bias, constant in an episode [m/m].
        bias_heading_per_metre: Standard deviation of a robot's turn bias, constant in an episode [rad/m].
    """

    sigma_distance: float = 0.05
    sigma_heading_per_metre: float = float(np.radians(2.0))
    bias_distance: float = 0.02
    bias_heading_per_metre: float = float(np.radians(0.5))

    def __post_init__(self) -> None:
        for name in self.__slots__:
            hint = "Give a standard deviation."
            check_float(f"odometry.{name}", getattr(self, name), hint, at_least=0.0, at_most=LARGEST_SIGMA)


def draw_bias(noise: OdometryNoise, num_robots: int, rng: np.random.Generator) -> FloatArray:
    """Draw the odometry bias of each robot for an episode.

    Args:
        noise: Standard deviations.
        num_robots: Number of robots K.
        rng: Source of the draws, 2 K of them.

    Returns:
        (K, 2) float64. Relative distance bias [m/m] and turn bias [rad/m].
    """
    return rng.standard_normal((num_robots, 2)) * (noise.bias_distance, noise.bias_heading_per_metre)


def read_odometry(
    previous_poses: FloatArray,
    poses: FloatArray,
    bias: FloatArray,
    noise: OdometryNoise,
    rng: np.random.Generator,
    travelled: FloatArray | None = None,
) -> FloatArray:
    """Return noisy odometry of one tick.

    Encoder errors scale the whole translation by one factor; the error of the turn also rotates its direction. A robot
    at rest reads exactly zero.

    Args:
        previous_poses: (K, 3) float64 [m, m, rad], world frame. True poses at the last tick.
        poses: (K, 3) float64 [m, m, rad], world frame. Current true poses.
        bias: (K, 2) float64. Biases from `draw_bias`.
        noise: Standard deviations.
        rng: Source of the draws, always 2 K of them.
        travelled: (K,) float64 [m]. Accumulator of the true distances, updated if given.

    Returns:
        (K, 3) float64 [m, m, rad], each robot's previous frame. Motions (dx, dy, dtheta).
    """
    robots = len(poses)
    travelled = np.zeros(robots) if travelled is None else travelled
    read, draws = np.empty((robots, 3)), rng.standard_normal((robots, 2))
    sigmas = noise.sigma_distance, noise.sigma_heading_per_metre
    _read(previous_poses, poses, bias, draws, *sigmas, travelled, read)
    return read


@in_place
def _read(
    before: FloatArray,
    after: FloatArray,
    bias: FloatArray,
    draws: FloatArray,
    sigma_distance: float,
    sigma_heading_per_metre: float,
    travelled: FloatArray,
    read: FloatArray,
) -> None:
    """Write the readings (K, 3) of motions between poses (K, 3), given standard normal draws (K, 2); add distances."""
    for k in range(len(after)):
        dx, dy, turned = after[k, 0] - before[k, 0], after[k, 1] - before[k, 1], after[k, 2] - before[k, 2]
        distance = math.hypot(dx, dy)
        travelled[k] += distance
        stretch = 1.0 + bias[k, 0] + sigma_distance * draws[k, 0]
        turn = distance * (bias[k, 1] + sigma_heading_per_metre * draws[k, 1])
        into_robot = 0.5 * turn - before[k, 2]  # half of the turn error arises before the midpoint
        c, s = math.cos(into_robot), math.sin(into_robot)
        read[k, 0] = stretch * (c * dx - s * dy)
        read[k, 1] = stretch * (s * dx + c * dy)
        read[k, 2] = (turned + turn + math.pi) % (2.0 * math.pi) - math.pi
