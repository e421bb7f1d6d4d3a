"""Tables and figure of a benchmark plan: interquartile means, differences, oracle ladder, team sizes."""

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

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
from training.bench.exploration.report import COLOURS, STYLES, label
from training.experiments.plotting import picture, save_png
from training.experiments.statistics import grouped
from training.experiments.tables import E_SCALE, csv_text, markdown_table, number

Rows = Sequence[Mapping[str, Any]]
Values = dict[tuple[str, int], float]  # of worlds, by family and seed
FACTORS = ("large_world", "one_robot", "five_robots", "hard", "lossy_radio")
ORACLES, TEAM_SIZE = "oracles", "team_size"
PARTS_OF_E = ("missed", "misplaced", "duplicate", "false")
PROFILE_CM = (10.0, 20.0, 30.0, 40.0)
THRESHOLDS = np.linspace(0.0, 0.75, 151)  # of E [m]
CM = 100.0
REFUSED = "refused: "  # columns of the number of refused merges by reason
TEXTS = (
    "part",
    "policy",
    "family",
    "world",
    "oracle",
    "preset",
    "digest",
    "policy_digest",
    "machine",
)  # columns of texts


class Section(NamedTuple):
    """Table with its title and a note below it."""

    title: str
    note: str
    headings: Sequence[str]
    rows: Sequence[Sequence[str]]


def sections(plan: Plan, rows: Rows) -> list[Section]:
    """Return all tables for which there are rows; policies are ordered by their map error in the base part."""
    base = [row for row in rows if row["part"] == BASE_PART]
    first = next((name for name in plan.policies if any(row["policy"] == name for row in base)), None)
    found = []
    if base:
        order = sorted({row["policy"] for row in base}, key=lambda name: float(_iqm(base, name, "map_error")))
        found += [_overall(base, order, first), _families(base, order, first), _error_table(base, order)]
        found += [_merge_table(base, order), _profile_table(base, order)]
        found += [_factors(plan, rows, order), _ladder(rows, order)]
    found.append(_team_sizes(rows))
    return [section for section in found if section.rows]


def markdown(plan: Plan, rows: Rows, policies: Sequence[str]) -> str:
    """Return all tables as Markdown, with what is left out.

    Args:
        policies: Labels of the policies that should have rows.
    """
    parts = [f"Plan {plan.name}, hash {plan.digest}. {E_SCALE}\n"]
    if plan.floor_plans and not any(row["family"] == FLOOR_PLANS for row in rows):
        parts.append("There are no rows of floor plans: they need `VSLAM_DATA`, and `--quick` leaves them out.\n")
    parts += [f"Not a complete result: {text}.\n" for text in incomplete(plan, rows, policies)]
    for section in sections(plan, rows):
        parts.append(f"### {section.title}\n\n{section.note}\n\n{markdown_table(section.headings, section.rows)}")
    return "\n".join(parts)


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


def aggregate(plan: Plan, rows: Rows) -> list[dict[str, Any]]:
    """Return a line for each part and policy: worlds, and interquartile means of the main metrics with intervals."""
    found = []
    for (part, policy), group in grouped(rows, ("part", "policy")).items():
        line: dict[str, Any] = {"part": part, "policy": policy, "episodes": len(group)}
        for name in ("map_error", "mean_coverage", "below_50_s", "below_90_s", "map_recall", "ate_start_m"):
            worlds = [np.array([row[name] for row in family]) for family in grouped(group, ("family",)).values()]
            line |= dict(zip((name, f"{name}_low", f"{name}_high"), stratified_ci(worlds, pooled(iqm)), strict=True))
        found.append(line)
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
    tidy = tidy_rows(rows)
    names = list(tidy[0]) if tidy else []
    return csv_text(names, ([row[name] for name in names] for row in tidy))


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
    played = [(draw, own) for part, draw in parts.items() if (own := [row for row in rows if row["part"] == part])]
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
    names = sorted({row["policy"] for row in base}, key=lambda name: float(_iqm(base, name, "map_error")))
    for i, policy in enumerate(names):
        worlds = [-own for own in by_family(_values(base, policy, "map_error"))]
        style = STYLES[i // len(COLOURS) % len(STYLES)]
        share = performance_profile(worlds, -THRESHOLDS)
        panel.plot(THRESHOLDS, share, style, color=COLOURS[i % len(COLOURS)], label=label(policy), linewidth=1.3)
    panel.set(xlabel="map error E [m]", ylabel="share of worlds with a smaller error", title="base part")


def _draw_team_sizes(panel: Axes, sizes: Rows) -> None:
    """Draw E over the number of robots, a line per number of particles."""
    for i, ((particles,), group) in enumerate(sorted(grouped(sizes, ("particles",)).items())):
        teams = sorted(grouped(group, ("robots",)).items())
        middle, low, high = np.array([_ci(each, "map_error") for _, each in teams]).T
        robots, colour = [count for (count,), _ in teams], COLOURS[i % len(COLOURS)]
        panel.plot(robots, middle, "o-", color=colour, label=f"{particles} particles", markersize=3)
        panel.fill_between(robots, low, high, color=colour, alpha=0.12, linewidth=0)
    panel.set(xlabel="robots", ylabel="map error E [m]", title="team size and particles")
    panel.set_xticks(sorted({row["robots"] for row in sizes}))


# ------------------------------------------------------------------ tables


def _overall(base: Rows, order: Sequence[str], first: str | None) -> Section:
    """Return the main table: one row per policy over all worlds of the base part."""
    columns: Sequence[tuple[str, str, int, float]] = (
        ("E [cm]", "map_error", 1, CM), ("coverage over time [%]", "mean_coverage", 1, CM),
        ("T50 [s]", "below_50_s", 0, 1.0),
        ("T90 [s]", "below_90_s", 0, 1.0), ("recall [%]", "map_recall", 1, CM), ("ATE [cm]", "ate_start_m", 1, CM),
        ("NEES", "nees", 1, 1.0),
    )  # fmt: skip
    lines = []
    for policy in order:
        played = [row for row in base if row["policy"] == policy]
        cells = [_with_ends(_ci(played, name), digits, factor) for _, name, digits, factor in columns[:2]]
        cells += [number(float(_iqm(base, policy, name)), digits, factor) for _, name, digits, factor in columns[2:]]
        lines.append(
            [label(policy), *cells, number(_mean(played, "decision_p99_ms"), 1), _improvement(base, policy, first)]
        )
    note = f"Interquartile means over {_worlds(base)} worlds, with 95 % intervals."
    if first is not None:
        note += f" P: probability that the map of a random world is better than one of `{first}`."
    headings = ["all worlds", *(heading for heading, *_ in columns), "decision, p99 [ms]", "P"]
    return Section("All worlds", note, headings, lines)


def _families(base: Rows, order: Sequence[str], first: str | None) -> Section:
    """Return E of each family, and the paired difference to the first policy."""
    families = list(dict.fromkeys(row["family"] for row in base))
    lines = []
    for policy in order:
        cells = []
        for family in families:
            own = _values([row for row in base if row["family"] == family], policy, "map_error")
            other = _values([row for row in base if row["family"] == family], str(first), "map_error")
            cells.append(number(float(np.mean(list(own.values()))), 1, CM) if own else "-")
            if policy != first and own.keys() & other.keys():
                cells[-1] += f", {_with_ends(_paired(own, other), 1, CM)}"
        lines.append([label(policy), *cells])
    note = f"Means of E [cm] and, behind the comma, paired differences to `{first}` with their 95 % intervals."
    return Section("Families", note, ["E [cm]", *families], lines)


def _error_table(base: Rows, order: Sequence[str]) -> Section:
    """Return what the squared map error consists of."""
    lines = []
    for policy in order:
        played = [row for row in base if row["policy"] == policy]
        parts = [_mean(played, f"squared_{name}") for name in PARTS_OF_E]
        lines.append([
            label(policy), *(number(part / sum(parts), 1, CM) for part in parts),
            number(_mean(played, "map_rmse_m"), 1, CM), number(_mean(played, "map_precision"), 1, CM),
        ])  # fmt: skip
    note = "Shares of the mean of E^2 [%]; RMSE of the landmarks found, and the share of found ones that exist."
    headings = ["parts of E^2 [%]", *PARTS_OF_E, "RMSE [cm]", "precision [%]"]
    return Section("What the map error consists of", note, headings, lines)


def _merge_table(base: Rows, order: Sequence[str]) -> Section:
    """Return merges, contacts and driving, per episode."""
    reasons = sorted({reason for row in base for reason in row["refusals"]})
    lines = []
    for policy in order:
        played = [row for row in base if row["policy"] == policy]
        names = ("right_merges", "false_merges", "undone_merges", "last_merge_s")
        refused = [sum(row["refusals"].get(reason, 0) for row in played) / len(played) for reason in reasons]
        lines.append([
            label(policy), *map(number, (_mean(played, name) for name in names), (2, 2, 2, 0)),
            number(_mean(played, "overlap"), 0, CM), number(_mean(played, "way_m"), 0),
            number(_mean(played, "balance"), 2),
            number(_mean(played, "collisions"), 1, 0.1), number(_mean(played, "bytes_sent"), 0, 1e-3),
            *(number(share, 1) for share in refused),
        ])  # fmt: skip
    headings = [
        "per episode", "merged", "false", "undone", "last [s]", "overlap [%]", "path [m]", "balance", "collisions [s]",
        "sent [kB]", *reasons,
    ]  # fmt: skip
    note = (
        "Overlap: share of the seen floor that two robots have seen. Balance: shortest over longest path of a team. "
        "The last columns count refused attempts by reason."
    )
    return Section("Merges and driving", note, headings, lines)


def _profile_table(base: Rows, order: Sequence[str]) -> Section:
    """Return the performance profile at a few map errors."""
    limits = -np.array(PROFILE_CM) / CM
    lines = []
    for policy in order:
        profile = performance_profile([-own for own in by_family(_values(base, policy, "map_error"))], limits)
        lines.append([label(policy), *(number(float(share), 0, CM) for share in profile)])
    headings = ["worlds [%]", *(f"E < {limit:g} cm" for limit in PROFILE_CM)]
    return Section("Performance profile", "Share of the worlds with a smaller map error.", headings, lines)


def _factors(plan: Plan, rows: Rows, order: Sequence[str]) -> Section:
    """Return E where one factor differs from the base part."""
    parts = plan.all_parts()
    names = [name for name in FACTORS if name in parts and any(row["part"] == name for row in rows)]
    lines = []
    for policy in order:
        own = [[row for row in rows if (row["part"], row["policy"]) == (name, policy)] for name in names]
        if any(own):
            lines.append([label(policy), *(_with_ends(_ci(each, "map_error"), 1, CM) if each else "-" for each in own)])
    note = "Interquartile means of E [cm] with 95 % intervals; all else as in the base part."
    return Section("One factor at a time", note, ["E [cm]", *(parts[name].title for name in names)], lines)


def _ladder(rows: Rows, order: Sequence[str]) -> Section:
    """Return how much of E each oracle removes, on the worlds of that part."""
    lines = []
    for policy in order:
        told = [row for row in rows if (row["part"], row["policy"]) == (ORACLES, policy)]
        by_oracle = {
            oracle: _values(group, policy, "map_error") for (oracle,), group in grouped(told, ("oracle",)).items()
        }
        if "all" not in by_oracle:
            continue
        base = _values([row for row in rows if row["part"] == BASE_PART], policy, "map_error")
        worlds = [world for world in by_oracle["all"] if world in base]
        if not worlds:
            continue
        cells = [number(float(np.mean([base[world] for world in worlds])), 1, CM)]
        cells += [
            _with_ends(_paired(base, by_oracle[name]), 1, CM) if name in by_oracle else "-"
            for name in ("pose", "association", "merge", "all")
        ]
        cells.append(number(float(np.mean([by_oracle["all"][world] for world in worlds])), 1, CM))
        lines.append([label(policy), *cells])
    note = (
        "E [cm] without oracles; what knowing the poses, the landmarks' identities, the alignment of maps, and all "
        "three takes off it, paired; and what is left with all: landmarks that exploration did not reach."
    )
    headings = ["E [cm]", "none", "localisation", "association", "merging", "all", "left: exploration"]
    return Section("Oracle ladder", note, headings, lines)


def _team_sizes(rows: Rows) -> Section:
    """Return E over the numbers of robots and particles."""
    own = [row for row in rows if row["part"] == TEAM_SIZE]
    robots = sorted({row["robots"] for row in own})
    lines = [
        [f"{particles} particles", *(
            _with_ends(_ci([row for row in each if row["robots"] == count], "map_error"), 1, CM) for count in robots
        )]
        for (particles,), each in sorted(grouped(own, ("particles",)).items())
    ]  # fmt: skip
    note = f"Interquartile means of E [cm] of {_names(own)}: Fig. 6b of the paper, with robots that explore."
    return Section("Team size and particles", note, ["E [cm]", *(f"K = {count}" for count in robots)], lines)


# ------------------------------------------------------------------ values


def _values(rows: Rows, policy: str, name: str) -> Values:
    """Return a metric of a policy by family and seed, without unknown values."""
    own = (row for row in rows if row["policy"] == policy and row[name] is not None)
    return {(row["family"], row["seed"]): float(row[name]) for row in own}


def _iqm(rows: Rows, policy: str, name: str) -> FloatArray:
    """Return the interquartile mean of a metric over all worlds, NaN if it is unknown in all."""
    found = list(_values(rows, policy, name).values())
    return iqm(np.array(found)) if found else np.array(np.nan)


def _mean(rows: Rows, name: str) -> float:
    """Return the mean of the known values of a metric, NaN if there are none."""
    found = [row[name] for row in rows if row[name] is not None]
    return float(np.mean(found)) if found else float("nan")


def _ci(rows: Rows, name: str) -> tuple[float, float, float]:
    """Return the interquartile mean of a metric with its interval; rows of several conditions are pooled."""
    families = grouped([row for row in rows if row[name] is not None], ("family",)).values()
    return stratified_ci([np.array([row[name] for row in own], float) for own in families], pooled(iqm))


def _paired(own: Values, other: Values) -> tuple[float, float, float]:
    """Return the mean difference on common worlds with its interval."""
    worlds = [world for world in own if world in other]
    return stratified_ci(by_family({world: own[world] - other[world] for world in worlds}), pooled(_average))


def _average(values: FloatArray) -> FloatArray:
    return np.asarray(values.mean(axis=-1))


def _improvement(base: Rows, policy: str, first: str | None) -> str:
    """Return the probability that a map of a policy is better than one of the first policy, with its interval."""
    if policy == first or first is None:
        return "-"
    own, other = (_values(base, name, "map_error") for name in (policy, first))
    families = [family for family in dict.fromkeys(f for f, _ in own) if any(f == family for f, _ in other)]
    if not families:
        return "-"
    xs, ys = (
        [-np.array([v for (f, _), v in side.items() if f == family]) for family in families] for side in (own, other)
    )
    return _with_ends(probability_of_improvement(xs, ys), 2, 1.0)


def _with_ends(value: tuple[float, float, float], digits: int, factor: float) -> str:
    """Format a value with its interval."""
    middle, low, high = (number(each, digits, factor) for each in value)
    return middle if low == "-" else f"{middle} ({low} .. {high})"


def _worlds(rows: Rows) -> int:
    return len({(row["family"], row["seed"]) for row in rows})


def _names(rows: Rows) -> str:
    return ", ".join(f"`{label(name)}`" for name in dict.fromkeys(row["policy"] for row in rows))
