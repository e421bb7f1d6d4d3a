"""The tables of the accuracy bench, on the console and as Markdown."""

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console

from training.bench.accuracy.summary import CONDITION
from training.experiments.tables import console_table, markdown_table, number

NAMES = {
    "dead_reckoning": "dead reckoning", "batch_ml": "batch ML", "ideal_online": "ideal online",
    "fastslam1": "fastslam1", "fastslam2": "fastslam2", "fastslam2+existence": "with existence",
    "fastslam2+rejuvenation": "with rejuvenation",
}  # fmt: skip
# Per table its columns: heading, figure, statistic over seeds, factor, digits, whether with its interval.
PARTS: dict[str, tuple[tuple[str, str, str, float, int, bool], ...]] = {
    "paths": (
        ("pose [m]", "pose_rms_m", "mean", 1.0, 3, True),
        ("median", "pose_rms_m", "median", 1.0, 3, False),
        ("worst", "pose_rms_m", "worst", 1.0, 3, False),
        ("aligned", "pose_aligned_rms_m", "mean", 1.0, 3, False),
        ("heading [°]", "heading_rms_deg", "mean", 1.0, 2, False),
    ),
    "maps": (
        ("map [m]", "map_rmse_m", "mean", 1.0, 3, True),
        ("aligned", "map_aligned_rmse_m", "mean", 1.0, 3, False),
        ("recall", "map_recall", "mean", 100.0, 1, False),
        ("precision", "map_precision", "mean", 100.0, 1, False),
        ("if seen twice [%]", "confirmed_precision", "mean", 100.0, 1, False),
    ),
    "honesty": (
        ("ANEES", "anees", "mean", 1.0, 1, True),
        ("NEES mean", "nees_mean", "mean", 1.0, 1, False),
        ("median", "nees_median", "mean", 1.0, 1, False),
        ("NIS", "nis", "mean", 1.0, 2, False),
        ("ESS/M [%]", "ess_share", "mean", 100.0, 1, False),
    ),
    "matches and time": (
        ("wrong matches [%]", "wrong_match_share", "mean", 100.0, 2, False),
        ("neither matched nor new [%]", "held_back_share", "mean", 100.0, 2, False),
        ("step [ms]", "step_ms", "median", 1.0, 2, False),
        ("rejuvenation [ms]", "rejuvenation_ms", "median", 1.0, 1, False),
        ("refused [%]", "refused_share", "mean", 100.0, 1, False),
    ),
}


def table_rows(lines: Sequence[Mapping[str, Any]], columns: Sequence[Any]) -> tuple[list[str], list[list[str]]]:
    """Return headings and rows of text for the lines of one condition; columns that nobody fills are left out."""
    shown = [column for column in columns if any(line[column[1]] is not None for line in lines)]
    rows = []
    for line in lines:
        if any(line[column[1]] is not None for column in shown):
            name = NAMES[line["method"]] + (f", {line['particles']}" if line["particles"] else "")
            rows.append([name, *(_cell(line[figure], *rest) for _, figure, *rest in shown)])
    return ["method, M", *(column[0] for column in shown)], rows


def conditions(lines: Sequence[Mapping[str, Any]]) -> dict[str, list[Mapping[str, Any]]]:
    """Return the lines of each condition under its name, in the order in which they come."""
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for line in lines:
        preset, association, robots, length = (line[name] for name in CONDITION)
        title = f"{preset} stereo, {association} association, K = {robots}, {length:g} m"
        groups.setdefault(title, []).append(line)
    return groups


def print_tables(console: Console, lines: Sequence[Mapping[str, Any]]) -> None:
    """Print up to four tables for each condition.

    Args:
        console: Where to.
        lines: Of `summarise`.
    """
    for title, own in conditions(lines).items():
        seeds = max(line["seeds"] for line in own)
        for part, columns in PARTS.items():
            headings, rows = table_rows(own, columns)
            if rows:
                console.print(console_table(f"{title}, {seeds} seeds: {part}", headings, rows))


def markdown(lines: Sequence[Mapping[str, Any]]) -> str:
    """Return the same tables as Markdown."""
    parts = []
    for title, own in conditions(lines).items():
        parts.append(f"### {title[0].upper()}{title[1:]}, {max(line['seeds'] for line in own)} seeds\n")
        for columns in PARTS.values():
            headings, rows = table_rows(own, columns)
            if rows:
                parts.append(markdown_table(headings, rows))
    return "\n".join(parts)


def _cell(
    found: Mapping[str, float | None] | None, statistic: str, factor: float, digits: int, with_interval: bool
) -> str:
    """Show a statistic, with its interval if asked for, and what is not known as a dash."""
    value = None if found is None else found[statistic]
    if found is None or value is None:
        return "-"
    low, high = (None, None) if not with_interval else (found[f"{statistic}_{end}"] for end in ("low", "high"))
    if low is None or high is None:
        return number(value, digits, factor)
    return f"{number(value, digits, factor)} ({number(low, digits, factor)}-{number(high, digits, factor)})"
