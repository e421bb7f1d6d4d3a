"""Leaderboard of a benchmark plan, generated from kept results."""

import gzip
import textwrap
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from slam_backend.core.text_files import read_text
from slam_backend.core.validation import argument_error
from training.bench.exploration.plan import BASE_PART, FLOOR_PLANS, Plan
from training.bench.exploration.plan_report import incomplete, markdown, read_episodes, section
from training.bench.exploration.players import label
from training.bench.exploration.verification import OUTCOMES, last_outcomes
from training.experiments.run_folder import read_config
from training.experiments.statistics import grouped
from training.experiments.study import Column, ResultTable

EPISODES = ("episodes.csv", "episodes.csv.gz")
ABOUT = (
    "Made by `vslam bench leaderboard` from folders of results; this project keeps its own in "
    "`benchmarks/vslam-bench-v0`. `docs/how-to/exploration.md` describes the policies, `docs/reference/metrics.md` the "
    "columns, `docs/how-to/benchmark.md` how to add a row.\n"
)
PICTURE = "Share of worlds below each map error, and map error over the number of robots and particles"


@dataclass(frozen=True, slots=True)
class Results:
    """Results of some policies on a plan."""

    plan: Plan
    rows: Sequence[Mapping[str, Any]]  # A row per episode
    verified: Mapping[str, Sequence[int]]  # Numbers of `OUTCOMES` by policy, see `last_outcomes`


def read_results(folder: Path) -> Results:
    """Read the results in a run folder of a plan; `episodes.csv` may be compressed.

    Raises:
        ValueError: If there are none, they are incomplete, or the installed plan of that name has another hash.
    """
    values, _ = read_config(folder, "bench exploration", "folders")
    rows = kept_episodes(folder)
    if rows is None or "plan" not in values:
        hint = "Run vslam bench exploration --plan."
        raise argument_error("folders", "results of a plan", f"none in {str(folder)!r}", hint)
    plan = Plan.of_run(folder, values, "folders")
    if values.get("quick"):
        hint = "Play without --quick, in a new folder."
        raise argument_error("folders", "complete results", f"those of --quick in {str(folder)!r}", hint)
    if lacking := incomplete(plan, rows, values.get("policies") or plan.policies):
        hint = f"Resume the run in {str(folder)!r}."
        raise argument_error("folders", "complete results", f"a folder in which {lacking[0]}", hint)
    return Results(plan, rows, last_outcomes(folder))


def kept_episodes(folder: Path) -> list[dict[str, Any]] | None:
    """Return the rows of `episodes.csv` or its compressed form in a folder, or None if there is neither."""
    file = next((folder / name for name in EPISODES if (folder / name).is_file()), None)
    if file is None:
        return None
    is_packed = file.suffix == ".gz"
    return read_episodes(gzip.decompress(file.read_bytes()).decode() if is_packed else read_text(file, "folders"))


def played_rows(results: Sequence[Results]) -> list[Mapping[str, Any]]:
    """Return the rows of the finished parts of all policies.

    A policy in several folders, such as the baseline, counts once, as in the first of them.

    Raises:
        ValueError: If two folders have different custom policies or models of the same label, or a policy has not
            played in a family in which another one has.
    """
    kept: dict[str, Sequence[Mapping[str, Any]]] = {}
    for each in results:
        for (policy,), group in grouped(each.rows, ("policy",)).items():
            sources = {row["policy_digest"] for row in (*kept.get(policy, []), *group)}
            if len(sources) > 1:
                raise argument_error("folders", "one policy for each label", policy, "Give one of them a LABEL=.")
            kept.setdefault(policy, _finished(each.plan, policy, group))
    families = {policy: {row["family"] for row in group if row["part"] == BASE_PART} for policy, group in kept.items()}
    all_families = set().union(*families.values())
    for policy, own_families in families.items():
        if missing := all_families - own_families:
            hint = "Set VSLAM_DATA, and resume the run." if FLOOR_PLANS in missing else "Resume the run."
            got = f"none of {policy!r} in {', '.join(sorted(missing))}"
            raise argument_error("folders", "episodes of all policies in the same families", got, hint)
    return [row for group in kept.values() for row in group]


def leaderboard(results: Sequence[Results], figure: str) -> str:
    """Return the page: figure, all tables, and which episodes were played again.

    Args:
        results: Results of one plan.
        figure: Path from the page to the picture that `draw_plan` makes of `played_rows`.

    Raises:
        ValueError: As in `played_rows`.
    """
    rows = played_rows(results)
    verified = {policy: counts for each in results for policy, counts in each.verified.items()}
    again = ResultTable(
        name="verification", title="Verification", by=("policy",), words={"policy": ("policy", label)},
        note="Episodes of each policy that were played again at the last verification: all bits are compared where "
        "versions are the same and the processor can do the same, all results up to a ten-thousandth elsewhere.",
        columns=(
            Column("episodes", statistic=len, digits=0),
            *(
                Column(outcome, "" if i else f"again: {outcome}", partial(_verified, verified, i), digits=0)
                for i, outcome in enumerate(OUTCOMES)
            ),
        ),
    )  # fmt: skip
    machines = sorted({str(row["machine"]) for row in rows})
    text = "\n".join([
        "# Leaderboard of exploration policies\n", ABOUT, f"![{PICTURE}]({figure})\n",
        markdown(results[0].plan, rows, ()), section(again, again.lines(rows)), f"Played on: {'; '.join(machines)}.\n",
    ])  # fmt: skip
    return "\n".join(line if line[:1] in "#!|" else _wrapped(line) for line in text.split("\n"))


def _verified(counts: Mapping[str, Sequence[int]], outcome: int, rows: Sequence[Mapping[str, Any]]) -> int | None:
    """Return the number of episodes of a policy with an outcome, None if none were played again."""
    return counts[rows[0]["policy"]][outcome] if rows[0]["policy"] in counts else None


def _wrapped(line: str) -> str:
    return textwrap.fill(line, 120, break_long_words=False, break_on_hyphens=False)


def _finished(plan: Plan, policy: str, rows: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Return the rows of parts of which none is missing; `read_results` checks the base part."""
    wanted = Counter(trial.part for trial in plan.trials((policy,)))
    parts = grouped(rows, ("part",)).items()
    return [row for (part,), own in parts if part == BASE_PART or len(own) >= wanted[part] for row in own]
