"""Commands `vslam bench ...`: policies, and speed of filters, environments and starts."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from training.bench.config import (
    EnvBenchConfig,
    ExplorationBenchConfig,
    ExplorationTrial,
    FilterBenchConfig,
    StartBenchConfig,
)
from training.commands._options import Workers, options
from training.commands._plan import (
    Cluster,
    PlanName,
    Verified,
    VerifiedRows,
    first_steps,
    is_plan_run,
    run_plan,
    verify_rows,
    write_leaderboard,
)
from training.commands._progress import TrialSet, run_trial_sets, trial_progress
from training.commands._run_folder import Call

bench = typer.Typer(help="Compare policies, and measure the speed of filters and environments.", no_args_is_help=True)


@bench.command("filter")
@options(
    FilterBenchConfig, "bench filter", quick={"measurements": (15,), "robots": (1,), "steps": 100},
    quick_help="15 measurements, 1 robot, 100 steps.",
)  # fmt: skip
def bench_filter(call: Call[FilterBenchConfig]) -> None:
    """Time steps of the filter over particles, landmarks, measurements and robots, on one thread."""
    from training.bench.filter.bench import count_trials, run_bench
    from training.bench.filter.report import draw_speed, print_result

    console, folder = call.begin()
    with trial_progress(console, count_trials(call.config)) as (on_trial, interrupted):
        result = run_bench(call.config, on_trial, interrupted)
    print_result(console, result)
    call.write(result)
    draw_speed(folder.path / "speed.png", result)
    call.finish()


@bench.command("env")
@options(
    EnvBenchConfig, "bench env",
    quick={"robots": (3,), "particles": (100,), "worlds": ("office",), "modes": ("driver",), "steps": 300},
    quick_help="Base configuration only, 300 steps.",
)  # fmt: skip
def bench_env(call: Call[EnvBenchConfig]) -> None:
    """Time steps of environments with the filter in the loop, on one thread, with a breakdown by part."""
    from training.bench.env.bench import count_trials, print_env_result, run_bench
    from vslam_env import vslam_v1

    for load in call.config.loads():  # detects configurations that cannot be built before the folder is created
        vslam_v1.parallel_env(config=load.config())
    console, _ = call.begin()
    with trial_progress(console, count_trials(call.config)) as (on_trial, interrupted):
        result = run_bench(call.config, on_trial, interrupted)
    print_env_result(console, result, call.config.peer)
    call.write(result)
    call.finish()


@bench.command("exploration")
@options(
    ExplorationBenchConfig, "bench exploration", continues=True,
    quick={"worlds": ("office",), "duration": 60.0, "seeds": 3},
    quick_help="Office worlds only, 60 s, 3 seeds; with --plan 2 worlds of four families.",
)  # fmt: skip
def bench_exploration(
    call: Call[ExplorationBenchConfig], plan: PlanName = None, workers: Workers = 1, ray: Cluster = None,
    verify: Verified = None, verified_rows: VerifiedRows = 5,
) -> None:  # fmt: skip
    """Compare policies over worlds: coverage, map errors, pose errors and merges, with confidence intervals.

    With --plan, the plan of a benchmark fixes all but the policies; --quick then plays two worlds of four families.
    With --verify, episodes of a finished run are played again: all bits are compared where versions
    are the same and this processor can do the same, all numbers elsewhere.

    All policies of a seed have the same worlds, starts and noise. Options in the plural take comma-separated values;
    all combinations are run. Robots with known poses, landmark names and merges show the cost of estimation.
    Episodes of a policy that raises, returns no valid action or takes too long are left out, with status 2 at the end.
    Ctrl-C finishes the current episode; the same command with --out FOLDER resumes the run.
    """
    if verify is not None:
        verify_rows(call, verify, verified_rows, workers)
        return
    if plan is not None or is_plan_run(call):
        run_plan(call, plan, workers, ray)
        return
    from training.bench.exploration import report
    from training.bench.exploration.players import parted
    from training.bench.exploration.trials import TRIALS_FILE, check_same_policies, play
    from training.experiments.run_folder import plain
    from training.experiments.tables import csv_of

    trials = call.config.trials()
    check_same_policies(call.out, call.config.policies)
    firsts = {(t.policy, t.world, t.robots): t for t in reversed(trials)}.values()
    config = call.config
    checks = (
        partial(first_steps, config.environment(t), parted(t.policy), t.seed, config.decision_limit) for t in firsts
    )  # fmt: skip
    console, folder = call.begin(*checks)
    part = TrialSet(
        file=TRIALS_FILE, kind=ExplorationTrial, play=partial(play, call.config), trials=trials, workers=workers,
        cluster=ray,
        tell=lambda row: f"{row['world']}, {row['policy']}, seed {row['seed']}: {row['coverage']:.0%} seen",
    )  # fmt: skip
    (rows,) = run_trial_sets(console, folder, part)
    lines, over_time = plain(report.summarise(rows)), plain(report.curves(rows))
    policies_differ, oracles_differ = plain(report.compare_policies(rows)), plain(report.compare_oracles(rows))
    report.print_tables(console, lines, policies_differ, oracles_differ)
    metrics = {"summary": lines, "policies_differ": policies_differ, "oracles_differ": oracles_differ, "trials": rows}
    call.write(metrics)
    folder.write_text("tables.md", report.markdown(lines, policies_differ, oracles_differ))
    folder.write_text("trials.csv", csv_of(rows))
    folder.write_text("curves.csv", csv_of(over_time))
    if over_time:
        report.draw_exploration(folder.path / "exploration.png", over_time)
    call.finish()
    if part.failures:
        raise typer.Exit(2)


@bench.command("leaderboard")
def bench_leaderboard(
    folders: Annotated[list[Path], typer.Argument(help="Run folders of one plan, each with the rows of its policies.")],
    out: Annotated[Path, typer.Option(help="Markdown file; its figure goes beside it.")] = Path("leaderboard.md"),
) -> None:
    """Write the leaderboard of a benchmark plan from the results in run folders."""
    write_leaderboard(folders, out)


@bench.command("start")
@options(
    StartBenchConfig, "bench start", quick={"parts": ("import", "count"), "repeats": 1},
    quick_help="Imports and numbers of kernels, once.",
)  # fmt: skip
def bench_start(call: Call[StartBenchConfig]) -> None:
    """Time what a user waits for at first: compilation, first steps, imports; on two cores, caches and home empty.

    The part wheel times the first picture with the kernels that `make kernels-wheel` compiles.
    """
    from training.bench.start.bench import check_wheel, markdown, print_result, run_bench

    chosen = call.config.with_wheel()
    check_wheel(chosen)
    console, folder = call.begin(config=chosen)
    with trial_progress(console, chosen.repeats * len(chosen.parts)) as (on_trial, interrupted):
        result = run_bench(chosen, on_trial, interrupted)
    print_result(console, result)
    folder.write_text("table.md", markdown(result))
    call.write(result)
    call.finish()


def _say_where(name: str, study: str) -> None:
    """Add a hidden command that says where a study has gone."""

    @bench.command(name, hidden=True, context_settings={"ignore_unknown_options": True})
    def moved(arguments: Annotated[list[str] | None, typer.Argument()] = None) -> None:
        from slam_backend.core.validation import argument_error

        raise argument_error("bench", "another command", name, f"In a clone: python -m studies.{study}.")


MOVED = {
    "accuracy": "accuracy or studies.losses", "alignment": "alignment", "mrclam": "mrclam_pairs", "scale": "scale",
    "stereo": "stereo", "train": "training_speed",
}  # fmt: skip
for _name, _study in MOVED.items():
    _say_where(_name, _study)
