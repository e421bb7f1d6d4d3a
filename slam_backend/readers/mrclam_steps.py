"""A MR.CLAM log becomes steps: odometry between common times, and what each robot saw around each of them."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from slam_backend.camera import ROBOT_FROM_CAMERA
from slam_backend.errors import FloatArray, IntArray, bad_argument, check_array, check_float
from slam_backend.geometry import between, compose, rotation, wrap_angle
from slam_backend.measurements import Measurements
from slam_backend.readers.mrclam import MrclamLog, RobotLog

HOLD = 1.5  # [s] a command older than this no longer moves the robot
MAX_STEPS = 1_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class SightingNoise:
    """Assumed errors of one sighting, systematic part included; the defaults suit the cameras of this log.

    Their range errs by a factor that differs by a few per cent from robot to robot, so its deviation grows with range.

    Attributes:
        range_floor: Standard deviation of a range near zero [m].
        range_share: What each metre of range adds, in quadrature [m/m].
        bearing: Standard deviation of a bearing [rad].
        height: Standard deviation of the height [m]: all landmarks are taken to stand at the camera's own.
    """

    range_floor: float = 0.12
    range_share: float = 0.06
    bearing: float = 0.04
    height: float = 0.05

    def __post_init__(self) -> None:
        for name in ("range_floor", "bearing", "height"):
            check_float(f"sensor.{name}", getattr(self, name), "Give a standard deviation.", above=0.0)
        check_float("sensor.range_share", self.range_share, "Give a share of the range.", at_least=0.0)


@dataclass(frozen=True, slots=True, eq=False)
class RobotSteps:
    """One robot's readings, step by step.

    Attributes:
        odometry: (T, 3) float64 [m, m, rad]. Motion since the step before, in the previous robot frame; the first is 0.
        measurements: T entries; None where it saw no landmark. Descriptors are one-hot, by the order of
            `MrclamLog.subjects`.
    """

    odometry: FloatArray
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


def steps(log: MrclamLog, dt: float = 0.25, noise: SightingNoise | None = None) -> MrclamSteps:
    """Resample a log at common times, from its earliest command to its last reading.

    A sighting goes to the nearest step and is moved there by the odometry in between, so that it loses nothing to the
    rounding of its time. Of several sightings of one landmark in one step the first counts: their errors are largely
    the same. The default step is a little longer than the 0.23 s between two frames of these cameras.

    Args:
        log: What `load_mrclam` returned.
        dt: Time between steps [s].
        noise: Errors assumed for each sighting. None: `SightingNoise()`.

    Raises:
        ValueError: If `dt` is not positive, or makes more than a million steps.
    """
    dt = check_float("dt", dt, "Give seconds between steps.", above=0.0)
    noise = SightingNoise() if noise is None else noise
    stamps = [robot.commands[:, 0] for robot in log.robots] + [robot.sightings[:, 0] for robot in log.robots]
    start = min(float(robot.commands[0, 0]) for robot in log.robots)
    end = max(float(times[-1]) for times in stamps if len(times))
    if (end - start) / dt > MAX_STEPS:
        raise bad_argument("dt", f"at most {MAX_STEPS:,} steps", (end - start) / dt, "Take longer steps.")
    times = start + dt * np.arange(int(np.ceil((end - start) / dt)) + 1, dtype=np.float64)
    return MrclamSteps(times, tuple(_robot_steps(robot, times, log.subjects, noise) for robot in log.robots))


def integrate_commands(commands: ArrayLike, times: ArrayLike, hold: float = HOLD) -> FloatArray:
    """Follow commanded velocities exactly along their arcs; a command holds until the next, but no longer than `hold`.

    Args:
        commands: (n, 3) float64 [s, m/s, rad/s]. Time, forward and angular velocity, ordered by time, n >= 1.
        times: (T,) float64 [s], any order. Before the first command the robot stands.
        hold: Longest time that a command moves the robot [s].

    Returns:
        (T, 3) poses at these times in the robot's start frame.

    >>> integrate_commands([[0.0, 1.0, 0.0], [2.0, 0.0, 1.0]], [1.0, 5.0], hold=3.0).tolist()
    [[1.0, 0.0, 0.0], [2.0, 0.0, 3.0]]
    """
    table: FloatArray = check_array("commands", commands, (None, 3), "Give rows (time, velocity, angular velocity).")
    wanted: FloatArray = check_array("times", times, (None,), "Give times in seconds.")
    if not len(table):
        raise bad_argument("commands", "at least one row", "no row", "Give the robot's first command.")
    held = np.minimum(np.diff(table[:, 0]), hold)
    headings = np.concatenate([[0.0], np.cumsum(table[:-1, 2] * held)])
    chords = _arc(table[:-1, 1], table[:-1, 2], held)
    moved = (rotation(headings[:-1]) @ chords[:, :2, None])[..., 0]
    knots = np.column_stack([np.concatenate([np.zeros((1, 2)), np.cumsum(moved, axis=0)]), headings])
    last = np.searchsorted(table[:, 0], wanted, side="right") - 1
    row = np.maximum(last, 0)
    since = np.where(last < 0, 0.0, np.minimum(wanted - table[row, 0], hold))
    return compose(knots[row], _arc(table[row, 1], table[row, 2], since))


def _arc(velocity: FloatArray, angular_velocity: FloatArray, duration: FloatArray) -> FloatArray:
    """Return the motions (n, 3) of a unicycle at constant velocities (n,) during (n,) seconds."""
    turn = angular_velocity * duration
    chord = velocity * duration * np.sinc(turn / (2.0 * np.pi))  # numpy's sinc is sin(pi x) / (pi x)
    return np.stack([chord * np.cos(0.5 * turn), chord * np.sin(0.5 * turn), turn], axis=-1)


def _robot_steps(log: RobotLog, times: FloatArray, subjects: IntArray, noise: SightingNoise) -> RobotSteps:
    path = integrate_commands(log.commands, times)
    odometry = np.concatenate([np.zeros((1, 3)), between(path[:-1], path[1:])])
    odometry.setflags(write=False)
    step = np.rint((log.sightings[:, 0] - times[0]) / (times[1] - times[0])).astype(np.int64) if len(times) > 1 else 0
    step = np.clip(np.broadcast_to(step, len(log.sightings)), 0, len(times) - 1)
    column = np.searchsorted(subjects, log.sightings[:, 1].astype(np.int64))
    _, first = np.unique(step * len(subjects) + column, return_index=True)  # sorted by step, then subject
    chosen, step, column = log.sightings[first], step[first], column[first]
    # The robot at the time of the sighting, seen from where it is at the step.
    offset = between(path[step], integrate_commands(log.commands, chosen[:, 0]))
    points, covariances = _to_camera(chosen[:, 2], chosen[:, 3], offset, noise)
    descriptors = np.eye(len(subjects), dtype=np.float32)[column]
    bounds = np.searchsorted(step, np.arange(len(times) + 1))
    frames = [
        Measurements(points[a:b], descriptors[a:b], covariances[a:b]) if b > a else None
        for a, b in pairwise(bounds)
    ]
    return RobotSteps(odometry, tuple(frames))


def _to_camera(
    ranges: FloatArray, bearings: FloatArray, offsets: FloatArray, noise: SightingNoise
) -> tuple[FloatArray, FloatArray]:
    """Return points (n, 3) and covariances (n, 3, 3), camera frame at the step, of sightings made at offsets (n, 3)."""
    n = len(ranges)
    direction = wrap_angle(bearings + offsets[:, 2])
    ahead, left = np.cos(direction), np.sin(direction)
    points = np.stack([ranges * ahead + offsets[:, 0], ranges * left + offsets[:, 1], np.zeros(n)], axis=-1)
    jacobian = np.zeros((n, 3, 3))  # of the point by (range, bearing, height)
    jacobian[:, 0, 0], jacobian[:, 0, 1] = ahead, -ranges * left
    jacobian[:, 1, 0], jacobian[:, 1, 1] = left, ranges * ahead
    jacobian[:, 2, 2] = 1.0
    variances = np.zeros((n, 3))
    variances[:, 0] = noise.range_floor**2 + (noise.range_share * ranges) ** 2
    variances[:, 1], variances[:, 2] = noise.bearing**2, noise.height**2
    covariances = (jacobian * variances[:, None, :]) @ jacobian.transpose(0, 2, 1)
    return points @ ROBOT_FROM_CAMERA, ROBOT_FROM_CAMERA.T @ covariances @ ROBOT_FROM_CAMERA
