"""The figure of the accuracy bench: pose error, map error and ANEES against the number of particles."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, LogLocator, NullFormatter, NullLocator, StrMethodFormatter

from training.bench.accuracy.tables import NAMES, conditions
from training.bench.accuracy.trials import FILTERS
from training.experiments.plotting import save_png

PANELS = (
    ("pose_rms_m", "online pose error, RMS [m]"), ("map_rmse_m", "map error, RMS [m]"), ("anees", "ANEES (ideal: 1)")
)  # fmt: skip
COLOURS = {
    "fastslam1": "#D55E00", "fastslam2": "#0072B2", "batch_ml": "#009E73", "ideal_online": "#CC79A7",
    "dead_reckoning": "#7f7f7f", "fastslam2+existence": "#56B4E9",
    "fastslam2+rejuvenation": "#E69F00",
}  # fmt: skip  # told apart by colour-blind eyes too


def draw_accuracy(file: Path, lines: Sequence[Mapping[str, Any]]) -> None:
    """Draw one row of panels for each condition into a PNG file: means over seeds with 95 % bootstrap intervals.

    Args:
        file: Where to write.
        lines: Of `summarise`.
    """
    groups = conditions(lines)
    with mpl.rc_context({"font.size": 9, "axes.titlesize": 9}):
        figure = Figure(figsize=(12.0, 3.6 * len(groups)), layout="constrained")
        axes = figure.subplots(len(groups), len(PANELS), squeeze=False)
        for row, (title, own) in zip(axes, groups.items(), strict=True):
            for panel, (key, label) in zip(row, PANELS, strict=True):
                _draw_panel(panel, own, key, label)
            row[0].set_title(title, loc="left")
        handles, labels = axes[0][0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False)
        save_png(figure, file, 110)


def _draw_panel(ax: Axes, lines: Sequence[Mapping[str, Any]], key: str, label: str) -> None:
    """Draw the filters as curves over M, what has no particles as level lines with their intervals."""
    for method in dict.fromkeys(line["method"] for line in lines):
        own = [line for line in lines if line["method"] == method and line[key] is not None]
        if not own:
            continue
        mean = np.array([line[key]["mean"] for line in own])
        ends = [[line[key][f"mean_{end}"] for line in own] for end in ("low", "high")]
        low, high = (np.where([v is None for v in e], mean, [v or 0.0 for v in e]) for e in ends)
        colour, name = COLOURS[method], NAMES[method]
        if method in FILTERS:
            particles = [line["particles"] for line in own]
            ax.errorbar(
                particles, mean, yerr=[np.maximum(mean - low, 0.0), np.maximum(high - mean, 0.0)], marker="o", ms=3.5,
                lw=1.2, capsize=2.5, color=colour, label=name,
            )  # fmt: skip
        else:
            ax.axhline(mean[0], color=colour, lw=1.0, ls="--", label=name)
            ax.axhspan(low[0], high[0], color=colour, alpha=0.12, lw=0)
    ax.set_xscale("log")
    ax.set_yscale("log")
    ticks = sorted({line["particles"] for line in lines if line["method"] in FILTERS})
    ax.xaxis.set_major_locator(FixedLocator(ticks))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    bottom, top = ax.get_ylim()
    if top < 1e3 * bottom:  # else powers of ten are easier to read
        ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        ax.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        ax.yaxis.set_minor_formatter(NullFormatter())
    ax.set_xlabel("particles M")
    ax.set_ylabel(label)
    ax.grid(alpha=0.2, which="both")
