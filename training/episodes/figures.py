"""Two plots of a run: the maps over the true world, and the map errors over time."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.figure import Figure

from slam_backend.core.validation import FloatArray
from slam_backend.geometry import compose, rotate_covariances, transform_points
from training.episodes.runner import EpisodeRecord
from training.experiments.plotting import rgb, save_png
from vslam_env.rendering import Scene
from vslam_env.rendering.canvas import CHI_SQUARE_95
from vslam_env.rendering.palette import FAINT_INK, INK, PAPER, TRUE_LANDMARK, WALL, Colour, robot_colour

MARGIN_M = 0.8
COLUMNS = 4  # number of columns of small panels
LEGEND = "wide, faint: true path   ·   line: estimated path   ·   dotted: odometry only   ·   ellipses: 95 %"


def draw_maps(record: EpisodeRecord, path: Path) -> None:
    """Save a plot of the map of each robot before its first merge, and of all maps at the end.

    Each map is placed by the true start pose of its robot, without any fit, so that deviations from the walls are
    estimation errors.
    """
    robots = range(len(record.infos))
    columns = min(len(robots), COLUMNS)
    rows = -(-len(robots) // columns)
    low, high = _extent(record.scene)
    ratio = (high[1] - low[1]) / (high[0] - low[0])
    small, large = 9.0 / columns * ratio + 0.45, 9.0 * ratio + 0.45
    figure = Figure(figsize=(9.3, rows * small + large + 0.25), layout="constrained", facecolor=rgb(PAPER))
    parts: Any = figure.subfigures(2, 1, height_ratios=[rows * small, large])
    upper, lower = parts
    for part in (upper, lower):
        part.set_facecolor(rgb(PAPER))
    panels = upper.subplots(rows, columns, squeeze=False).ravel()
    for axes in panels[len(robots) :]:
        axes.set_visible(False)
    for robot, axes in zip(robots, panels, strict=False):
        start, held = record.true_poses[robot, 0], record.own_maps[robot]
        _draw_truth(axes, record.scene, 0.8)
        covariances = rotate_covariances(start[2], held.covariances)
        _draw_landmarks(axes, transform_points(start, held.means), covariances, robot_colour(robot), 3.0)
        until = record.alone_until[robot]
        _draw_paths(axes, record, robot, record.times[-1] if until is None else until)
        when = "to the end" if until is None else f"until {until:.0f} s"
        axes.set_title(f"robot {robot} alone, {when}", fontsize=9, color=rgb(INK))
    main = lower.subplots()
    _draw_truth(main, record.scene, 1.5)
    for robot in robots:
        view = record.scene.robots[robot]
        _draw_landmarks(main, view.landmark_means, view.landmark_covariances, robot_colour(robot), 7.0)
    for robot in robots:
        _draw_paths(main, record, robot, record.times[-1])
    groups = "  ".join("{" + ", ".join(map(str, group)) + "}" for group in record.groups)
    main.set_title(
        f"at {record.times[-1]:.0f} s: groups {groups}, {100 * record.coverage[-1]:.0f} % of the floor seen",
        fontsize=11, color=rgb(INK),
    )  # fmt: skip
    main.set_xlabel(LEGEND, fontsize=8, color=rgb(FAINT_INK))
    save_png(figure, path, 150)


def draw_errors(record: EpisodeRecord, path: Path) -> None:
    """Save a plot of the map error of each robot and of the coverage over time, with merges as vertical lines."""
    figure = Figure(figsize=(9.3, 5.6), layout="constrained", facecolor=rgb(PAPER))
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=[3, 1])
    for robot, errors in enumerate(record.map_errors):
        top.plot(record.times, errors, color=rgb(robot_colour(robot)), label=f"robot {robot}", linewidth=1.6)
    bottom.plot(record.times, 100.0 * record.coverage, color=rgb(FAINT_INK), linewidth=1.6)
    for axes in (top, bottom):
        for merge in record.merges:
            axes.axvline(merge.time, color=rgb(INK), linewidth=0.9, linestyle=(0, (4, 3)), zorder=0)
        axes.set_facecolor("white")
        axes.grid(color="0.92")
        axes.spines[["top", "right"]].set_visible(False)
    for number, merge in enumerate(record.merges):
        who = " + ".join("{" + ", ".join(map(str, group)) + "}" for group in (merge.robots_a, merge.robots_b))
        top.annotate(
            f"{who} merged", (merge.time, 0.98 - 0.07 * (number % 4)), xycoords=("data", "axes fraction"),
            xytext=(4, 0), textcoords="offset points", fontsize=8, color=rgb(INK), verticalalignment="top",
        )  # fmt: skip
    top.set_ylim(0.0, 1.08 * max(float(record.map_errors.max()), 1e-3))
    top.set_ylabel("map error [m]")
    top.legend(frameon=False, fontsize=8, loc="lower left")
    bottom.set_ylim(0.0, 100.0)
    bottom.set_ylabel("floor seen [%]")
    bottom.set_xlabel("time [s]")
    bottom.set_xlim(0.0, max(float(record.times[-1]), 1e-3))
    save_png(figure, path, 150)


def _extent(scene: Scene) -> tuple[FloatArray, FloatArray]:
    """Return the corners (2,) of the visible box."""
    ends = scene.walls.reshape(-1, 2)
    return ends.min(axis=0) - MARGIN_M, ends.max(axis=0) + MARGIN_M


def _draw_truth(axes: Axes, scene: Scene, width: float) -> None:
    """Draw walls and true landmarks, and set the limits of the axes."""
    axes.add_collection(LineCollection(list(scene.walls.reshape(-1, 2, 2)), colors=[rgb(WALL)], linewidths=width))
    axes.scatter(scene.landmarks[:, 0], scene.landmarks[:, 1], s=2.2 * width, color=rgb(TRUE_LANDMARK), linewidths=0)
    low, high = _extent(scene)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xticks=[], yticks=[])
    axes.set_facecolor("white")
    axes.spines[:].set_visible(False)


def _draw_landmarks(axes: Axes, means: FloatArray, covariances: FloatArray, colour: Colour, area: float) -> None:
    """Draw landmarks (n, 3) with their 95 % ellipses."""
    variances, vectors = np.linalg.eigh(covariances[:, :2, :2])
    axes_m = 2.0 * np.sqrt(CHI_SQUARE_95 * np.maximum(variances, 0.0))
    angles = np.degrees(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]))
    ellipses = EllipseCollection(
        axes_m[:, 1], axes_m[:, 0], angles, units="xy", offsets=means[:, :2], offset_transform=axes.transData,
        facecolors="none", edgecolors=[(*rgb(colour), 0.45)], linewidths=0.6,
    )  # fmt: skip
    axes.add_collection(ellipses)
    axes.scatter(means[:, 0], means[:, 1], s=area, color=rgb(colour), linewidths=0)


def _draw_paths(axes: Axes, record: EpisodeRecord, robot: int, until: float) -> None:
    """Draw the true path faint, the estimated path, and the odometry path dotted, up to a given time."""
    shown = record.times <= until
    truth, colour = record.true_poses[robot], rgb(robot_colour(robot))
    axes.plot(truth[shown, 0], truth[shown, 1], color=colour, alpha=0.25, linewidth=3.0)
    for path, style, width in ((record.estimated[robot], "-", 1.1), (record.reckoned[robot], ":", 0.9)):
        x, y, _ = compose(truth[0], path[shown]).T
        axes.plot(x, y, color=colour, linestyle=style, linewidth=width)
    axes.plot(truth[0, 0], truth[0, 1], marker="o", markersize=4.0, markerfacecolor="white", color=colour)
