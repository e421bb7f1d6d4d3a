"""Tables and figure of a benchmark plan: the mean of its tracks, each track, and what each limit costs."""

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from training.bench.exploration.aggregate import mean_with_interval, performance_profile, strata_of
from training.bench.exploration.plan import BASE, FLOOR_PLANS, NO_RELAXATION, Plan, PlanTrial
from training.bench.exploration.players import label
from training.experiments.output.plotting import picture, save_png
from training.experiments.output.study_chart import COLOURS, STYLES
from training.experiments.output.tables import E_SCALE, escaped, markdown_table
from training.experiments.statistics import grouped
from training.experiments.study import Column, Estimate, ResultTable, Statistic
from training.experiments.trial_store import trial_of

Rows = Sequence[Mapping[str, Any]]
Values = dict[tuple[Any, ...], float]  # of worlds, by `WORLD`
WORLD = ("track", "family", "robots", "seed")
ACTION_TRACKS = {"drive": "continuous", "goal": "goal"}  # tracks that compare policies with one kind of actions alone
PARTS_OF_E = ("missed", "misplaced", "duplicate", "false")
THRESHOLDS = np.linspace(0.0, 0.75, 151)  # of E [m]
CM = 100.0

# ------------------------------------------------------------------ tables


def tables(plan: Plan, rows: Rows) -> list[ResultTable]:
    """Return the tables of a plan; their columns depend on what was played."""
    played = _of(rows, relaxation=NO_RELAXATION)
    first = next((name for name in plan.policies if _of(played, policy=name)), None)
    other = _of(played, policy=first)
    base = [name for name, track in plan.all_tracks.items() if track.base]
    played_by = {name: {row["policy"] for row in _of(played, track=name) if _is_base(plan, row)} for name in base}
    whole = set.intersection(*played_by.values()) if base else set()  # policies with a mean over all of them
    title = " and ".join(base)
    compared = f" Differences to `{shown(first)}` are paired." if first is not None else ""
    note = f"Means over the worlds of the base part, each family and track alike, with 95 % intervals.{compared}"
    each: dict[str, Any] = {"each": ("track",), "by": ("track", "policy")}
    words = {"policy": ("policy", shown), "track": ("track", lambda name: _title(plan, name))}
    is_played: dict[str, Any] = {"words": words, "where": lambda row: row["relaxation"] == NO_RELAXATION}
    less = _column(f"minus {shown(first or '')}", partial(_difference, other))
    headline = (
        _e_column("E [cm]"), less, *(_e_column(f"{name} [cm]", track=name) for name in base),
        Column("decision_p99_ms", "decision, p99 [ms]", digits=1),
        Column("bytes_sent", "sent [kB]", digits=0, factor=1e-3), Column("way_m", "path [m]", digits=0),
    )  # fmt: skip
    return [
        ResultTable(
            name="headline", title=f"Mean of {title}", note=note, by=("policy",), columns=headline, words=words,
            where=partial(_counts, plan, whole, None),
        ),
        *(
            ResultTable(
                name=name, title=f"Track {name}: {actions} actions only, mean of {title}", by=("policy",),
                columns=headline, words=words,
                where=partial(_counts, plan, whole, actions),
            )
            for name, actions in ACTION_TRACKS.items()
        ),
        ResultTable(
            name="maps", title="Maps", **each, **is_played,
            columns=(
                Column("episodes", statistic=len, digits=0), _e_column("E [cm]"), less,
                *(_column(f"{part} [%]", partial(_share_of_error, part), 0) for part in PARTS_OF_E),
                Column("map_recall", "recall [%]", digits=1, factor=CM),
                Column("map_rmse_m", "RMSE [cm]", digits=1, factor=CM), Column("nees", "NEES", digits=1),
                Column("right_merges", "merged", digits=2),
                Column("false_merges", "false merges", digits=3), Column("undone_merges", "undone", digits=2),
                Column("last_merge_s", "last [s]", digits=0),
            ),
        ),
        ResultTable(
            name="driving", title="Driving", **each, **is_played,
            columns=(
                Column("mean_coverage", "coverage over time [%]", digits=1, factor=CM),
                Column("below_50_s", "T50 [s]", digits=0), Column("below_90_s", "T90 [s]", digits=0),
                Column("overlap", "overlap [%]", digits=0, factor=CM), Column("way_m", "path [m]", digits=0),
                Column("balance", digits=2), Column("collisions", "collisions [s]", digits=1, factor=0.1),
                Column("invalid_actions", "invalid", digits=1),
                Column("bytes_sent", "sent [kB]", digits=0, factor=1e-3),
                Column("decision_ms", "decision [ms]", digits=1), Column("decision_p99_ms", "p99 [ms]", digits=1),
            ),
        ),
        ResultTable(
            name="worlds", title="E in each world [cm]", **each, **is_played,
            columns=tuple(_e_column(heading, **where) for heading, where in _places(plan, played).items()),
        ),
        ResultTable(
            name="limits", title="What each limit costs", each=("track",), by=("track", "relaxation"),
            note=f"E of `{plan.relaxed_policy}` with one limit relaxed, in the same worlds.",
            words={"track": words["track"], "relaxation": ("relaxed", lambda name: plan.all_relaxations[name].title)},
            columns=(
                Column("worlds", statistic=len, digits=0), _e_column("E [cm]"),
                _column("difference", partial(_difference, _of(played, policy=plan.relaxed_policy), relaxed=True)),
            ),
            where=lambda row: row["relaxation"] != NO_RELAXATION,
        ),
    ]  # fmt: skip


def sections(plan: Plan, rows: Rows) -> Iterable[tuple[ResultTable, str, list[str], list[list[str]]]]:
    """Yield each table, its title, headings and cells, without columns in which no line has a value."""
    for table in tables(plan, rows):
        for title, cells in table.parts(table.lines(ordered(plan, rows))):
            kept = [k for k in range(len(table.headings)) if k == 0 or any(line[k] != "-" for line in cells)]
            yield table, title, [table.headings[k] for k in kept], [[line[k] for k in kept] for line in cells]


def ordered(plan: Plan, rows: Rows) -> list[Mapping[str, Any]]:
    """Return the rows policy by policy, ordered by the map error in the base part."""
    errors = {
        policy: _mean([row["map_error"] for row in own if _is_base(plan, row)])
        for (policy,), own in grouped(rows, ("policy",)).items()
    }
    known = {policy: np.inf if error is None else error for policy, error in errors.items()}
    tracks = list(plan.all_tracks)
    return sorted(rows, key=lambda row: (tracks.index(row["track"]), known[row["policy"]]))


def markdown(plan: Plan, rows: Rows, policies: Sequence[str]) -> str:
    """Return all tables as Markdown, with what is left out.

    Args:
        policies: Labels of the policies that should have rows.
    """
    parts = [f"Plan {plan.name}, hash {plan.digest}. {E_SCALE}\n"]
    if plan.floor_plans and not _of(rows, family=FLOOR_PLANS):
        parts.append("There are no rows of floor plans: they need `VSLAM_DATA`, and are no part of the base.\n")
    if empty := [name for name in plan.all_tracks if not _of(rows, track=name)]:
        parts.append(f"Tracks without rows: {', '.join(empty)}.\n")
    parts += [f"Not a complete result: {text}.\n" for text in incomplete(plan, rows, policies)]
    for table, title, headings, cells in sections(plan, rows):
        note = f"{table.note}\n\n" if table.note else ""
        parts.append(f"### {title}\n\n{note}{markdown_table(headings, cells)}")
    return "\n".join(parts)


def incomplete(plan: Plan, rows: Rows, policies: Sequence[str]) -> list[str]:
    """Return a text for each of some policies that lacks episodes of the base part."""
    found, finished = [], {trial_of(row, PlanTrial) for row in rows}
    for policy in dict.fromkeys([*policies, *(row["policy"] for row in rows)]):
        wanted = plan.trials([policy], extent=BASE)
        played = sum(trial in finished for trial in wanted)
        if played < len(wanted):
            found.append(f"`{shown(policy)}` has {played} of {len(wanted)} episodes of the base part")
    return found


@picture
def draw_plan(file: Path, plan: Plan, rows: Rows) -> None:
    """Draw profiles of E of all policies into a PNG file, a panel for each track with a base part that was played."""
    tracks = [
        (name, own)
        for name, track in plan.all_tracks.items()
        if track.base and (own := _of(ordered(plan, rows), track=name, relaxation=NO_RELAXATION))
    ]
    if not tracks:
        return
    policies = list(dict.fromkeys(row["policy"] for row in ordered(plan, rows)))
    figure = Figure(figsize=(4.6 * len(tracks) + 2.2, 4.4), layout="constrained")
    for panel, (name, own) in zip(figure.subplots(1, len(tracks), squeeze=False)[0], tracks, strict=True):
        for (policy,), group in grouped(own, ("policy",)).items():
            i = policies.index(policy)
            style, colour = STYLES[i // len(COLOURS) % len(STYLES)], COLOURS[i % len(COLOURS)]
            share = performance_profile(strata_of(_values(group)), THRESHOLDS)
            panel.plot(THRESHOLDS, share, style, color=colour, label=label(policy).replace("$", r"\$"), linewidth=1.3)
        panel.set(xlabel="map error E [m]", ylabel="share of worlds with a smaller error", title=_title(plan, name))
        panel.grid(alpha=0.2)
        panel.spines[["top", "right"]].set_visible(False)
    panel.legend(fontsize=7, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    save_png(figure, file, 110)


# ------------------------------------------------------------------ columns


def _column(heading: str, statistic: Statistic, digits: int = 1) -> Column:
    return Column(heading, heading, statistic, digits, CM)


def _e_column(heading: str, **where: Any) -> Column:
    """Return the column of the mean of E with its interval, over the rows with some values."""

    def statistic(rows: Rows) -> Estimate:
        values = _values(_of(rows, **where))
        return _estimate(mean_with_interval(strata_of(values))) if values else Estimate(None)

    return _column(heading, statistic)


def _difference(other: Rows, rows: Rows, relaxed: bool = False) -> Estimate:
    """Return the mean difference of E to the other policy on common worlds, with its interval; none to itself."""
    own, first = _values(rows), _values(other)
    apart = {world: own[world] - first[world] for world in own if world in first}
    if not apart or (not relaxed and rows[0]["policy"] == other[0]["policy"]):
        return Estimate(None)
    return _estimate(mean_with_interval(strata_of(apart)))


def _share_of_error(name: str, rows: Rows) -> float:
    """Return the share of a part in the mean of the squared map error."""
    parts = {part: _mean(row[f"squared_{part}"] for row in rows) or 0.0 for part in PARTS_OF_E}
    return parts[name] / max(float(sum(parts.values())), 1e-12)


# ------------------------------------------------------------------ values


def shown(policy: str) -> str:
    """Return the label of a policy as text of a page."""
    return escaped(label(policy))


def _is_base(plan: Plan, row: Mapping[str, Any]) -> bool:
    """Return whether an episode belongs to the base part."""
    is_early = row["seed"] - plan.first_seed < plan.all_tracks[row["track"]].base
    return row["relaxation"] == NO_RELAXATION and row["family"] != FLOOR_PLANS and bool(is_early)


def _counts(plan: Plan, policies: set[str], actions: str | None, row: Mapping[str, Any]) -> bool:
    """Return whether an episode of the base part is one of some policies, and of one kind of actions if it is given."""
    return row["policy"] in policies and actions in (None, row["action_type"]) and _is_base(plan, row)


def _of(rows: Rows, **where: Any) -> Rows:
    """Return the rows with some values."""
    return [row for row in rows if all(row[name] == value for name, value in where.items())]


def _values(rows: Rows) -> Values:
    """Return the map errors of the rows of a policy by world."""
    return {tuple(row[name] for name in WORLD): float(row["map_error"]) for row in rows}


def _mean(values: Iterable[float]) -> float | None:
    known = list(values)
    return float(np.mean(known)) if known else None


def _estimate(found: tuple[float, float, float]) -> Estimate:
    return Estimate(found[0]) if np.isnan(found[1]) else Estimate(*found)


def _title(plan: Plan, track: str) -> str:
    return f"{track}: {plan.all_tracks[track].title}"


def _places(plan: Plan, rows: Rows) -> dict[str, dict[str, Any]]:
    """Return which rows are of each kind of world, by heading; of a number of robots where a track has several."""
    found: dict[str, dict[str, Any]] = {}
    for track, family, robots in grouped(rows, WORLD[:-1]):
        several = len(plan.all_tracks[track].robots) > 1
        where = {"family": family} | ({"robots": robots} if several else {})
        found[f"{family}, K={robots}" if several else family] = where
    return found
