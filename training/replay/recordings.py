"""Recordings of replays for the playback in reports: paths and maps over time, and merges."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.geometry import compose
from slam_backend.maps.landmark_map import LandmarkMap
from training.replay.core import CUTOFF, Replay
from training.replay.figures import Scores, starts_in_world
from training.replay.log import Log
from training.replay.metrics import paths_of, true_poses
from training.report.recording import MOST_FRAMES, Recording, ellipses, event_entry


def record_replay(log: Log, result: Replay, scores: Scores) -> Recording:
    """Return the recording of a replay.

    Each group is placed by one fit of its final map, or else of its first path; dead reckoning of a single robot by a
    fit of its own.
    """
    steps, count = slice(0, None, math.ceil(len(result.times) / MOST_FRAMES)), len(log.robots)
    starts = {
        robot: start
        for group in result.groups
        for robot, start in zip(group, starts_in_world(log, result, scores, group), strict=True)
    }
    estimate, reckoned, truth = np.empty((3, len(result.times), count, 3))
    for robot, score in enumerate(scores):
        paths, frames = paths_of(result, log, robot), [starts[robot]] * 2
        if log.team is None and score is not None:
            frames[1] = score.scores[1].world_from_path
        estimate[:, robot], reckoned[:, robot] = map(compose, frames, paths)
        truth[:, robot] = true_poses(log.robots[robot].truth, result.times)
    names = [robot.number for robot in log.robots]
    events = []
    for merge in result.merges:
        events.append(event_entry(merge.event, merge.time, names))
        if merge.undone is not None:
            events.append(events[-1] | {"kind": "undo", "time": merge.undone, "text": f"undone: {events[-1]['text']}"})
    placed = "by one rigid fit of each final map" if log.landmarks is not None else "by a rigid fit of the path"
    maps = [(step, {robot: own.moved(starts[robot]) for robot, own in maps.items()}) for step, maps in result.stages]
    return Recording(
        about={
            "names": ["robot"] if log.team is None else [f"robot {name}" for name in names], "cutoff": CUTOFF,
            "events": sorted(events, key=lambda event: float(event["time"])),
            "placed": placed if log.landmarks is not None or any(scores) else "in the start frame",
        },
        times=(result.times - result.times[0])[steps],
        estimate=estimate[steps], truth=truth[steps], reckoned=reckoned[steps],
        landmarks=np.zeros((0, 2)) if log.landmarks is None else log.landmarks, **_maps(maps, steps, count),
    )  # fmt: skip


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
