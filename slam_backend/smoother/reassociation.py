"""Refused measurements are taken up where they agree that a landmark lies elsewhere than its few sightings say.

A landmark whose first sighting lay far off blocks itself: what is seen of it later lies beyond the gate, but is too
near to something that looks the same to be new, and would be refused for ever. One refused measurement says nothing, it
may be false; several from different frames that agree with each other are no accident.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.jit import in_place
from slam_backend.core.packed_symmetric import UNPACK_INDEX
from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.fastslam.options import FilterOptions
from slam_backend.geometry import rotation
from slam_backend.models.camera import ROBOT_FROM_CAMERA
from slam_backend.smoother.graph_building import InitialPoses
from slam_backend.smoother.log_arrays import LogArrays

NO_ONE = -1
ROUNDING = 1e-12  # [m^2]; keeps covariances of sensors without noise invertible


class RejectedMeasurements(NamedTuple):
    """What of one robot's step was neither matched nor new.

    Attributes:
        rows: (n,) int64. Among the step's logged measurements.
        descriptors: (n, d) float32.
    """

    rows: IntArray
    descriptors: NDArray[np.float32]


class LandmarkTable(NamedTuple):
    """Landmarks of a map that no caller has named.

    Attributes:
        ids: (l,) int64.
        means: (l, 3) float64 [m], map frame.
        covariances: (l, 6) float64 [m^2], upper triangles by rows.
        counts: (l,) int. Sightings of each.
        descriptors: (l, d) float32.
    """

    ids: IntArray
    means: FloatArray
    covariances: FloatArray
    counts: NDArray[np.int32]
    descriptors: NDArray[np.float32]


class _Points(NamedTuple):
    """Refused measurements where they lie: robot (n,), step (n,), row in the robot's log (n,), map frame, look."""

    robots: IntArray
    steps: IntArray
    places: IntArray
    means: FloatArray
    covariances: FloatArray
    descriptors: NDArray[np.float32]


def reassociate(
    logs: Sequence[LogArrays],
    refused: Sequence[Mapping[int, RejectedMeasurements]],
    guesses: Sequence[InitialPoses],
    known: LandmarkTable,
    options: FilterOptions,
) -> list[LogArrays]:
    """Return the logs in which refused measurements bear the name of the landmark that they must be of.

    A rejected measurement can belong to the only similar landmark within `new_landmark_radius`, if nothing else of its
    frame does. Measurements of one landmark that agree on its position, within `position_gate` of one from another
    frame, are associated if they outnumber its own sightings and their mean is within `new_landmark_gate` of it.

    Args:
        logs: Per robot.
        refused: Per robot by step; steps that its log does not hold are passed over.
        guesses: Per robot where it was.
        known: The map.
        options: Gates and camera of the filter.
    """
    points = _locate(logs, refused, guesses, options)
    if points is None or not len(known.ids):
        return list(logs)
    owners = _find_owners(points, logs, known, options)
    ids = [log.ids for log in logs]
    for owner in np.unique(owners[owners != NO_ONE]):
        members = np.flatnonzero(owners == owner)
        members = members[_agreeing(points, members, options.position_gate)]
        if len(members) <= max(1, known.counts[owner]):
            continue
        mean, covariance = _mean(points, members)
        off, joint = mean - known.means[owner], covariance + known.covariances[owner][UNPACK_INDEX]
        if off @ np.linalg.solve(joint, off) <= options.new_landmark_gate:
            for n in members:
                robot = int(points.robots[n])
                if ids[robot] is logs[robot].ids:
                    ids[robot] = logs[robot].ids.copy()
                ids[robot][points.places[n]] = known.ids[owner]
    return [replace(log, ids=own) for log, own in zip(logs, ids, strict=True)]


def _locate(
    logs: Sequence[LogArrays],
    refused: Sequence[Mapping[int, RejectedMeasurements]],
    guesses: Sequence[InitialPoses],
    options: FilterOptions,
) -> _Points | None:
    """Return where what was refused lies in the map, seen from the guessed poses; None if there is nothing."""
    found = []
    for robot, (log, of_steps, guessed) in enumerate(zip(logs, refused, guesses, strict=True)):
        row_of = {step: t for t, step in enumerate(log.steps.tolist()) if step in of_steps}
        poses = guessed.at(log.steps)
        held = [(step, t) for step, t in row_of.items() if not np.isnan(poses[t, 0])]
        if not held:
            continue
        steps, t = np.repeat(held, [len(of_steps[step].rows) for step, _ in held], axis=0).T
        places = log.starts[t] + np.concatenate([of_steps[step].rows for step, _ in held])
        own, turns = log.points[places], np.zeros((len(t), 3, 3))
        turns[:, :2, :2], turns[:, 2, 2] = rotation(poses[t, 2]), 1.0
        spread = ROBOT_FROM_CAMERA @ options.camera.covariance(own @ ROBOT_FROM_CAMERA) @ ROBOT_FROM_CAMERA.T
        if log.covariances is not None:
            given = log.given[t]
            spread[given] = log.covariances[places[given]][:, UNPACK_INDEX]
        means = (turns @ (own + np.asarray(options.camera.mount))[:, :, None])[:, :, 0]
        means[:, :2] += poses[t, :2]
        covariances = turns @ spread @ turns.transpose(0, 2, 1) + ROUNDING * np.eye(3)
        descriptors = np.concatenate([of_steps[step].descriptors for step, _ in held])
        found.append((np.full(len(t), robot), steps, places, means, covariances, descriptors))
    return _Points(*(np.concatenate(column) for column in zip(*found, strict=True))) if found else None


def _find_owners(points: _Points, logs: Sequence[LogArrays], known: LandmarkTable, options: FilterOptions) -> IntArray:
    """Return the row (n,) in `known` of the only landmark that each point can be of; `NO_ONE`: none, or several."""
    owners = np.empty(len(points.means), dtype=np.int64)
    find_only(
        points.means, points.descriptors, np.ascontiguousarray(known.means), known.descriptors,
        options.new_landmark_radius, options.descriptor_gate, owners,
    )  # fmt: skip
    for n in np.flatnonzero(owners != NO_ONE):
        log = logs[points.robots[n]]
        t = int(np.searchsorted(log.steps, points.steps[n]))
        if (log.ids[log.starts[t] : log.starts[t + 1]] == known.ids[owners[n]]).any():
            owners[n] = NO_ONE
    return owners


@in_place
def find_only(
    means: FloatArray, descriptors: NDArray[np.float32], known_means: FloatArray,
    known_descriptors: NDArray[np.float32], radius: float, gate: float, owners: IntArray,
) -> None:  # fmt: skip
    """Find the only landmark that lies near each point and looks like it.

    Args:
        means, descriptors: (n, 3) [m], (n, d) of the points.
        known_means, known_descriptors: (l, 3) [m], (l, d) of the landmarks.
        radius: [m] Within which one is near.
        gate: L2 distance within which two look alike.
        owners: (n,), result: the landmark's row, `NO_ONE` where there is none or more than one.
    """
    for n in range(len(means)):
        owners[n], fits = NO_ONE, 0
        for row in range(len(known_means)):
            dx, dy = means[n, 0] - known_means[row, 0], means[n, 1] - known_means[row, 1]
            dz = means[n, 2] - known_means[row, 2]
            if math.sqrt(dx * dx + dy * dy + dz * dz) > radius:
                continue
            unlike = 0.0
            for i in range(descriptors.shape[1]):
                off = descriptors[n, i] - known_descriptors[row, i]
                unlike += off * off
            if math.sqrt(unlike) <= gate:
                owners[n], fits = row, fits + 1
        if fits != 1:
            owners[n] = NO_ONE


def _agreeing(points: _Points, members: IntArray, gate: float) -> BoolArray:
    """Return which members (n,) lie where another one does that is of another frame."""
    off = points.means[members][:, None] - points.means[members]
    joint = points.covariances[members][:, None] + points.covariances[members]
    squares = np.einsum("ijk,ijk->ij", off, np.linalg.solve(joint, off[..., None])[..., 0])
    robots, steps = points.robots[members], points.steps[members]
    others = (robots[:, None] != robots) | (steps[:, None] != steps)
    return np.asarray(((squares <= gate) & others).any(axis=1))


def _mean(points: _Points, members: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return the mean (3,) of the members, each by what it knows, and its covariance (3, 3)."""
    infos = np.linalg.inv(points.covariances[members])
    covariance = np.linalg.inv(infos.sum(axis=0))
    return covariance @ np.einsum("nij,nj->i", infos, points.means[members]), covariance
