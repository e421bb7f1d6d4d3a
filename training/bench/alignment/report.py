"""Report of `vslam bench alignment`: summary, tables, Markdown and a figure."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter
from rich.console import Console
from scipy.stats import chi2

from training.experiments.plotting import add_legend, picture, save_png
from training.experiments.statistics import CONFIDENCE, grouped
from training.experiments.tables import console_table, number, titled_markdown

CELL = ("kind", "case", "overlap", "outliers", "method")

TITLES = {
    "grid": "200 landmarks in each map, 5 cm noise, by share of common landmarks and of wrong similar pairs",
    "U": "Maps that must not be aligned",
    "I": "Maps that can barely be aligned: 12 to 40 true pairs, spread over 2 m to 15 m",
}
HEADINGS = {
    "grid": ("common", "wrong", "method", "right [%]", "translation/bound", "rotation/bound", "ANEES", "ms", "95 %"),
    "U": ("case", "method", "accepted", "refused for", "ms", "95 %"),
    "I": ("case", "method", "accepted [%]", "false", "worst [m]", "worst [°]", "ANEES", "refused for", "ms"),
}
# Safe for colour-blind readers
COLOURS = {
    "ransac": "#0072B2", "impicp": "#E69F00", "icp": "#D55E00", "svd": "#7f7f7f",
}  # fmt: skip
MARKERS = {"ransac": "o", "impicp": "D", "icp": "v", "svd": "x"}
PANELS = (
    ("right", "share right [%]"), ("translation", "translation error / bound"), ("rotation", "rotation error / bound"),
    ("median_ms", "computing time, median [ms]"),
)  # fmt: skip


def summarise(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return a line for each cell and method, in the order of first occurrence, and for each kind and method in total.

    Returns:
        Lines of `CELL` (None if pooled), `trials`, `accepted`, `right` (accepted and not false), `false`,
        `reasons` (counts), `translation` and `rotation` (RMS error over the root of the mean Cramer-Rao bound,
        accepted trials), `anees` with its 95 % range `anees_low` to `anees_high` for consistent covariances,
        `worst_m`, `worst_deg`; processor times `median_ms`, `p95_ms`, `max_ms`, and `passed_ms`, the median
        wall-clock time, which other processes lengthen.
    """
    cells = grouped(rows, CELL)
    for (kind, method), group in grouped(rows, ("kind", "method")).items():
        cells[kind, None, None, None, method] = group
    return [dict(zip(CELL, cell, strict=True)) | _describe(group) for cell, group in cells.items()]


def _describe(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the metrics of one line."""
    found = [row for row in rows if "error_m" in row]
    milliseconds = 1e3 * np.array([row["cpu_seconds"] for row in rows])
    line: dict[str, Any] = {
        "trials": len(rows), "accepted": sum(row["success"] for row in rows) / len(rows),
        "right": sum(row["success"] and not row["false"] for row in rows) / len(rows),
        "false": sum(row["false"] for row in rows),
        "reasons": dict(Counter(row["reason"] for row in rows if row["reason"]).most_common()),
        "median_ms": float(np.median(milliseconds)), "p95_ms": float(np.quantile(milliseconds, 0.95)),
        "max_ms": float(milliseconds.max()), "passed_ms": 1e3 * float(np.median([row["seconds"] for row in rows])),
    }  # fmt: skip
    figures = ("translation", "rotation", "anees", "anees_low", "anees_high", "worst_m", "worst_deg")
    line |= dict.fromkeys(figures)
    if found:
        column = {name: np.array([row[name] for row in found]) for name in ("error_m", "error_rad", "nees")}
        dof = 3 * len(found)
        low, high = (float(chi2.ppf(0.5 + 0.5 * side * CONFIDENCE, dof)) / dof for side in (-1.0, 1.0))
        line |= {
            "translation": _over_bound(column["error_m"], [row["bound_m2"] for row in found]),
            "rotation": _over_bound(column["error_rad"], [row["bound_rad2"] for row in found]),
            "anees": float(column["nees"].mean() / 3.0), "anees_low": low, "anees_high": high,
            "worst_m": float(column["error_m"].max()), "worst_deg": float(np.rad2deg(column["error_rad"].max())),
        }  # fmt: skip
    return line


def _over_bound(errors: Any, bounds: Sequence[float]) -> float:
    """Return the RMS error over the root of the mean bound."""
    return float(np.sqrt((np.asarray(errors) ** 2).mean() / np.mean(bounds)))


def table_rows(kind: str, lines: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Return the text rows of the table of one kind."""
    return [_cells(kind, line) for line in lines if line["kind"] == kind]


def print_tables(console: Console, lines: Sequence[Mapping[str, Any]]) -> None:
    """Print the results of each kind of trial."""
    for kind, title in TITLES.items():
        if rows := table_rows(kind, lines):
            console.print(console_table(title, HEADINGS[kind], rows))


def markdown(lines: Sequence[Mapping[str, Any]]) -> str:
    """Return the same tables as Markdown."""
    parts = (titled_markdown(title, HEADINGS[kind], table_rows(kind, lines)) for kind, title in TITLES.items())
    return "\n".join(part for part in parts if part)


def _cells(kind: str, line: Mapping[str, Any]) -> list[str]:
    """Return one row as text."""
    refused = ", ".join(f"{reason} {count}" for reason, count in line["reasons"].items())
    anees = number(line["anees"], 2)
    if kind == "grid":
        pooled = line["overlap"] is None
        cell = ["all", "all"] if pooled else [f"{100 * line['overlap']:.0f} %", f"{100 * line['outliers']:.0f} %"]
        over = [number(line[name], 2) for name in ("translation", "rotation")]
        return [*cell, line["method"], f"{100 * line['right']:.1f}", *over, anees, *_times(line)]
    case = line["case"] or "all"
    if kind == "U":
        accepted = f"{round(line['accepted'] * line['trials'])} of {line['trials']}"
        return [case, line["method"], accepted, refused, *_times(line)]
    worst = [number(line[name], 2) for name in ("worst_m", "worst_deg")]
    accepted = f"{100 * line['accepted']:.1f}"
    return [case, line["method"], accepted, str(line["false"]), *worst, anees, refused, _times(line)[0]]


def _times(line: Mapping[str, Any]) -> list[str]:
    """Return the median and the 95 % quantile of the time."""
    return [f"{line['median_ms']:.1f}", f"{line['p95_ms']:.1f}"]


@picture
def draw_alignment(file: Path, lines: Sequence[Mapping[str, Any]]) -> None:
    """Draw a row of panels for each share of common landmarks into a PNG file."""
    grid = [line for line in lines if line["kind"] == "grid" and line["overlap"] is not None]
    overlaps = [o for o in dict.fromkeys(line["overlap"] for line in grid) if o < 1.0]
    if not overlaps:
        return
    with mpl.rc_context({"font.size": 9, "axes.titlesize": 9}):
        figure = Figure(figsize=(12.0, 2.7 * len(overlaps) + 0.4), layout="constrained")
        axes = figure.subplots(len(overlaps), len(PANELS), squeeze=False, sharex=True)
        for row, overlap in zip(axes, overlaps, strict=True):
            for panel, (key, label) in zip(row, PANELS, strict=True):
                _draw_panel(panel, [line for line in grid if line["overlap"] == overlap], key)
                panel.set_ylabel(label)
            row[0].set_title(f"{200 * overlap:.0f} of 200 landmarks in common", loc="left")
        for panel in axes[-1]:
            panel.set_xlabel("wrong similar pairs [%]")
        add_legend(figure, axes[0][0])
        save_png(figure, file, 110)


def _draw_panel(ax: Axes, lines: Sequence[Mapping[str, Any]], key: str) -> None:
    """Draw one metric of all methods over the share of outliers; a method without success has no curve."""
    for method in dict.fromkeys(line["method"] for line in lines):
        chosen = [line for line in lines if line["method"] == method and line[key] is not None]
        factor = 100.0 if key == "right" else 1.0
        ax.plot(
            [100.0 * line["outliers"] for line in chosen], [factor * line[key] for line in chosen],
            marker=MARKERS[method], ms=5, mfc="none", lw=1.2, color=COLOURS[method], label=method,
        )  # fmt: skip
    if key == "right":
        ax.set_ylim(-5.0, 105.0)
    elif key == "median_ms":
        ax.set_yscale("log")
        ax.axhline(5.0, color="0.5", lw=0.8, ls=":")
        ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        ax.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        ax.yaxis.set_minor_formatter(NullFormatter())
    else:
        ax.axhline(1.1, color="0.5", lw=0.8, ls=":")
        ax.set_ylim(0.8, 1.3)
    ax.set_xlim(-5.0, 95.0)
    ax.grid(alpha=0.2, which="both")
