"""The tables that a run ends with."""

from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.table import Table

from training.episodes.attempt_tables import print_refusals
from training.experiments.tables import console_table, number

ROWS = (
    ("map error E [m], errors cut at 1 m", "map_error", 3, 1.0),
    ("map RMSE of matched landmarks [m]", "map_rmse_m", 3, 1.0),
    ("recall [%]", "map_recall", 1, 100.0),
    ("precision [%]", "map_precision", 1, 100.0),
    ("ATE, aligned [m]", "ate_aligned_m", 3, 1.0),
    ("   odometry's [m]", "dead_reckoning_ate_aligned_m", 3, 1.0),
    ("ATE, start frame [m]", "ate_start_m", 3, 1.0),
    ("   odometry's [m]", "dead_reckoning_ate_start_m", 3, 1.0),
    ("path [m]", "path_m", 1, 1.0),
    ("odometry's last error [% of path]", "dead_reckoning_end_percent", 1, 1.0),
)


def print_tables(console: Console, metrics: Mapping[str, Any]) -> None:
    """Print robots and team, then the merges.

    Args:
        console: Where to.
        metrics: As `score_episode` names them; None stands for what is not known.
    """
    columns = {f"robot {robot}": row for robot, row in enumerate(metrics["robots"])} | {"team": metrics["team"]}
    rows = [
        [label, *(number(row[key], digits, factor) for row in columns.values())] for label, key, digits, factor in ROWS
    ]
    console.print(console_table("Maps and paths, each robot in its own start frame", ("", *columns), rows))
    if metrics["merges"]:
        console.print(_merges(metrics["merges"]))
    else:
        console.print("No merge.")
    print_refusals(console, metrics["refusals"])
    groups = "; ".join(", ".join(map(str, group)) for group in metrics["groups"])
    console.print(
        f"Groups at the end: {groups}.  Floor seen: {metrics['coverage']:.1%} in {metrics['duration_s']:.0f} s.  "
        f"Alignments tried: {metrics['attempts']}.",
        highlight=False,
    )


def _merges(rows: list[Mapping[str, Any]]) -> Table:
    """Return the table of merges."""
    headings = ("time [s]", "robots", "with", "landmarks", "off by [m]", "off by [deg]", "verdict")
    cells = []
    for row in rows:
        sides = [", ".join(map(str, row[side])) for side in ("robots_a", "robots_b")]
        errors = f"{row['error_m']:.3f}", f"{row['error_deg']:.2f}"
        verdict = "false" if row["false"] else ""
        if row["undone_s"] is not None:
            verdict += f"{', ' if verdict else ''}undone at {row['undone_s']:.1f} s"
        cells.append([f"{row['time_s']:.1f}", *sides, str(row["landmarks"]), *errors, verdict])
    return console_table("Merges, against the true motion between the start poses", headings, cells)
