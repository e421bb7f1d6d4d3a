"""Plots of replays: paths and maps against the ground truth, for a team or a single robot."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.geometry import compose, inverse, transform_points
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.readers.mrclam import MrclamLog
from training.experiments.plotting import ellipse_95, picture, save_png
from training.replay.metrics import AlignedMap, PathScore, align_to_truth
from training.replay.mrclam import Replay
from training.replay.single_robot import OneReplay, PositionScore

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#B8860B")  # safe for colour-blind readers
TRUTH = "#9a9a9a"
COLUMNS = 3

MARGIN = 0.06  # margin around the content, relative to the larger extent
STRAY = 0.001  # share of outliers ignored at each edge: a GPS fix may jump by 100 m
WIDTH = 8.0  # [in]
OFTEN = 10  # measurements from which a landmark is drawn opaque


@picture
def draw_replay(file: Path, log: MrclamLog, replay: Replay, paths: Sequence[PathScore | None]) -> None:
    """Draw the replay into a PNG file.

    Args:
        paths: Path scores of `score_path` for each robot; None without ground truth.
    """
    joint = [group for group in replay.groups if len(group) > 1]
    panels = len(log.robots) + len(joint)
    rows = -(-panels // COLUMNS)
    with mpl.rc_context({"font.size": 9, "axes.titlesize": 10}):
        figure = Figure(figsize=(4.6 * COLUMNS, 6.4 * rows), layout="constrained")
        axes = figure.subplots(rows, COLUMNS, squeeze=False).ravel()
        for robot, ax in enumerate(axes[: len(log.robots)]):
            _draw_robot(ax, log, replay, paths[robot], robot)
        for group, ax in zip(joint, axes[len(log.robots) : panels], strict=True):
            _draw_group(ax, log, replay, paths, group)
        for ax in axes[panels:]:
            ax.set_axis_off()
        save_png(figure, file, 110)


@picture
def draw_joint_map(
    file: Path, log: MrclamLog, replay: Replay, paths: Sequence[PathScore | None], group: tuple[int, ...]
) -> None:
    """Draw the final map of a group of robots, with their paths, into a PNG file of its own.

    Args:
        paths: Path scores of `score_path` for each robot; None without ground truth.
    """
    with mpl.rc_context({"font.size": 9, "axes.titlesize": 10}):
        figure = Figure(figsize=(5.2, 7.4), layout="constrained")
        _draw_group(figure.subplots(), log, replay, paths, group)
        save_png(figure, file, 110)


def _draw_robot(ax: Axes, log: MrclamLog, replay: Replay, path: PathScore | None, robot: int) -> None:
    """Draw one robot's path and dead reckoning, aligned to the true path, and its map, aligned to the landmarks."""
    colour = COLOURS[robot % len(COLOURS)]
    title = f"robot {log.robots[robot].robot}"
    fitted = align_to_truth(replay.maps[robot], replay.claims[robot], log)
    own = own_frame(fitted, path)
    frames, labels = (own, own), ("odometry", "estimate")
    if path is not None:
        ax.plot(*path.truth[:, :2].T, color=TRUTH, alpha=0.7, lw=2.2, label="true path")
        frames = path.world_from_reckoned, path.world_from_path
        labels = f"odometry {path.reckoned_aligned:.2f} m", f"estimate {path.ate_aligned:.2f} m"
    reckoned = transform_points(frames[0], replay.reckoned[robot][:, :2])
    ax.plot(*reckoned.T, color=colour, alpha=0.6, lw=0.9, ls=":", label=labels[0])
    ax.plot(*transform_points(frames[1], replay.paths[robot][:, :2]).T, color=colour, lw=1.0, label=labels[1])
    _draw_landmarks(ax, replay.maps[robot].moved(own), colour)
    if fitted is not None:
        title += f": map {fitted.score.rmse:.2f} m, {fitted.score.recall:.0%} of landmarks"
    elif path is None:
        title += ", own start frame"
    _finish(ax, log, title)


def _draw_group(
    ax: Axes, log: MrclamLog, replay: Replay, paths: Sequence[PathScore | None], group: tuple[int, ...]
) -> None:
    """Draw the map of several robots and their paths, all aligned by one fit of the map to the true landmarks."""
    names = ", ".join(str(log.robots[robot].robot) for robot in group)
    first = group[0]
    fitted = align_to_truth(replay.maps[first], replay.claims[first], log)
    own = own_frame(fitted, paths[first])
    in_world = fitted is not None or paths[first] is not None
    for robot in group:
        # The map is in the first robot's start frame; the group relates it to the other start frames.
        first_from_own = compose(replay.start_from_group[first], inverse(replay.start_from_group[robot]))
        points = transform_points(compose(own, first_from_own), replay.paths[robot][:, :2])
        score = paths[robot]
        if score is not None and in_world:
            label = "true paths" if robot == first else None
            ax.plot(*score.truth[:, :2].T, color=TRUTH, alpha=0.35, lw=1.6, label=label)
        label = f"robot {log.robots[robot].robot}"
        ax.plot(*points.T, color=COLOURS[robot % len(COLOURS)], lw=0.7, alpha=0.85, label=label)
    _draw_landmarks(ax, replay.maps[first].moved(own), "black")
    _finish(ax, log, f"joint map of {names}, " + ("one fit for all" if in_world else "start frame of the first"))


def own_frame(fitted: AlignedMap | None, path: PathScore | None) -> FloatArray:
    """Return the start frame (3,) of a robot in the plot: aligned by its map, else by its path, else the identity."""
    if fitted is not None:
        return fitted.world_from_map
    return np.zeros(3) if path is None else path.world_from_path


def _draw_landmarks(ax: Axes, landmarks: LandmarkMap, colour: str) -> None:
    """Draw estimated landmarks as dots with 95 % ellipses."""
    for mean, covariance in zip(landmarks.means, landmarks.covariances, strict=True):
        ax.add_patch(ellipse_95(mean, covariance[:2, :2], fc=colour, ec=colour, alpha=0.3, zorder=4))
    ax.plot(*landmarks.means[:, :2].T, ls="", marker=".", ms=4, color=colour, zorder=5, label="landmarks, 95 %")


def _finish(ax: Axes, log: MrclamLog, title: str) -> None:
    """Add the common elements of all panels: true landmarks, equal axes, a legend."""
    if log.positions is not None:
        ax.plot(*log.positions.T, ls="", marker="+", ms=8, mew=1.1, color="#404040", zorder=3, label="true landmarks")
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_title(title)
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")
    ax.grid(alpha=0.15)
    ax.legend(fontsize=7, loc="best", framealpha=0.8)


@picture
def draw_one(
    file: Path, title: str, result: OneReplay, paths: tuple[FloatArray, FloatArray],
    scores: tuple[PositionScore, PositionScore] | None = None, truth: FloatArray | None = None,
    truth_label: str = "true path",
) -> None:  # fmt: skip
    """Draw a replay into a PNG file, with each path aligned to the ground truth by its own SE(2) transform.

    The plot is limited to the estimate and the ground truth, except outliers, and may cut off dead reckoning; the
    legend gives the number of known positions outside.

    Args:
        paths: Positions (T, 2) [m], start frame, of the estimate and of dead reckoning.
        scores: Scores of estimate and dead reckoning; None without ground truth: the plot then uses the start frame.
    """
    origin = np.zeros(3)
    fits = (origin, origin) if scores is None else (scores[0].world_from_path, scores[1].world_from_path)
    estimate, reckoned = (transform_points(fit, path) for fit, path in zip(fits, paths, strict=True))
    landmarks = transform_points(fits[0], result.landmarks.means[:, :2])
    tails = ("", "") if scores is None else tuple(f", {score.aligned:.2f} m RMS" for score in scores)
    low, high = _window(estimate, truth)
    with mpl.rc_context({"font.size": 9, "axes.titlesize": 10}):
        ratio = float(np.clip((high - low)[1] / (high - low)[0], 0.4, 1.6))
        figure = Figure(figsize=(WIDTH, 0.93 * WIDTH * ratio + 0.6), layout="constrained")
        ax = figure.subplots()
        if truth is not None:
            outside = np.count_nonzero(((truth < low) | (truth > high)).any(axis=1))
            label = f"{truth_label} ({outside} of {len(truth)} outside)" if outside else truth_label
            ax.plot(*truth.T, ls="", marker=".", ms=5.0, mew=0.0, color=TRUTH, label=label)
        _draw_counted(ax, landmarks, result.landmarks.counts)
        ax.plot(*reckoned.T, color=COLOURS[1], lw=0.8, ls=":", label=f"odometry{tails[1]}")
        ax.plot(*estimate.T, color=COLOURS[0], lw=0.9, label=f"estimate{tails[0]}")
        ax.set_aspect("equal", adjustable="box")
        ax.set_xlim(low[0], high[0])
        ax.set_ylim(low[1], high[1])
        ax.set_title(title)
        ax.set_xlabel("x [m]")
        ax.set_ylabel("y [m]")
        ax.grid(alpha=0.15)
        ax.legend(fontsize=8, loc="best", framealpha=0.85)
        save_png(figure, file, 100)


def _window(estimate: FloatArray, truth: FloatArray | None) -> tuple[FloatArray, FloatArray]:
    """Return the lower and upper corner (2,) [m] of the plot."""
    low, high = estimate.min(axis=0), estimate.max(axis=0)
    if truth is not None:
        few, most = np.quantile(truth, [STRAY, 1.0 - STRAY], axis=0)
        low, high = np.minimum(low, few), np.maximum(high, most)
    room = MARGIN * float((high - low).max()) + 1e-3
    return low - room, high + room


def _draw_counted(ax: Axes, landmarks: FloatArray, counts: IntArray) -> None:
    """Draw landmarks (N, 2): opaque if measured often, otherwise transparent."""
    often = counts >= OFTEN
    for chosen, alpha, label in ((~often, 0.35, f"seen less than {OFTEN} times"), (often, 1.0, "landmarks")):
        if chosen.any():
            label = f"{np.count_nonzero(chosen)} {label}"
            ax.plot(*landmarks[chosen].T, ls="", marker="o", ms=2.2, color=COLOURS[2], alpha=alpha, label=label)
