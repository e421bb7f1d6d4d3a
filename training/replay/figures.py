"""The pictures of a replay: paths and maps against the truth, a panel per robot and joint map, and joint maps alone."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from slam_backend.core.validation import FloatArray
from slam_backend.geometry import compose, inverse, transform_points
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.readers.mrclam import MrclamLog
from training.experiments.plotting import save_png
from training.replay.metrics import AlignedMap, PathScore, align_to_truth
from training.replay.mrclam import Replay

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#B8860B")  # told apart by colour-blind eyes too
TRUTH = "#9a9a9a"
CHI_95 = 2.448  # radius of the 95 % ellipse of a planar Gaussian, in standard deviations
COLUMNS = 3


def draw_replay(file: Path, log: MrclamLog, replay: Replay, paths: Sequence[PathScore | None]) -> None:
    """Draw the replay into a PNG file.

    Args:
        file: Where to write.
        log: With the truth.
        replay: What was estimated.
        paths: Scores of `score_path`, per robot; None where the truth is not known.
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


def draw_joint_map(
    file: Path, log: MrclamLog, replay: Replay, paths: Sequence[PathScore | None], group: tuple[int, ...]
) -> None:
    """Draw the map that a group of robots shares at the end, with their paths, alone into a PNG file.

    Args:
        file: Where to write.
        log: With the truth.
        replay: What was estimated.
        paths: Scores of `score_path`, per robot; None where the truth is not known.
        group: Its robots, counted from 0, as in `Replay.groups`.
    """
    with mpl.rc_context({"font.size": 9, "axes.titlesize": 10}):
        figure = Figure(figsize=(5.2, 7.4), layout="constrained")
        _draw_group(figure.subplots(), log, replay, paths, group)
        save_png(figure, file, 110)


def _draw_robot(ax: Axes, log: MrclamLog, replay: Replay, path: PathScore | None, robot: int) -> None:
    """Draw one robot's path and dead reckoning, each fitted to the true path, and its map, fitted to the landmarks."""
    colour = COLOURS[robot % len(COLOURS)]
    title = f"robot {log.robots[robot].robot}"
    fitted = align_to_truth(replay.maps[robot], replay.claims[robot], log)
    own = _own_frame(fitted, path)
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
    """Draw the map of several robots and their paths, all moved by one fit of the map to the true landmarks."""
    names = ", ".join(str(log.robots[robot].robot) for robot in group)
    first = group[0]
    fitted = align_to_truth(replay.maps[first], replay.claims[first], log)
    own = _own_frame(fitted, paths[first])
    in_world = fitted is not None or paths[first] is not None
    for robot in group:
        # The map hangs in the first robot's start frame; the others' start frames follow through the group's.
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


def _own_frame(fitted: AlignedMap | None, path: PathScore | None) -> FloatArray:
    """Return where a picture puts a robot's start frame (3,): by its map, else by its path, else at the origin."""
    if fitted is not None:
        return fitted.world_from_map
    return np.zeros(3) if path is None else path.world_from_path


def _draw_landmarks(ax: Axes, landmarks: LandmarkMap, colour: str) -> None:
    """Draw estimated landmarks as dots with 95 % ellipses."""
    for mean, covariance in zip(landmarks.means, landmarks.covariances, strict=True):
        width, height, angle = _ellipse(covariance[:2, :2])
        ax.add_patch(Ellipse((mean[0], mean[1]), width, height, angle=angle, fc=colour, ec=colour, alpha=0.3, zorder=4))
    ax.plot(*landmarks.means[:, :2].T, ls="", marker=".", ms=4, color=colour, zorder=5, label="landmarks, 95 %")


def _ellipse(covariance: FloatArray) -> tuple[float, float, float]:
    """Return both diameters [m] and the direction of the first [degrees] of the 95 % ellipse."""
    values, vectors = np.linalg.eigh(covariance)
    width, height = 2.0 * CHI_95 * np.sqrt(np.maximum(values, 0.0))
    return float(width), float(height), float(np.rad2deg(np.arctan2(vectors[1, 0], vectors[0, 0])))


def _finish(ax: Axes, log: MrclamLog, title: str) -> None:
    """Add what all panels share: true landmarks, equal axes, a legend."""
    if log.positions is not None:
        ax.plot(*log.positions.T, ls="", marker="+", ms=8, mew=1.1, color="#404040", zorder=3, label="true landmarks")
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_title(title)
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")
    ax.grid(alpha=0.15)
    ax.legend(fontsize=7, loc="best", framealpha=0.8)
