"""Report of the accuracy benchmark: summary, tables, Markdown and a figure."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, LogLocator, NullFormatter, NullLocator, StrMethodFormatter
from rich.console import Console

from slam_backend.core.validation import FloatArray
from training.bench.accuracy.trials import FILTERS
from training.experiments.plotting import add_legend, picture, save_png
from training.experiments.statistics import grouped, interval
from training.experiments.tables import console_table, markdown_table, number

CONDITION = ("preset", "association", "robots", "length")
GROUP = (*CONDITION, "method", "particles")
FIGURES = (
    "pose_rms_m", "pose_aligned_rms_m", "heading_rms_deg", "map_rmse_m", "map_aligned_rmse_m", "map_recall",
    "map_precision", "confirmed_recall", "confirmed_precision", "nees_median", "nees_mean", "anees", "ess_share",
    "nis", "wrong_match_share", "held_back_share", "step_ms", "rejuvenation_ms",
    "refused_share",
)  # fmt: skip

NAMES = {
    "dead_reckoning": "dead reckoning", "batch_ml": "batch ML", "ideal_online": "ideal online",
    "fastslam1": "fastslam1", "fastslam2": "fastslam2", "fastslam2+existence": "with existence",
    "fastslam2+rejuvenation": "with rejuvenation",
}  # fmt: skip
# Columns of each table: heading, metric, statistic over seeds, factor, digits, whether its interval is shown.
PARTS: dict[str, tuple[tuple[str, str, str, float, int, bool], ...]] = {
    "paths": (
        ("pose [m]", "pose_rms_m", "mean", 1.0, 3, True), ("median", "pose_rms_m", "median", 1.0, 3, False),
        ("worst", "pose_rms_m", "worst", 1.0, 3, False), ("aligned", "pose_aligned_rms_m", "mean", 1.0, 3, False),
        ("heading [°]", "heading_rms_deg", "mean", 1.0, 2, False),
    ),
    "maps": (
        ("map [m]", "map_rmse_m", "mean", 1.0, 3, True), ("aligned", "map_aligned_rmse_m", "mean", 1.0, 3, False),
        ("recall", "map_recall", "mean", 100.0, 1, False), ("precision", "map_precision", "mean", 100.0, 1, False),
        ("if seen twice [%]", "confirmed_precision", "mean", 100.0, 1, False),
    ),
    "honesty": (
        ("ANEES", "anees", "mean", 1.0, 1, True), ("NEES mean", "nees_mean", "mean", 1.0, 1, False),
        ("median", "nees_median", "mean", 1.0, 1, False), ("NIS", "nis", "mean", 1.0, 2, False),
        ("ESS/M [%]", "ess_share", "mean", 100.0, 1, False),
    ),
    "matches and time": (
        ("wrong matches [%]", "wrong_match_share", "mean", 100.0, 2, False),
        ("neither matched nor new [%]", "held_back_share", "mean", 100.0, 2, False),
        ("step [ms]", "step_ms", "median", 1.0, 2, False),
        ("rejuvenation [ms]", "rejuvenation_ms", "median", 1.0, 1, False),
        ("refused [%]", "refused_share", "mean", 100.0, 1, False),
    ),
}  # fmt: skip
PANELS = (
    ("pose_rms_m", "online pose error, RMS [m]"), ("map_rmse_m", "map error, RMS [m]"), ("anees", "ANEES (ideal: 1)")
)  # fmt: skip
COLOURS = {
    "fastslam1": "#D55E00", "fastslam2": "#0072B2", "batch_ml": "#009E73", "ideal_online": "#CC79A7",
    "dead_reckoning": "#7f7f7f", "fastslam2+existence": "#56B4E9",
    "fastslam2+rejuvenation": "#E69F00",
}  # fmt: skip  # safe for colour-blind readers


def summarise(rows: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return one line per condition, method and M, in the order of first occurrence.

    Returns:
        The fields of `GROUP`, `seeds`, and for each of `FIGURES` a table with `mean`, `median` and their intervals
        `mean_low`, `mean_high`, `median_low`, `median_high` (95 %, percentile bootstrap over seeds; None for a single
        seed) and `worst`; or None if no seed has the metric.
    """
    lines = []
    for key, members in grouped(rows, GROUP).items():
        line: dict[str, Any] = dict(zip(GROUP, key, strict=True)) | {"seeds": len(members)}
        for figure in FIGURES:
            values = np.array([np.nan if row[figure] is None else row[figure] for row in members], dtype=np.float64)
            line[figure] = describe(values[np.isfinite(values)])
        lines.append(line)
    return lines


def describe(values: FloatArray) -> dict[str, float | None] | None:
    """Return mean, median, their bootstrap intervals and the maximum of values (n,); None if there are none.

    >>> describe(np.array([2.0]))["mean_low"] is None
    True
    """
    if not len(values):
        return None
    summary: dict[str, float | None] = {"worst": float(values.max())}
    for name, statistic in (("mean", np.mean), ("median", np.median)):
        summary[name] = float(statistic(values))
        summary[f"{name}_low"], summary[f"{name}_high"] = interval(values, statistic)
    return summary


def table_rows(lines: Sequence[Mapping[str, Any]], columns: Sequence[Any]) -> tuple[list[str], list[list[str]]]:
    """Return headings and text rows for the lines of one condition, without empty columns."""
    shown = [column for column in columns if any(line[column[1]] is not None for line in lines)]
    rows = []
    for line in lines:
        if any(line[column[1]] is not None for column in shown):
            name = NAMES[line["method"]] + (f", {line['particles']}" if line["particles"] else "")
            rows.append([name, *(_cell(line[figure], *rest) for _, figure, *rest in shown)])
    return ["method, M", *(column[0] for column in shown)], rows


def conditions(lines: Sequence[Mapping[str, Any]]) -> dict[str, list[Mapping[str, Any]]]:
    """Return the lines of each condition by its name, in the order of first occurrence."""
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for line in lines:
        preset, association, robots, length = (line[name] for name in CONDITION)
        title = f"{preset} stereo, {association} association, K = {robots}, {length:g} m"
        groups.setdefault(title, []).append(line)
    return groups


def print_tables(console: Console, lines: Sequence[Mapping[str, Any]]) -> None:
    """Print up to four tables for each condition."""
    for title, group in conditions(lines).items():
        seeds = max(line["seeds"] for line in group)
        for part, columns in PARTS.items():
            headings, rows = table_rows(group, columns)
            if rows:
                console.print(console_table(f"{title}, {seeds} seeds: {part}", headings, rows))


def markdown(lines: Sequence[Mapping[str, Any]]) -> str:
    """Return the same tables as Markdown."""
    parts = []
    for title, group in conditions(lines).items():
        parts.append(f"### {title[0].upper()}{title[1:]}, {max(line['seeds'] for line in group)} seeds\n")
        for columns in PARTS.values():
            headings, rows = table_rows(group, columns)
            if rows:
                parts.append(markdown_table(headings, rows))
    return "\n".join(parts)


def _cell(
    summary: Mapping[str, float | None] | None, statistic: str, factor: float, digits: int, with_interval: bool
) -> str:
    """Format a statistic, with its interval if requested; unknown values give a dash."""
    value = None if summary is None else summary[statistic]
    if summary is None or value is None:
        return "-"
    low, high = (None, None) if not with_interval else (summary[f"{statistic}_{end}"] for end in ("low", "high"))
    if low is None or high is None:
        return number(value, digits, factor)
    return f"{number(value, digits, factor)} ({number(low, digits, factor)}-{number(high, digits, factor)})"


@picture
def draw_accuracy(file: Path, lines: Sequence[Mapping[str, Any]]) -> None:
    """Draw one row of panels for each condition into a PNG file: means over seeds with 95 % bootstrap intervals."""
    groups = conditions(lines)
    with mpl.rc_context({"font.size": 9, "axes.titlesize": 9}):
        figure = Figure(figsize=(12.0, 3.6 * len(groups)), layout="constrained")
        axes = figure.subplots(len(groups), len(PANELS), squeeze=False)
        for row, (title, group) in zip(axes, groups.items(), strict=True):
            for panel, (key, label) in zip(row, PANELS, strict=True):
                _draw_panel(panel, group, key, label)
            row[0].set_title(title, loc="left")
        add_legend(figure, axes[0][0])
        save_png(figure, file, 110)


def _draw_panel(ax: Axes, lines: Sequence[Mapping[str, Any]], key: str, label: str) -> None:
    """Draw filters as curves over M, and methods without particles as level lines with their intervals."""
    for method in dict.fromkeys(line["method"] for line in lines):
        group = [line for line in lines if line["method"] == method and line[key] is not None]
        if not group:
            continue
        mean = np.array([line[key]["mean"] for line in group])
        ends = [[line[key][f"mean_{end}"] for line in group] for end in ("low", "high")]
        low, high = (np.where([v is None for v in e], mean, [v or 0.0 for v in e]) for e in ends)
        colour, name = COLOURS[method], NAMES[method]
        if method in FILTERS:
            particles = [line["particles"] for line in group]
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
    if top < 1e3 * bottom:  # otherwise powers of ten are easier to read
        ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        ax.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        ax.yaxis.set_minor_formatter(NullFormatter())
    ax.set_xlabel("particles M")
    ax.set_ylabel(label)
    ax.grid(alpha=0.2, which="both")
