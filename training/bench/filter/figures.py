"""The picture of the filter's speed: against the landmarks, the particles and the robots."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from slam_backend.core.validation import FloatArray
from training.bench.filter.bench import BenchResult
from training.bench.filter.trials import Row
from training.experiments.plotting import save_png

COLOURS = {"fastslam1": "#0072B2", "fastslam2": "#D55E00"}
COMMON = {"landmarks": 300, "measurements": 15, "robots": 1}
INK = "0.35"
AXES = (
    ("landmarks", "landmarks in the map, N", "B = 15, K = 1"),
    ("particles", "particles, M", "N = 300, B = 15, K = 1"),
    ("robots", "robots, K", "N = 300, B = 15 in all"),
)
LEGEND = [
    *(Line2D([], [], color=colour, marker="o", label=name) for name, colour in COLOURS.items()),
    Patch(color=INK, alpha=0.2, lw=0, label="10-90 % of the steps"),
]


def draw_speed(file: Path, result: BenchResult) -> None:
    """Draw the time of a step against N, M and K into a PNG file."""
    figure = Figure(figsize=(12.0, 5.0), layout="constrained")
    panels = figure.subplots(1, 3, sharey=True)
    for ax, (name, label, title) in zip(panels, AXES, strict=True):
        numbers = {key: value for key, value in COMMON.items() if key != name}
        rows = [row for row in result.rows if all(getattr(row.load, key) == value for key, value in numbers.items())]
        ax.set(xscale="linear" if name == "robots" else "log", yscale="log", xlabel=label, title=title)
        _draw_panel(ax, rows, name)
        shown = sorted({getattr(row.load, name) for row in rows})
        ax.set_xticks(shown, [f"{value:,}" for value in shown])
        ax.set_xticks([], minor=True)
        ax.margins(x=0.16)
        ax.grid(color="0.92")
        ax.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("time of a step [ms]")
    figure.legend(handles=LEGEND, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    save_png(figure, file, 120)


def _draw_panel(ax: Axes, rows: Sequence[Row], name: str) -> None:
    """Draw one line for each proposal, and for each number of particles unless these are the abscissa."""
    ways = sorted({(str(row.load.proposal), 0 if name == "particles" else row.load.particles) for row in rows})
    longest = len({getattr(row.load, name) for row in rows})
    for proposal, particles in ways:
        line = [row for row in rows if row.load.proposal == proposal and particles in (0, row.load.particles)]
        line.sort(key=lambda row: int(getattr(row.load, name)))
        if len(line) < longest:  # rows that were timed for another panel
            continue
        x, low, median, high = _columns(line, name)
        colour = COLOURS[proposal]
        ax.plot(x, median, color=colour, marker="o", ms=4)
        ax.fill_between(x, low, high, color=colour, alpha=0.15, lw=0)
        if particles:
            above = proposal == "fastslam2"  # the slower one, so that labels keep apart
            ax.annotate(
                f"M={particles:,}", (x[-1], median[-1]), xytext=(5, 2 if above else -2), textcoords="offset points",
                fontsize=7, color=colour, va="bottom" if above else "top",
            )  # fmt: skip


def _columns(line: Sequence[Row], name: str) -> FloatArray:
    """Return the abscissa and the low, median and high time [ms] of a line, (4, n)."""
    return np.transpose(
        [(getattr(row.load, name), row.timing.low_ms, row.timing.median_ms, row.timing.high_ms) for row in line]
    )
