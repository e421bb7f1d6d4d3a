"""Report of `vslam bench exploration`: means, paired differences and curves, as tables, CSV and a figure."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.console import Console

from agents.plugins import is_plugin
from agents.trained import MODEL_FILE
from training.bench.config import NO_ORACLE
from training.bench.exploration.trials import CURVES, TEAM
from training.experiments.plotting import picture, save_png
from training.experiments.policy_names import parted_label
from training.experiments.statistics import format_ci, grouped, mean_ci, mean_curves, paired_difference, summarise_means
from training.experiments.tables import E_SCALE, console_table, markdown_table

Rows = Sequence[Mapping[str, Any]]
PLACE = ("world", "robots", "oracle")
CONDITION = (*PLACE, "policy")
FIGURES = (
    "coverage", "mean_coverage", "below_90_s", "reached_90", *TEAM, "pose_error", "way_m", "right_merges",
    "false_merges", "undone_merges", "first_merge_s", "last_merge_s", "one_group", "attempts", "collisions",
    "invalid_actions", "decision_ms", "decision_p99_ms",
)  # fmt: skip
# Metrics for the comparison of policies: whether larger is better, heading, and factor.
COMPARED = {
    "mean_coverage": (True, "over time [%]", 100.0), "below_90_s": (False, "below 90 % [s]", 1.0),
    "map_error": (False, "E [cm]", 100.0), "map_recall": (True, "recall [%]", 100.0),
    "map_rmse_m": (False, "RMSE [cm]", 100.0), "pose_error": (False, "pose [cm]", 100.0),
}  # fmt: skip
PRINTED = ("mean_coverage", "below_90_s", "map_error", "map_recall", "pose_error")  # fit into 80 columns
BELOW = "\n  "  # separator that puts the oracle on its own line
CURVE_PANELS = {
    "coverage": ("coverage [%]", 100.0), "map_error": ("map error E [m]", 1.0), "pose_error": ("pose error [m]", 1.0),
}  # fmt: skip
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7f7f7f")  # safe for colour-blind readers
STYLES = ("-", "--", ":", "-.")


class Column(NamedTuple):
    """Column of a table: heading, metric, digits, factor, and whether its interval is shown."""

    heading: str
    figure: str
    digits: int
    factor: float = 1.0
    interval: bool = False

    def cell(self, line: Mapping[str, Any], stacked: bool = False) -> str:
        """Return the text for a line; with `stacked` the interval is below the mean."""
        ends = {} if self.interval else {f"{self.figure}_low": None, f"{self.figure}_high": None}
        return format_ci({**line, **ends}, self.figure, self.digits, self.factor, stacked)


OVER_TIME = Column("over time [%]", "mean_coverage", 1, 100.0, True)
BELOW_90 = Column("below 90 % [s]", "below_90_s", 1, 1.0, True)
IN_SHORT = (
    OVER_TIME, BELOW_90, Column("E [cm]", "map_error", 1, 100.0, True),
    Column("RMSE [cm]", "map_rmse_m", 1, 100.0, True), Column("merges", "right_merges", 1),
    Column("false", "false_merges", 1),
)  # fmt: skip
PARTS: dict[str, tuple[Column, ...]] = {
    "coverage": (
        Column("coverage [%]", "coverage", 1, 100.0, True), OVER_TIME, BELOW_90,
        Column("90 % reached [%]", "reached_90", 0, 100.0), Column("path [m]", "way_m", 0),
    ),
    "maps and poses": (
        Column("E [m]", "map_error", 3, 1.0, True), Column("RMSE [m]", "map_rmse_m", 3, 1.0, True),
        Column("recall [%]", "map_recall", 1, 100.0), Column("precision [%]", "map_precision", 1, 100.0),
        Column("pose [m]", "pose_error", 3, 1.0, True), Column("ATE [m]", "ate_start_m", 3, 1.0, True),
    ),
    "merges and driving": (
        Column("right", "right_merges", 2), Column("false", "false_merges", 2), Column("undone", "undone_merges", 2),
        Column("first [s]", "first_merge_s", 0), Column("last [s]", "last_merge_s", 0),
        Column("all in one group [%]", "one_group", 0, 100.0), Column("collisions [s]", "collisions", 1, 0.1),
        Column("decision [ms]", "decision_ms", 2), Column("99th percentile [ms]", "decision_p99_ms", 2),
    ),
}  # fmt: skip


def summarise(rows: Rows) -> list[dict[str, Any]]:
    """Return a line for each of `CONDITION`: its number of seeds and the means of `FIGURES` over seeds with a value.

    If 90 % of the floor are not always reached, the mean of `below_90_s` is a restricted mean, of the time below 90 %.
    """
    return summarise_means(rows, CONDITION, FIGURES)


def compare_policies(rows: Rows) -> list[dict[str, Any]]:
    """Return the paired differences of each policy to the first, for each place and metric, on common seeds.

    Fields: those of `PLACE`, `policy`, `than`, `figure`, `seeds`, `more` with `more_low` and `more_high` (95 %,
    bootstrap over the seeds), `better`: the share of seeds in which the policy is better.
    """
    found = []
    for place, group in grouped(rows, PLACE).items():
        by_policy = grouped(group, ("policy",))
        (first,), *others = by_policy
        for (policy,) in others:
            line = dict(zip(PLACE, place, strict=True)) | {"policy": policy, "than": first}
            found += _differences(line, by_policy[policy,], by_policy[first,])
    return found


def compare_oracles(rows: Rows) -> list[dict[str, Any]]:
    """Return the paired differences of each policy with and without an oracle, in the same form; `than` is `"none"`."""
    found = []
    for (world, robots, policy), group in grouped(rows, ("world", "robots", "policy")).items():
        by_oracle = grouped(group, ("oracle",))
        for (oracle,) in by_oracle:
            if oracle != NO_ORACLE and (NO_ORACLE,) in by_oracle:
                line = {"world": world, "robots": robots, "oracle": oracle, "policy": policy, "than": NO_ORACLE}
                found += _differences(line, by_oracle[oracle,], by_oracle[NO_ORACLE,])
    return found


def curves(rows: Rows) -> list[dict[str, Any]]:
    """Return a row for each of `CONDITION` and time: means of `CURVES` over seeds, with intervals.

    Policies with other decision intervals may have other times.
    """
    return mean_curves(rows, CONDITION, CURVES)


def _differences(line: Mapping[str, Any], own: Rows, other: Rows) -> list[dict[str, Any]]:
    """Return a line for each of `COMPARED` that both have on common seeds."""
    found = []
    for figure, (more_is_better, _, _) in COMPARED.items():
        sides = [{row["seed"]: row[figure] for row in side if row[figure] is not None} for side in (own, other)]
        more = paired_difference(*sides)
        if len(more):
            better = float(((more > 0.0) if more_is_better else (more < 0.0)).mean())
            found.append({**line, "figure": figure, "seeds": len(more), **mean_ci("more", more), "better": better})
    return found


def label(name: str) -> str:
    """Return the label of a policy or a world for tables and figures: a path is given without its folders.

    >>> label("runs/train-0-1"), label("runs/train-0-1/model.npz"), label("mine=look_again:LookAgain@discrete")
    ('train-0-1', 'train-0-1/model.npz', 'mine@discrete')
    """
    given, policy = parted_label(name)
    if given:
        _, at, suffix = policy.rpartition("@")
        return f"{given}{at}{suffix}" if at else given
    path = Path(name)
    if is_plugin(name):
        return name
    return f"{path.parent.name}/{path.name}" if path.name == MODEL_FILE else path.name


def print_tables(console: Console, lines: Rows, policies: Rows, oracles: Rows) -> None:
    """Print the main metrics and the differences for each world and number of robots, within 80 columns."""
    for title, own, comparisons in _places(lines, policies, oracles):
        rows = [[who, *(column.cell(line, True) for column in IN_SHORT)] for who, line in _named(own, BELOW)]
        console.print(console_table(title, _stacked(column.heading for column in IN_SHORT), rows))
        console.print(E_SCALE)
        for heading, differences in comparisons:
            cells = _difference_rows(differences, PRINTED, True)
            headings = _stacked(COMPARED[name][1] for name in PRINTED)
            console.print(console_table(f"{title}: {heading}", headings, cells))


def markdown(lines: Rows, policies: Rows, oracles: Rows) -> str:
    """Return all metrics and differences as Markdown."""
    parts = []
    for place, own, comparisons in _places(lines, policies, oracles):
        parts.append(f"### {place}\n\n{E_SCALE}\n")
        for title, columns in PARTS.items():
            rows = [[who, *(column.cell(line) for column in columns)] for who, line in _named(own)]
            parts.append(markdown_table([title, *(column.heading for column in columns)], rows))
        for heading, differences in comparisons:
            headings = [heading, *(text for _, text, _ in COMPARED.values())]
            parts.append(markdown_table(headings, _difference_rows(differences, tuple(COMPARED), False)))
    return "\n".join(parts)


def policy_label(line: Mapping[str, Any], between: str = ", ") -> str:
    """Return the label of a policy and its oracle; the separator `BELOW` puts the oracle on its own line."""
    oracle = "" if line["oracle"] == NO_ORACLE else f"{between}oracle {line['oracle']}"
    name = label(line["policy"])
    return (name.replace("@", f"{BELOW}@") if between == BELOW else name) + oracle


def _stacked(headings: Iterable[str]) -> list[str]:
    """Return the headings of a narrow table, with an empty first one and units on a second line."""
    return ["", *(heading.replace(" [", "\n[") for heading in headings)]


def _named(lines: Rows, between: str = ", ") -> list[tuple[str, Mapping[str, Any]]]:
    """Return the lines by label, policy by policy."""
    order = list(dict.fromkeys(line["policy"] for line in lines))
    return [(policy_label(line, between), line) for line in sorted(lines, key=lambda line: order.index(line["policy"]))]


def _places(lines: Rows, policies: Rows, oracles: Rows) -> Iterator[tuple[str, Rows, list[tuple[str, Rows]]]]:
    """Yield for each world and number of robots a title, the lines, and the differences by heading."""
    place = ("world", "robots")
    for (world, robots), group in grouped(lines, place).items():
        seeds = sorted({line["seeds"] for line in group})
        count = f"{seeds[0]}-{seeds[-1]} seeds" if len(seeds) > 1 else f"{seeds[0]} seed{'s' if seeds[0] > 1 else ''}"
        comparisons: list[tuple[str, Rows]] = []
        if by_policy := grouped(policies, place).get((world, robots)):
            comparisons.append((f"paired difference to {label(by_policy[0]['than'])}", by_policy))
        if by_oracle := grouped(oracles, place).get((world, robots)):
            comparisons.append(("paired difference to no oracle", by_oracle))
        yield f"{label(world)}, K={robots}, {count}", group, comparisons


def _difference_rows(differences: Rows, names: Sequence[str], stacked: bool) -> list[list[str]]:
    """Return the differences of each policy and oracle in some metrics as text, after their labels."""
    by_name: dict[str, dict[str, Mapping[str, Any]]] = {}
    for line in differences:
        by_name.setdefault(policy_label(line, BELOW if stacked else ", "), {})[line["figure"]] = line
    return [
        [
            who,
            *(format_ci(own[name], "more", 1, COMPARED[name][2], stacked) if name in own else "-" for name in names),
        ]
        for who, own in by_name.items()
    ]


@picture
def draw_exploration(file: Path, curves: Rows) -> None:
    """Draw a row of panels for each world and number of robots into a PNG file: means over seeds, 95 % intervals."""
    places = grouped(curves, ("world", "robots"))
    colours = _each(COLOURS, (line["policy"] for line in curves))
    policy_of = {policy_label(line): line["policy"] for line in curves}
    styles = _each(STYLES, (NO_ORACLE, *(line["oracle"] for line in curves)))
    figure = Figure(figsize=(12.0, 2.7 * len(places) + 0.5), layout="constrained")
    axes = figure.subplots(len(places), len(CURVE_PANELS), squeeze=False, sharex=True)
    for row, ((world, robots), here) in zip(axes, places.items(), strict=True):
        for panel, (name, (text, factor)) in zip(row, CURVE_PANELS.items(), strict=True):
            for (policy, oracle), group in grouped(here, ("policy", "oracle")).items():
                _draw_mean(panel, group, name, factor, colours[policy], styles[oracle])
            panel.set_ylabel(text)
            panel.set_ylim(0.0, 100.0 if name == "coverage" else None)
            panel.grid(alpha=0.2)
            panel.spines[["top", "right"]].set_visible(False)
        row[0].set_title(f"{label(world)}, {robots} robots", loc="left", fontsize=10)
    for panel in axes[-1]:
        panel.set_xlabel("time [s]")
    handles, names = axes[0][0].get_legend_handles_labels()
    entries = dict(sorted(zip(names, handles, strict=True), key=lambda e: list(colours).index(policy_of[e[0]])))
    columns = min(len(colours), 6)  # a policy, and below it the same policy with an oracle
    figure.legend(entries.values(), entries, loc="outside upper center", ncols=columns, frameon=False, fontsize=9)
    save_png(figure, file, 100)


def _draw_mean(axes: Axes, lines: Rows, name: str, factor: float, colour: str, style: str) -> None:
    """Draw the mean of one policy over time with its interval, or faint and without interval for an oracle."""
    times = [line["time_s"] for line in lines]
    mean = factor * np.array([line[name] for line in lines])
    alone = lines[0]["oracle"] == NO_ORACLE
    axes.plot(times, mean, color=colour, linestyle=style, linewidth=1.6 if alone else 1.1, label=policy_label(lines[0]))
    if alone and lines[0][f"{name}_low"] is not None:
        low, high = (factor * np.array([line[f"{name}_{end}"] for line in lines]) for end in ("low", "high"))
        axes.fill_between(times, low, high, color=colour, alpha=0.15, linewidth=0)


def _each(choices: Sequence[str], names: Iterable[str]) -> dict[str, str]:
    """Return a different choice for each name, as long as there are enough."""
    return {name: choices[i % len(choices)] for i, name in enumerate(dict.fromkeys(names))}
