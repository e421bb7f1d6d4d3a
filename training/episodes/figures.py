"""Two plots of a run: the maps over the true world, and the map errors over time."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D

from slam_backend.core.validation import BoolArray, FloatArray
from slam_backend.geometry import compose, rotate_covariances, transform_points
from training.episodes.runner import EpisodeRecord, MergeRecord
from training.experiments.output.plotting import picture, rgb, save_png
from training.experiments.output.tables import E_NOTHING
from vslam_env.rendering import Scene
from vslam_env.rendering.canvas import CHI_SQUARE_95
from vslam_env.rendering.overlays import scale_length
from vslam_env.rendering.palette import FAINT_INK, INK, PAPER, TRUE_LANDMARK, WALL, Colour, robot_colour

MARGIN_M = 0.8
COLUMNS = 4  # number of columns of small panels
TURNS = 60  # intervals of the plot, drawn in turn by the robots that share a map
TEXT_SIZE = 8.0  # [pt]
LETTER = 0.56 * TEXT_SIZE / 72.0  # mean width of a letter of this size [in]


@picture
def draw_maps(record: EpisodeRecord, path: Path) -> None:
    """Save a plot of the map of each robot before its first merge, and of the map of each group at the end.

    Each map is placed by the true start pose of its robot, of a group by that of its first one, without any fit, so
    that deviations from the walls are estimation errors.
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
    for first in dict.fromkeys(record.scene.map_owners):
        view = record.scene.robots[first]
        _draw_landmarks(main, view.landmark_means, view.landmark_covariances, robot_colour(first), 8.0)
    for robot in robots:
        _draw_paths(main, record, robot, record.times[-1])
    groups = "  ".join("{" + ", ".join(map(str, group)) + "}" for group in record.groups)
    main.set_title(
        f"at {record.times[-1]:.0f} s: groups {groups}, coverage {100 * record.coverage[-1]:.0f} %",
        fontsize=11, color=rgb(INK),
    )  # fmt: skip
    _draw_scale_bar(main)
    _add_map_legend(lower)
    save_png(figure, path, 150)


@picture
def draw_errors(record: EpisodeRecord, path: Path) -> None:
    """Save a plot of the map error of each robot and of the coverage over time, with merges as vertical lines.

    Robots that share a map draw their curves, which are nearly equal, in turn, so that none hides another.
    """
    figure = Figure(figsize=(9.3, 5.6), layout="constrained", facecolor=rgb(PAPER))
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=[3, 1])
    for robot, (errors, drawn) in enumerate(zip(record.map_errors, turns(record), strict=True)):
        colour, points = rgb(robot_colour(robot)), np.column_stack([record.times, errors])
        segments = np.stack([points[:-1], points[1:]], axis=1)[drawn[:-1]]
        top.add_collection(LineCollection(list(segments), colors=[colour], linewidths=1.8, capstyle="projecting"))
        top.plot([], [], color=colour, label=f"robot {robot}", linewidth=1.8)
    bottom.plot(record.times, 100.0 * record.coverage, color=rgb(FAINT_INK), linewidth=1.6)
    for axes in (top, bottom):
        for merge in record.merges:
            axes.axvline(merge.time, color=rgb(INK), linewidth=0.9, linestyle=(0, (4, 3)), zorder=0)
        axes.set_facecolor("white")
        axes.grid(color="0.92")
        axes.spines[["top", "right"]].set_visible(False)
    end = max(float(record.times[-1]), 1e-3)
    labels = [_merge_label(merge) for merge in record.merges]
    rows = place_labels([merge.time for merge in record.merges], labels, end, 0.88 * 9.3)
    most = max(float(record.map_errors.max()), E_NOTHING)
    height = 1.09 * most + 0.075 * most * max((row + 1 for row, _ in rows), default=0)
    for (row, is_left), label, merge in zip(rows, labels, record.merges, strict=True):
        top.annotate(
            label, (merge.time, height - 0.075 * most * row), xytext=(-4 if is_left else 4, 0),
            textcoords="offset points", fontsize=TEXT_SIZE, color=rgb(INK), verticalalignment="top",
            horizontalalignment="right" if is_left else "left",
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.8},
        )  # fmt: skip
    top.axhline(E_NOTHING, color=rgb(FAINT_INK), linewidth=0.8, linestyle=":", zorder=0)
    top.annotate(
        f"{E_NOTHING:.2f} m: nothing found", (0.0, E_NOTHING), xytext=(4, 2), textcoords="offset points",
        fontsize=TEXT_SIZE, color=rgb(FAINT_INK), verticalalignment="bottom",
    )  # fmt: skip
    top.set_ylim(0.0, height)
    top.set_ylabel("map error E [m]")
    figure.legend(frameon=False, fontsize=TEXT_SIZE, loc="outside upper left", ncols=len(record.map_errors))
    bottom.set_ylim(0.0, 100.0)
    bottom.set_ylabel("coverage [%]")
    bottom.set_xlabel("time [s]")
    bottom.set_xlim(0.0, end)
    save_png(figure, path, 150)


def turns(record: EpisodeRecord) -> BoolArray:
    """Return which robot draws its curve from each time of a record to the next, (K, T) bool."""
    count, end = len(record.map_errors), max(float(record.times[-1]), 1e-3)
    groups = np.tile(np.arange(count), (len(record.times), 1))
    for merge in record.merges:  # in order
        until = np.inf if merge.undone is None else merge.undone
        joint = (record.times >= merge.time) & (record.times < until)
        members = [*merge.robots_a, *merge.robots_b]
        groups[joint[:, None] & np.isin(np.arange(count), members)] = min(members)
    slots = np.floor(TURNS * record.times / end).astype(np.int64)
    drawn = np.ones((count, len(record.times)), bool)
    for robot in range(count):
        same = groups == groups[:, [robot]]
        drawn[robot] = slots % same.sum(axis=1) == same[:, :robot].sum(axis=1)
    return drawn


def _merge_label(merge: MergeRecord) -> str:
    sides = (", ".join(map(str, group)) for group in (merge.robots_a, merge.robots_b))
    return " + ".join(sides) + (" merged, then undone" if merge.undone is not None else " merged")


def place_labels(times: Sequence[float], labels: Sequence[str], end: float, width: float) -> list[tuple[int, bool]]:
    """Return the row of each label beside its time, and whether it is on the left: none overlap or leave the plot.

    Args:
        times: Time of each label [s], between 0 and `end`.
        labels: Texts of one line.
        end: Last time of the plot [s].
        width: Width of the plot [in].

    >>> place_labels([1.0, 2.0, 99.0], ["0 + 1 merged", "0, 1 + 2 merged", "3 + 4 merged"], 100.0, 8.0)
    [(0, False), (1, False), (0, True)]
    """
    taken: list[list[tuple[float, float]]] = []
    places = []
    for time, label in zip(times, labels, strict=True):
        at, length = width * time / end, LETTER * len(label) + 0.1
        is_left = at + length > width
        begin, stop = (at - length, at) if is_left else (at, at + length)
        row = next(
            (row for row, spans in enumerate(taken) if all(stop <= b or begin >= e for b, e in spans)), len(taken)
        )
        if row == len(taken):
            taken.append([])
        taken[row].append((begin, stop))
        places.append((row, is_left))
    return places


def _draw_scale_bar(axes: Axes) -> None:
    """Draw a scale bar in the lower left corner."""
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    length = scale_length((right - left) / 8.0)
    x, y, tick = left + 0.015 * (right - left), low + 0.012 * (high - low), 0.008 * (high - low)
    axes.plot([x, x, x + length, x + length], [y + tick, y, y, y + tick], color=rgb(INK), linewidth=1.4)
    axes.annotate(
        f"{length:g} m", (x + length, y), xytext=(4, 0), textcoords="offset points", fontsize=TEXT_SIZE,
        color=rgb(INK), verticalalignment="bottom",
    )  # fmt: skip


def _add_map_legend(figure: SubFigure) -> None:
    """Add a legend of lines and marks below the axes; the robots' colours are those of the panels above."""
    grey = rgb(FAINT_INK)
    estimated = "estimated landmark with 95 % ellipse, in the colour of its map's first robot"
    handles = [
        Line2D([], [], color=rgb(WALL), linewidth=2.0, label="wall"),
        Line2D([], [], linestyle="", marker="o", markersize=2.4, color=rgb(TRUE_LANDMARK), label="true landmark"),
        Line2D([], [], linestyle="", marker="o", markersize=5.0, color=grey, label=estimated),
        Line2D([], [], color=grey, alpha=0.3, linewidth=4.0, label="true path"),
        Line2D([], [], color=grey, linewidth=1.2, label="estimated path"),
        Line2D([], [], color=grey, linewidth=1.0, linestyle=":", label="odometry only"),
        Line2D([], [], linestyle="", marker="o", markerfacecolor="white", color=grey, label="start"),
    ]
    figure.legend(
        handles=handles, loc="outside lower center", ncols=4, frameon=False, fontsize=TEXT_SIZE, handletextpad=0.5,
        columnspacing=1.2,
    )  # fmt: skip


def _extent(scene: Scene) -> tuple[FloatArray, FloatArray]:
    """Return the corners (2,) of the visible box."""
    ends = scene.walls.reshape(-1, 2)
    return ends.min(axis=0) - MARGIN_M, ends.max(axis=0) + MARGIN_M


def _draw_truth(axes: Axes, scene: Scene, width: float) -> None:
    """Draw walls and, on them, true landmarks, and set the limits of the axes."""
    axes.add_collection(LineCollection(list(scene.walls.reshape(-1, 2, 2)), colors=[rgb(WALL)], linewidths=width))
    axes.scatter(
        scene.landmarks[:, 0], scene.landmarks[:, 1], s=2.4 * width, color=rgb(TRUE_LANDMARK), linewidths=0, zorder=2.5
    )
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
    axes.scatter(means[:, 0], means[:, 1], s=area, color=rgb(colour), linewidths=0, zorder=3.0)


def _draw_paths(axes: Axes, record: EpisodeRecord, robot: int, until: float) -> None:
    """Draw the true path faint, the estimated path, and the odometry path dotted, up to a given time."""
    shown = record.times <= until
    truth, colour = record.true_poses[robot], rgb(robot_colour(robot))
    axes.plot(truth[shown, 0], truth[shown, 1], color=colour, alpha=0.25, linewidth=3.0)
    for path, style, width in ((record.estimated[robot], "-", 1.1), (record.reckoned[robot], ":", 0.9)):
        x, y, _ = compose(truth[0], path[shown]).T
        axes.plot(x, y, color=colour, linestyle=style, linewidth=width)
    axes.plot(truth[0, 0], truth[0, 1], marker="o", markersize=4.0, markerfacecolor="white", color=colour)
