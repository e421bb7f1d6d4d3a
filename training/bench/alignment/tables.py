"""The tables of `vslam bench alignment`, on the console and as Markdown."""

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console

from training.experiments.tables import console_table, number, titled_markdown

TITLES = {
    "grid": "200 landmarks in each map, 5 cm noise, by share in common and share of wrong look-alikes",
    "U": "Maps that must not be aligned",
    "I": "Maps that just can be aligned: 12 to 40 true pairs, spread over 2 m to 15 m",
}
HEADINGS = {
    "grid": ("common", "wrong", "method", "right [%]", "translation/bound", "rotation/bound", "ANEES", "ms", "95 %"),
    "U": ("case", "method", "accepted", "refused as", "ms", "95 %"),
    "I": ("case", "method", "accepted [%]", "false", "worst [m]", "worst [°]", "ANEES", "refused as", "ms"),
}


def table_rows(kind: str, lines: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Return the rows of text of one kind's table."""
    return [_cells(kind, line) for line in lines if line["kind"] == kind]


def print_tables(console: Console, lines: Sequence[Mapping[str, Any]]) -> None:
    """Print what each kind of trial came to."""
    for kind, title in TITLES.items():
        if rows := table_rows(kind, lines):
            console.print(console_table(title, HEADINGS[kind], rows))


def markdown(lines: Sequence[Mapping[str, Any]]) -> str:
    """Return the same tables as Markdown."""
    parts = (titled_markdown(title, HEADINGS[kind], table_rows(kind, lines)) for kind, title in TITLES.items())
    return "\n".join(part for part in parts if part)


def _cells(kind: str, line: Mapping[str, Any]) -> list[str]:
    """Return one line as text."""
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
    """Return median and 95 % quantile of the time."""
    return [f"{line['median_ms']:.1f}", f"{line['p95_ms']:.1f}"]
