"""Tables and figure of a benchmark plan: interquartile means, differences, oracle ladder, team sizes."""

import csv
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from slam_backend.core.validation import FloatArray, argument_error
from slam_backend.maps.alignment import REASONS
from training.bench.exploration.aggregate import (
    by_family,
    iqm,
    performance_profile,
    pooled,
    probability_of_improvement,
    stratified_ci,
)
from training.bench.exploration.plan import BASE_PART, FLOOR_PLANS, Plan, PlanTrial
from training.bench.exploration.players import label
from training.experiments.plotting import picture, save_png
from training.experiments.statistics import grouped
from training.experiments.study import Chart, Column, Estimate, Panel, ResultTable, Statistic
from training.experiments.study_chart import COLOURS, STYLES, draw_panel
from training.experiments.tables import E_SCALE, csv_of, markdown_table, number

Rows = Sequence[Mapping[str, Any]]
Values = dict[tuple[str, int], float]  # of worlds, by family and seed
FACTORS = ("large_world", "one_robot", "five_robots", "hard", "lossy_radio")
ORACLES, TEAM_SIZE = "oracles", "team_size"
PARTS_OF_E = ("missed", "misplaced", "duplicate", "false")
PROFILE_CM = (10.0, 20.0, 30.0, 40.0)
THRESHOLDS = np.linspace(0.0, 0.75, 151)  # of E [m]
CM = 100.0
REFUSED = "refused: "  # columns of the number of refused merges by reason
# Columns of texts
TEXTS = ("part", "policy", "family", "world", "oracle", "preset", "digest", "policy_digest", "machine")

# ------------------------------------------------------------------ tables


def tables(plan: Plan, rows: Rows) -> list[ResultTable]:
    """Return the tables of a plan; their columns depend on what was played."""
    base = _of(rows, part=BASE_PART)
    first = next((name for name in plan.policies if _of(base, policy=name)), None)
    other, sizes, parts = _of(base, policy=first), _of(rows, part=TEAM_SIZE), plan.all_parts()
    worlds = len(grouped(base, ("family", "seed")))

    def of_base(name: str, title: str, note: str, heading: str, *columns: Column) -> ResultTable:
        return ResultTable(
            name=name, title=title, note=note, by=("policy",), columns=columns, words={"policy": (heading, label)},
            where=lambda row: row["part"] == BASE_PART,
        )  # fmt: skip

    compared = f" P: probability that the map of a random world is better than one of `{first}`."
    whole = {row["policy"] for row in rows if (row["part"], row["oracle"]) == (ORACLES, "all")}
    return [
        of_base(
            "worlds", "All worlds",
            f"Interquartile means over {worlds} worlds, with 95 % intervals." + compared * (first is not None),
            "all worlds",
            _e_column("E [cm]"), _column("coverage over time [%]", _ci("mean_coverage")),
            _column("T50 [s]", _iqm("below_50_s"), 0, 1.0), _column("T90 [s]", _iqm("below_90_s"), 0, 1.0),
            _column("recall [%]", _iqm("map_recall")), _column("ATE [cm]", _iqm("ate_start_m")),
            _column("NEES", _iqm("nees"), 1, 1.0), Column("decision_p99_ms", "decision, p99 [ms]", digits=1),
            _column("P", partial(_improvement, other), 2, 1.0),
        ),
        of_base(
            "families", "Families",
            f"Means of E [cm] and, behind the comma, paired differences to `{first}` with their 95 % intervals.",
            "E [cm]",
            *(_column(family, partial(_in_family, family, other)) for (family,) in grouped(base, ("family",))),
        ),
        of_base(
            "errors", "What the map error consists of",
            "Shares of the mean of E^2 [%]; RMSE of the landmarks found, and the share of found ones that exist.",
            "parts of E^2 [%]",
            *(_column(name, partial(_share_of_error, name)) for name in PARTS_OF_E),
            Column("map_rmse_m", "RMSE [cm]", digits=1, factor=CM),
            Column("map_precision", "precision [%]", digits=1, factor=CM),
        ),
        of_base(
            "merges", "Merges and driving",
            "Overlap: share of the seen floor that two robots have seen. Balance: shortest over longest path of a "
            "team. The last columns count refused attempts by reason.",
            "per episode",
            Column("right_merges", "merged", digits=2), Column("false_merges", "false", digits=2),
            Column("undone_merges", "undone", digits=2), Column("last_merge_s", "last [s]", digits=0),
            Column("overlap", "overlap [%]", digits=0, factor=CM), Column("way_m", "path [m]", digits=0),
            Column("balance", digits=2), Column("collisions", "collisions [s]", digits=1, factor=0.1),
            Column("bytes_sent", "sent [kB]", digits=0, factor=1e-3),
            *(
                _column(reason, partial(_refused, reason), 1, 1.0)
                for reason in sorted({reason for row in base for reason in row["refusals"]})
            ),
        ),
        of_base(
            "profile", "Performance profile", "Share of the worlds with a smaller map error.", "worlds [%]",
            *(_column(f"E < {limit:g} cm", partial(_share_below, limit / CM), 0) for limit in PROFILE_CM),
        ),
        ResultTable(
            name="factors", title="One factor at a time", by=("policy",), words={"policy": ("E [cm]", label)},
            note="Interquartile means of E [cm] with 95 % intervals; all else as in the base part.",
            columns=tuple(
                _e_column(parts[name].title, part=name) for name in FACTORS if name in parts and _of(rows, part=name)
            ),
            where=lambda row: row["part"] in FACTORS,
        ),
        ResultTable(
            name="oracles", title="Oracle ladder", by=("policy",), words={"policy": ("E [cm]", label)},
            note="E [cm] without oracles; what knowing the poses, the landmarks' identities, the alignment of maps, "
            "and all three takes off it, paired; and what is left with all: landmarks that exploration did not reach.",
            columns=(
                _column("none", partial(_with_all, BASE_PART)), _column("localisation", partial(_rung, "pose")),
                _column("association", partial(_rung, "association")), _column("merging", partial(_rung, "merge")),
                _column("all", partial(_rung, "all")), _column("left: exploration", partial(_with_all, ORACLES)),
            ),
            where=lambda row: row["policy"] in whole and row["part"] in (BASE_PART, ORACLES),
        ),
        ResultTable(
            name="team_size", title="Team size and particles", by=("particles",),
            note=f"Interquartile means of E [cm] of {_names(sizes)}: Fig. 6b of the paper, with robots that explore.",
            words={"particles": ("E [cm]", lambda particles: f"{particles} particles")},
            columns=tuple(
                _e_column(f"K = {robots}", robots=robots)
                for robots in sorted({row["robots"] for row in sizes})
            ),
            where=lambda row: row["part"] == TEAM_SIZE,
        ),
    ]  # fmt: skip


def ordered(rows: Rows) -> list[Mapping[str, Any]]:
    """Return the rows policy by policy, ordered by the map error in the base part."""
    errors = {
        policy: _iqm("map_error")(_of(own, part=BASE_PART)) for (policy,), own in grouped(rows, ("policy",)).items()
    }
    known = {policy: np.inf if error is None else error for policy, error in errors.items()}
    return sorted(rows, key=lambda row: known[row["policy"]])


def markdown(plan: Plan, rows: Rows, policies: Sequence[str]) -> str:
    """Return all tables as Markdown, with what is left out.

    Args:
        policies: Labels of the policies that should have rows.
    """
    parts = [f"Plan {plan.name}, hash {plan.digest}. {E_SCALE}\n"]
    if plan.floor_plans and not _of(rows, family=FLOOR_PLANS):
        parts.append("There are no rows of floor plans: they need `VSLAM_DATA`, and `--quick` leaves them out.\n")
    parts += [f"Not a complete result: {text}.\n" for text in incomplete(plan, rows, policies)]
    for table in tables(plan, rows):
        if lines := table.lines(ordered(rows)):
            parts.append(section(table, lines))
    return "\n".join(parts)


def section(table: ResultTable, lines: Rows) -> str:
    """Return a table as a section of a page."""
    cells = markdown_table(table.headings, list(map(table.cells, lines)))
    return f"### {table.title}\n\n{table.note}\n\n{cells}"


def incomplete(plan: Plan, rows: Rows, policies: Sequence[str]) -> list[str]:
    """Return a text for each of some policies that lacks episodes of the base part.

    Floor plans may be missing altogether.
    """
    found = []
    base = plan.all_parts()[BASE_PART]
    base_rows = [row for row in rows if row["part"] == BASE_PART]
    has_plans = any(row["family"] == FLOOR_PLANS for row in base_rows)
    conditions = len(base.robots) * len(base.particles) * len(base.oracles) * base.seeds
    wanted = conditions * sum(world != FLOOR_PLANS or has_plans for world in base.worlds)
    for policy in dict.fromkeys([*policies, *(row["policy"] for row in base_rows)]):
        played = sum(row["policy"] == policy for row in base_rows)
        if played < wanted:
            found.append(f"`{label(policy)}` has {played} of {wanted} episodes of the base part")
    return found


def tidy_rows(rows: Rows) -> list[dict[str, Any]]:
    """Return rows with a column for each reason of a refusal, and without curves."""
    return [
        {name: value for name, value in row.items() if name not in ("curves", "refusals")}
        | {f"{REFUSED}{reason}": row["refusals"].get(reason, 0) for reason in REASONS}
        for row in rows
    ]


def episodes_csv(rows: Rows) -> str:
    """Return a line for each episode as CSV; floats have six significant digits."""
    return csv_of(tidy_rows(rows))


def read_episodes(text: str) -> list[dict[str, Any]]:
    """Read the rows that `episodes_csv` wrote.

    Raises:
        ValueError: If a column of `PlanTrial` is missing.
    """
    found = []
    for line in csv.DictReader(io.StringIO(text)):
        row = {name: _parsed(name, value) for name, value in line.items()}
        if missing := [name for name in PlanTrial.__dataclass_fields__ if name not in row]:
            hint = "Give a file that the benchmark wrote."
            raise argument_error("episodes", f"a column {missing[0]!r}", "none", hint)
        refusals = {name.removeprefix(REFUSED): row.pop(name) for name in list(row) if name.startswith(REFUSED)}
        found.append({**row, "refusals": {reason: count for reason, count in refusals.items() if count}})
    return found


def _parsed(name: str, text: str) -> Any:
    """Return a value of a CSV file: None, a number, a truth value or a text."""
    if text in ("", "True", "False"):
        return {"": None, "True": True, "False": False}[text]
    if name in TEXTS:
        return text
    return float(text) if any(c in text for c in ".en") else int(text)


def write_parquet(file: Path, rows: Rows) -> bool:
    """Write a line for each episode as Parquet; return whether pyarrow (extra `parquet`) is installed."""
    try:
        import pyarrow as pa  # type: ignore[import-untyped]
        from pyarrow import parquet
    except ImportError:
        return False
    from slam_backend.core.files import write_file

    stream = io.BytesIO()
    parquet.write_table(pa.Table.from_pylist(tidy_rows(rows)), stream)
    write_file(file, stream.getvalue(), "out")
    return True


@picture
def draw_plan(file: Path, rows: Rows) -> None:
    """Draw profiles of E in the base part, and E over team sizes and particles, as far as played, into a PNG file."""
    parts = {BASE_PART: _draw_profiles, TEAM_SIZE: _draw_team_sizes}
    played = [(draw, own) for part, draw in parts.items() if (own := _of(ordered(rows), part=part))]
    if not played:
        return
    figure = Figure(figsize=(6.8 * len(played), 4.4), layout="constrained")
    for panel, (draw, own) in zip(figure.subplots(1, len(played), squeeze=False)[0], played, strict=True):
        draw(panel, own)
        panel.legend(fontsize=7, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
        panel.grid(alpha=0.2)
        panel.spines[["top", "right"]].set_visible(False)
    save_png(figure, file, 110)


def _draw_profiles(panel: Axes, base: Rows) -> None:
    """Draw the share of worlds below each map error, a line per policy."""
    for i, ((policy,), own) in enumerate(grouped(base, ("policy",)).items()):
        share = performance_profile([-errors for errors in by_family(_values(own))], -THRESHOLDS)
        style = STYLES[i // len(COLOURS) % len(STYLES)]
        panel.plot(THRESHOLDS, share, style, color=COLOURS[i % len(COLOURS)], label=label(policy), linewidth=1.3)
    panel.set(xlabel="map error E [m]", ylabel="share of worlds with a smaller error", title="base part")


def _draw_team_sizes(panel: Axes, sizes: Rows) -> None:
    """Draw E over the number of robots, a line per number of particles."""
    column = Column("map_error", "map error E [m]", _ci("map_error"))
    chart = Chart(x="robots", label="robots", by="particles", panels=(Panel(column=column),))
    draw_panel(panel, chart, chart.panels[0], sizes, sorted({row["particles"] for row in sizes}))
    panel.set(xlabel="robots", title="team size, by number of particles")
    panel.set_xticks(sorted({row["robots"] for row in sizes}))


# ------------------------------------------------------------------ columns


def _column(heading: str, statistic: Statistic, digits: int = 1, factor: float = CM) -> Column:
    return Column(heading, heading, statistic, digits, factor)


def _e_column(heading: str, **where: Any) -> Column:
    """Return the column of the interquartile mean of E with its interval, over the rows with some values."""
    return _column(heading, _ci("map_error", **where))


def _ci(name: str, **where: Any) -> Statistic:
    """Return the interquartile mean of a metric with its interval; rows of several conditions are pooled."""

    def statistic(rows: Rows) -> Estimate:
        known = [row for row in _of(rows, **where) if row[name] is not None]
        strata = [np.array([row[name] for row in own], float) for own in grouped(known, ("family",)).values()]
        return _estimate(stratified_ci(strata, pooled(iqm))) if strata else Estimate(None)

    return statistic


def _iqm(name: str) -> Callable[[Rows], float | None]:
    """Return the interquartile mean of a metric over all worlds, None if it is unknown in all."""

    def statistic(rows: Rows) -> float | None:
        found = list(_values(rows, name).values())
        return float(iqm(np.array(found))) if found else None

    return statistic


def _improvement(other: Rows, rows: Rows) -> Estimate:
    """Return the probability that a map of a policy is better than one of the first policy, with its interval."""
    own, first = (grouped(side, ("family",)) for side in (rows, other))
    common = [family for family in own if family in first]
    if not common or rows[0]["policy"] == other[0]["policy"]:
        return Estimate(None)
    xs, ys = ([-np.array(list(_values(side[family]).values())) for family in common] for side in (own, first))
    return _estimate(probability_of_improvement(xs, ys))


def _in_family(family: str, other: Rows, rows: Rows) -> str:
    """Return the mean E in a family, and the paired difference to the first policy."""
    own, first = (_values(_of(side, family=family)) for side in (rows, other))
    text = number(_mean(own.values()), 1, CM)
    if not own.keys() & first.keys() or rows[0]["policy"] == other[0]["policy"]:
        return text
    column = _e_column("")
    return f"{text}, {column.text(column.scaled(_paired(own, first)))}"


def _share_of_error(name: str, rows: Rows) -> float:
    """Return the share of a part in the mean of the squared map error."""
    parts = {part: _mean(row[f"squared_{part}"] for row in rows) or 0.0 for part in PARTS_OF_E}
    return parts[name] / float(sum(parts.values()))


def _refused(reason: str, rows: Rows) -> float:
    """Return the number of attempts per episode that were refused for a reason."""
    return float(np.mean([row["refusals"].get(reason, 0) for row in rows]))


def _share_below(limit: float, rows: Rows) -> float:
    """Return the share of worlds, the mean over families, with a smaller map error [m]."""
    return float(performance_profile([-own for own in by_family(_values(rows))], np.array([-limit]))[0])


def _with_all(part: str, rows: Rows) -> float | None:
    """Return the mean E of a part over the worlds with all oracles that are in the base part."""
    whole, base = _values(_of(rows, part=ORACLES, oracle="all")), _values(_of(rows, part=BASE_PART))
    return _mean((base if part == BASE_PART else whole)[world] for world in whole if world in base)


def _rung(oracle: str, rows: Rows) -> Estimate:
    """Return what an oracle takes off E, paired over the worlds with it."""
    return _paired(_values(_of(rows, part=BASE_PART)), _values(_of(rows, part=ORACLES, oracle=oracle)))


# ------------------------------------------------------------------ values


def _of(rows: Rows, **where: Any) -> Rows:
    """Return the rows with some values."""
    return [row for row in rows if all(row[name] == value for name, value in where.items())]


def _values(rows: Rows, name: str = "map_error") -> Values:
    """Return a metric of the rows of a policy by family and seed, without unknown values."""
    return {(row["family"], row["seed"]): float(row[name]) for row in rows if row[name] is not None}


def _mean(values: Iterable[float]) -> float | None:
    known = list(values)
    return float(np.mean(known)) if known else None


def _paired(own: Values, other: Values) -> Estimate:
    """Return the mean difference on common worlds with its interval."""
    apart = {world: own[world] - other[world] for world in own if world in other}
    return _estimate(stratified_ci(by_family(apart), pooled(_average))) if apart else Estimate(None)


def _average(values: FloatArray) -> FloatArray:
    return np.asarray(values.mean(axis=-1))


def _estimate(found: tuple[float, float, float]) -> Estimate:
    return Estimate(found[0]) if np.isnan(found[1]) else Estimate(*found)


def _names(rows: Rows) -> str:
    return ", ".join(f"`{label(name)}`" for name in dict.fromkeys(row["policy"] for row in rows))
