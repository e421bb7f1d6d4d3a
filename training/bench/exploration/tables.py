"""The tables of `vslam bench exploration`, on the console and as Markdown, and its CSV files."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from agents.own import is_own
from agents.trained import MODEL_FILE
from training.bench.exploration.bench import NO_ORACLE
from training.bench.exploration.summary import COMPARED, Rows
from training.experiments.statistics import shown
from training.experiments.tables import console_table, csv_text, markdown_table


@dataclass(frozen=True, slots=True)
class Column:
    """A column of a table: its heading, the figure, digits and factor, and whether its interval is shown."""

    heading: str
    figure: str
    digits: int
    factor: float = 1.0
    interval: bool = False

    def cell(self, line: Mapping[str, Any], stacked: bool = False) -> str:
        """Return the text for a line; `stacked` puts the interval below the mean."""
        ends = {} if self.interval else {f"{self.figure}_low": None, f"{self.figure}_high": None}
        return shown({**line, **ends}, self.figure, self.digits, self.factor, stacked)


OVER_TIME = Column("over time [%]", "mean_coverage", 1, 100.0, True)
BELOW_90 = Column("below 90 % [s]", "below_90_s", 1, 1.0, True)
IN_SHORT = (
    OVER_TIME,
    BELOW_90,
    Column("E [cm]", "map_error", 1, 100.0, True),
    Column("RMSE [cm]", "map_rmse_m", 1, 100.0, True),
    Column("merges", "right_merges", 1),
    Column("false", "false_merges", 1),
)
PARTS: dict[str, tuple[Column, ...]] = {
    "what was seen": (
        Column("floor seen [%]", "coverage", 1, 100.0, True),
        OVER_TIME,
        BELOW_90,
        Column("90 % reached [%]", "reached_90", 0, 100.0),
        Column("way [m]", "way_m", 0),
    ),
    "maps and poses": (
        Column("E [m]", "map_error", 3, 1.0, True),
        Column("RMSE [m]", "map_rmse_m", 3, 1.0, True),
        Column("recall [%]", "map_recall", 1, 100.0),
        Column("precision [%]", "map_precision", 1, 100.0),
        Column("pose [m]", "pose_error", 3, 1.0, True),
        Column("path [m]", "ate_start_m", 3, 1.0, True),
    ),
    "merges and driving": (
        Column("right", "right_merges", 2),
        Column("false", "false_merges", 2),
        Column("undone", "undone_merges", 2),
        Column("first [s]", "first_merge_s", 0),
        Column("last [s]", "last_merge_s", 0),
        Column("all in one group [%]", "one_group", 0, 100.0),
        Column("pushing [s]", "collisions", 1, 0.1),
        Column("decision [ms]", "decision_ms", 2),
    ),
}
UNITS = {column.figure: column.factor for column in IN_SHORT} | {"pose_error": 100.0}
BELOW = "\n  "  # what a policy is told, on a line of its own
HEADINGS = {
    "mean_coverage": "over time [%]",
    "below_90_s": "below 90 % [s]",
    "map_error": "E [cm]",
    "map_rmse_m": "RMSE [cm]",
    "pose_error": "pose [cm]",
}


def label(name: str) -> str:
    """Return a policy or a world as tables and figures call it: without folders, if it is a path.

    >>> label("runs/train-0-1"), label("runs/train-0-1/model.npz"), label("random_goals")
    ('train-0-1', 'train-0-1/model.npz', 'random_goals')
    """
    path = Path(name)
    if is_own(name):
        return name
    return f"{path.parent.name}/{path.name}" if path.name == MODEL_FILE else path.name


def print_tables(console: Console, lines: Rows, policies: Rows, oracles: Rows) -> None:
    """Print, for each world and number of robots, the figures in short and the differences.

    Args:
        console: Where to; 80 columns are enough.
        lines: Of `summarise`.
        policies: Of `compare_policies`.
        oracles: Of `compare_oracles`.
    """
    for (world, robots), own in _places(lines).items():
        title = f"{label(world)}, K={robots}, {_seeds(own)}"
        rows = [[who, *(column.cell(line, True) for column in IN_SHORT)] for who, line in _named(own, BELOW)]
        console.print(console_table(title, _stacked(column.heading for column in IN_SHORT), rows))
        for heading, differences in _comparisons(_at(policies, world, robots), _at(oracles, world, robots)):
            rows = [[who, *cells] for who, cells in _difference_rows(differences, True)]
            console.print(console_table(f"{title}: {heading}", _stacked(HEADINGS[name] for name in COMPARED), rows))


def markdown(lines: Rows, policies: Rows, oracles: Rows) -> str:
    """Return all figures and differences as Markdown."""
    parts = []
    for (world, robots), own in _places(lines).items():
        parts.append(f"### {label(world)}, K={robots}, {_seeds(own)}\n")
        for title, columns in PARTS.items():
            rows = [[who, *(column.cell(line) for column in columns)] for who, line in _named(own)]
            parts.append(markdown_table([title, *(column.heading for column in columns)], rows))
        for heading, differences in _comparisons(_at(policies, world, robots), _at(oracles, world, robots)):
            rows = [[who, *cells] for who, cells in _difference_rows(differences, False)]
            parts.append(markdown_table([heading, *(HEADINGS[name] for name in COMPARED)], rows))
    return "\n".join(parts)


def to_csv(rows: Rows) -> str:
    """Return rows as CSV under a heading; numbers have six digits, lists and tables are left out."""
    names = [name for name, value in rows[0].items() if not isinstance(value, Mapping | list)] if rows else []
    return csv_text(names, ([row[name] for name in names] for row in rows))


def who_is(line: Mapping[str, Any], between: str = ", ") -> str:
    """Return the name of a policy and what it is told; with `BELOW` between them, for narrow columns, line by line."""
    told = "" if line["oracle"] == NO_ORACLE else f"{between}told {line['oracle']}"
    name = label(line["policy"])
    return (name.replace("@", f"{BELOW}@") if between == BELOW else name) + told


def _stacked(headings: Iterable[str]) -> list[str]:
    """Return the headings of a narrow table, units on a second line, after that of the names."""
    return ["", *(heading.replace(" [", "\n[") for heading in headings)]


def _named(lines: Rows, between: str = ", ") -> list[tuple[str, Mapping[str, Any]]]:
    """Return the lines under their names, policy by policy."""
    order = list(dict.fromkeys(line["policy"] for line in lines))
    return [(who_is(line, between), line) for line in sorted(lines, key=lambda line: order.index(line["policy"]))]


def _comparisons(policies: Rows, oracles: Rows) -> list[tuple[str, Rows]]:
    """Return both kinds of differences, as far as there are any, each under a heading."""
    both = []
    if policies:
        both.append((f"less {label(policies[0]['than'])}, paired", policies))
    if oracles:
        both.append(("told less not told, paired", oracles))
    return both


def _difference_rows(differences: Rows, stacked: bool) -> list[tuple[str, list[str]]]:
    """Return the differences of each policy and oracle as texts."""
    by_name: dict[str, dict[str, Mapping[str, Any]]] = {}
    for line in differences:
        by_name.setdefault(who_is(line, BELOW if stacked else ", "), {})[line["figure"]] = line
    return [
        (who, [shown(own[n], "more", 1, UNITS[n], stacked) if n in own else "-" for n in COMPARED])
        for who, own in by_name.items()
    ]


def _places(lines: Rows) -> dict[tuple[str, int], list[Mapping[str, Any]]]:
    """Return the lines of each world and number of robots."""
    places: dict[tuple[str, int], list[Mapping[str, Any]]] = {}
    for line in lines:
        places.setdefault((line["world"], line["robots"]), []).append(line)
    return places


def _at(lines: Rows, world: str, robots: int) -> Rows:
    return [line for line in lines if (line["world"], line["robots"]) == (world, robots)]


def _seeds(lines: Sequence[Mapping[str, Any]]) -> str:
    """Return of how many seeds the lines are."""
    least, most = (pick(line["seeds"] for line in lines) for pick in (min, max))
    return f"{most} seed{'s' if most > 1 else ''}" if least == most else f"{least}-{most} seeds"
