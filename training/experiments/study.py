"""Studies: trials that are played once each, and the tables and the chart that sum them up, declared once.

>>> from dataclasses import dataclass
>>> rows = [{"method": "icp", "seed": seed, "error_m": 0.1 * (1 + seed)} for seed in range(3)]
>>> table = ResultTable(name="errors", title="Errors", by=("method",), columns=(
...     Column("error_m", digits=2, interval=True), Column("error_m", "worst [m]", statistic="worst", digits=2),
... ))
>>> [line] = table.lines(rows)
>>> table.headings, table.cells(line)
(['method', 'error [m]', 'worst [m]'], ['icp', '0.20 (0.10 .. 0.30)', '0.30'])
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from scipy.stats import gmean

from training.experiments.config import ExperimentConfig
from training.experiments.output.tables import csv_text, heading, in_words, markdown_table, number
from training.experiments.statistics import differences, grouped, interval

Row = Mapping[str, Any]
ConfigT = TypeVar("ConfigT", bound=ExperimentConfig)
TrialT = TypeVar("TrialT")
ALL = "all"  # cell of a field over whose values a line is pooled


class Estimate(NamedTuple):
    """A statistic of some rows, and the ends of its interval, if it has one."""

    value: Any
    low: float | None = None
    high: float | None = None


STATISTICS: dict[str, Callable[..., Any]] = {
    "mean": np.mean, "median": np.median, "least": np.min, "worst": np.max, "sum": np.sum,
    "geometric mean": gmean, "p95": lambda values, axis=None: np.quantile(values, 0.95, axis=axis),
    "share above 0": lambda values, axis=None: np.mean(values > 0.0, axis=axis),
}  # fmt: skip
Statistic = str | Callable[[Sequence[Row]], Any]
Words = Mapping[str, tuple[str, Callable[[Any], str]]]  # headings of fields, and texts of their values


def value_text(words: Words, name: str, value: Any) -> str:
    """Return the value of a field as text."""
    return words[name][1](value) if name in words and value != ALL else str(value)


@dataclass(frozen=True, slots=True)
class Column:
    """Column of a table, and quantity of a panel.

    Attributes:
        name: Field of the rows, or name of the quantity if `statistic` is a function.
        heading: Heading with its unit; empty: that of `training.experiments.output.tables.WORDS`, or the name in words.
        statistic: A name in `STATISTICS`, over the values of the rows that have one; or a function of the rows, which
            returns a number, a text or an `Estimate`, None if there is none.
        digits: Digits after the point.
        factor: Factor of the values shown; None: that of the unit.
        interval: Whether a 95 % bootstrap interval over the rows is shown.
    """

    name: str
    heading: str = ""
    statistic: Statistic = "mean"
    digits: int = 3
    factor: float | None = None
    interval: bool = False

    @property
    def title(self) -> str:
        """Heading with its unit."""
        return self.heading or heading(self.name)

    @property
    def scale(self) -> float:
        """Factor from the values of the rows to those shown."""
        return in_words(self.name)[2] if self.factor is None else self.factor

    def estimate(self, rows: Sequence[Row]) -> Estimate:
        """Return the statistic of some rows, in the unit of the title."""
        if not isinstance(self.statistic, str):
            found = self.statistic(rows)
            return self.scaled(found if isinstance(found, Estimate) else Estimate(found))
        values = np.array([row[self.name] for row in rows if row.get(self.name) is not None], np.float64)
        if not len(values):
            return Estimate(None)
        statistic = STATISTICS[self.statistic]
        ends = interval(values, statistic) if self.interval else (None, None)
        return self.scaled(Estimate(float(statistic(values)), *ends))

    def scaled(self, found: Estimate) -> Estimate:
        """Return an estimate in the unit of the title."""
        if isinstance(found.value, str) or self.scale == 1.0:
            return found
        return Estimate(*(None if value is None else self.scale * value for value in found))

    def text(self, found: Estimate) -> str:
        """Return an estimate as the text of a cell."""
        if isinstance(found.value, str):
            return found.value
        text, *ends = (number(value, self.digits) for value in found)
        return text if found.low is None else f"{text} ({' .. '.join(ends)})"


@dataclass(frozen=True, slots=True, kw_only=True)
class ResultTable:
    """Table of a study: a line for each combination of some fields of the trials.

    Attributes:
        name: Name of its file.
        title: Title.
        by: Fields of the trials, in the order of the first columns.
        columns: Further columns.
        where: Test of the rows that count.
        pooled: Fields over whose values there are further lines.
        each: Fields with a table for each combination of their values, which its title names.
        against: Field over whose values lines are compared, by the differences of `training.experiments.statistics`;
            empty: there is no comparison. Functions of a column get the rows of the differences.
        base: Value to compare with; None: the first.
        note: Text below the title.
        words: Headings of fields, and texts of their values.
    """

    name: str
    title: str
    by: tuple[str, ...]
    columns: tuple[Column, ...]
    where: Callable[[Row], bool] = lambda row: True
    pooled: tuple[str, ...] = ()
    each: tuple[str, ...] = ()
    against: str = ""
    base: Any = None
    note: str = ""
    words: Words = field(default_factory=dict)

    def __post_init__(self) -> None:
        titles = [column.title for column in self.columns]
        assert len(set(titles)) == len(titles), f"{self.name}: two columns with one heading: {titles}"

    @property
    def headings(self) -> list[str]:
        """Headings of all columns."""
        fields = [self.words[name][0] if name in self.words else in_words(name)[0] for name in self._shown]
        return fields + [column.title for column in self.columns]

    @property
    def _shown(self) -> list[str]:
        """Fields with a column."""
        return [name for name in self.by if name not in self.each]

    def parts(self, lines: Sequence[Mapping[str, Any]]) -> Iterator[tuple[str, list[list[str]]]]:
        """Yield the title and the cells of each table."""
        for key, group in grouped(lines, self.each).items():
            texts = (value_text(self.words, *item) for item in zip(self.each, key, strict=True))
            yield ", ".join((self.title, *texts)), list(map(self.cells, group))

    def lines(self, rows: Iterable[Row]) -> list[dict[str, Any]]:
        """Return a line for each group of rows in the order of first occurrence: fields, and `Estimate`s by title."""
        chosen = list(filter(self.where, rows))
        if self.against:
            names = [column.name for column in self.columns if isinstance(column.statistic, str)]
            chosen = differences(chosen, names, self.by, self.against, self.base)
        groups = grouped(chosen, self.by)
        if self.pooled:
            others = [name for name in self.by if name not in self.pooled]
            for key, group in grouped(chosen, others).items():
                known = dict(zip(others, key, strict=True))
                groups[tuple(known.get(name, ALL) for name in self.by)] = group
        return [
            dict(zip(self.by, key, strict=True)) | {column.title: column.estimate(group) for column in self.columns}
            for key, group in groups.items()
        ]

    def cells(self, line: Mapping[str, Any]) -> list[str]:
        """Return a line as text."""
        fields = [value_text(self.words, name, line[name]) for name in self._shown]
        return fields + [column.text(line[column.title]) for column in self.columns]

    def markdown(self, lines: Sequence[Mapping[str, Any]]) -> str:
        """Return the table as Markdown under its title."""
        note = f"{self.note}\n\n" if self.note else ""
        return "\n".join(
            f"**{title}**\n\n{note}{markdown_table(self.headings, cells)}" for title, cells in self.parts(lines)
        )

    def csv(self, lines: Sequence[Mapping[str, Any]]) -> str:
        """Return the table as CSV, with all digits and the ends of intervals in columns of their own."""
        headings, rows = list(self.by), [[line[name] for name in self.by] for line in lines]
        for column in self.columns:
            more = ("", " low", " high") if any(line[column.title].low is not None for line in lines) else ("",)
            headings += [f"{column.title}{end}" for end in more]
            for row, line in zip(rows, lines, strict=True):
                row += line[column.title][: len(more)]
        return csv_text(headings, rows)


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """Panel of a chart.

    Attributes:
        column: Quantity on the y axis.
        log: Whether the y axis is logarithmic.
        limits: Limits of the y axis; None: as the values need.
        guide: Height of a dotted line, such as an ideal value; None: there is none.
    """

    column: Column
    log: bool = False
    limits: tuple[float, float] | None = None
    guide: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Chart:
    """Chart of a study: a panel for each quantity, a row of panels for each value of a field.

    Attributes:
        x: Field of the trials on the x axis; values of trials without one (None) are level lines.
        label: Label of the x axis.
        panels: Panels of a row.
        by: Field with a line for each value; empty: one line.
        rows: Field with a row for each value; empty: one row.
        title: Title of a row, given the value.
        where: Test of the rows that count.
        factor: Factor of the values of `x`.
        log: Whether the x axis is logarithmic.
        words: Headings of fields, and texts of their values.
    """

    x: str
    label: str
    panels: tuple[Panel, ...]
    by: str = ""
    rows: str = ""
    title: Callable[[Any], str] = str
    where: Callable[[Row], bool] = lambda row: True
    factor: float = 1.0
    log: bool = False
    words: Words = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class Curves:
    """Means over time of what trials return as `curves`: a list by name, with their times as `time_s`.

    Attributes:
        by: Fields of the trials with a line for each combination of their values.
        columns: Names of the curves, with headings and factors; each has a panel.
        rows: The first of these fields, with a row of panels for each combination of their values.
        words: Headings of fields, and texts of their values.
        label: Label of a logarithmic axis that all curves share, in a panel for each combination; empty: each curve has
            its own panels.
        axis: Label of the x axis.
    """

    by: tuple[str, ...]
    columns: tuple[Column, ...]
    rows: tuple[str, ...] = ()
    words: Words = field(default_factory=dict)
    label: str = ""
    axis: str = "time [s]"

    def lines(self, rows: Iterable[Row]) -> list[dict[str, Any]]:
        """Return a line for each group and time: the fields, `time_s`, and means with the ends of their intervals.

        Groups may have other times.
        """
        lines = []
        for key, group in grouped(rows, self.by).items():
            for point, when in enumerate(group[0]["curves"]["time_s"]):
                line: dict[str, Any] = dict(zip(self.by, key, strict=True)) | {"time_s": when}
                for column in self.columns:
                    name = column.name
                    values = [{name: row["curves"][name][point]} for row in group]
                    ends = replace(column, interval=True, factor=1.0).estimate(values)
                    line |= dict(zip((name, f"{name}_low", f"{name}_high"), ends, strict=True))
                lines.append(line)
        return lines


class Claim(NamedTuple):
    """Claim about the results, with what was measured, the limits in words, and whether it holds."""

    text: str
    measured: Estimate
    limits: str
    holds: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Study(Generic[ConfigT, TrialT]):
    """Study: what is played, and what is shown of it.

    Attributes:
        name: Name of its command and of its chart.
        about: Text of `--help`; its first sentence is the summary. Commands of `vslam` have their own.
        config: Class of the configuration, whose fields are options.
        trial: Frozen dataclass of a trial.
        trials: Function that returns the trials of a configuration, in order.
        play: Function of configuration and trial that plays it: the fields of its row besides those of the trial. Other
            processes import it. Trials whose policy fails (`PolicyError`), or with a field `failed`, are not kept.
        tables: Tables of the results.
        chart: Chart of the results, or none.
        curves: Curves over time, or none.
        claims: Function that returns the claims that are checked on the rows, or none.
        checks: Function that returns the first steps of a configuration, which are run before the run folder is made,
            to detect what cannot be played.
        unfold: Function of the rows of all trials that returns those that tables, chart and claims sum up.
        quick: Values that `--quick` sets.
        log: Default of the option `path` below the data folder, and the expected content, worded for an error.
        timed: Whether trials are timed, so that they run one after another in this process.
    """

    name: str
    about: str = ""
    config: type[ConfigT]
    trial: type[TrialT]
    trials: Callable[[ConfigT], Sequence[TrialT]]
    play: Callable[[ConfigT, TrialT], Mapping[str, Any]]
    tables: tuple[ResultTable, ...]
    chart: Chart | None = None
    curves: Curves | None = None
    claims: Callable[[Sequence[Row]], Sequence[Claim]] | None = None
    checks: Callable[[ConfigT], Iterable[Callable[[], object]]] = lambda config: ()
    unfold: Callable[[Sequence[Row]], Sequence[Row]] = lambda rows: rows
    quick: Mapping[str, Any] = field(default_factory=dict)
    log: tuple[Path, str] | None = None
    timed: bool = False
