"""Console of the command line: shows text as it is, and takes styles apart from it."""

from functools import partial
from typing import Any

from rich.console import Console
from rich.progress import TextColumn
from rich.text import Text


def make_console(stderr: bool = False) -> Console:
    """Return a console that shows texts and tables as they are: brackets and colons in names and paths are no markup.

    Args:
        stderr: Whether it writes to stderr instead of stdout.
    """
    return Console(stderr=stderr, markup=False, highlight=False, emoji=False)


def print_error(text: str, console: Console | None = None, word: str = "error", style: str = "red") -> None:
    """Print one line that begins with a coloured word, on stderr unless a console is given."""
    line = Text.assemble((word, style), " ", " ".join(text.split("\n")))
    (console or make_console(stderr=True)).print(line, soft_wrap=True)


print_warning = partial(print_error, word="warning", style="yellow")


def text_column(template: str) -> Any:
    """Return a column of a progress bar; its text is formatted with `task`, and shown as it is."""
    return TextColumn(template, markup=False)
