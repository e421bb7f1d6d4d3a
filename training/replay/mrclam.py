"""Replay of an MR.CLAM log: robots with separate filters and unknown starts, alone or as a team.

The default odometry noise was calibrated on data sets 7 and 4: their results are not those of unseen logs.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.fastslam.consistency import Consistency
from slam_backend.maps.alignment import AlignmentOptions
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.models.measurements import Measurements
from slam_backend.models.odometry import OdometryModel
from slam_backend.readers.mrclam import MrclamLog, to_filter_steps
from slam_backend.team.merge_scheduler import AttemptOptions
from slam_backend.team.reports import MergeEvent, PairAttempts, TeamReport
from slam_backend.team.team import TeamSlam
from training.replay.config import MRCLAM_MOTION, MrclamConfig
from training.replay.single_robot import PLANAR_GATE, RejuvenationCount, is_stage
from vslam_env.evaluation.map_scores import GroundTruthAssociation
from vslam_env.sensors.landmark_sensor import padded

# The weights of a joint filter's particles combine the measurements of all its robots, so that depletion is faster:
# with known starts, the path errors of five robots were 13 % larger with 100 particles than with 500.
PARTICLES_PER_ROBOT = 100

MOTION = OdometryModel(**MRCLAM_MOTION)
# Given identities: barcodes cannot be confused, so that the gate only rejects gross errors; a barcode never creates a
# second landmark. Hidden identities: all landmarks have the same descriptor, and the gate has two degrees of freedom,
# since all measurements are planar; only measurements far beyond it create landmarks. With one to three similar
# landmarks in view, most of them contradict a correct pose too easily to widen it.
GATES: dict[str, dict[str, Any]] = {
    "given": {"position_gate": 1e4, "new_landmark_gate": 1e6},
    "hidden": {"position_gate": PLANAR_GATE, "new_landmark_gate": 40.0, "recovery_position": 0.0},
}
# Early maps of these robots are deformed by tenths of a metre: inliers need not fit closely, but almost all landmarks
# must be inliers. On two logs and four seeds, merges with 12 of the 15 landmarks had errors up to 24 degrees, with 14
# at most 4.
POSITION_FLOOR = 0.3
LANDMARKS_NOT_SHARED = 1
MAX_SIGMA_HEADING = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Merge:
    """One merge, with the smoothed maps just before it, without landmarks first seen in that step."""

    time: float  # Time since the first step [s]
    event: MergeEvent  # Merge event; robots count from 0
    map_a: LandmarkMap  # Map of the group whose frame is kept
    map_b: LandmarkMap  # Map of the other group
    # (N,) int64. Row in `MrclamLog.positions` of the measurement that created each landmark of `map_a`.
    claims_a: IntArray
    claims_b: IntArray  # The same for `map_b`
    undone: float | None = None  # Time of the undo since the first step [s]; None: not undone


@dataclass(frozen=True, slots=True, eq=False)
class Replay:
    """Estimates of the team, for K robots and T steps."""

    times: FloatArray  # (T,) float64 [s]. Times of the steps by the log's clock.
    # (K, T, 3) float64 [m, m, rad]. Pose estimates at the time of each step, start frames.
    paths: FloatArray
    reckoned: FloatArray  # (K, T, 3) float64 [m, m, rad]. Dead reckoning of the commands, start frames.
    maps: tuple[LandmarkMap, ...]  # Final map of each robot's group, in the robot's start frame
    # Steps, and the maps after them by the first robot of each group, in its start frame; the last step included
    stages: tuple[tuple[int, Mapping[int, LandmarkMap]], ...]
    # Row in `MrclamLog.positions` of the measurement that created each landmark of each robot's map, (N,) int64;
    # recorded outside the filters, which do not use it.
    claims: tuple[IntArray, ...]
    start_from_group: FloatArray  # (K, 3) float64 [m, m, rad]. Group's map frame in each start frame.
    groups: tuple[tuple[int, ...], ...]  # Robots, counted from 0, that share a map at the end
    merges: tuple[Merge, ...]  # Merges in order
    attempts: int  # Number of alignment attempts
    # Outcomes of these attempts, by pairs of groups; None: robots do not merge
    pairs: tuple[PairAttempts, ...] | None
    # Rejuvenations of all filters, see `RejuvenationCount.to_mapping`
    rejuvenations: dict[str, Any]
    consistency: tuple[Consistency, ...]  # Consistency of each robot's filter at the end
    seconds: float  # Computing time of the filters [s]


def replay_team(
    log: MrclamLog, config: MrclamConfig, on_step: Callable[[float, TeamReport], None] = lambda progress, report: None
) -> Replay:
    """Run a team of filters on a log.

    Returns:
        Paths as estimated at each step, and maps and merges.
    """
    readings = to_filter_steps(log, config.dt, config.sensor, config.drive)
    robots, num_steps = range(len(log.robots)), len(readings.times)
    team = _make_team(log, config)
    contacts = np.eye(len(robots), dtype=np.bool_) if config.alone else None
    flat = np.zeros((len(log.subjects), 3))
    if log.positions is not None:
        flat[:, :2] = log.positions
    ground_truth = GroundTruthAssociation(len(robots), flat, np.ones(len(flat), dtype=np.bool_), cutoff=1.0)
    paths = np.zeros((len(robots), num_steps, 3))
    merges: list[Merge] = []
    stages: list[tuple[int, Mapping[int, LandmarkMap]]] = []
    attempts, seconds, rejuvenations = 0, 0.0, RejuvenationCount()
    for step in range(num_steps):
        seen = [one.measurements[step] for one in readings.robots]
        rows = [_true_landmark_rows(frame) for frame in seen]
        identities = rows if config.identities == "given" else None
        given = seen if config.identities == "given" else [_alike(frame) for frame in seen]
        groups = {robot: group for group in team.groups for robot in group}
        maps = {group: team.map(group[0]) for group in team.groups}
        started = time.perf_counter()
        report = team.step(
            [one.odometry[step] if step else None for one in readings.robots], given, contacts, identities
        )
        seconds += time.perf_counter() - started
        for _, attempt in report.rejuvenations:
            rejuvenations.add(attempt)
        for event in report.events:
            attempts += event.kind == "attempt"
            if event.kind == "merge":
                since = float(readings.times[step] - readings.times[0])
                sides = [groups[side[0]] for side in (event.robots_a, event.robots_b)]
                joined = [
                    _common_landmarks(new, maps[side]) for side, new in zip(sides, team.merged_maps(event), strict=True)
                ]
                claims = [
                    ground_truth.true_ids(side[0], side_map.ids) for side, side_map in zip(sides, joined, strict=True)
                ]
                merges.append(Merge(since, event, joined[0], joined[1], claims[0], claims[1]))
            if event.kind == "undo":
                when = float(readings.times[step] - readings.times[0])
                merges = [replace(m, undone=when) if m.event.alignment is event.alignment else m for m in merges]
        ground_truth.record(report, padded(rows))
        for robot in robots:
            paths[robot, step] = team.pose_from_start(robot).mean
        if is_stage(step, num_steps):
            firsts = [group[0] for group in team.groups]
            stages.append((step, {first: team.map(first).moved(team.start_from_group(first)) for first in firsts}))
        on_step((step + 1) / num_steps, report)
    frames = np.array([team.start_from_group(robot) for robot in robots])
    maps_of = [team.map(robot) for robot in robots]
    return Replay(
        times=readings.times, paths=paths, reckoned=np.array([one.reckoned for one in readings.robots]),
        maps=tuple(held.moved(frame) for held, frame in zip(maps_of, frames, strict=True)),
        stages=tuple(stages),
        claims=tuple(ground_truth.true_ids(robot, maps_of[robot].ids) for robot in robots), start_from_group=frames,
        groups=team.groups, merges=tuple(merges), attempts=attempts, pairs=None if config.alone else team.pair_attempts,
        rejuvenations=rejuvenations.to_mapping(), consistency=tuple(map(team.consistency, robots)), seconds=seconds,
    )  # fmt: skip


def _make_team(log: MrclamLog, config: MrclamConfig) -> TeamSlam:
    """Return the team before the first step."""
    sharing = 1 if config.alone else len(log.robots)
    particles = PARTICLES_PER_ROBOT * sharing if config.particles is None else config.particles
    return TeamSlam(
        len(log.robots),
        alignment=AlignmentOptions(
            position_floor=POSITION_FLOOR,
            min_inliers=max(3, len(log.subjects) - LANDMARKS_NOT_SHARED),
            max_sigma_heading=MAX_SIGMA_HEADING,
        ),
        attempts=AttemptOptions(new_candidates=1), seed=config.seed, num_particles=particles, motion=config.motion,
        proposal=config.estimator, rejuvenate_every=config.rejuvenate_every or None, **GATES[config.identities],
    )  # fmt: skip


def _common_landmarks(landmarks: LandmarkMap, known: LandmarkMap) -> LandmarkMap:
    """Return the landmarks that are also in another map."""
    return landmarks.subset(np.flatnonzero(np.isin(landmarks.ids, known.ids)))


def _alike(frame: Measurements | None) -> Measurements | None:
    """Return the measurements with the same descriptor for all: only positions identify landmarks."""
    if frame is None:
        return None
    return Measurements(frame.points, np.ones((len(frame), 1), dtype=np.float32), frame.covariances)


def _true_landmark_rows(frame: Measurements | None) -> IntArray:
    """Return the row in `MrclamLog.positions` (n,) of each measured landmark."""
    return np.empty(0, dtype=np.int64) if frame is None else frame.descriptors.argmax(axis=1).astype(np.int64)
