"""Leaderboard of a benchmark plan, generated from kept results that anybody may have written."""

import re
import textwrap
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

from slam_backend.core.validation import argument_error
from training.bench.exploration.episodes import kept_episodes
from training.bench.exploration.plan import BASE, FLOOR_PLANS, QUICK, Plan, PlanTrial
from training.bench.exploration.plan_report import incomplete, markdown, shown
from training.bench.exploration.verification import COMMAND as VERIFY
from training.bench.exploration.verification import OUTCOMES, TENTH, replayed
from training.experiments.output.tables import escaped, markdown_table
from training.experiments.run_folder import read_config
from training.experiments.statistics import grouped
from training.experiments.study import Column, ResultTable
from training.experiments.trial_store import trial_of

COMMAND = "bench exploration"
ABOUT = (
    "Made by `vslam bench leaderboard` from folders of results. `docs/how-to/exploration.md` describes the policies, "
    "`docs/reference/metrics.md` the columns, `docs/how-to/benchmark.md` the tracks and how to add a row.\n"
)
PICTURE = "Share of worlds below each map error"
Rows = Sequence[Mapping[str, Any]]


@dataclass(frozen=True, slots=True)
class Results:
    """Results of some policies on a plan."""

    plan: Plan
    rows: Rows  # A row per episode
    again: Mapping[str, Sequence[int]]  # Numbers of `OUTCOMES` of episodes played again, by policy


def read_results(folder: Path) -> Results:
    """Read the results in a run folder of a plan; `episodes.csv` may be compressed.

    Raises:
        ValueError: If there are none, a row is damaged, out of range, of no episode of the plan, of another task, or
            there twice; or a policy lacks episodes of the base part, or has those of several versions.
    """
    values, _ = read_config(folder, COMMAND, "folders")
    rows = kept_episodes(folder)
    if not rows or "plan" not in values:
        hint = "Run vslam bench exploration --plan."
        raise argument_error("folders", "results of a plan", f"none in {str(folder)!r}", hint)
    plan = Plan.of_run(folder, values, "folders")
    _check_rows(plan, rows, folder)
    if lacking := incomplete(plan, rows, ()):
        whole = f"Go on with the command that began {str(folder)!r}."
        hint = "Play the base part in a new folder: --base --out NEW." if values.get("extent") == QUICK else whole
        raise argument_error("folders", "complete results", f"a folder in which {', '.join(lacking)}", hint)
    return Results(plan, rows, replayed(folder, rows))


def _check_rows(plan: Plan, rows: Rows, folder: Path) -> None:
    """Refuse rows that are not those of the plan's episodes, each once."""
    policies = list(dict.fromkeys(row["policy"] for row in rows))
    known, seen, digests = set(plan.trials(policies, with_missing=True)), Counter[PlanTrial](), Counter[Any]()
    for row in rows:
        trial = trial_of(row, PlanTrial)
        about = f"{trial.track}, {trial.world}, seed {trial.seed}, of {trial.policy!r}"
        if trial not in known:
            raise argument_error("folders", "episodes of the plan", about, f"Remove it from {str(folder)!r}.")
        seen[trial] += 1
        played = trial.policy, trial.track, trial.relaxation, row["digest"]  # tracks may share episodes
        digests[played] += 1
        if seen[trial] > 1 or digests[played] > 1:
            hint = f"Play the episode again in {str(folder)!r}."
            raise argument_error("folders", "each episode once", f"one or its digest twice: {about}", hint)
        if (task := plan.task_of(trial)) is not None and row["task"] != task:
            hint = "The world, the starts or the readings differ: use the release of the plan."
            raise argument_error("folders", f"an episode with the task {task}", f"{row['task']} in {about}", hint)
    for (policy,), own in grouped(rows, ("policy",)).items():
        for name in ("version", "policy_digest", "action_type"):
            if len(values := sorted({str(row[name]) for row in own})) > 1:
                hint = f"Play {policy!r} again in a new folder."
                raise argument_error("folders", f"one {name} for each policy", ", ".join(values), hint)
    if newer := [row["version"] for row in rows if _numbers(row["version"]) > _numbers(version("vslam-env"))]:
        hint = "Use that release."
        raise argument_error("folders", f"results up to version {version('vslam-env')}", newer[0], hint)


def played_rows(results: Sequence[Results]) -> list[Mapping[str, Any]]:
    """Return the rows of all policies: their base part, and the tracks and relaxations that are finished.

    A policy in several folders, such as the baseline, counts once, as in the first of them with the latest version.

    Raises:
        ValueError: If two folders have different custom policies or models of the same label.
    """
    kept: dict[str, Rows] = {}
    plans = {}
    for each in results:
        for (policy,), group in grouped(each.rows, ("policy",)).items():
            sources = {row["policy_digest"] for row in (*kept.get(policy, []), *group)}
            if len(sources) > 1:
                raise argument_error("folders", "one policy for each label", policy, "Give one of them a LABEL=.")
            if policy not in kept or _version(group) > _version(kept[policy]):
                kept[policy], plans[policy] = group, each.plan
    return [row for policy, group in kept.items() for row in _finished(plans[policy], policy, group)]


def leaderboard(results: Sequence[Results], figure: str) -> str:
    """Return the page: figure, all tables of the latest version, and which episodes were played again.

    Args:
        results: Results of one plan.
        figure: Path from the page to the picture that `draw_plan` makes of `latest_rows`.

    Raises:
        ValueError: As in `played_rows`.
    """
    rows, plan = latest_rows(results), results[0].plan
    counts = {policy: each.again[policy] for each in reversed(results) for policy in each.again}
    older = {row["policy"]: row["version"] for row in played_rows(results)}
    older = {policy: name for policy, name in older.items() if policy not in {row["policy"] for row in rows}}
    again = ResultTable(
        name="status", title="Status", by=("policy", "version"), words={"policy": ("policy", shown)},
        columns=(
            Column("status", "status", partial(status, counts)), Column("episodes", statistic=len, digits=0),
            *(
                Column(outcome, "" if i else f"again: {outcome}", partial(_again, counts, i), digits=0)
                for i, outcome in enumerate(OUTCOMES)
            ),
        ),
    )  # fmt: skip
    note = (
        f"*replayed*: at least {TENTH:.0%} of the episodes were played again by `{VERIFY}`, and none differed: in all "
        "bits where versions are the same and the processor can do the same, elsewhere in all numbers up to a "
        "ten-thousandth. *claimed*: fewer were, or some differed."
    )
    machines = sorted({str(row["machine"]) for row in rows})
    text = "\n".join([
        "# Leaderboard of exploration policies\n", ABOUT, f"![{PICTURE}]({figure})\n", markdown(plan, rows, ()),
        f"### {again.title}\n\n{note}\n\n"
        + markdown_table(again.headings, [again.cells(line) for line in again.lines(rows)]),
        *(f"Older: `{shown(policy)}`, played by version {escaped(name)}.\n" for policy, name in older.items()),
        f"Played on: {'; '.join(map(escaped, machines))}.\n",
    ])  # fmt: skip
    return "\n".join(line if line[:1] in "#!|" else _wrapped(line) for line in text.split("\n"))


def latest_rows(results: Sequence[Results]) -> list[Mapping[str, Any]]:
    """Return those of `played_rows` that the latest version among them played."""
    rows = played_rows(results)
    latest = max(_numbers(row["version"]) for row in rows)
    return [row for row in rows if _numbers(row["version"]) == latest]


def status(counts: Mapping[str, Sequence[int]], rows: Rows) -> str:
    """Return "replayed" if enough episodes of a policy were played again, all with the same results, or "claimed"."""
    *same, different = counts.get(rows[0]["policy"], (0, 0, 0))
    return "replayed" if not different and sum(same) >= TENTH * len(rows) else "claimed"


def _again(counts: Mapping[str, Sequence[int]], outcome: int, rows: Rows) -> int | None:
    """Return the number of episodes of a policy with an outcome, None if none were played again."""
    return counts[rows[0]["policy"]][outcome] if rows[0]["policy"] in counts else None


def _wrapped(line: str) -> str:
    return textwrap.fill(line, 120, break_long_words=False, break_on_hyphens=False)


def _finished(plan: Plan, policy: str, rows: Rows) -> list[Mapping[str, Any]]:
    """Return the rows of the base part, and those of tracks, floor plans and relaxations of which none is missing."""

    def part_of(trial: PlanTrial) -> tuple[Any, ...]:
        is_base = trial in base
        return is_base, trial.track, trial.relaxation, trial.family == FLOOR_PLANS

    base = set(plan.trials([policy], extent=BASE))
    wanted = Counter(map(part_of, plan.trials([policy], with_missing=True)))
    played = Counter(part_of(trial_of(row, PlanTrial)) for row in rows)
    return [row for row in rows if played[part := part_of(trial_of(row, PlanTrial))] == wanted[part]]


def _version(rows: Rows) -> tuple[int, ...]:
    return _numbers(rows[0]["version"])


def _numbers(name: str) -> tuple[int, ...]:
    """Return the numbers of a version, which order versions."""
    return tuple(int(part) for part in re.findall(r"\d{1,9}", name)[:4])
