"""Text tables for the console, Markdown and CSV: first column left-aligned, numbers right-aligned."""

import csv
import io
import math
from collections.abc import Iterable, Sequence
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

LARGE = 1e5  # numbers from here on have an exponent
CUTOFF_M = 1.0  # errors of landmarks are cut here in the map error E [m]
E_NOTHING = CUTOFF_M / math.sqrt(2.0)  # E of an empty map [m]
E_SCALE = f"E: map error; 0 m = perfect map, {E_NOTHING:.2f} m = nothing found; errors are cut at {CUTOFF_M:g} m."


def number(value: float | None, digits: int = 2, factor: float = 1.0) -> str:
    """Format a number, times a factor, with fixed digits; None and NaN give a dash.

    >>> number(0.1234, 1, 100.0), number(-1e-9), number(3.2e7), number(None)
    ('12.3', '0.00', '3e+07', '-')
    """
    if value is None or value != value:
        return "-"
    scaled = factor * value
    return f"{scaled:z.{digits}f}" if abs(scaled) < LARGE else f"{scaled:.0e}"


def console_table(title: str, headings: Sequence[str], rows: Sequence[Sequence[str]] = ()) -> Table:
    """Return a table for the console; title, headings and rows are shown verbatim, without markup."""
    table = Table(
        title=Text(title, "table.title"), box=SIMPLE_HEAD, title_justify="left", padding=(0, 1), collapse_padding=True
    )
    for column, heading in enumerate(headings):
        table.add_column(Text(heading), justify="left" if column == 0 else "right", overflow="fold")
    for row in rows:
        table.add_row(*map(Text, row))
    return table


def markdown_table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    r"""Return a Markdown table with a final line break.

    >>> markdown_table(("method", "error [m]"), [("svd", "0.12")])
    '| method | error [m] |\n| --- | ---: |\n| svd | 0.12 |\n'
    """
    rule = ["---", *["---:"] * (len(headings) - 1)]
    return "".join("| " + " | ".join(row) + " |\n" for row in (headings, rule, *rows))


def titled_markdown(title: str, headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table under a bold title, or nothing if it has no rows."""
    return f"**{title}**\n\n{markdown_table(headings, rows)}" if rows else ""


def csv_text(headings: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    r"""Return rows as CSV with a header: floats have six significant digits, None is empty.

    >>> csv_text(("robot", "error_m"), [(0, 1 / 3), (1, None)])
    'robot,error_m\n0,0.333333\n1,\n'
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(headings)
    writer.writerows([f"{value:.6g}" if isinstance(value, float) else value for value in row] for row in rows)
    return text.getvalue()
