"""A log of Victoria Park becomes steps: the motion of the vehicle between laser scans, and the trees in each."""

from dataclasses import dataclass

import numpy as np

from slam_backend.errors import FloatArray, check_float
from slam_backend.geometry import between
from slam_backend.measurements import Measurements
from slam_backend.readers.polar import points_from_polar
from slam_backend.readers.velocities import integrate_commands
from slam_backend.readers.victoria import VictoriaLog

# Where laser and GPS antenna are, from the middle of the rear axle [m], and the encoder's wheel: the vehicle model that
# E. Nebot publishes with the data (acfr.usyd.edu.au, "Ute modeling info"): L = 2.83, H = 0.76, b = 0.5, a = L + 0.95.
WHEELBASE = 2.83  # L
ENCODER = 0.76  # H, the rear left wheel from the middle of its axle, to the left
SENSOR = (3.78, 0.5, 0.0)  # (a, b) and height; heights do not matter, all is seen in one plane


@dataclass(frozen=True, slots=True, kw_only=True)
class TreeNoise:
    """Assumed errors of one tree's reading.

    From one scan to the next, trees keep their place to 0.03 m in range near the laser and 0.06 m at 60 m, and to 0.003
    and 0.0015 rad in bearing. That is not what a filter may believe: a trunk is seen from all sides, and what is wrong
    with its reading from one side stays so from scan to scan. The defaults are half of the median trunk's diameter
    (0.42 m) and two of the laser's rays (half a degree each).

    Attributes:
        range: Standard deviation of a range [m].
        bearing: Standard deviation of a bearing [rad].
        height: Standard deviation of the height [m].
    """

    range: float = 0.2
    bearing: float = 0.02
    height: float = 0.1

    def __post_init__(self) -> None:
        for name in ("range", "bearing", "height"):
            check_float(f"sensor.{name}", getattr(self, name), "Give a standard deviation.", above=0.0)


@dataclass(frozen=True, slots=True, eq=False)
class VictoriaSteps:
    """A log as steps at the times of its scans.

    Attributes:
        times: (T,) float64 [s].
        odometry: (T, 3) float64 [m, m, rad]. Motion of the rear axle since the step before; the first is 0.
        measurements: T entries; None where no tree was seen. Points are relative to the laser at `SENSOR`; all
            descriptors are (1,): trees look alike.
    """

    times: FloatArray
    odometry: FloatArray
    measurements: tuple[Measurements | None, ...]


def steps(log: VictoriaLog, noise: TreeNoise | None = None) -> VictoriaSteps:
    """Turn a log into odometry and measurements.

    Args:
        log: What `load_victoria` returned.
        noise: Errors assumed for each tree. None: `TreeNoise()`.
    """
    noise = TreeNoise() if noise is None else noise
    path = integrate_commands(axle_velocities(log.controls), log.scan_times)
    odometry = np.concatenate([np.zeros((1, 3)), between(path[:-1], path[1:])])
    for array in (odometry, path):
        array.setflags(write=False)
    return VictoriaSteps(log.scan_times, odometry, tuple(_frame(trees, noise) for trees in log.scans))


def axle_velocities(controls: FloatArray) -> FloatArray:
    """Return the velocities (n, 3) [s, m/s, rad/s] of the middle of the rear axle under controls (n, 3) [s, m/s, rad].

    v_c = v_e / (1 - tan(alpha) H / L), omega = v_c tan(alpha) / L: the encoder sits on the left wheel, which is slower
    than the middle of the axle in a turn to the left.

    >>> axle_velocities(np.array([[0.0, 2.0, 0.0]])).tolist()
    [[0.0, 2.0, 0.0]]
    """
    slope = np.tan(controls[:, 2])
    speed = controls[:, 1] / (1.0 - slope * ENCODER / WHEELBASE)
    return np.stack([controls[:, 0], speed, speed * slope / WHEELBASE], axis=-1)


def _frame(trees: FloatArray, noise: TreeNoise) -> Measurements | None:
    """Return the trees (n, 3) of a scan as measurements, which all look alike; None if there are none."""
    if not len(trees):
        return None
    variances = np.tile([noise.range**2, noise.bearing**2, noise.height**2], (len(trees), 1))
    points, covariances = points_from_polar(trees[:, 0], trees[:, 1], variances)
    return Measurements(points, np.ones((len(trees), 1), dtype=np.float32), covariances)
