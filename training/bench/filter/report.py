"""Tables and figure of `vslam bench filter`."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from rich.console import Console
from rich.table import Table

from slam_backend.core.validation import FloatArray
from training.bench.filter.bench import STATE_LOAD
from training.experiments.plotting import picture, save_png
from training.experiments.tables import console_table
from training.experiments.timing import print_caveats

Row = Mapping[str, Any]
COLOURS = {"fastslam1": "#0072B2", "fastslam2": "#D55E00"}
COMMON = {"landmarks": 300, "measurements": 15, "robots": 1}
INK = "0.35"
AXES = (
    ("landmarks", "landmarks in the map, N", "B = 15, K = 1"), ("particles", "particles, M", "N = 300, B = 15, K = 1"),
    ("robots", "robots, K", "N = 300, B = 15 in all"),
)  # fmt: skip
LEGEND = [
    *(Line2D([], [], color=colour, marker="o", label=name) for name, colour in COLOURS.items()),
    Patch(color=INK, alpha=0.2, lw=0, label="10-90 % of the steps"),
]


def print_result(console: Console, result: Mapping[str, Any]) -> None:
    """Print the rows and the other results."""
    rows, machine, compilation = result["rows"], result["machine"], result["compilation"]
    for proposal in dict.fromkeys(row["proposal"] for row in rows):
        console.print(_table(rows, proposal))
    if rows:
        console.print(
            "Unknown association, resampling at every step, one thread. right: share of correctly "
            "associated measurements."
        )
    console.print(f"{machine['processor']}.")
    if rows:
        largest = max(rows, key=lambda row: row["particles"] * row["landmarks"])
        console.print(
            f"Memory: {largest['bytes_per_landmark']:.0f} bytes per particle and landmark; "
            f"{largest['nbytes'] / 1e6:.0f} MB for M={largest['particles']}, N={largest['landmarks']}."
        )
    if result["state"]:
        times = ", ".join(f"{name} {_ms(timing['median_ms'])} ms" for name, timing in result["state"].items())
        console.print(f"M={STATE_LOAD.particles}, N={STATE_LOAD.landmarks}: {times} (medians).")
    if compilation is not None:
        cold, cached = compilation["cold"], compilation["cached"]
        console.print(
            f"Kernels: compiled in {cold['compile_s']:.0f} s, once; loaded from the cache "
            f"({compilation['cache_bytes'] / 1e6:.1f} MB) in {cached['warm_up_s']:.1f} s; "
            f"import {cached['import_s']:.1f} s."
        )
    print_caveats(console, result)


def _table(rows: Sequence[Row], proposal: str) -> Table:
    """Return the table of one proposal's times, with a row for each number of particles, landmarks and measurements."""
    first, *more = sorted({row["robots"] for row in rows})
    headings = ("M", "N", "B", f"K={first}", "10-90 %", "min", *(f"K={k}" for k in more), "right")
    lines: dict[Any, dict[int, Row]] = {}
    for row in rows:
        if row["proposal"] == proposal:
            load = row["particles"], row["landmarks"], row["measurements"]
            lines.setdefault(load, {}).setdefault(row["robots"], row)
    cells = []
    for load, by_robots in lines.items():
        if first in by_robots:
            row = by_robots[first]
            others = (_ms(by_robots[k]["median_ms"]) if k in by_robots else "" for k in more)
            spread = f"{_ms(row['low_ms'])}-{_ms(row['high_ms'])}"
            times = _ms(row["median_ms"]), spread, _ms(row["min_ms"]), *others
            cells.append([*map(str, load), *times, f"{row['right']:.0%}"])
    return console_table(f"One step of {proposal}: median in ms", headings, cells)


def _ms(value: float) -> str:
    """Format milliseconds with three significant digits."""
    return f"{value:.3f}" if value < 1.0 else f"{value:.2f}" if value < 10.0 else f"{value:.1f}"


@picture
def draw_speed(file: Path, result: Mapping[str, Any]) -> None:
    """Draw the time of a step over N, M and K into a PNG file."""
    figure = Figure(figsize=(12.0, 5.0), layout="constrained")
    panels = figure.subplots(1, 3, sharey=True)
    for ax, (name, label, title) in zip(panels, AXES, strict=True):
        numbers = {key: value for key, value in COMMON.items() if key != name}
        rows = [row for row in result["rows"] if all(row[key] == value for key, value in numbers.items())]
        ax.set(xscale="linear" if name == "robots" else "log", yscale="log", xlabel=label, title=title)
        _draw_panel(ax, rows, name)
        shown = sorted({row[name] for row in rows})
        ax.set_xticks(shown, [f"{value:,}" for value in shown])
        ax.set_xticks([], minor=True)
        ax.margins(x=0.16)
        ax.grid(color="0.92")
        ax.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("time of a step [ms]")
    figure.legend(handles=LEGEND, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    save_png(figure, file, 120)


def _draw_panel(ax: Axes, rows: Sequence[Row], name: str) -> None:
    """Draw one line for each proposal, and for each number of particles unless it is the abscissa."""
    ways = sorted({(row["proposal"], 0 if name == "particles" else row["particles"]) for row in rows})
    longest = len({row[name] for row in rows})
    for proposal, particles in ways:
        line = [row for row in rows if row["proposal"] == proposal and particles in (0, row["particles"])]
        line.sort(key=lambda row: int(row[name]))
        if len(line) < longest:  # rows for another panel
            continue
        x, low, median, high = _columns(line, name)
        colour = COLOURS[proposal]
        ax.plot(x, median, color=colour, marker="o", ms=4)
        ax.fill_between(x, low, high, color=colour, alpha=0.15, lw=0)
        if particles:
            above = proposal == "fastslam2"  # slower, so that labels do not overlap
            ax.annotate(
                f"M={particles:,}", (x[-1], median[-1]), xytext=(5, 2 if above else -2), textcoords="offset points",
                fontsize=7, color=colour, va="bottom" if above else "top",
            )  # fmt: skip


def _columns(line: Sequence[Row], name: str) -> FloatArray:
    """Return the abscissa and the low, median and high times [ms] of a line, (4, n)."""
    return np.transpose([(row[name], row["low_ms"], row["median_ms"], row["high_ms"]) for row in line])
