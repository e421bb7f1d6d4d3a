"""Whether filters err as little as they claim: for `metrics.json`, and as a table."""

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rich.console import Console

from training.experiments.tables import console_table, number

if TYPE_CHECKING:  # what computes is imported when the command runs, so that --help answers at once
    from slam_backend.fastslam.consistency import Consistency

COLUMNS = ("robot", "mean NIS", "NIS beyond 95 %", "few particles", "mostly rejected", "verdict")
CAUTIOUS = 1.0  # mean NIS below which covariances are at least twice as large as they need be, even in the plane


def consistency_rows(robots: Iterable[int], reports: Iterable["Consistency"]) -> list[dict[str, Any]]:
    """Return the entry `consistency` of `metrics.json`, one row for each robot, under these numbers."""
    return [{"robot": robot} | report.to_mapping() for robot, report in zip(robots, reports, strict=True)]


def print_consistency(console: Console, rows: Sequence[Mapping[str, Any]]) -> None:
    """Print what `consistency_rows` gave, NaN as None; each warning in words, once."""
    cells = []
    for row in rows:
        shares = (f"{100.0 * row[key]:.1f} %" for key in ("nis_share", "ess_share", "rejected_share"))
        cells.append([str(row["robot"]), number(row["nis_mean"]), *shares, _verdict(row)])
    title = "Consistency: do filters err as little as they claim? (shares of frames)"
    console.print(console_table(title, COLUMNS, cells))
    texts: dict[str, list[str]] = {}
    for row in rows:
        for warning in row["warnings"]:
            texts.setdefault(warning["text"], []).append(str(row["robot"]))
    for text, robots in texts.items():
        console.print(f"Warning, robot {', '.join(robots)}: {text}", highlight=False)


def _verdict(row: Mapping[str, Any]) -> str:
    """Return what the row comes to, in a word or two."""
    if row["warnings"]:
        return "inconsistent"
    is_cautious = row["nis_mean"] is not None and row["nis_mean"] < CAUTIOUS
    return "cautious" if is_cautious else "no objection"
