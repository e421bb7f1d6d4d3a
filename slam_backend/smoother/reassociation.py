"""Repeated data association of rejected measurements that agree on another position of a landmark.

A landmark with an outlier as its first sighting blocks itself: later measurements lie beyond its gate, but are too near
to a similar landmark to start a new one, and would always be rejected. A single rejected measurement may be false;
several from different frames that agree with each other are evidence.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.packed_symmetric import UNPACK_INDEX
from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.fastslam.options import FilterOptions
from slam_backend.geometry import rotation
from slam_backend.models.camera import ROBOT_FROM_CAMERA
from slam_backend.smoother.graph_building import InitialPoses
from slam_backend.smoother.log_arrays import LogArrays
from slam_backend.state import FLOAT32, INT64, MAX_DESCRIPTOR, Array, with_state

NO_ONE = -1
ROUNDING = 1e-12  # [m^2]; keeps covariances of sensors without noise invertible


@with_state(
    rows=Array(INT64, "n", ascending=True),
    descriptors=Array(FLOAT32, "n d", -MAX_DESCRIPTOR, MAX_DESCRIPTOR),
)
class RejectedMeasurements(NamedTuple):
    """Measurements of one robot's step that neither matched a landmark nor started one.

    Attributes:
        rows: (n,) int64. Rows among the step's logged measurements.
        descriptors: (n, d) float32.
    """

    rows: IntArray
    descriptors: NDArray[np.float32]


class LandmarkTable(NamedTuple):
    """Landmarks of a map whose ids come from data association.

    Attributes:
        ids: (l,) int64, ascending.
        means: (l, 3) float64 [m], map frame.
        covariances: (l, 6) float64 [m^2], upper triangles by rows.
        counts: (l,) int. Number of sightings.
        descriptors: (l, d) float32.
    """

    ids: IntArray
    means: FloatArray
    covariances: FloatArray
    counts: NDArray[np.int32]
    descriptors: NDArray[np.float32]


class _Points(NamedTuple):
    """Rejected measurements: robot (n,), step (n,), row in the robot's log (n,), position in the map, descriptor."""

    robots: IntArray
    steps: IntArray
    places: IntArray
    means: FloatArray
    covariances: FloatArray
    descriptors: NDArray[np.float32]


def reassociate(
    logs: Sequence[LogArrays],
    rejected: Sequence[Mapping[int, RejectedMeasurements]],
    initial_poses: Sequence[InitialPoses],
    known: LandmarkTable,
    options: FilterOptions,
) -> list[LogArrays]:
    """Return the logs with rejected measurements associated to landmarks where they agree.

    A rejected measurement can belong to the only similar landmark within `new_landmark_radius`, if nothing else of its
    frame does. Measurements of one landmark that agree on its position, within `position_gate` of one from another
    frame, are associated if they outnumber its own sightings and their mean is within `new_landmark_gate` of it.

    Args:
        logs: One log per robot.
        rejected: Rejected measurements of each robot by step; steps outside its log are ignored.
        initial_poses: Initial poses of each robot.
        known: Landmarks of the map.
        options: Gates and camera of the filter.
    """
    points = _locate(logs, rejected, initial_poses, options)
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
    return [replace(log, ids=new_ids) for log, new_ids in zip(logs, ids, strict=True)]


def _locate(
    logs: Sequence[LogArrays],
    rejected: Sequence[Mapping[int, RejectedMeasurements]],
    initial_poses: Sequence[InitialPoses],
    options: FilterOptions,
) -> _Points | None:
    """Return the rejected measurements in the map frame, from the initial poses; None if there are none."""
    found = []
    for robot, (log, of_steps, initial) in enumerate(zip(logs, rejected, initial_poses, strict=True)):
        row_of = {step: t for t, step in enumerate(log.steps.tolist()) if step in of_steps}
        poses = initial.at(log.steps)
        held = [(step, t) for step, t in row_of.items() if not np.isnan(poses[t, 0])]
        if not held:
            continue
        steps, t = np.repeat(held, [len(of_steps[step].rows) for step, _ in held], axis=0).T
        places = log.starts[t] + np.concatenate([of_steps[step].rows for step, _ in held])
        points, turns = log.points[places], np.zeros((len(t), 3, 3))
        turns[:, :2, :2], turns[:, 2, 2] = rotation(poses[t, 2]), 1.0
        spread = ROBOT_FROM_CAMERA @ options.camera.covariance(points @ ROBOT_FROM_CAMERA) @ ROBOT_FROM_CAMERA.T
        if log.covariances is not None:
            given = log.given[t]
            spread[given] = log.covariances[places[given]][:, UNPACK_INDEX]
        means = (turns @ (points + np.asarray(options.camera.mount))[:, :, None])[:, :, 0]
        means[:, :2] += poses[t, :2]
        covariances = turns @ spread @ turns.transpose(0, 2, 1) + ROUNDING * np.eye(3)
        descriptors = np.concatenate([of_steps[step].descriptors for step, _ in held])
        found.append((np.full(len(t), robot), steps, places, means, covariances, descriptors))
    return _Points(*(np.concatenate(column) for column in zip(*found, strict=True))) if found else None


def _find_owners(points: _Points, logs: Sequence[LogArrays], known: LandmarkTable, options: FilterOptions) -> IntArray:
    """Return the row (n,) in `known` of the only possible landmark of each point; `NO_ONE`: none, or several."""
    owners = find_only(
        points.means, points.descriptors, known.means, known.descriptors, options.new_landmark_radius,
        options.descriptor_gate,
    )  # fmt: skip
    for n in np.flatnonzero(owners != NO_ONE):
        log = logs[points.robots[n]]
        t = int(np.searchsorted(log.steps, points.steps[n]))
        if (log.ids[log.starts[t] : log.starts[t + 1]] == known.ids[owners[n]]).any():
            owners[n] = NO_ONE
    return owners


def find_only(
    means: FloatArray, descriptors: NDArray[np.float32], known_means: FloatArray,
    known_descriptors: NDArray[np.float32], radius: float, gate: float,
) -> IntArray:  # fmt: skip
    """Return the only landmark within a radius of each point that has a similar descriptor.

    Args:
        means, descriptors: (n, 3) [m], (n, d). Positions and descriptors of the points.
        known_means, known_descriptors: (l, 3) [m], (l, d). Positions and descriptors of the landmarks.
        radius: Largest distance from the point [m].
        gate: Largest L2 distance of similar descriptors.

    Returns:
        (n,) row of the landmark, `NO_ONE` if there is none or more than one.
    """
    point, row = np.nonzero(np.linalg.norm(means[:, None] - known_means, axis=2) <= radius)
    alike = np.linalg.norm(descriptors[point] - known_descriptors[row], axis=1) <= gate
    owners = np.full(len(means), NO_ONE)
    owners[point[alike]] = row[alike]
    owners[np.bincount(point[alike], minlength=len(means)) > 1] = NO_ONE
    return owners


def _agreeing(points: _Points, members: IntArray, gate: float) -> BoolArray:
    """Return the mask (n,) of members that lie within the gate of a member from another frame."""
    off = points.means[members][:, None] - points.means[members]
    joint = points.covariances[members][:, None] + points.covariances[members]
    squares = np.einsum("ijk,ijk->ij", off, np.linalg.solve(joint, off[..., None])[..., 0])
    robots, steps = points.robots[members], points.steps[members]
    others = (robots[:, None] != robots) | (steps[:, None] != steps)
    return np.asarray(((squares <= gate) & others).any(axis=1))


def _mean(points: _Points, members: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return the information-weighted mean (3,) of the members, and its covariance (3, 3)."""
    infos = np.linalg.inv(points.covariances[members])
    covariance = np.linalg.inv(infos.sum(axis=0))
    return covariance @ np.einsum("nij,nj->i", infos, points.means[members]), covariance
