"""Tables of text, on the console and as Markdown: the first column to the left, numbers to the right."""

from collections.abc import Sequence

from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table


def console_table(title: str, headings: Sequence[str], rows: Sequence[Sequence[str]] = ()) -> Table:
    """Return a table for the console; title, headings and rows are shown as they are, markup and all."""
    table = Table(title=escape(title), box=SIMPLE_HEAD, title_justify="left", padding=(0, 1), collapse_padding=True)
    for column, heading in enumerate(headings):
        table.add_column(escape(heading), justify="left" if column == 0 else "right", overflow="fold")
    for row in rows:
        table.add_row(*map(escape, row))
    return table


def markdown_table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    r"""Return a Markdown table that ends with a line break.

    >>> markdown_table(("method", "error [m]"), [("svd", "0.12")])
    '| method | error [m] |\n| --- | ---: |\n| svd | 0.12 |\n'
    """
    rule = ["---", *["---:"] * (len(headings) - 1)]
    return "".join("| " + " | ".join(row) + " |\n" for row in (headings, rule, *rows))
