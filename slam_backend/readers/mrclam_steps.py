"""A MR.CLAM log becomes steps: odometry between common times, and what each robot saw around each of them."""

from dataclasses import dataclass

import numpy as np

from slam_backend.errors import FloatArray, IntArray, check_float
from slam_backend.measurements import Measurements
from slam_backend.readers.mrclam import MrclamLog, RobotLog
from slam_backend.readers.range_bearing import even_times, frames_at, motions
from slam_backend.readers.velocities import integrate_commands


@dataclass(frozen=True, slots=True, kw_only=True)
class SightingNoise:
    """Assumed errors of one sighting; the defaults are twice what the sightings of this data set show.

    Against the truth of six robots (five of data set 7, one of 4), ranges scatter by 0.03 to 0.17 m from 1 to 3 m and
    by 0.07 to 0.21 m from 4 to 6 m, robot by robot, and bearings by 0.006 to 0.018 rad. These errors persist: those of
    ranges correlate by about 0.85 from one frame to the next, 0.65 over a second and 0.4 over four, those of bearings
    half as much. A filter takes each sighting for new evidence, hence the factor of two.

    Attributes:
        range_floor: Standard deviation of a range near zero [m].
        range_share: What each metre of range adds, in quadrature [m/m].
        bearing: Standard deviation of a bearing [rad].
        height: Standard deviation of the height [m]: all landmarks are taken to stand at the camera's own.
    """

    range_floor: float = 0.1
    range_share: float = 0.07
    bearing: float = 0.025
    height: float = 0.05

    def __post_init__(self) -> None:
        for name in ("range_floor", "bearing", "height"):
            check_float(f"sensor.{name}", getattr(self, name), "Give a standard deviation.", above=0.0)
        check_float("sensor.range_share", self.range_share, "Give a share of the range.", at_least=0.0)

    def variances(self, ranges: FloatArray) -> FloatArray:
        """Return the variances (n, 3) [m^2, rad^2, m^2] of range, bearing and height at ranges (n,) [m]."""
        along = self.range_floor**2 + (self.range_share * ranges) ** 2
        return np.stack([along, *(np.full(len(ranges), v**2) for v in (self.bearing, self.height))], axis=-1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Drive:
    """How a robot follows its commands; the default takes them at their word.

    Attributes:
        delay: From a command to the motion [s].
        speed: Driven over commanded velocity [-].
        turn: Driven over commanded angular velocity [-].
    """

    delay: float = 0.0
    speed: float = 1.0
    turn: float = 1.0

    def __post_init__(self) -> None:
        check_float("drive.delay", self.delay, "Give seconds.", at_least=0.0)
        for name in ("speed", "turn"):
            check_float(f"drive.{name}", getattr(self, name), "Give a factor near 1.", above=0.0)

    def driven(self, commands: FloatArray) -> FloatArray:
        """Return the velocities (n, 3) [s, m/s, rad/s] that follow from commands (n, 3) of the same units."""
        return np.asarray(commands * [1.0, self.speed, self.turn] + [self.delay, 0.0, 0.0])


@dataclass(frozen=True, slots=True, eq=False)
class RobotSteps:
    """One robot's readings, step by step.

    Attributes:
        odometry: (T, 3) float64 [m, m, rad]. Motion since the step before, in the previous robot frame; the first is 0.
        reckoned: (T, 3) float64 [m, m, rad]. Where the commands, taken at their word, would lead; own start frame.
        measurements: T entries; None where it saw no landmark. Descriptors are one-hot, by the order of
            `MrclamLog.subjects`.
    """

    odometry: FloatArray
    reckoned: FloatArray
    measurements: tuple[Measurements | None, ...]


@dataclass(frozen=True, slots=True, eq=False)
class MrclamSteps:
    """A log as steps at common times.

    Attributes:
        times: (T,) float64 [s]. Evenly spaced.
        robots: In the order of the log.
    """

    times: FloatArray
    robots: tuple[RobotSteps, ...]


def steps(
    log: MrclamLog, dt: float = 0.25, noise: SightingNoise | None = None, drive: Drive | None = None
) -> MrclamSteps:
    """Resample a log at common times, from its earliest command to its last reading.

    A sighting goes to the nearest step and is moved there by the odometry in between, so that it loses nothing to the
    rounding of its time. Of several sightings of one landmark in one step the first counts: their errors are largely
    the same. The default step is a little longer than the 0.23 s between two frames of these cameras.

    Args:
        log: What `load_mrclam` returned.
        dt: Time between steps [s].
        noise: Errors assumed for each sighting. None: `SightingNoise()`.
        drive: How the robots follow their commands. None: `Drive()`.

    Raises:
        ValueError: If `dt` is not positive, or makes more than a million steps.
    """
    noise = SightingNoise() if noise is None else noise
    stamps = [robot.commands[:, 0] for robot in log.robots] + [robot.sightings[:, 0] for robot in log.robots]
    start = min(float(robot.commands[0, 0]) for robot in log.robots)
    times = even_times(start, max(float(own[-1]) for own in stamps if len(own)), dt)
    drive = Drive() if drive is None else drive
    return MrclamSteps(times, tuple(_robot_steps(robot, times, log.subjects, noise, drive) for robot in log.robots))


def _robot_steps(
    log: RobotLog, times: FloatArray, subjects: IntArray, noise: SightingNoise, drive: Drive
) -> RobotSteps:
    """Return the steps of one robot at these times (T,) [s]."""
    velocities = drive.driven(log.commands)

    def pose_at(wanted: FloatArray) -> FloatArray:
        return integrate_commands(velocities, wanted)

    reckoned = integrate_commands(log.commands, times)
    reckoned.setflags(write=False)
    column = np.searchsorted(subjects, log.sightings[:, 1].astype(np.int64))
    descriptors = np.eye(len(subjects), dtype=np.float32)[column]
    seen, variances = log.sightings[:, [0, 2, 3]], noise.variances(log.sightings[:, 2])
    frames = frames_at(times, pose_at, seen, variances, descriptors, column)
    return RobotSteps(motions(pose_at(times)), reckoned, frames)
