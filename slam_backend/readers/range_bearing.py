"""Conversion of asynchronous odometry and range-bearing readings to steps of a filter at common times."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import FloatArray, IntArray, argument_error, check_array, check_float
from slam_backend.geometry import between
from slam_backend.models.measurements import Measurements
from slam_backend.readers.conversions import HOLD, integrate_commands, points_from_polar
from slam_backend.readers.plausibility import MOST_BEARING, check_precision, check_rate, repetition_note, unit_notes
from slam_backend.readers.tables import MOST_JITTER, sorted_note, steps_back, time_order

MAX_STEPS = 1_000_000
ROUNDING = 1e-6  # share of a step by which its time may be rounded
DT_HINT = "Give seconds between steps."


@short_repr
@dataclass(frozen=True, slots=True, eq=False)
class RobotReadings:
    """Readings of one robot, step by step.

    Attributes:
        odometry: (T, 3) float64 [m, m, rad]. Motion since the previous step, in the previous robot frame; the first is
            zero.
        measurements: T entries; None for a step without landmarks. Points in camera axes with covariances.
    """

    odometry: FloatArray
    measurements: tuple[Measurements | None, ...]


@short_repr
@dataclass(frozen=True, slots=True, eq=False)
class RangeBearingSteps:
    """One robot's log as steps at common times.

    Attributes:
        times: (T,) float64 [s]. Evenly spaced times, none after the last reading.
        odometry: (T, 3) float64 [m, m, rad]. Motion since the previous step, in the previous robot frame; the first is
            zero.
        measurements: T entries; None for a step without sightings. Points in the camera frame with covariances.
            Descriptors are one-hot by `names`, or all equal without identities.
        names: (N,) Identities in ascending order, the columns of the descriptors; empty without identities.
        notes: Lines about rows that were sorted by time, about landmarks that a frame has twice, about gaps between
            velocities, and about quantities whose unit is implausible.
    """

    times: FloatArray
    odometry: FloatArray
    measurements: tuple[Measurements | None, ...]
    names: NDArray[Any]
    notes: tuple[str, ...] = ()


def range_bearing_steps(
    velocities: ArrayLike,
    sightings: ArrayLike,
    identities: ArrayLike | None = None,
    *,
    sigma_range: float | ArrayLike,
    sigma_bearing: float | ArrayLike,
    sigma_height: float | ArrayLike = 0.05,
    dt: float = 0.25,
    hold: float = HOLD,
) -> RangeBearingSteps:
    """Convert the log of one robot in the plane to odometry and measurements.

    Rows up to `MOST_JITTER` back in time are sorted. A sighting is assigned to the nearest step and moved there by the
    odometry in between. Only the first of several sightings of one identity in one step is used.

    Args:
        velocities: (n, 3) float64 [s, m/s, rad/s]. Time, forward and angular velocity; n >= 1. The last of several rows
            at one time applies.
        sightings: (m, 3) float64 [s, m, rad]. Time, range, bearing (positive to the left of straight ahead); m >= 1.
        identities: (m,) numbers or names of the landmarks; None: unknown, data association by position alone.
        sigma_range: Standard deviation of a range [m], one number or (m,).
        sigma_bearing: Standard deviation of a bearing [rad], one number or (m,).
        sigma_height: Standard deviation of the landmarks' height relative to the sensor, assumed zero [m], one number
            or (m,).
        dt: Time between steps [s].
        hold: Longest effect of a velocity [s].

    Raises:
        ValueError: If an array is empty or has a wrong shape, a number is not finite, a range is not positive, a
            bearing is more than a full turn, a time lies more than `MOST_JITTER` back, times are too coarse or
            velocities usually further apart than `hold`, no sighting lies between the first and the last velocity, a
            standard deviation or `dt` is not positive, or there are more than a million steps.
    """
    check_float("hold", hold, "Give seconds.", above=0.0)
    check_float("dt", dt, DT_HINT, above=0.0)
    driven, _, driven_words = _table("velocities", velocities, "Give rows (time, velocity, angular velocity).")
    seen, order, seen_words = _table("sightings", sightings, "Give rows (time, range, bearing).")
    if (seen[:, 1] <= 0.0).any():
        least = float(seen[:, 1].min())
        raise argument_error("sightings", "ranges > 0 m", least, "Drop readings without an echo.")
    if (largest := float(np.abs(seen[:, 2]).max())) > MOST_BEARING:
        raise argument_error("sightings", "bearings within +-2 pi", largest, "Give radians.")
    check_precision("velocities", velocities, driven[:, 0], dt)
    check_precision("sightings", sightings, seen[:, 0], dt)
    check_rate("velocities", driven[:, 0], hold, "Give times in seconds; set hold if velocities are logged rarely.")
    first, last = driven[0, 0], driven[-1, 0]
    if not ((seen[:, 0] >= first) & (seen[:, 0] <= last + hold)).any():
        among = f"times among those of the velocities, {first:.3f} to {last:.3f} s"
        got = f"a log of sightings from {seen[0, 0]:.3f} to {seen[-1, 0]:.3f} s"
        raise argument_error("sightings", among, got, "Give both in seconds of one clock.")
    names, column = _identities(identities, len(seen))
    column = column[order]
    end = max(last, seen[-1, 0])
    times = even_times(min(first, seen[0, 0]), end, dt)
    times = np.minimum(times[times <= end + ROUNDING * dt], end)
    sigmas = {"sigma_range": sigma_range, "sigma_bearing": sigma_bearing, "sigma_height": sigma_height}
    variances = np.stack([_variances(name, sigma, len(seen))[order] for name, sigma in sigmas.items()], axis=-1)
    if len(names):
        descriptors, labels = np.eye(len(names), dtype=np.float32)[column], column
    else:
        descriptors, labels = np.ones((len(seen), 1), dtype=np.float32), np.arange(len(seen))
    repeated = repetition_note(seen[:, 0], names[column]) if len(names) else ()

    def pose_at(wanted: FloatArray) -> FloatArray:
        return integrate_commands(driven, wanted, hold)

    return RangeBearingSteps(
        times,
        motions(pose_at(times)),
        frames_at(times, pose_at, seen, variances, descriptors, labels),
        names,
        (*sorted_note([driven_words, seen_words]), *repeated, *unit_notes(driven, seen, hold, dt)),
    )


def even_times(start: float, end: float, dt: float) -> FloatArray:
    """Return times (T,) [s] from `start`, `dt` [s] apart, until `end` is reached.

    Raises:
        ValueError: If `dt` is not positive, or gives more than a million steps.

    >>> even_times(1.0, 1.8, 0.5).tolist()
    [1.0, 1.5, 2.0]
    """
    dt = check_float("dt", dt, DT_HINT, above=0.0)
    if (end - start) / dt > MAX_STEPS:
        hint = "Take longer steps, and give all times in seconds of one clock."
        raise argument_error("dt", f"at most {MAX_STEPS:,} steps", (end - start) / dt, hint)
    return np.asarray(start + dt * np.arange(int(np.ceil((end - start) / dt)) + 1, dtype=np.float64))


def motions(path: FloatArray) -> FloatArray:
    """Return the motions (T, 3) [m, m, rad] of poses (T, 3) since and relative to the previous one; the first is zero.

    >>> motions(np.array([[1.0, 0.0, 0.0], [1.0, 2.0, 0.0]])).tolist()
    [[0.0, 0.0, 0.0], [0.0, 2.0, 0.0]]
    """
    odometry = np.concatenate([np.zeros((1, 3)), between(path[:-1], path[1:])])
    odometry.setflags(write=False)
    return odometry


def frames_at(
    times: FloatArray,
    pose_at: Callable[[FloatArray], FloatArray],
    sightings: FloatArray,
    variances: FloatArray,
    descriptors: NDArray[np.float32],
    identities: IntArray,
) -> tuple[Measurements | None, ...]:
    """Assign sightings to the nearest of evenly spaced steps, moved there by the odometry in between.

    Args:
        times: (T,) float64 [s]. Evenly spaced times.
        pose_at: Function that returns dead-reckoned poses (k, 3) [m, m, rad] at times (k,) [s].
        sightings: (m, 3) float64 [s, m, rad]. Time, range, bearing, ordered by time.
        variances: (m, 3) float64 [m^2, rad^2, m^2]. Errors of range, bearing and height.
        descriptors: (m, d) float32.
        identities: (m,) int64 >= 0. Identities; only the first of several sightings of one in one step is used.

    Returns:
        T frames; None for a step without sightings.
    """
    step = nearest_steps(times, sightings[:, 0])
    first = first_of_each(step, identities)
    chosen, step = sightings[first], step[first]
    # Pose of the robot at the time of the sighting, relative to its pose at the step.
    offset = between(pose_at(times)[step], pose_at(chosen[:, 0]))
    points, covariances = points_from_polar(chosen[:, 1], chosen[:, 2], variances[first], offset)
    return by_step(len(times), step, points, descriptors[first], covariances)


def nearest_steps(times: FloatArray, stamps: FloatArray) -> IntArray:
    """Return the nearest of evenly spaced steps (T,) [s] for each time (m,) [s].

    >>> nearest_steps(np.array([0.0, 0.5, 1.0]), np.array([0.2, 0.3, 7.0])).tolist()
    [0, 1, 2]
    """
    step = np.rint((stamps - times[0]) / (times[1] - times[0])).astype(np.int64) if len(times) > 1 else 0
    return np.asarray(np.clip(np.broadcast_to(step, len(stamps)), 0, len(times) - 1))


def first_of_each(step: IntArray, identities: IntArray) -> IntArray:
    """Return the rows of the first sighting of each identity in each step, by step, then identity.

    Args:
        step: (m,) int64. Step of each sighting.
        identities: (m,) int64 >= 0.
    """
    return np.asarray(np.unique(step * (identities.max(initial=0) + 1) + identities, return_index=True)[1])


def by_step(
    count: int, step: IntArray, points: FloatArray, descriptors: NDArray[np.float32], covariances: FloatArray
) -> tuple[Measurements | None, ...]:
    """Return the measurements of each of `count` steps; None for a step without any.

    Args:
        count: Number of steps T.
        step: (m,) int64. Step of each point, ascending.
        points: (m, 3) float64 [m], camera frame.
        descriptors: (m, d) float32.
        covariances: (m, 3, 3) float64 [m^2], camera frame.
    """
    bounds = np.searchsorted(step, np.arange(count + 1))
    return tuple(
        Measurements(points[a:b], descriptors[a:b], covariances[a:b]) if b > a else None for a, b in pairwise(bounds)
    )


def _table(name: str, value: ArrayLike, hint: str) -> tuple[FloatArray, IntArray, str]:
    """Return rows (n, 3) in order of time, that order, and the remark of `time_order`."""
    table: FloatArray = check_array(name, value, (None, 3), hint)
    if not len(table):
        raise argument_error(name, "at least one row", "no row", hint)
    late = np.flatnonzero(steps_back(table[:, 0]) > MOST_JITTER)
    if len(late):
        row = int(late[0])
        got = f"a time {table[row, 0]:.3f} s after {table[:row, 0].max():.3f} s in row {row}"
        raise argument_error(name, f"times that go back by at most {MOST_JITTER:g} s", got, "Check the log there.")
    order, words = time_order(name, table[:, 0])
    return table[order], order, words


def _variances(name: str, sigma: float | ArrayLike, count: int) -> FloatArray:
    """Return the variances (count,) of a standard deviation, or of one per sighting."""
    hint = "Give a standard deviation, or one per sighting."
    given: FloatArray = check_array(name, np.full(count, sigma) if np.ndim(sigma) == 0 else sigma, (count,), hint)
    if (given <= 0.0).any():
        raise argument_error(name, "standard deviations > 0", float(given.min()), hint)
    return given**2


def _identities(identities: ArrayLike | None, count: int) -> tuple[NDArray[Any], IntArray]:
    """Return the names (N,) and the index of each sighting's name (count,); no names without identities."""
    if identities is None:
        return np.empty(0, dtype=np.int64), np.zeros(count, dtype=np.int64)
    given = np.asarray(identities)
    hint = "Give one number or name per sighting, or None."
    if given.shape != (count,) or given.dtype.kind not in "iufUS":
        got = f"an array of {given.dtype}, shape {given.shape}"
        raise argument_error("identities", f"numbers or names of shape ({count},)", got, hint)
    if given.dtype.kind == "f" and not np.array_equal(given, np.round(given)):
        raise argument_error("identities", "whole numbers or names", "NaN or fractions", hint)
    names, column = np.unique(given, return_inverse=True)
    return names, column.astype(np.int64)
