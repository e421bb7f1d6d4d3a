"""Trials of an evaluation summed up: a line per policy, and the model's lead over each, paired over the seeds."""

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console

from training.experiments.statistics import ahead_by, grouped, mean_of, shown
from training.experiments.tables import console_table
from training.rl.evaluation import FIGURES, MODEL

Rows = Sequence[Mapping[str, Any]]
SHOWN = {
    "return": "return [m]",
    "map_error": "map error [m]",
    "map_recall": "recall",
    "coverage": "floor",
    "merges": "merges",
    "distance": "way [m]",
}
WITH_INTERVAL = ("return", "map_error")  # the others have theirs in metrics.json


def summarise(rows: Rows) -> list[dict[str, Any]]:
    """Return per policy, in the order in which they first come, its seeds, and of each figure the mean.

    With `_low` and `_high` appended, the ends of its 95 % bootstrap interval over the seeds.
    """
    lines = []
    for (name,), own in grouped(rows, ("policy",)).items():
        line: dict[str, Any] = {"policy": name, "seeds": len(own)}
        for figure in FIGURES:
            line |= mean_of(figure, [row[figure] for row in own])
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
        ahead = ahead_by(own, theirs)
        if len(ahead):
            told = {"over": name, "seeds": len(ahead), "won": float((ahead > 0.0).mean())}
            found.append(told | mean_of("lead", ahead))
    return found


def print_evaluation(console: Console, lines: Rows, ahead: Rows, split: str | None) -> None:
    """Print a table, which 80 columns hold, and a line for each lead.

    Args:
        console: Where to.
        lines: As `summarise` returns them.
        ahead: As `leads` returns them.
        split: Of the worlds; None where all episodes are in the same building.
    """
    played = sorted({line["seeds"] for line in lines})
    episodes = "-".join(str(n) for n in (played if len(played) < 2 else (played[0], played[-1])))
    rows = [
        [
            line["policy"],
            *(shown(line, name, stacked=True) if name in WITH_INTERVAL else f"{line[name]:.2f}" for name in SHOWN),
        ]
        for line in lines
    ]
    worlds = "One building" if split is None else f"Worlds of the {split} split"
    title = f"{worlds}, {episodes} episodes of each policy"
    console.print(console_table(title, ["policy", *SHOWN.values()], rows))
    for lead in ahead:
        console.print(
            f"model - {lead['over']}: {shown(lead, 'lead')} m of return, ahead in {100.0 * lead['won']:.0f} % "
            f"of {lead['seeds']} seeds",
            highlight=False,
            soft_wrap=True,
        )
