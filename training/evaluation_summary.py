"""Trials of an evaluation summed up: a line per policy, and the model's lead over each, paired over the seeds."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from training.accuracy_summary import interval
from training.evaluation import FIGURES, MODEL

Rows = Sequence[Mapping[str, Any]]
SHOWN = {
    "return": "return [m]",
    "map_error": "map error [m]",
    "map_recall": "recall",
    "coverage": "coverage",
    "merges": "merges",
    "distance": "way [m]",
}
WITH_INTERVAL = ("return", "map_error")  # the others have theirs in metrics.json


def summarise(rows: Rows) -> list[dict[str, Any]]:
    """Return per policy, in the order in which they first come, its seeds, and of each figure the mean.

    With `_low` and `_high` appended, the ends of its 95 % bootstrap interval over the seeds.
    """
    lines = []
    for name in dict.fromkeys(row["policy"] for row in rows):
        own = [row for row in rows if row["policy"] == name]
        line: dict[str, Any] = {"policy": name, "seeds": len(own)}
        for figure in FIGURES:
            line |= _described(figure, np.array([row[figure] for row in own]))
        lines.append(line)
    return lines


def leads(rows: Rows) -> list[dict[str, Any]]:
    """Return per other policy by how much the model's return is higher on the same seeds.

    Fields: `over`, `seeds` (those that both have played), `lead` with `lead_low` and `lead_high` (95 %, bootstrap),
    `won`: the share of seeds in which the model's is higher.
    """
    returns: dict[str, dict[int, float]] = {}
    for row in rows:
        returns.setdefault(row["policy"], {})[row["seed"]] = row["return"]
    own = returns.pop(MODEL, {})
    found = []
    for name, theirs in returns.items():
        seeds = sorted(own.keys() & theirs.keys())
        if seeds:
            ahead = np.array([own[seed] - theirs[seed] for seed in seeds])
            told = {"over": name, "seeds": len(seeds), "won": float((ahead > 0.0).mean())}
            found.append(told | _described("lead", ahead))
    return found


def print_evaluation(console: Console, lines: Rows, ahead: Rows) -> None:
    """Print both as tables."""
    table = Table("policy", title="Worlds that were not trained on", title_justify="left")
    for label in (*SHOWN.values(), "seeds"):
        table.add_column(label, justify="right")
    for line in lines:
        shown = (_with_interval(line, name) if name in WITH_INTERVAL else f"{line[name]:.2f}" for name in SHOWN)
        table.add_row(line["policy"], *shown, str(line["seeds"]))
    console.print(table)
    for lead in ahead:
        console.print(
            f"model - {lead['over']}: {_with_interval(lead, 'lead')} m of return, ahead in {100.0 * lead['won']:.0f} % "
            f"of {lead['seeds']} seeds",
            highlight=False,
            soft_wrap=True,
        )


def _described(name: str, values: Any) -> dict[str, Any]:
    low, high = interval((values,), np.mean)
    return {name: float(values.mean()), f"{name}_low": low, f"{name}_high": high}


def _with_interval(line: Mapping[str, Any], name: str) -> str:
    mean, low, high = (line[f"{name}{end}"] for end in ("", "_low", "_high"))
    return f"{mean:.3f}" if low is None or high is None else f"{mean:.3f} ({low:.3f} .. {high:.3f})"
