"""The replay of a MR.CLAM log: robots, each with its own filter from its own unknown start, alone or as a team.

The default odometry noise was calibrated on data sets 7 and 4: their figures are not those of unseen logs.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.fastslam.consistency import Consistency
from slam_backend.fastslam.reports import MergeEvent, TeamReport
from slam_backend.maps.alignment import AlignmentOptions
from slam_backend.maps.alignment_types import PairAttempts
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.models.measurements import Measurements
from slam_backend.models.odometry import OdometryModel
from slam_backend.readers.mrclam import MrclamLog, to_filter_steps
from slam_backend.team.merge_scheduler import AttemptOptions
from slam_backend.team.team import TeamSlam
from training.replay.config import MRCLAM_MOTION, MrclamConfig
from training.replay.single_robot import PLANAR_GATE, RejuvenationCount
from vslam_env.evaluation.map_scores import GroundTruthAssociation

# A joint filter's particles are weighed by what all its robots see, and die out so much faster: with the starts known,
# five robots in 100 particles were 13 % farther from their paths than in 500.
PARTICLES_PER_ROBOT = 100

MOTION = OdometryModel(**MRCLAM_MOTION)
# Identities given: a barcode cannot be taken for another, so position need not tell landmarks apart and the gate only
# stops nonsense; nor does a barcode ever start a second landmark. Identities hidden: all landmarks look alike, and the
# gate is that of two degrees of freedom, as all is seen in one plane; one landmark is new only far beyond it. With one
# to three look-alikes in view, most of them contradict a right pose too easily to widen it.
GATES: dict[str, dict[str, Any]] = {
    "given": {"position_gate": 1e4, "new_landmark_gate": 1e6},
    "hidden": {"position_gate": PLANAR_GATE, "new_landmark_gate": 40.0, "recovery_position": 0.0},
}
# Young maps of these robots are bent by tenths of a metre: landmarks need not fit closely, but nearly all have to. On
# two logs and four seeds, merges on 12 of the 15 landmarks were up to 24 degrees off, on 14 never more than 4.
POSITION_FLOOR = 0.3
LANDMARKS_NOT_SHARED = 1
MAX_SIGMA_HEADING = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Merge:
    """One merge, with the maps as they were just before it, straightened, without landmarks first seen in that step."""

    time: float  # Seconds since the first step [s]
    event: MergeEvent  # The merge; its robots count from 0
    map_a: LandmarkMap  # Of the group whose frame stays
    map_b: LandmarkMap  # Of the other group
    # (N,) int64. Row in `MrclamLog.positions` of the landmark whose sighting began each one of `map_a`.
    claims_a: IntArray
    claims_b: IntArray  # Likewise of `map_b`
    undone: float | None = None  # When the team took it back, seconds since the first step [s]; None: it is in force


@dataclass(frozen=True, slots=True, eq=False)
class Replay:
    """What the team estimated. K robots, T steps."""

    times: FloatArray  # (T,) float64 [s]. Of the log's clock.
    # (K, T, 3) float64 [m, m, rad]. Estimated at each step from what was known then, own start frames.
    paths: FloatArray
    reckoned: FloatArray  # (K, T, 3) float64 [m, m, rad]. Dead reckoning of the commands, own start frames.
    maps: tuple[LandmarkMap, ...]  # Of each robot's group at the end, moved to the robot's own start frame
    # Per robot (N,) int64. Row in `MrclamLog.positions` of the landmark whose sighting began each one of its map; kept
    # beside the filters, which need not know it.
    claims: tuple[IntArray, ...]
    start_from_group: FloatArray  # (K, 3) float64 [m, m, rad]. From its group's map frame to each robot's start frame.
    groups: tuple[tuple[int, ...], ...]  # Robots, counted from 0, that share a map at the end
    merges: tuple[Merge, ...]  # In order
    attempts: int  # How often two maps were compared
    # Outcome of these attempts, by pairs of groups; None: each robot stays by itself
    pairs: tuple[PairAttempts, ...] | None
    # What came of drawing particles anew, all filters together, see `RejuvenationCount.to_mapping`
    rejuvenations: dict[str, Any]
    consistency: tuple[Consistency, ...]  # Per robot whether its filter at the end errs as little as it claims
    seconds: float  # What the filters took to live through the log [s]


def replay_team(
    log: MrclamLog, config: MrclamConfig, on_step: Callable[[float, TeamReport], None] = lambda progress, report: None
) -> Replay:
    """Let a team of filters live through a log.

    Returns:
        Paths as they were known at each step, maps and merges as they came.
    """
    readings = to_filter_steps(log, config.dt, config.sensor, config.drive)
    robots, num_steps = range(len(log.robots)), len(readings.times)
    team = _make_team(log, config)
    contacts = np.eye(len(robots), dtype=np.bool_) if config.alone else None
    flat = np.zeros((len(log.subjects), 3))
    if log.positions is not None:
        flat[:, :2] = log.positions
    ledger = GroundTruthAssociation(len(robots), flat, np.ones(len(flat), dtype=np.bool_), cutoff=1.0)
    paths = np.zeros((len(robots), num_steps, 3))
    merges: list[Merge] = []
    attempts, seconds, rejuvenations = 0, 0.0, RejuvenationCount()
    for step in range(num_steps):
        seen = [own.measurements[step] for own in readings.robots]
        rows = [_true_rows(frame) for frame in seen]
        names = rows if config.identities == "given" else None
        told = seen if config.identities == "given" else [_alike(frame) for frame in seen]
        groups = {robot: group for group in team.groups for robot in group}
        maps = {group: team.map(group[0]) for group in team.groups}
        started = time.perf_counter()
        report = team.step([own.odometry[step] if step else None for own in readings.robots], told, contacts, names)
        seconds += time.perf_counter() - started
        for _, told_of in report.rejuvenations:
            rejuvenations.add(told_of)
        for event in report.events:
            attempts += event.kind == "attempt"
            if event.kind == "merge":
                since = float(readings.times[step] - readings.times[0])
                sides = [groups[side[0]] for side in (event.robots_a, event.robots_b)]
                joined = [_those_of(new, maps[side]) for side, new in zip(sides, team.merged_maps(event), strict=True)]
                claims = [ledger.true_ids(side[0], own.ids) for side, own in zip(sides, joined, strict=True)]
                merges.append(Merge(since, event, joined[0], joined[1], claims[0], claims[1]))
            if event.kind == "undo":
                when = float(readings.times[step] - readings.times[0])
                merges = [replace(m, undone=when) if m.event.alignment is event.alignment else m for m in merges]
        ledger.record(report, rows)
        for robot in robots:
            paths[robot, step] = team.pose_from_start(robot).mean
        on_step((step + 1) / num_steps, report)
    frames = np.array([team.start_from_group(robot) for robot in robots])
    maps_of = [team.map(robot) for robot in robots]
    return Replay(
        times=readings.times, paths=paths, reckoned=np.array([own.reckoned for own in readings.robots]),
        maps=tuple(own.moved(frame) for own, frame in zip(maps_of, frames, strict=True)),
        claims=tuple(ledger.true_ids(robot, maps_of[robot].ids) for robot in robots), start_from_group=frames,
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


def _those_of(landmarks: LandmarkMap, known: LandmarkMap) -> LandmarkMap:
    """Return the landmarks that another map holds, too."""
    return landmarks.subset(np.flatnonzero(np.isin(landmarks.ids, known.ids)))


def _alike(frame: Measurements | None) -> Measurements | None:
    """Return the frame with one descriptor for all: what is seen says where it is, not what it is."""
    if frame is None:
        return None
    return Measurements(frame.points, np.ones((len(frame), 1), dtype=np.float32), frame.covariances)


def _true_rows(frame: Measurements | None) -> IntArray:
    """Return the row in `MrclamLog.positions` (n,) of what was seen."""
    return np.empty(0, dtype=np.int64) if frame is None else frame.descriptors.argmax(axis=1).astype(np.int64)
