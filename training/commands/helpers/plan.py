"""Runs of benchmark plans, repetition of their episodes, and the leaderboard."""

from contextlib import closing
from dataclasses import asdict, replace
from functools import partial
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from training.bench.exploration.config import ExplorationConfig, PlanConfig, Trial
from training.commands.helpers.progress import TrialSet, run_trial_set, trial_progress
from training.commands.helpers.run_folder import Call
from training.commands.study import plain_lines, print_table
from training.experiments.output.console import print_error

if TYPE_CHECKING:  # numerical modules are imported when the command runs, so that --help is fast
    from training.bench.exploration.plan import Plan

COMMAND = "bench exploration"
OPEN = ("policies", "decision_limit")  # options that a plan leaves open

PlanName = Annotated[
    str | None, typer.Option(help="Plan of a benchmark: vslam-bench-v1, or a TOML file.", show_default="none")
]
Tracks = Annotated[
    str | None, typer.Option(help="Tracks of --plan, with commas between their names.", show_default="all")
]
Base = Annotated[bool, typer.Option("--base", help="Play only the episodes of --plan that a row needs.")]
Verified = Annotated[
    Path | None, typer.Option(help="Run folder whose episodes are played again and compared.", show_default=False)
]
VerifiedRows = Annotated[
    int | None,
    typer.Option(
        "--rows", help="Number of episodes of each policy that --verify plays.", min=1, show_default="a tenth"
    ),
]


def is_plan_run(call: Call[ExplorationConfig]) -> bool:
    """Return whether the configuration in --config is that of a plan."""
    from training.experiments.run_folder import read_config

    return call.file is not None and "plan" in read_config(call.file, COMMAND)[0]


def run_plan(
    call: Call[ExplorationConfig], name: str | None, tracks: str | None, base: bool, workers: int, cluster: str | None
) -> None:
    """Play the episodes of a plan that the run folder does not contain yet, and write its tables."""
    from slam_backend.core.text_files import read_text
    from training.bench.exploration.episodes import CSV, PARQUET, check_row, episodes_csv, write_parquet
    from training.bench.exploration.plan import PLAN_COPY, PlanBench, PlanTrial
    from training.bench.exploration.plan_report import draw_plan, markdown, ordered, tables
    from training.bench.exploration.trials import check_same_policies, checks, play
    from training.experiments.machine.numerics import PORTABLE, variables_for
    from training.experiments.output.tables import E_SCALE
    from training.experiments.policy_names import check_named

    config, plan = _configured(call, name, tracks, base)
    _check_same_plan(call.out, plan)
    trials = plan.trials(config.policies, config.tracks, config.extent)
    check_named((trial.policy for trial in trials), call.given.get("policies"))
    check_same_policies(call.out, {trial.policy for trial in trials})
    bench = PlanBench(plan, config.decision_limit)
    first = [trial for trial in trials if (trial.track, trial.relaxation) == (trials[0].track, trials[0].relaxation)]
    console, folder = call.begin(*checks(bench, first), config=config)
    if (file := Path(config.plan)).is_file():
        folder.write_text(PLAN_COPY, read_text(file, "plan", "a TOML file"))
    if missing := plan.missing_floor_plans():
        text = f"Floor plans are left out: VSLAM_DATA does not contain {len(missing)} of {len(plan.floor_plans)}."
        console.print(text, soft_wrap=True)
    part = TrialSet(
        kind=PlanTrial, play=partial(play, bench), trials=trials, workers=workers, cluster=cluster,
        check=check_row, variables=variables_for(PORTABLE),
    )  # fmt: skip
    rows = run_trial_set(console, folder, part)
    found = [(table, lines) for table in tables(plan, rows) if (lines := table.lines(ordered(plan, rows)))]
    for table, lines in found[:1]:  # as far as it fits into 80 columns
        print_table(console, replace(table, columns=table.columns[:2]), lines)
    console.print(E_SCALE)
    by_name = {table.name: plain_lines(lines) for table, lines in found}
    call.write({"plan": plan.name, "plan_hash": plan.digest, "tables": by_name})
    folder.write_text(CSV, episodes_csv(rows))
    if rows and not write_parquet(folder.path / PARQUET, rows):
        text = f"{PARQUET} is not written: it needs pip install 'vslam-env[parquet]'."
        console.print(text, soft_wrap=True)
    folder.write_text("tables.md", markdown(plan, rows, config.policies or plan.policies))
    draw_plan(folder.path / "plan.png", plan, rows)
    call.finish()
    if part.failures:
        raise typer.Exit(2)


def _configured(
    call: Call[ExplorationConfig], name: str | None, tracks: str | None, base: bool
) -> "tuple[PlanConfig, Plan]":
    """Return the configuration of a run of a plan, and the plan.

    Raises:
        ValueError: If an option is given that the plan fixes, or the plan has changed since the run in --config.
    """
    from slam_backend.core.validation import argument_error
    from training.bench.exploration.plan import BASE, QUICK, Plan
    from training.experiments.policy_names import check_configuration
    from training.experiments.run_folder import read_config

    for option in call.given:
        if option not in OPEN:
            hint = "Omit it, or write a plan of your own."
            raise argument_error(option, "no value with --plan, which fixes it", call.given[option], hint)
    earlier = read_config(call.file, COMMAND)[0] if call.file is not None else {}
    check_configuration(earlier, call.given)
    values = earlier | {key: call.given[key] for key in OPEN if key in call.given}
    values |= {"plan": name} if name is not None else {}
    if call.quick and base:
        raise argument_error("base", "no value with --quick", True, "Give one of the two.")
    values |= {"extent": QUICK if call.quick else BASE} if call.quick or base else {}
    values |= {"tracks": tuple(name.strip() for name in tracks.split(","))} if tracks is not None else {}
    plan = Plan.load(values["plan"])
    config = PlanConfig.from_mapping(values | {"plan_hash": plan.digest})
    if earlier.get("plan") == config.plan and earlier["plan_hash"] != plan.digest:
        hint = "Use the release that wrote it."
        raise argument_error("config", f"a run of plan {plan.digest}", earlier["plan_hash"], hint)
    return config, plan


def _check_same_plan(out: Path | None, plan: "Plan") -> None:
    """Refuse to resume results of another plan or of another version of the package."""
    from slam_backend.core.validation import argument_error
    from training.experiments.run_folder import CONFIG_FILE, installed_versions, read_config, read_versions

    if out is None or not (out / CONFIG_FILE).is_file():
        return
    kept = read_config(out, COMMAND, "out")[0]
    hint = "Choose another folder, or the release that wrote it."
    if kept.get("plan_hash") != plan.digest:
        got = f"one of {kept.get('plan', 'no plan')!r}, hash {kept.get('plan_hash', 'none')}"
        raise argument_error("out", f"a folder of plan {plan.name!r}, hash {plan.digest}", got, hint)
    before, now = read_versions(out).get("vslam-env"), installed_versions().get("vslam-env")
    if before != now:
        raise argument_error("out", f"results of vslam-env {now}", f"results of {before}", hint)


def verify_rows(call: Call[ExplorationConfig], folder: Path, count: int | None, workers: int) -> None:
    """Play some episodes of each policy of a run again, and compare them with what the run stored.

    Processes that play them have the numerics of the stored ones, where this processor can do these.

    Raises:
        typer.Exit: With status 1 if an episode differs from what the run says of it, with the same numerics and
            versions.
    """
    import numpy as np

    from slam_backend.core.validation import argument_error
    from training.bench.exploration.episodes import check_row, kept_episodes
    from training.bench.exploration.plan import Plan, PlanBench, PlanTrial
    from training.bench.exploration.trials import Bench, play
    from training.bench.exploration.verification import OUTCOMES, TABLE, choose, compare, keep, outcome_of, replayed
    from training.experiments.machine.numerics import variables_for
    from training.experiments.policy_names import check_named
    from training.experiments.run_folder import CONFIG_FILE, read_config
    from training.experiments.statistics import grouped
    from training.experiments.trial_store import FAILED, TRIALS_FILE, finished_trials, run_in_processes, trial_of

    values, seed = read_config(folder, COMMAND, "verify")
    check_named(values.get("policies") or (), call.given.get("policies"))
    bench: Bench
    kind: type[Any] = Trial
    if "plan" in values:
        plan = Plan.of_run(folder, values, "verify")
        bench, kind = PlanBench(plan, float(values["decision_limit"])), PlanTrial
    else:
        bench = ExplorationConfig.from_mapping(values | {"seed": seed})
    stored = finished_trials(folder / TRIALS_FILE, kind, check_row if kind is PlanTrial else bool)
    rows_of_run = list(stored.values()) or kept_episodes(folder, "verify") or []
    if kind is PlanTrial:
        replayed(folder, rows_of_run, "verify")  # its errors, before anything is played
    chosen = choose(rows_of_run, count, np.random.default_rng())
    if not chosen or any("digest" not in row for row in chosen):
        hint = f"Check {str(folder / CONFIG_FILE)!r}, or play its episodes again with this release."
        raise argument_error("verify", "a run folder whose episodes have digests", "none", hint)
    check_named((row["policy"] for row in chosen), call.given.get("policies"))
    outcomes = []
    with trial_progress(call.console, len(chosen), timed=False) as (advance, interrupted):
        for (where,), group in grouped(chosen, ("machine",)).items():
            rows = {trial_of(row, kind): row for row in group}
            going = takewhile(lambda _: not interrupted(), rows)
            played = run_in_processes(partial(play, bench), going, workers, variables_for(where))
            with closing(played) as repeated:
                for again in repeated:
                    if FAILED in again:
                        print_error(again[FAILED], call.console)
                        raise typer.Exit(2)
                    trial = trial_of(again, kind)
                    outcomes.append(compare(rows[trial], again))
                    keep(folder, outcomes[-1], asdict(trial))
                    advance(f"{trial.policy}, seed {trial.seed}")
    print_table(call.console, TABLE, TABLE.lines(outcomes))
    others = sorted({(row["stored_on"], row["machine"]) for row in outcomes if row["is_equal"] is None})
    for stored_on, here in others:
        text = f"Other numerics or versions, so that last bits may differ: {stored_on}. Here: {here}."
        call.console.print(text, soft_wrap=True)
    changed = sorted({row["policy"] for row in outcomes if row["is_other_policy"]})
    if changed:
        text = f"The file of {', '.join(changed)} is another one than when the episodes were played."
        call.console.print(text, soft_wrap=True)
    if any(outcome_of(row) == OUTCOMES[-1] for row in outcomes if row["is_equal"] is not None):
        raise typer.Exit(1)


def write_leaderboard(folders: list[Path], out: Path) -> None:
    """Write the tables of all results in some run folders of one plan, and their figure beside the page.

    Raises:
        ValueError: If a folder has no results of a plan, they are no whole results, plans differ, or two folders have
            different policies of the same label.
    """
    from slam_backend.core.files import write_file
    from slam_backend.core.validation import argument_error
    from training.bench.exploration.leaderboard import latest_rows, leaderboard, read_results
    from training.bench.exploration.plan_report import draw_plan

    results = [read_results(folder) for folder in folders]
    for each in results[1:]:
        if each.plan.digest != results[0].plan.digest:
            hint = "Give results of the same plan."
            raise argument_error("folders", f"results of plan {results[0].plan.digest}", each.plan.digest, hint)
    figure = out.with_suffix(".png")
    write_file(out, leaderboard(results, figure.name), "out")
    draw_plan(figure, results[0].plan, latest_rows(results))
    typer.echo(f"Leaderboard: {out}")


def write_submission(folder: Path, out: Path) -> None:
    """Write the files of a submission, and say what to do with them."""
    from training.bench.exploration.leaderboard import status
    from training.bench.exploration.players import label
    from training.bench.exploration.submission import submit
    from training.experiments.statistics import grouped

    results = submit(folder, out)
    typer.echo(f"Submission: {out}")
    for (policy,), rows in grouped(results.rows, ("policy",)).items():
        typer.echo(f"{label(policy)}: {len(rows)} episodes, {status(results.again, rows)}.")
    typer.echo(f"Add this folder to benchmarks/{results.plan.name} in a pull request.")
