"""True odometry noise: what wheel encoders read of the way that robots really went."""

import math
from dataclasses import dataclass

import numpy as np

from slam_backend.core.jit import in_place
from slam_backend.core.validation import FloatArray, check_float

LARGEST_SIGMA = 100.0  # per metre; filters take no motion of 10 km in a tick


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryNoise:
    """Noise of odometry readings; everything grows with the distance d travelled in a tick.

    Attributes:
        sigma_distance: Standard deviation of the distance read, as a share of d [m/m].
        sigma_heading_per_metre: Standard deviation of the turn read [rad/m].
        bias_distance: Standard deviation of the share by which a robot misreads all distances of an episode [m/m].
        bias_heading_per_metre: Standard deviation of the turn per metre by which it misreads them [rad/m].
    """

    sigma_distance: float = 0.05
    sigma_heading_per_metre: float = float(np.radians(2.0))
    bias_distance: float = 0.02
    bias_heading_per_metre: float = float(np.radians(0.5))

    def __post_init__(self) -> None:
        for name in self.__slots__:
            cure = "Give a standard deviation."
            check_float(f"odometry.{name}", getattr(self, name), cure, at_least=0.0, at_most=LARGEST_SIGMA)


def draw_bias(noise: OdometryNoise, num_robots: int, rng: np.random.Generator) -> FloatArray:
    """Draw what each robot misreads throughout an episode.

    Args:
        noise: Standard deviations.
        num_robots: K.
        rng: Source of the draws, 2 K of them.

    Returns:
        (K, 2) float64. Share of the distance [m/m] and turn per metre [rad/m].
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
    """Read the motion of one tick with the encoders' errors.

    An encoder misjudges how far a wheel rolled, so one factor stretches the reading as a whole, whatever its direction
    in the robot's frame; the direction itself suffers from the misread turn. A robot at rest reads exactly zero.

    Args:
        previous_poses: (K, 3) float64 [m, m, rad], world frame. At the last tick.
        poses: (K, 3) float64 [m, m, rad], world frame. Now.
        bias: (K, 2) float64, from `draw_bias`.
        noise: Standard deviations.
        rng: Source of the draws: 2 K of them, whatever the motion.
        travelled: (K,) float64 [m]. The true way of each robot is added to it; None: ways are not added up.

    Returns:
        (K, 3) float64 [m, m, rad], each robot's previous frame: (dx, dy, dtheta).
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
    """Write down the readings (K, 3) of motions between poses (K, 3) under standard normal draws (K, 2), add ways."""
    for k in range(len(after)):
        dx, dy, turned = after[k, 0] - before[k, 0], after[k, 1] - before[k, 1], after[k, 2] - before[k, 2]
        distance = math.hypot(dx, dy)
        travelled[k] += distance
        stretch = 1.0 + bias[k, 0] + sigma_distance * draws[k, 0]
        turn = distance * (bias[k, 1] + sigma_heading_per_metre * draws[k, 1])
        into_robot = 0.5 * turn - before[k, 2]  # half of the misread turn falls before the middle of the way
        c, s = math.cos(into_robot), math.sin(into_robot)
        read[k, 0] = stretch * (c * dx - s * dy)
        read[k, 1] = stretch * (s * dx + c * dy)
        read[k, 2] = (turned + turn + math.pi) % (2.0 * math.pi) - math.pi
