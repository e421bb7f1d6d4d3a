"""Checks of units and clocks of range-bearing logs: errors for what cannot be, notes for what may be meant."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.validation import FloatArray, argument_error

MOST_BEARING = 2.0 * np.pi * (1.0 + 1e-6)  # [rad], of bearings from 0 to a full turn in float32
MOST_SPEED, MOST_TURN, MOST_RANGE = 100.0, 2.0 * np.pi, 1000.0  # [m/s, rad/s, m] medians of plausible logs
MOST_STEPS_APART = 100  # of frames, in the median of plausible logs


def check_precision(name: str, value: Any, times: FloatArray, dt: float) -> None:
    """Refuse times in single precision that are rounded by more than a tenth of a step.

    Args:
        name: The argument, for the error.
        value: The array as it was given.
        times: (n,) float64 [s]. Times of its rows.
        dt: Time between steps [s].

    Raises:
        ValueError: For float32 numbers of seconds since 1970, for example.
    """
    kind, latest = np.asarray(value).dtype, np.abs(times).max()
    if kind.kind != "f" or kind.itemsize >= times.itemsize:
        return
    if (apart := float(np.spacing(latest.astype(kind)))) > 0.1 * dt:
        got = f"an array of {kind}, whose numbers are {apart:g} s apart at {latest:.0f} s"
        raise argument_error(name, "times that tell steps apart", got, "Give float64, or seconds since the start.")


def check_rate(name: str, times: FloatArray, hold: float, hint: str) -> None:
    """Refuse velocities of which most are older than `hold` before the next one arrives.

    Args:
        name: The argument, for the error.
        times: (n,) float64 [s]. Times of velocities, ascending.
        hold: Longest effect of a velocity [s].
        hint: Advice, a full sentence.

    Raises:
        ValueError: If the times are milliseconds, for example, or all equal.
    """
    gaps = np.diff(np.unique(times))
    if len(times) > 1 and not len(gaps):
        raise argument_error(name, "times that increase", f"a time {times[0]:.3f} s in all rows", hint)
    if len(gaps) and (usual := float(np.median(gaps))) > hold:
        expected = f"rows that are usually at most {hold:g} s apart"
        raise argument_error(name, expected, f"a median of {usual:g} s", hint)


def unit_notes(velocities: FloatArray, sightings: FloatArray, hold: float, dt: float) -> Iterator[str]:
    """Yield a line for each quantity that is implausible in its unit.

    Args:
        velocities: (n, 3) float64 [s, m/s, rad/s]. Times, forward and angular velocities, in order of time.
        sightings: (m, 3) float64 [s, m, rad]. Times, ranges, bearings, in order of time.
        hold: Longest effect of a velocity [s].
        dt: Time between steps [s].
    """
    gaps = np.diff(velocities[:, 0])
    if count := int(np.count_nonzero(gaps > hold)):
        plural = "s" if count > 1 else ""
        yield (
            f"{count} gap{plural} of more than {hold:g} s between velocities, up to {gaps.max():.1f} s: the robot is "
            "assumed to stand there."
        )
    quantities = (
        ("speed", velocities[:, 1], MOST_SPEED, "metres per second"),
        ("turn rate", velocities[:, 2], MOST_TURN, "radians per second"),
        ("range", sightings[:, 1], MOST_RANGE, "metres"),
        ("time between sightings", np.diff(sightings[:, 0]), MOST_STEPS_APART * dt, "seconds"),
    )
    for name, values, most, unit in quantities:
        magnitudes = np.abs(values[values != 0.0])
        if len(magnitudes) and (usual := float(np.median(magnitudes))) > most:
            yield f"Median {name} {usual:.4g}: check that it is in {unit}."


def repetition_note(times: FloatArray, landmarks: NDArray[Any]) -> Iterator[str]:
    """Yield a line if frames contain a landmark more than once.

    Args:
        times: (m,) float64 [s]. Times of sightings, ascending; those of one time are a frame.
        landmarks: (m,) Names of their landmarks.
    """
    numbers = np.unique(landmarks, return_inverse=True)[1]
    _, first = np.unique(np.column_stack([times, numbers]), axis=0, return_index=True)
    if len(first) < len(times):
        again = int(np.setdiff1d(np.arange(len(times)), first)[0])
        count = len(times) - len(first)
        yield (
            f"{count} sighting{'s' if count > 1 else ''} of a landmark that its frame has already, of which only the "
            f"first counts: see {landmarks[again]} at {times[again]:.3f} s."
        )
