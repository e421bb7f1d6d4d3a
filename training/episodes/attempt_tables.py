"""Why maps were not merged: rows for `metrics.json`, and the table and hints that a run or a replay ends with."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rich.console import Console

from training.experiments.tables import console_table

if TYPE_CHECKING:  # what computes is imported when the command runs, so that --help answers at once
    from slam_backend.maps.alignment_types import PairAttempts

MISSED = {
    "translation": "The standard deviation of the translation was beyond its bound.",
    "rotation": "The standard deviation of the rotation was beyond its bound.",
    "one match": "Leaving one match out would have moved the result by more than its bound.",
    "paths": "The robots' paths from their starts left the motion between these open by more than its bound.",
    "repeat": "Two trials in a row found motions that differ by more than their bound.",
}


def pair_rows(
    pairs: "Sequence[PairAttempts] | None", groups: Sequence[Sequence[int]], names: Sequence[int] | None = None
) -> list[dict[str, Any]]:
    """Return one row for each pair of groups that tried, and for each pair of groups at the end that never did.

    `apart` says whether the two share no map at the end; `last_step` counts the steps of the filters.

    Args:
        pairs: Outcome of the attempts; None: robots that stay alone have no rows.
        groups: Robots that share a map at the end.
        names: Number of each robot; None: its index.
    """
    if pairs is None:
        return []
    group_of = {robot: group for group in groups for robot in group}

    def named(robots: Sequence[int]) -> list[int]:
        return [robot if names is None else names[robot] for robot in robots]

    rows = [
        {
            "robots_a": named(pair.robots_a),
            "robots_b": named(pair.robots_b),
            "attempts": pair.attempts,
            "refused": dict(pair.refusals),
            "last_reason": pair.last_reason,
            "last_step": pair.last_step,
            "missed": pair.missed,
            "excess": pair.excess,
            "apart": group_of[pair.robots_a[0]] != group_of[pair.robots_b[0]],
        }
        for pair in pairs
    ]
    tried = {frozenset((group_of[pair.robots_a[0]], group_of[pair.robots_b[0]])) for pair in pairs}
    for i, one in enumerate(groups):
        for other in groups[i + 1 :]:
            if frozenset((one, other)) not in tried:
                rows.append(_never_tried(named(one), named(other)))
    return rows


def print_refusals(console: Console, rows: Sequence[Mapping[str, Any]]) -> None:
    """Print how often each pair tried and why it was refused, and what helps those that are apart at the end.

    Args:
        console: Where to.
        rows: As `pair_rows` returns them.
    """
    from slam_backend.maps.alignment_types import HINTS

    told = [row for row in rows if row["refused"] or not row["attempts"]]
    if not told:
        return
    cells = []
    for row in told:
        sides = [", ".join(map(str, row[side])) for side in ("robots_a", "robots_b")]
        reasons = ", ".join(f"{reason} ({count})" for reason, count in row["refused"].items())
        cells.append([*sides, str(row["attempts"]), reasons, _last(row), "apart" if row["apart"] else "one map"])
    title = "Refused attempts to merge maps (and by what factor a bound was missed)"
    headings = ("robots", "with", "attempts", "refused as", "last", "at the end")
    console.print(console_table(title, headings, cells))
    for reason in dict.fromkeys(row["last_reason"] for row in told if row["apart"] and row["last_reason"]):
        console.print(f"{reason}: {HINTS[reason]}", highlight=False)
    for missed in dict.fromkeys(row["missed"] for row in told if row["apart"] and row["missed"]):
        console.print(f"{missed}: {MISSED[missed]}", highlight=False)
    if any(not row["attempts"] for row in told):
        console.print(
            f"never tried: The robots were out of contact, or: {HINTS['too few candidates']}", highlight=False
        )


def _last(row: Mapping[str, Any]) -> str:
    """Tell of the last refusal of a pair."""
    if row["last_step"] is None:
        return "never tried"
    told = f"{row['last_reason']} at step {row['last_step']}"
    if row["missed"]:
        factor = "" if row["excess"] is None else f" {row['excess']:.1f}"
        told += f" ({row['missed']}{factor})"
    return told


def _never_tried(robots_a: list[int], robots_b: list[int]) -> dict[str, Any]:
    """Return the row of two groups that are apart and were never compared."""
    return {
        "robots_a": robots_a, "robots_b": robots_b, "attempts": 0, "refused": {}, "last_reason": "", "last_step": None,
        "missed": "", "excess": float("nan"), "apart": True,
    }  # fmt: skip
