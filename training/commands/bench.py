"""Commands `vslam bench ...`: comparison of policies, leaderboards, and speed."""

from pathlib import Path
from typing import Annotated

import typer

from training.bench.exploration.config import ExplorationConfig
from training.bench.speed.config import BatchedSpeedConfig, EnvSpeedConfig, FilterSpeedConfig, StartSpeedConfig
from training.commands.helpers.options import Cluster, Workers, options
from training.commands.helpers.plan import (
    Base,
    PlanName,
    Tracks,
    Verified,
    VerifiedRows,
    is_plan_run,
    run_plan,
    verify_rows,
    write_leaderboard,
    write_submission,
)
from training.commands.helpers.run_folder import Call
from training.commands.study import run_study

bench = typer.Typer(help="Compare policies, and measure the speed of filters and environments.", no_args_is_help=True)


@bench.command("exploration")
@options(
    ExplorationConfig, "bench exploration", continues=True,
    quick={"worlds": ("office",), "duration": 60.0, "seeds": 3},
    quick_help="Office worlds only, 60 s, 3 seeds; with --plan 2 seeds of each track.",
)  # fmt: skip
def bench_exploration(
    call: Call[ExplorationConfig], plan: PlanName = None, tracks: Tracks = None, base: Base = False,
    workers: Workers = 1, ray: Cluster = None, verify: Verified = None, verified_rows: VerifiedRows = None,
) -> None:  # fmt: skip
    """Compare policies over worlds: coverage, map errors, pose errors and merges, with confidence intervals.

    With --plan, the plan of a benchmark fixes all but the policies; --quick then plays two seeds of each track.
    With --verify, episodes of a finished run are played again: all bits are compared where versions
    are the same and this processor can do the same, all numbers elsewhere.

    All policies of a seed have the same worlds, starts and noise. Options in the plural take comma-separated values;
    all combinations are run. Robots with known poses, landmark names and merges show the cost of estimation.
    Episodes of a policy that raises, returns no valid action or takes too long are left out, with status 2 at the end.
    Ctrl-C finishes the current episode; the same command with --out FOLDER resumes the run.
    """
    from slam_backend.core.validation import argument_error

    if verified_rows is not None and verify is None:
        raise argument_error("rows", "no value without --verify", verified_rows, "Omit it, or give --verify FOLDER.")
    if verify is not None:
        verify_rows(call, verify, verified_rows, workers)
        return
    if plan is not None or is_plan_run(call):
        run_plan(call, plan, tracks, base, workers, ray)
        return
    if tracks is not None or base:
        name = "tracks" if tracks is not None else "base"
        raise argument_error(name, "a plan with it", "no --plan", "Add --plan vslam-bench-v1.")
    from training.bench.exploration.report import STUDY
    from training.bench.exploration.trials import check_same_policies

    check_same_policies(call.out, call.config.policies)
    run_study(call, STUDY, workers, ray)


@bench.command("leaderboard")
def bench_leaderboard(
    folders: Annotated[list[Path], typer.Argument(help="Run folders of one plan, each with the rows of its policies.")],
    out: Annotated[Path, typer.Option(help="Markdown file; its figure goes beside it.")] = Path("leaderboard.md"),
) -> None:
    """Write the leaderboard of a benchmark plan from the results in run folders."""
    write_leaderboard(folders, out)


@bench.command("submit")
def bench_submit(
    folder: Annotated[Path, typer.Argument(help="Run folder of a plan, with the episodes of its base part.")],
    out: Annotated[Path, typer.Option(help="New folder of the submission.")] = Path("submission"),
) -> None:
    """Pack the results of a run on a benchmark plan with its policies, versions and digests."""
    write_submission(folder, out)


speed = typer.Typer(help="Time steps of filters and environments, and the start-up.", no_args_is_help=True)
bench.add_typer(speed, name="speed")


@speed.command("filter")
@options(
    FilterSpeedConfig, "bench speed filter", continues=True,
    quick={"measurements": (15,), "robots": (1,), "steps": 100}, quick_help="15 measurements, 1 robot, 100 steps.",
)  # fmt: skip
def speed_filter(call: Call[FilterSpeedConfig]) -> None:
    """Time steps of the filter over particles, landmarks, measurements and robots, on one thread."""
    from training.bench.speed.filter import STUDY

    run_study(call, STUDY)


@speed.command("env")
@options(
    EnvSpeedConfig, "bench speed env", continues=True,
    quick={"robots": (3,), "particles": (100,), "worlds": ("office",), "modes": ("driver",), "steps": 300},
    quick_help="Base configuration only, 300 steps.",
)  # fmt: skip
def speed_env(call: Call[EnvSpeedConfig]) -> None:
    """Time steps of environments with the filter in the loop, on one thread, with a breakdown by part."""
    from training.bench.speed.env import STUDY

    run_study(call, STUDY)


@speed.command("batched")
@options(
    BatchedSpeedConfig, "bench speed batched", continues=True,
    quick={"batches": (2,), "beside": 1, "world": "fig5", "robots": 2, "rows": 64, "steps": 3},
    quick_help="Two environments, one process, fig5, 2 robots.",
)  # fmt: skip
def speed_batched(call: Call[BatchedSpeedConfig]) -> None:
    """Time batched teams on the accelerator of this machine beside processes of the environment."""
    from training.bench.speed.batched import STUDY

    run_study(call, STUDY)


@speed.command("start")
@options(
    StartSpeedConfig, "bench speed start", continues=True, quick={"parts": ("import", "count"), "repeats": 1},
    quick_help="Imports and numbers of kernels, once.",
)  # fmt: skip
def speed_start(call: Call[StartSpeedConfig]) -> None:
    """Time what a user waits for at first: compilation, first steps, imports; on two cores, caches and home empty.

    The part wheel times the first picture with the kernels that `make kernels-wheel` compiles.
    """
    from training.bench.speed.start import STUDY

    run_study(call, STUDY)
