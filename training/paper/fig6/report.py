"""Tables and figure of `vslam paper fig6`."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator
from rich.console import Console
from rich.text import Text

from slam_backend.core.validation import FloatArray
from training.experiments.plotting import picture, rgb, save_png
from training.experiments.tables import console_table, number
from training.paper.fig6.claims import Claim
from training.paper.fig6.trials import BOUND, REGIMES
from vslam_env.rendering.palette import robot_colour

MARKERS = ("o", "s", "^")  # markers of one, two and three robots, as in the paper
STYLES = {"fastslam1": "-", "fastslam2": "--", "fastslam2+rejuvenation": ":", BOUND: (0, (6, 1.5, 1, 1.5))}
Lines = Sequence[Mapping[str, Any]]


def print_result(
    console: Console, lines: Sequence[Mapping[str, Any]], ratios: Sequence[Mapping[str, Any]], claims: Sequence[Claim]
) -> None:
    """Print a table for each regime and proposal, one of the ratios, and the results of the claims."""
    for regime, proposal in dict.fromkeys((line["regime"], line["proposal"]) for line in lines):
        points = [line for line in lines if (line["regime"], line["proposal"]) == (regime, proposal)]
        _print_points(console, f"{REGIMES[regime].title}, {proposal}", points)
    if ratios:
        few, many = ratios[0]["robots"]
        table = console_table(f"Map error, K={many} over K={few} (95 %)", ("regime", "M", "not aligned", "aligned"))
        for row in ratios:
            name = f"{REGIMES[row['regime']].title}, {row['proposal']}"
            table.add_row(name, str(row["particles"] or "-"), *(_interval(row[key]) for key in ("raw", "aligned")))
        console.print(table)
    if claims:
        table = console_table("The paper's claims", ("claim", "ratio (95 %)", ""))
        for claim in claims:
            verdict = "holds" if claim.holds else Text("does not hold", "red")
            table.add_row(claim.claim, _interval(claim.to_mapping()), verdict)
        console.print(table)


def _print_points(console: Console, title: str, lines: Sequence[Mapping[str, Any]]) -> None:
    """Print map error and time, with a row for each M and a column for each K."""
    robots = sorted({line["robots"] for line in lines})
    parts = [("map error [m]", "map_rmse_m", 3, 1)] + [("step [ms]", "median_ms", 3, 0)] * any(
        line["median_ms"] is not None for line in lines
    )
    table = console_table(f"{title}, {max(line['seeds'] for line in lines)} seeds", ("M",))
    for name, *_ in parts:
        for k in robots:
            table.add_column(f"{name}\nK={k}", justify="right")
    for m in dict.fromkeys(line["particles"] for line in lines):
        of_robots = {line["robots"]: line for line in lines if line["particles"] == m}
        cells = [
            _cell(of_robots.get(k), figure, digits, bool(wide)) for _, figure, digits, wide in parts for k in robots
        ]
        table.add_row(str(m or "-"), *cells)
    console.print(table)


def _cell(line: Mapping[str, Any] | None, figure: str, digits: int, with_interval: bool) -> str:
    """Format a mean, with its interval if requested; unknown values give a dash."""
    if line is None:
        return "-"
    low, high = line[f"{figure}_low"], line[f"{figure}_high"]
    ends = f"\n{number(low, digits)}-{number(high, digits)}" if with_interval and low is not None else ""
    return number(line[figure], digits) + ends


def _interval(ratio: Mapping[str, Any]) -> str:
    """Format a ratio with its interval."""
    ends = "" if ratio["low"] is None else f" ({number(ratio['low'])}-{number(ratio['high'])})"
    return number(ratio["ratio"]) + ends


@picture
def draw_fig6(file: Path, lines: Lines) -> None:
    """Draw the figure into a PNG file: means over seeds with 95 % bootstrap intervals."""
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
    """Draw a curve over M for each proposal and number of robots, and the bound, which has no M, as a level line."""
    robots = sorted({line["robots"] for line in lines})
    for line in lines:
        if line["proposal"] == BOUND and line[key] is not None:
            ax.axhline(line[key], color=rgb(robot_colour(line["robots"] - 1)), lw=0.9, ls=STYLES[BOUND])
    for proposal, k in sorted({(line["proposal"], line["robots"]) for line in lines if line["proposal"] != BOUND}):
        own = [line for line in lines if (line["proposal"], line["robots"]) == (proposal, k) and line[key] is not None]
        x, mean, low, high = _columns(own, key)
        x = x * 1.03 ** (robots.index(k) - 0.5 * (len(robots) - 1))  # shifts the intervals side by side
        ax.errorbar(
            x, mean, yerr=[np.maximum(mean - low, 0.0), np.maximum(high - mean, 0.0)], lw=1.1,
            color=rgb(robot_colour(k - 1)), marker=_marker(k), mfc="white", ms=4.5, capsize=1.5, elinewidth=0.8,
            ls=STYLES[proposal],
        )  # fmt: skip
    ax.set(xscale="log", yscale="log")
    ax.grid(color="0.92", which="both", lw=0.6)
    ax.spines[["top", "right"]].set_visible(False)
    for axis, subs in ((ax.xaxis, (1.0,)), (ax.yaxis, (1.0, 2.0, 3.0, 5.0))):
        axis.set_major_locator(LogLocator(subs=subs))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("")


def _columns(lines: Lines, key: str) -> FloatArray:
    """Return M, the mean and the ends of its interval, (4, n), sorted by M; a missing interval equals the mean."""
    rows = []
    for line in sorted(lines, key=lambda line: int(line["particles"])):
        ends = (line[f"{key}_low"], line[f"{key}_high"])
        rows.append((line["particles"], line[key], *(line[key] if end is None else end for end in ends)))
    return np.array(rows, dtype=np.float64).reshape(-1, 4).T


def _legend(robots: Sequence[int], proposals: Sequence[str]) -> list[Line2D]:
    """Return the entries of the legend."""
    handles = [
        Line2D([], [], color=rgb(robot_colour(k - 1)), marker=_marker(k), mfc="white", ms=4.5, label=f"K = {k}")
        for k in robots
    ]
    return handles + [
        Line2D([], [], color="0.4", ls=STYLES[name], label="batch ML" if name == BOUND else name) for name in proposals
    ]


def _marker(robots: int) -> str:
    """Return the marker for K robots."""
    return MARKERS[(robots - 1) % len(MARKERS)]
