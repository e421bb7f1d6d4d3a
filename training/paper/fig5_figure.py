"""The picture of `vslam paper fig5`: the room from above, sight lines dashed, hidden landmarks crossed out."""

from pathlib import Path

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Wedge

from training.experiments.plotting import save_png
from training.paper.fig5 import Fig5
from vslam_env.rendering.palette import robot_colour

WIDTH = 7.0  # [in]
BODY = 0.35  # [m] drawn larger than it is
INK = "0.15"


def draw_fig5(file: Path, found: Fig5) -> None:
    """Draw the figure into a PNG file."""
    low, high = found.walls.reshape(-1, 2).min(axis=0), found.walls.reshape(-1, 2).max(axis=0)
    ratio = (high[1] - low[1]) / (high[0] - low[0])
    figure = Figure(figsize=(WIDTH, WIDTH * ratio + 0.6), layout="constrained")
    axes = figure.subplots()
    axes.add_collection(LineCollection(found.walls.reshape(-1, 2, 2).tolist(), colors=INK, linewidths=1.6))
    axes.plot(*found.landmarks[:, :2].T, "o", color="0.62", markersize=2.2, zorder=3)
    for robot, pose in enumerate(found.poses):
        colour = [channel / 255 for channel in robot_colour(robot)]
        axes.plot(*found.paths[robot].T, color=colour, linewidth=0.9, alpha=0.6)
        fan = np.degrees([pose[2] - found.half_fov, pose[2] + found.half_fov])
        axes.add_patch(Wedge(tuple(pose[:2]), found.max_range, *fan, facecolor=colour, alpha=0.07, linewidth=0))
        for mark in np.flatnonzero(found.seen[robot]):
            width = 0.9 if found.measured[robot, mark] else 0.35
            ends = np.vstack([pose[:2], found.landmarks[mark, :2]])
            axes.plot(*ends.T, "--", color=colour, linewidth=width, dashes=(4, 3), zorder=2)
        hidden = found.landmarks[found.in_view[robot] & ~found.seen[robot]]
        axes.plot(*hidden[:, :2].T, "x", color=colour, markersize=4.5, markeredgewidth=0.9, zorder=4)
        angles = pose[2] + np.array([0.0, 2.5, -2.5])
        body = pose[:2] + BODY * np.column_stack([np.cos(angles), np.sin(angles)])
        axes.fill(*body.T, facecolor=colour, edgecolor=INK, linewidth=0.8, zorder=5)
    handles = [
        Line2D([], [], color=INK, linewidth=1.6, label="wall"),
        Line2D([], [], color="0.62", marker="o", linestyle="", markersize=3, label="landmark"),
        Line2D([], [], color=INK, linestyle="--", linewidth=0.9, label="measured now"),
        Line2D([], [], color=INK, linestyle="--", linewidth=0.35, label="seen"),
        Line2D([], [], color=INK, marker="x", linestyle="", markersize=4.5, label="in view, but hidden"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=5, fontsize=7, frameon=False)
    axes.set_aspect("equal")
    axes.set_xlim(low[0] - 0.4, high[0] + 0.4)
    axes.set_ylim(low[1] - 0.4, high[1] + 0.4)
    axes.set_xlabel("x [m]", fontsize=7)
    axes.set_ylabel("y [m]", fontsize=7)
    axes.tick_params(labelsize=7)
    save_png(figure, file, 150)
