"""Recordings of replays for the playback in reports: paths and maps over time, and merges."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.geometry import compose, inverse
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.readers.mrclam import MrclamLog
from slam_backend.trajectory import Trajectory
from training.replay.figures import own_frame
from training.replay.metrics import PathScore, align_to_truth
from training.replay.mrclam import Replay
from training.replay.single_robot import OneReplay, PositionScore
from training.report.recording import MOST_FRAMES, Recording, ellipses, event_entry


def _steps(count: int) -> slice:
    """Return the recorded ones of a number of steps."""
    return slice(0, None, math.ceil(count / MOST_FRAMES))


def _maps(
    stages: Sequence[tuple[int, Mapping[int, LandmarkMap]]], steps: slice, count: int
) -> dict[str, IntArray | FloatArray]:
    """Return the fields of maps over time.

    Args:
        stages: Steps, ascending, and the maps after them by robot, in the world frame.
        steps: Recorded ones of the steps.
        count: Number of robots.
    """
    last = (stages[-1][0]) // steps.step  # index of the last recorded step
    keys = {min(-(-step // steps.step), last): maps for step, maps in stages}  # shown when the step is over
    points = [
        ellipses(maps[robot]) if robot in maps else np.zeros((0, 5)) for maps in keys.values() for robot in range(count)
    ]
    ends = np.cumsum([len(each) for each in points]).reshape(len(keys), count)
    return {"keyframes": np.array(list(keys)), "map_points": np.concatenate(points), "map_ends": ends}


def record_team(log: MrclamLog, replay: Replay, paths: Sequence[PathScore | None]) -> Recording:
    """Return the recording of a team. Each group is placed by one fit of its final map, or else of its first path.

    Args:
        paths: Path scores of `score_path` for each robot; None without ground truth.
    """
    steps = _steps(len(replay.times))
    times, count = replay.times[steps], len(log.robots)
    estimate, reckoned, truth = (np.full((len(times), count, 3), np.nan) for _ in range(3))
    starts: list[FloatArray] = [np.zeros(3)] * count
    for group in replay.groups:
        first = group[0]
        own = own_frame(align_to_truth(replay.maps[first], replay.claims[first], log), paths[first])
        for robot in group:
            first_from_own = compose(replay.start_from_group[first], inverse(replay.start_from_group[robot]))
            start = starts[robot] = compose(own, first_from_own)
            estimate[:, robot] = compose(start, replay.paths[robot][steps])
            reckoned[:, robot] = compose(start, replay.reckoned[robot][steps])
    for robot, each in enumerate(log.robots):
        truth[:, robot] = _true_poses(each.truth, times)
    numbers = [each.robot for each in log.robots]
    events = []
    for merge in replay.merges:
        events.append(event_entry(merge.event, merge.time, numbers))
        if merge.undone is not None:
            events.append(events[-1] | {"kind": "undo", "time": merge.undone, "text": f"undone: {events[-1]['text']}"})
    placed = [(step, {r: own.moved(starts[r]) for r, own in maps.items()}) for step, maps in replay.stages]
    return Recording(
        about={
            "names": [f"robot {number}" for number in numbers], "cutoff": 1.0,
            "events": sorted(events, key=lambda event: float(event["time"])),
            "placed": "by one rigid fit of each final map",
        },
        times=times - times[0], estimate=estimate, truth=truth, reckoned=reckoned,
        landmarks=np.zeros((0, 2)) if log.positions is None else log.positions[:, :2],
        **_maps(placed, steps, count),
    )  # fmt: skip


def record_one(
    result: OneReplay, paths: tuple[FloatArray, FloatArray], scores: tuple[PositionScore, PositionScore] | None,
    truth: FloatArray | None,
) -> Recording:  # fmt: skip
    """Return the recording of a robot; estimate and dead reckoning are each placed by their rigid fit to the truth.

    Args:
        paths: Positions or poses (T, 2 or 3), start frame, of the estimate and of dead reckoning.
        scores: Scores of both; None without ground truth: the start frame is then shown.
        truth: (n, 3) float64 [m, m, rad]. True poses at the first n steps; None: not known.
    """
    steps = _steps(len(result.times))
    headings = result.path[:, 2], result.reckoned[:, 2]
    fits = (np.zeros(3), np.zeros(3)) if scores is None else (scores[0].world_from_path, scores[1].world_from_path)
    placed = [
        compose(fit, np.column_stack([path[:, :2], heading]))[steps, None]
        for fit, path, heading in zip(fits, paths, headings, strict=True)
    ]
    known = np.full((len(result.times), 1, 3), np.nan)
    if truth is not None:
        known[: len(truth), 0] = truth[: len(known)]
    return Recording(
        about={
            "names": ["robot"], "events": [], "cutoff": 1.0,
            "placed": "in the start frame" if scores is None else "by a rigid fit of the path",
        },
        times=(result.times - result.times[0])[steps], estimate=placed[0], reckoned=placed[1], truth=known[steps],
        **_maps([(step, {0: stage.moved(fits[0])}) for step, stage in result.stages], steps, 1),
    )  # fmt: skip


def _true_poses(truth: Trajectory | None, times: FloatArray) -> FloatArray:
    """Return the true poses (n, 3) at some times; NaN where they are not known."""
    poses = np.full((len(times), 3), np.nan)
    if truth is not None:
        known = (times >= truth.times[0]) & (times <= truth.times[-1])
        poses[known] = truth.at(times[known])
    return poses
