"""The picture of `vslam paper fig6`: time and map error against M for each number of robots."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator

from slam_backend.core.validation import FloatArray
from training.experiments.plotting import save_png
from training.paper.fig6.noise_regimes import BOUND, REGIMES
from vslam_env.rendering.palette import robot_colour

MARKERS = ("o", "s", "^")  # of one, two and three robots, as in the paper
STYLES = {"fastslam1": "-", "fastslam2": "--", "fastslam2+rejuvenation": ":", BOUND: (0, (6, 1.5, 1, 1.5))}
Lines = Sequence[Mapping[str, Any]]


def draw_fig6(file: Path, lines: Lines) -> None:
    """Draw the figure into a PNG file: means over seeds with 95 % bootstrap intervals.

    Args:
        file: Where to write.
        lines: Of `paper_summary.summarise`.
    """
    timed = [line for line in lines if line["median_ms"] is not None]
    shown = [(name, [line for line in lines if line["regime"] == name and line["seeds"]]) for name in REGIMES]
    panels: list[tuple[str, str, Lines]] = [("time of a step [ms]", "median_ms", timed)] if timed else []
    panels += [("RMS error of the map [m]", "map_rmse_m", own) for _, own in shown if own]
    titles = ["time: as in the paper"] * bool(timed) + [f"error: {REGIMES[name].title}" for name, own in shown if own]
    columns = min(len(panels), 2)
    rows = -(-len(panels) // columns)
    with mpl.rc_context({"font.size": 9, "axes.titlesize": 9.5}):
        figure = Figure(figsize=(4.2 * columns, 3.1 * rows + 0.5), layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False).ravel()
        for letter, ax, title, (label, key, own) in zip("abcd", axes, titles, panels, strict=False):
            _draw_panel(ax, own, key)
            ax.set_title(f"({letter}) {title}", loc="left")
            ax.set(xlabel="particles M", ylabel=label)
        for ax in axes[len(panels) :]:
            ax.set_axis_off()
        robots = sorted({line["robots"] for line in lines})
        proposals = [name for name in STYLES if any(line["proposal"] == name for line in lines)]
        figure.legend(
            handles=_legend(robots, proposals), loc="outside lower center", ncols=len(robots) + len(proposals),
            frameon=False, columnspacing=1.2,
        )  # fmt: skip
        save_png(figure, file, 150)


def _draw_panel(ax: Axes, lines: Lines, key: str) -> None:
    """Draw a curve for each proposal and number of robots over M; the bound, which has no M, as a level."""
    robots = sorted({line["robots"] for line in lines})
    for line in lines:
        if line["proposal"] == BOUND and line[key] is not None:
            ax.axhline(line[key], color=_colour(line["robots"]), lw=0.9, ls=STYLES[BOUND])
    for proposal, k in sorted({(line["proposal"], line["robots"]) for line in lines if line["proposal"] != BOUND}):
        own = [line for line in lines if (line["proposal"], line["robots"]) == (proposal, k) and line[key] is not None]
        x, mean, low, high = _columns(own, key)
        x = x * 1.03 ** (robots.index(k) - 0.5 * (len(robots) - 1))  # so that intervals stand side by side
        ax.errorbar(
            x, mean, yerr=[np.maximum(mean - low, 0.0), np.maximum(high - mean, 0.0)], color=_colour(k), lw=1.1,
            marker=_marker(k), mfc="white", ms=4.5, capsize=1.5, elinewidth=0.8, ls=STYLES[proposal],
        )  # fmt: skip
    ax.set(xscale="log", yscale="log")
    ax.grid(color="0.92", which="both", lw=0.6)
    ax.spines[["top", "right"]].set_visible(False)
    for axis, subs in ((ax.xaxis, (1.0,)), (ax.yaxis, (1.0, 2.0, 3.0, 5.0))):
        axis.set_major_locator(LogLocator(subs=subs))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("")


def _columns(lines: Lines, key: str) -> FloatArray:
    """Return M, the mean and the ends of its interval, (4, n) in the order of M; a missing interval is the mean."""
    rows = []
    for line in sorted(lines, key=lambda line: int(line["particles"])):
        ends = (line[f"{key}_low"], line[f"{key}_high"])
        rows.append((line["particles"], line[key], *(line[key] if end is None else end for end in ends)))
    return np.array(rows, dtype=np.float64).reshape(-1, 4).T


def _legend(robots: Sequence[int], proposals: Sequence[str]) -> list[Line2D]:
    """Return what the curves mean."""
    handles = [
        Line2D([], [], color=_colour(k), marker=_marker(k), mfc="white", ms=4.5, label=f"K = {k}") for k in robots
    ]
    return handles + [
        Line2D([], [], color="0.4", ls=STYLES[name], label="batch ML" if name == BOUND else name) for name in proposals
    ]


def _marker(robots: int) -> str:
    """Return the marker of K robots."""
    return MARKERS[(robots - 1) % len(MARKERS)]


def _colour(robots: int) -> tuple[float, float, float]:
    """Return the colour of K robots."""
    r, g, b = robot_colour(robots - 1)
    return r / 255.0, g / 255.0, b / 255.0
