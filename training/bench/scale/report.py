"""Report of `vslam bench scale`: means over seeds as tables, CSV and a figure."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.console import Console

from training.bench.exploration.report import COLOURS, STYLES, Column
from training.bench.exploration.trials import TEAM
from training.bench.scale.trials import CURVES
from training.experiments.plotting import picture, save_png
from training.experiments.statistics import grouped, mean_curves, summarise_means
from training.experiments.tables import console_table, markdown_table

Rows = Sequence[Mapping[str, Any]]
CONDITION = ("family", "extent", "robots")
FIGURES = (
    "steps_per_s", "median_ms", "late_ms", "p99_ms", "longest_ms", "reset_s", "get_state_ms", "set_state_ms",
    "snapshot_mb", "memory_mb", "coverage", "mean_coverage", "pose_error", "landmarks", *TEAM, "right_merges",
    "false_merges", "undone_merges", "first_merge_s", "last_merge_s", "attempts", "one_group", "sharing_pairs",
    "merged_pairs",
)  # fmt: skip
SPEED = (
    Column("steps/s", "steps_per_s", 1), Column("median [ms]", "median_ms", 1),
    Column("last quarter [ms]", "late_ms", 1), Column("99 % [ms]", "p99_ms", 0),
    Column("longest [ms]", "longest_ms", 0), Column("get_state [ms]", "get_state_ms", 1),
    Column("set_state [ms]", "set_state_ms", 1), Column("snapshot [MB]", "snapshot_mb", 1),
    Column("memory [MB]", "memory_mb", 0), Column("reset [s]", "reset_s", 1),
)  # fmt: skip
RESULTS = (
    Column("coverage [%]", "coverage", 1, 100.0, True), Column("landmarks", "landmarks", 0),
    Column("pose [m]", "pose_error", 2, 1.0, True), Column("E [m]", "map_error", 2, 1.0, True),
    Column("RMSE [m]", "map_rmse_m", 2), Column("recall [%]", "map_recall", 1, 100.0),
    Column("right", "right_merges", 1), Column("false", "false_merges", 1), Column("undone", "undone_merges", 1),
    Column("pairs to merge", "sharing_pairs", 1), Column("merged", "merged_pairs", 1),
)  # fmt: skip
IN_SHORT = (SPEED[1], SPEED[4], SPEED[5], SPEED[8], Column("seen [%]", "coverage", 1, 100.0), RESULTS[2], RESULTS[6])
OVER_TIME = {"coverage": ("coverage [%]", 100.0), "step_ms": ("median step [ms]", 1.0)}
OVER_EXTENT = {
    "longest_ms": ("longest step [ms]", 1.0), "get_state_ms": ("get_state [ms]", 1.0),
    "snapshot_mb": ("snapshot [MB]", 1.0), "pose_error": ("pose error [m]", 1.0),
}  # fmt: skip


def summarise(rows: Rows) -> list[dict[str, Any]]:
    """Return a line for each of `CONDITION`: its number of seeds and the means of `FIGURES`."""
    return summarise_means(rows, CONDITION, FIGURES)


def curves(rows: Rows) -> list[dict[str, Any]]:
    """Return a row for each of `CONDITION` and time: means of `CURVES` over seeds, with intervals."""
    return mean_curves(rows, CONDITION, CURVES)


def _label(line: Mapping[str, Any]) -> str:
    """Return the label of a combination."""
    return f"{line['extent']:g} m, K={line['robots']}"


def print_tables(console: Console, lines: Rows) -> None:
    """Print the main metrics within 80 columns."""
    rows = [[_label(line), *(column.cell(line, True) for column in IN_SHORT)] for line in lines]
    headings = [column.heading.replace(" [", "\n[") for column in IN_SHORT]
    title = f"{lines[0]['family']}, seeds: {lines[0]['seeds']}" if lines else "no episodes"
    console.print(console_table(title, ["world", *headings], rows))


def markdown(lines: Rows) -> str:
    """Return all metrics as Markdown."""
    parts = []
    for title, columns in (("cost", SPEED), ("results", RESULTS)):
        rows = [[_label(line), *(column.cell(line) for column in columns)] for line in lines]
        parts.append(markdown_table([title, *(column.heading for column in columns)], rows))
    return "\n".join(parts)


@picture
def draw_scale(file: Path, lines: Rows, over_time: Rows) -> None:
    """Draw coverage and steps over time, and costs and errors over the extent, into a PNG file."""
    figure = Figure(figsize=(12.0, 6.0), layout="constrained")
    panels = figure.subplots(2, 3).ravel()
    extents, robots = (list(dict.fromkeys(line[name] for line in lines)) for name in ("extent", "robots"))
    colours = {extent: COLOURS[i % len(COLOURS)] for i, extent in enumerate(extents)}
    styles = {count: STYLES[i % len(STYLES)] for i, count in enumerate(robots)}
    for panel, (name, (text, factor)) in zip(panels, OVER_TIME.items(), strict=False):
        for (extent, count), group in grouped(over_time, ("extent", "robots")).items():
            times = [line["time_s"] for line in group]
            values = [np.nan if line[name] is None else factor * line[name] for line in group]
            panel.plot(times, values, color=colours[extent], linestyle=styles[count], label=_label(group[0]))
        _finish(panel, "time [s]", text)
    for panel, (name, (text, factor)) in zip(panels[len(OVER_TIME) :], OVER_EXTENT.items(), strict=True):
        for (count,), group in grouped(lines, ("robots",)).items():
            values = [factor * line[name] for line in group]
            panel.plot([line["extent"] for line in group], values, "o", linestyle=styles[count], color="#444444")
        _finish(panel, "extent [m]", text)
    handles, names = panels[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper center", ncols=6, frameon=False, fontsize=8)
    save_png(figure, file, 100)


def _finish(panel: Axes, across: str, up: str) -> None:
    """Label the axes of a panel."""
    panel.set_xlabel(across)
    panel.set_ylabel(up)
    panel.set_ylim(bottom=0.0)
    panel.grid(alpha=0.2)
    panel.spines[["top", "right"]].set_visible(False)
