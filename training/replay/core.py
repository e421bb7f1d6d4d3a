"""Replay of a log: one filter for one robot, or separate filters of a team that merge their maps."""

import math
import re
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray, argument_error
from slam_backend.diagnosis import LOOK_ALIKES, Cause, diagnose
from slam_backend.fastslam.consistency import Consistency
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.reports import PoseEstimate, RejuvenationReport
from slam_backend.geometry import compose
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.models.measurements import Measurements
from slam_backend.team.reports import LandmarksCreated, MergeEvent, PairAttempts, TeamReport
from slam_backend.team.team import TeamSlam
from slam_backend.trajectory import dead_reckoning
from training.replay.config import REJUVENATE_EVERY, ReplayConfig
from training.replay.log import Log
from vslam_env.evaluation.map_scores import GroundTruthAssociation
from vslam_env.sensors.landmark_sensor import padded

# The weights of a joint filter's particles combine the measurements of all its robots, so that depletion is faster:
# with known starts, the path errors of five robots were 13 % larger with 100 particles than with 500.
PARTICLES_PER_ROBOT = 100
CUTOFF = 1.0  # of the map error E [m]
MOST_STAGES = 75  # maps of a replay over time, for its playback
NUMBER = re.compile(r"\d+(\.\d+)?")


class RejuvenationCount:
    """Counts of rejuvenation attempts by outcome."""

    def __init__(self) -> None:
        self._reasons: Counter[str] = Counter()

    def add(self, report: RejuvenationReport) -> None:
        """Count an attempt; reasons that differ only in numbers are counted together."""
        self._reasons[NUMBER.sub("n", report.reason)] += 1

    def to_mapping(self) -> dict[str, Any]:
        """Return the number of rejuvenations, `drawn`, and the numbers of refusals by reason, `refused`."""
        refused = {reason: count for reason, count in sorted(self._reasons.items()) if reason}
        return {"drawn": self._reasons[""], "refused": refused}


@dataclass(frozen=True, slots=True, eq=False)
class Merge:
    """One merge, with the smoothed maps just before it, without landmarks first seen in that step."""

    time: float  # Time since the first step [s]
    event: MergeEvent  # Merge event; robots count from 0
    maps: tuple[LandmarkMap, LandmarkMap]  # Map of the group whose frame is kept, and that of the other group
    claims: tuple[IntArray, IntArray]  # (n,) int64 each. True landmark of each landmark, as in `Replay.claims`
    undone: float | None = None  # Time of the undo since the first step [s]; None: not undone


@dataclass(frozen=True, slots=True, eq=False)
class Replay:
    """Estimates of K robots in T steps."""

    times: FloatArray  # (T,) float64 [s]. Times of the steps by the log's clock.
    # (K, T, 3) float64 [m, m, rad]. Pose estimates at the time of each step, start frames.
    paths: FloatArray
    reckoned: FloatArray  # (K, T, 3) float64 [m, m, rad]. Dead reckoning, start frames.
    maps: tuple[LandmarkMap, ...]  # Final map of each robot's group, in the robot's start frame
    # Steps, and the maps after them by the first robot of each group, in its start frame; the last step included
    stages: tuple[tuple[int, Mapping[int, LandmarkMap]], ...]
    # Identity of the measurement that created each landmark of each robot's map, (N,) int64, recorded outside the
    # filters; -1: unknown.
    claims: tuple[IntArray, ...]
    start_from_group: FloatArray  # (K, 3) float64 [m, m, rad]. Group's map frame in each start frame.
    groups: tuple[tuple[int, ...], ...]  # Robots, counted from 0, that share a map at the end
    merges: tuple[Merge, ...]  # Merges in order
    attempts: int  # Number of alignment attempts
    # Outcomes of these attempts, by pairs of groups; None: robots do not merge
    pairs: tuple[PairAttempts, ...] | None
    # Numbers of measurements that were `matched`, have `created` landmarks, were `rejected`; of a single filter only
    measurements: Mapping[str, int]
    rejuvenations: Mapping[str, Any]  # Rejuvenations of all filters, see `RejuvenationCount.to_mapping`
    consistency: tuple[Consistency, ...]  # Consistency of each robot's filter at the end
    causes: tuple[tuple[Cause, ...], ...]  # Likely mistakes in the set-up of each robot's log, and look-alikes
    seconds: float  # Computing time of the filters [s]

    @property
    def speed(self) -> float:
        """Seconds of log per second of computing."""
        return float(self.times[-1] - self.times[0]) / self.seconds


class SingleFilter:
    """One filter of one robot, with the part of the interface of `TeamSlam` that replays use."""

    groups = ((0,),)
    pair_attempts = None

    def __init__(self, **options: Any) -> None:
        self.filter, self._steps = FastSlam(**options), 0
        self.measurements = dict.fromkeys(("matched", "created", "rejected"), 0)  # by the most probable particle

    def step(
        self, odometry: Sequence[Any], measurements: Sequence[Any], contacts: None, identities: Sequence[Any] | None
    ) -> TeamReport:
        """Do a step, and report it as a team of one does."""
        report = self.filter.step(odometry, measurements, identities)
        self._steps += 1
        counts = report.num_matched, report.num_new, report.num_rejected
        for name, count in zip(self.measurements, counts, strict=True):
            self.measurements[name] += count
        step, rejuvenation = self._steps - 1, report.rejuvenation
        return TeamReport(
            step=step, all_associations=report.all_associations, groups=self.groups, events=(), id_maps=(), maps=(0,),
            map_changes=(LandmarksCreated(0, 0, step, report.created[0]),), oldest_step=step + 1,
            rejuvenations=() if rejuvenation is None else (((0,), rejuvenation),),
        )  # fmt: skip

    def pose_from_start(self, robot: int) -> PoseEstimate:
        """Return the estimated pose in the start frame, which is the frame of the map."""
        return self.filter.pose()

    def map(self, robot: int) -> LandmarkMap:
        """Return the map."""
        return self.filter.map()

    def start_from_group(self, robot: int) -> FloatArray:
        """Return the identity."""
        return np.zeros(3)

    def consistency(self, robot: int) -> Consistency:
        """Return the consistency of the filter."""
        return self.filter.consistency

    def diagnose(self, robot: int) -> tuple[Cause, ...]:
        """Return what the filter says of the readings."""
        return self.filter.diagnose()


def make_filters(log: Log, config: ReplayConfig) -> "TeamSlam | SingleFilter":
    """Return the filters before the first step; what the user chose has priority over the options of the log."""
    usual = {
        "num_particles": PARTICLES_PER_ROBOT * (1 if log.alone else len(log.robots)),
        "rejuvenate_every": REJUVENATE_EVERY, "seed": config.seed if log.seed is None else log.seed,
    }  # fmt: skip
    chosen = {
        "num_particles": config.particles, "proposal": config.estimator, "rejuvenate_every": config.rejuvenate_every,
    }  # fmt: skip
    options = {**usual, **log.options, **{name: value for name, value in chosen.items() if value is not None}}
    options["rejuvenate_every"] = options["rejuvenate_every"] or None
    return SingleFilter(**options) if log.team is None else TeamSlam(len(log.robots), **log.team, **options)


def replay_log(
    log: Log, config: ReplayConfig, on_step: Callable[[float, TeamReport], None] = lambda progress, report: None
) -> Replay:
    """Run the filters on a log.

    Returns:
        Paths as estimated at each step, and maps and merges. The time in which the log computes its measurements is not
        counted.
    """
    team: Any = make_filters(log, config)
    end = math.inf if config.duration is None else log.times[0] + config.duration
    times = log.times[: max(2, int(np.searchsorted(log.times, end, side="right")))]
    robots, num_steps = range(len(log.robots)), len(times)
    contacts = np.eye(len(robots), dtype=np.bool_) if log.alone else None
    ground_truth = _claims_of(log) if log.has_identities else None
    paths, odometry = np.zeros((2, len(robots), num_steps, 3))
    seen: list[list[Measurements | None]] = [[] for _ in robots]
    merges: list[Merge] = []
    stages: list[tuple[int, Mapping[int, LandmarkMap]]] = []
    attempts, seconds, rejuvenations = 0, 0.0, RejuvenationCount()

    def predicted_pose(robot: int, move: FloatArray | None) -> FloatArray:
        mean = team.pose_from_start(robot).mean
        return mean if move is None else compose(mean, move)

    def true_ids(robot: int, landmarks: LandmarkMap) -> IntArray:
        if ground_truth is None:
            return np.full(len(landmarks), -1)
        return ground_truth.true_ids(robot, landmarks.ids)

    for step, taken in zip(range(num_steps), zip(*(robot.steps() for robot in log.robots), strict=True), strict=False):
        rows = None if ground_truth is None else [(robot.identities or ())[step] for robot in log.robots]
        groups = {robot: group for group in team.groups for robot in group}
        before = {group: team.map(group[0]) for group in team.groups} if len(robots) > 1 else {}
        moves = [move if step else None for move, _ in taken]
        started = time.perf_counter()
        frames = [
            frame and log.source.describe(frame, partial(predicted_pose, robot, moves[robot]))
            for robot, (_, frame) in enumerate(taken)
        ]
        report = team.step(moves, frames, contacts, rows if log.identified else None)
        seconds += time.perf_counter() - started
        for robot in robots:
            paths[robot, step] = team.pose_from_start(robot).mean
            odometry[robot, step] = 0.0 if moves[robot] is None else moves[robot]
            seen[robot].append(taken[robot][1])
        for _, attempt in report.rejuvenations:
            rejuvenations.add(attempt)
        since = float(times[step] - times[0])
        for event in report.events:
            attempts += event.kind == "attempt"
            if event.kind == "merge":
                sides = [groups[side[0]] for side in (event.robots_a, event.robots_b)]
                joined = [
                    new.subset(np.flatnonzero(np.isin(new.ids, before[side].ids)))
                    for side, new in zip(sides, team.merged_maps(event), strict=True)
                ]
                claims = [true_ids(side[0], own) for side, own in zip(sides, joined, strict=True)]
                merges.append(Merge(since, event, (joined[0], joined[1]), (claims[0], claims[1])))
            if event.kind == "undo":
                merges = [replace(m, undone=since) if m.event.alignment is event.alignment else m for m in merges]
        if ground_truth is not None and rows is not None:
            ground_truth.record(report, padded(rows))
        if is_stage(step, num_steps):
            firsts = [group[0] for group in team.groups]
            stages.append((step, {first: team.map(first).moved(team.start_from_group(first)) for first in firsts}))
        log.source.observe(report)
        on_step((step + 1) / num_steps, report)
    if not stages or stages[-1][0] < num_steps - 1:
        hint = "Yield a motion and measurements, or None, for each of the times."
        raise argument_error("measurements", f"{num_steps} steps", "fewer", hint)
    frames_of = np.array([team.start_from_group(robot) for robot in robots])
    maps = [team.map(robot) for robot in robots]
    reckoned = [
        dead_reckoning(np.zeros(3), odometry[number, 1:]) if robot.reckoned is None else robot.reckoned[:num_steps]
        for number, robot in enumerate(log.robots)
    ]
    noise = {name: log.options[name] for name in ("camera", "motion") if name in log.options}
    named = [robot.identities[:num_steps] if log.identified and robot.identities else None for robot in log.robots]
    causes = [
        diagnose(odometry[robot], seen[robot], named[robot], **noise)
        + tuple(cause for cause in team.diagnose(robot) if cause.name == LOOK_ALIKES)
        for robot in robots
    ]
    return Replay(
        times=times, paths=paths, reckoned=np.array(reckoned), stages=tuple(stages), groups=team.groups,
        maps=tuple(own.moved(frame) for own, frame in zip(maps, frames_of, strict=True)),
        claims=tuple(map(true_ids, robots, maps)), start_from_group=frames_of, merges=tuple(merges), attempts=attempts,
        pairs=None if log.alone else team.pair_attempts,
        measurements=getattr(team, "measurements", {}),
        rejuvenations=rejuvenations.to_mapping(), consistency=tuple(map(team.consistency, robots)),
        causes=tuple(causes), seconds=seconds,
    )  # fmt: skip


def is_stage(step: int, num_steps: int) -> bool:
    """Return whether the map after a step is one of the at most `MOST_STAGES` + 1 maps for the playback."""
    return step == num_steps - 1 or step % math.ceil(num_steps / MOST_STAGES) == 0


def _claims_of(log: Log) -> GroundTruthAssociation:
    """Return the record of the landmarks' identities before the first step."""
    flat = np.zeros((log.num_landmarks, 3))
    if log.landmarks is not None:
        flat[:, :2] = log.landmarks
    return GroundTruthAssociation(len(log.robots), flat, np.ones(len(flat), dtype=np.bool_), CUTOFF)
