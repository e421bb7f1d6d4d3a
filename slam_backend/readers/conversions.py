"""Conversion of ranges and bearings to points, and of velocity commands to motions."""

import numpy as np
from numpy.typing import ArrayLike

from slam_backend.core.validation import FloatArray, argument_error, check_array
from slam_backend.geometry import compose, rotation, wrap_angle
from slam_backend.models.camera import ROBOT_FROM_CAMERA


def points_from_polar(
    ranges: FloatArray, bearings: FloatArray, variances: FloatArray, offsets: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return the points of range and bearing readings and their covariances, to first order.

    Zc = r cos b, Xc = -r sin b, Yc = 0: a planar sensor is a camera whose points all have its own height.

    Args:
        ranges: (n,) float64 [m].
        bearings: (n,) float64 [rad], positive to the left of straight ahead.
        variances: (n, 3) float64 [m^2, rad^2, m^2]. Variances of range, bearing and height.
        offsets: (n, 3) float64 [m, m, rad]. Poses of the sensor at the readings, frame of the step; None: zeros.

    Returns:
        Points (n, 3) [m] and covariances (n, 3, 3) [m^2], camera frame at the step.
    """
    n = len(ranges)
    moved = np.zeros((n, 3)) if offsets is None else offsets
    direction = wrap_angle(bearings + moved[:, 2])
    ahead, left = np.cos(direction), np.sin(direction)
    points = np.stack([ranges * ahead + moved[:, 0], ranges * left + moved[:, 1], np.zeros(n)], axis=-1)
    jacobian = np.zeros((n, 3, 3))  # of the point by (range, bearing, height)
    jacobian[:, 0, 0], jacobian[:, 0, 1] = ahead, -ranges * left
    jacobian[:, 1, 0], jacobian[:, 1, 1] = left, ranges * ahead
    jacobian[:, 2, 2] = 1.0
    covariances = (jacobian * variances[:, None, :]) @ jacobian.transpose(0, 2, 1)
    return points @ ROBOT_FROM_CAMERA, ROBOT_FROM_CAMERA.T @ covariances @ ROBOT_FROM_CAMERA


HOLD = 1.5  # [s] a velocity older than this no longer moves the robot


def integrate_commands(commands: ArrayLike, times: ArrayLike, hold: float = HOLD) -> FloatArray:
    """Integrate velocities exactly along arcs; each applies until the next one, but no longer than `hold`.

    Args:
        commands: (n, 3) float64 [s, m/s, rad/s]. Time, forward and angular velocity, ordered by time, n >= 1.
        times: (T,) float64 [s], any order. The robot is stationary before the first command.
        hold: Longest effect of a command [s].

    Returns:
        (T, 3) poses at these times in the robot's start frame.

    Raises:
        ValueError: If a shape is wrong, a number is not finite or there is no command.

    >>> integrate_commands([[0.0, 1.0, 0.0], [2.0, 0.0, 1.0]], [1.0, 5.0], hold=3.0).tolist()
    [[1.0, 0.0, 0.0], [2.0, 0.0, 3.0]]
    """
    table: FloatArray = check_array("commands", commands, (None, 3), "Give rows (time, velocity, angular velocity).")
    wanted: FloatArray = check_array("times", times, (None,), "Give times in seconds.")
    if not len(table):
        raise argument_error("commands", "at least one row", "no row", "Give the robot's first command.")
    held = np.minimum(np.diff(table[:, 0]), hold)
    headings = np.concatenate([[0.0], np.cumsum(table[:-1, 2] * held)])
    chords = integrate_arc(table[:-1, 1], table[:-1, 2], held)
    moved = (rotation(headings[:-1]) @ chords[:, :2, None])[..., 0]
    knots = np.column_stack([np.concatenate([np.zeros((1, 2)), np.cumsum(moved, axis=0)]), headings])
    last = np.searchsorted(table[:, 0], wanted, side="right") - 1
    row = np.maximum(last, 0)
    since = np.where(last < 0, 0.0, np.minimum(wanted - table[row, 0], hold))
    return compose(knots[row], integrate_arc(table[row, 1], table[row, 2], since))


def integrate_arc(velocity: FloatArray, angular_velocity: FloatArray, duration: FloatArray) -> FloatArray:
    """Return the motions of a unicycle at constant velocities.

    Args:
        velocity: (n,) float64 [m/s]. Forward velocity.
        angular_velocity: (n,) float64 [rad/s].
        duration: (n,) float64 [s].

    Returns:
        (n, 3) float64 [m, m, rad]. Pose after the motion relative to the pose before it.
    """
    turn = angular_velocity * duration
    chord = velocity * duration * np.sinc(turn / (2.0 * np.pi))  # numpy's sinc is sin(pi x) / (pi x)
    return np.stack([chord * np.cos(0.5 * turn), chord * np.sin(0.5 * turn), turn], axis=-1)
