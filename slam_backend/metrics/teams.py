"""Scores of a team's paths and map against the truth, all under one rigid motion: robots share a frame."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import FloatArray, IntArray, argument_error, check_array, check_float, check_int
from slam_backend.geometry import transform_points
from slam_backend.metrics.maps import MapScore, map_rmse
from slam_backend.metrics.paths import RpeResult, align_se2, ate, rpe
from slam_backend.trajectory import Trajectory

MAX_GAP = 0.01  # [s] between the times of two poses that are compared


@short_repr
@dataclass(frozen=True, slots=True, eq=False)
class RobotScore:
    """Errors of one robot's path under the team's alignment.

    Attributes:
        ate: Root mean square distance to the truth [m].
        own_ate: The same after the best rigid motion of this path alone [m].
        rpe: Relative pose error, which no frame changes; None for paths of `delta` poses and fewer.
        pairs: Number of compared poses.
    """

    ate: float
    own_ate: float
    rpe: RpeResult | None
    pairs: int


@short_repr
@dataclass(frozen=True, slots=True, eq=False)
class TeamScore:
    """Errors of a team under one alignment.

    Attributes:
        transform: (3,) float64 [m, m, rad]. Motion truth_from_estimated that fits the positions of all robots best.
        ate: Root mean square distance of all compared poses to the truth [m].
        robots: Errors of each robot.
        map: Error, recall and precision of the map; None if there is none.
    """

    transform: FloatArray
    ate: float
    robots: tuple[RobotScore, ...]
    map: MapScore | None


def match_times(times_a: ArrayLike, times_b: ArrayLike, max_gap: float = MAX_GAP) -> IntArray:
    """Return which poses of two paths belong together: for each of the shorter one the nearest in time of the other.

    Args:
        times_a: (n,) float64 [s], increasing.
        times_b: (m,) float64 [s], increasing.
        max_gap: Largest difference of two times that belong together [s].

    Returns:
        (k, 2) int64 rows (index in a, index in b).

    >>> match_times([0.0, 1.0, 2.0], [0.995, 2.5], 0.01).tolist()
    [[1, 0]]
    """
    a = check_array("times_a", times_a, (None,), "Give times in seconds.")
    b = check_array("times_b", times_b, (None,), "Give times in seconds.")
    check_float("max_gap", max_gap, "Give seconds.", at_least=0.0)
    if not len(a) or not len(b):
        return np.empty((0, 2), np.int64)
    if len(b) < len(a):
        return match_times(b, a, max_gap)[:, ::-1]
    right = np.searchsorted(b, a).clip(1, len(b) - 1) if len(b) > 1 else np.zeros(len(a), np.int64)
    left = np.maximum(right - 1, 0)
    nearest = np.where(np.abs(b[right] - a) < np.abs(b[left] - a), right, left)
    rows = np.flatnonzero(np.abs(b[nearest] - a) <= max_gap)
    return np.column_stack([rows, nearest[rows]])


def score_team(
    estimated: Sequence[Trajectory], truth: Sequence[Trajectory], landmarks: ArrayLike | None = None,
    true_landmarks: ArrayLike | None = None, *, max_gap: float = MAX_GAP, delta: int = 1, gate: float = 0.5,
) -> TeamScore:  # fmt: skip
    """Score a team's paths, and its map if there is one, under the rigid motion that fits all paths together best.

    Args:
        estimated: Path of each robot, all in one frame.
        truth: True path of each robot, in the order of `estimated`, all in one frame.
        landmarks: (n, 2 or 3) float64 [m], frame of `estimated`. Positions of the map; None: no map.
        true_landmarks: (N, 2 or 3) float64 [m], frame of `truth`; given with `landmarks`.
        max_gap: See `match_times`.
        delta: Number of compared poses over which the relative error is taken.
        gate: Largest distance of a landmark to the true one that it is matched with [m], see `map_rmse`.

    Raises:
        ValueError: If there is no robot, numbers of paths differ, a path has no pose at a true one's time, or one kind
            of landmarks is missing.
    """
    if not estimated:
        raise argument_error("estimated", "at least one path", "no path", "Give the path of each robot.")
    if len(estimated) != len(truth):
        hint = "Give one true path for each estimated one, in the same order."
        raise argument_error("truth", f"as many paths as estimated ones, {len(estimated)}", len(truth), hint)
    check_int("delta", delta, 1, "Compare motions over at least one pose.")
    pairs = []
    for robot, (guess, true) in enumerate(zip(estimated, truth, strict=True)):
        rows = match_times(guess.times, true.times, max_gap)
        if not len(rows):
            spans = (f"{path.times[0]:.3f} to {path.times[-1]:.3f} s" for path in (guess, true))
            got = "a path from {}, a true one from {}".format(*spans)
            hint = f"Path {robot} has no pose within {max_gap:g} s of a true one: do both have one clock?"
            raise argument_error("estimated", "paths that overlap in time", got, hint)
        pairs.append((guess.poses[rows[:, 0]], true.poses[rows[:, 1]]))
    all_guesses, all_true = (np.concatenate(side) for side in zip(*pairs, strict=True))
    transform = align_se2(all_true[:, :2], all_guesses[:, :2])
    robots = tuple(
        RobotScore(
            ate=_rms(transform, guess, true), own_ate=ate(guess, true).aligned,
            rpe=rpe(guess, true, delta) if len(guess) > delta else None, pairs=len(guess),
        )
        for guess, true in pairs
    )  # fmt: skip
    score = None
    if (landmarks is None) != (true_landmarks is None):
        missing = "landmarks" if landmarks is None else "true_landmarks"
        raise argument_error(missing, "positions", "no positions", "Give a map and true landmarks, or neither.")
    if landmarks is not None and true_landmarks is not None:
        points, truths = _points("landmarks", landmarks), _points("true_landmarks", true_landmarks)
        if 2 in (points.shape[1], truths.shape[1]):  # heights that only one side has do not count
            points, truths = (np.column_stack([side[:, :2], np.zeros(len(side))]) for side in (points, truths))
        score = map_rmse(transform_points(transform, points), truths, gate=gate)
    return TeamScore(transform, _rms(transform, all_guesses, all_true), robots, score)


def _points(name: str, points: ArrayLike) -> FloatArray:
    """Return positions (n, 2 or 3)."""
    width = 2 if np.ndim(points) == 2 and np.shape(points)[1] == 2 else 3
    return check_array(name, points, (None, width), "Give one position per row.")


def _rms(transform: FloatArray, guess: FloatArray, truth: FloatArray) -> float:
    """Return the root mean square distance of moved positions to true ones."""
    apart = transform_points(transform, guess[:, :2]) - truth[:, :2]
    return float(np.sqrt(np.mean(np.square(apart).sum(axis=1))))
