"""Text tables for the console, Markdown and CSV, and the words for metrics in all tables and charts.

The first column of a table is left-aligned, numbers are right-aligned and have at most three significant digits.
"""

import csv
import html
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

NEGLIGIBLE = 1e-9  # smaller numbers are shown as 0
LARGE = 1e5  # numbers from here on have an exponent
CUTOFF_M = 1.0  # errors of landmarks are cut here in the map error E [m]
E_NOTHING = CUTOFF_M / math.sqrt(2.0)  # E of an empty map [m]
E_SCALE = f"E: map error; 0 m = perfect map, {E_NOTHING:.2f} m = nothing found; errors are cut at {CUTOFF_M:g} m."

ATE_NOTE = (
    "ATE: root mean square distance between a path and the true one, from the true start or after the best fit; "
    "odometry: dead reckoning, without landmarks, with its error at the end relative to the path."
)
MAPS_NOTE = "Maps are named by their robots; landmarks: those that both maps have."
NIS_NOTE = (
    "NIS: normalised innovation squared; its mean is about 3 (2 without heights) if covariances are right, and smaller "
    "if they are cautious; at most 5 % of frames should exceed its 95 % bound."
)
# Words, unit and factor of metrics whose names do not say enough
WORDS: dict[str, tuple[str, str, float]] = {
    "map_error": ("map error E", "m", 1.0), "pose_error": ("position error", "m", 1.0), "return": ("return", "m", 1.0),
    "map_rmse_m": ("map RMSE", "m", 1.0), "map_rmse_start_m": ("map RMSE from start", "m", 1.0),
    "map_rmse_aligned_m": ("map RMSE after fit", "m", 1.0), "map_recall": ("recall", "%", 100.0),
    "map_precision": ("precision", "%", 100.0), "coverage": ("coverage", "%", 100.0),
    "ate_aligned_m": ("ATE after fit", "m", 1.0), "ate_start_m": ("ATE from start", "m", 1.0),
    "dead_reckoning_ate_aligned_m": ("odometry's ATE after fit", "m", 1.0),
    "dead_reckoning_ate_start_m": ("odometry's ATE from start", "m", 1.0),
    "dead_reckoning_end_percent": ("odometry's end error", "%", 1.0), "path_m": ("path length", "m", 1.0),
    "robots_a": ("first map", "", 1.0), "robots_b": ("second map", "", 1.0),
    "undone_s": ("undone at", "s", 1.0),
    "attempts": ("merge attempts", "", 1.0), "refused": ("refusals", "", 1.0), "last_reason": ("last refusal", "", 1.0),
    "last_step": ("last refusal at step", "", 1.0), "missed": ("bound missed", "", 1.0),
    "excess": ("value over bound", "", 1.0), "apart": ("separate at the end", "", 1.0),
    "nis_mean": ("mean NIS", "", 1.0), "nis_share": ("frames beyond the NIS bound", "%", 100.0),
    "ess_share": ("frames with few particles", "%", 100.0),
    "rejected_share": ("frames mostly rejected", "%", 100.0),
}  # fmt: skip
UNITS = {"_m": "m", "_deg": "deg", "_s": "s", "_percent": "%", "_ms": "ms"}
INITIALS = ("ate", "rmse", "rms", "nis", "ess", "anees", "nees")


def in_words(metric: str) -> tuple[str, str, float]:
    """Return a metric's name in words, its unit, and the factor of values in that unit.

    >>> in_words("robots_a"), in_words("turn_rmse_deg"), in_words("map_recall")
    (('first map', '', 1.0), ('turn RMSE', 'deg', 1.0), ('recall', '%', 100.0))
    """
    if metric in WORDS:
        return WORDS[metric]
    end = next((end for end in UNITS if metric.endswith(end)), "")
    words = [word.upper() if word in INITIALS else word for word in metric.removesuffix(end).split("_")]
    return " ".join(words), UNITS.get(end, ""), 1.0


def heading(metric: str) -> str:
    """Return the heading of a metric's column, with its unit.

    >>> heading("map_rmse_m"), heading("ess_share"), heading("policy")
    ('map RMSE [m]', 'frames with few particles [%]', 'policy')
    """
    words, unit, _ = in_words(metric)
    return f"{words} [{unit}]" if unit else words


def significant(value: float) -> str:
    """Format a number with three significant digits, or as a whole number if it has more before the point.

    >>> significant(0.123456), significant(1234.56), significant(-1e-12), significant(2.5e7)
    ('0.123', '1235', '0', '2e+07')
    """
    if abs(value) < NEGLIGIBLE:
        return "0"
    return f"{value:.3g}" if abs(value) < 999.5 else number(value, 0)


def number(value: float | None, digits: int = 2, factor: float = 1.0) -> str:
    """Format a number, times a factor, with fixed digits or fewer, three significant ones; None and NaN give a dash.

    >>> number(0.1234, 1, 100.0), number(-1e-9), number(3.2e7), number(None), number(12.345, 3), number(99.99, 1)
    ('12.3', '0.00', '3e+07', '-', '12.3', '100')
    """
    if value is None or value != value:
        return "-"
    scaled = factor * value
    if abs(scaled) >= LARGE:
        return f"{scaled:.0e}"
    before = len(f"{abs(scaled):.3g}".partition(".")[0]) if abs(scaled) < 999.5 else 3  # digits before the point
    return f"{scaled:z.{min(digits, 3 - before if abs(scaled) >= 1.0 else digits)}f}"


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


def escaped(text: str) -> str:
    """Return a text of others so that a Markdown page shows it as it is, in one cell of a table.

    >>> escaped("<b>a|b</b>")
    '&lt;b&gt;a&#124;b&lt;/b&gt;'
    """
    marks = {ord(mark): f"&#{ord(mark)};" for mark in "|`[]*\\"}
    return html.escape(" ".join(text.split()), quote=False).translate(marks)


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


def csv_of(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return rows as CSV: numbers have six digits, missing ones are empty; lists and tables are left out."""
    items = (item for row in rows for item in row.items())
    names = list(dict.fromkeys(name for name, value in items if not isinstance(value, Mapping | list)))
    return csv_text(names, ([row.get(name) for name in names] for row in rows))
