"""Commands `vslam bench ...`: accuracy and speed of filters, environments and training."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from training.bench.config import (
    AccuracyConfig,
    EpisodeTrial,
    MrclamPairsConfig,
    StereoBenchConfig,
    TrainBenchConfig,
)
from training.bench.exploration.config import ExplorationConfig
from training.bench.speed.config import EnvSpeedConfig, FilterSpeedConfig, StartSpeedConfig
from training.commands._options import Cluster, Workers, options
from training.commands._plan import (
    PlanName,
    Verified,
    VerifiedRows,
    is_plan_run,
    run_plan,
    verify_rows,
    write_leaderboard,
)
from training.commands._progress import TrialSet, run_trial_set, share_progress, trial_progress
from training.commands._run_folder import Call
from training.commands.replay import MRCLAM_LOG
from training.commands.study import run_study
from training.experiments.console import print_error
from training.rl.config import require_extra

if TYPE_CHECKING:  # numerical modules are imported when the command runs, so that --help is fast
    from training.bench.stereo.real_images import RealPart

bench = typer.Typer(help="Measure accuracy and speed of filters, environments and training.", no_args_is_help=True)


@bench.command("accuracy")
@options(
    AccuracyConfig, "bench accuracy", continues=True, quick={"seeds": 2, "particles": (30,)},
    quick_help="2 seeds, 30 particles.",
)  # fmt: skip
def bench_accuracy(call: Call[AccuracyConfig], workers: Workers = 1) -> None:
    """Measure filter accuracy against lower bounds of the error, and name the losses in between.

    Without --world: filters on simulated stereo runs, against dead reckoning, batch maximum likelihood and the ideal
    online estimate. With --world: episodes of robots that explore these worlds, and the factors between the information
    in their readings and the error of their filters. Options that accept several values take them comma-separated; all
    combinations are run. Episodes of a policy that fails are left out, with status 2 at the end. Ctrl-C finishes the
    current trial and summarises the finished ones; the same command with --out FOLDER resumes the run.
    """
    if call.config.worlds is None:
        _accuracy_of_stereo_runs(call, workers)
    else:
        _losses_in_worlds(call, workers)


def _accuracy_of_stereo_runs(call: Call[AccuracyConfig], workers: int) -> None:
    """Run filters on simulated stereo runs."""
    from training.bench.accuracy.report import draw_accuracy, markdown, print_tables, summarise
    from training.bench.accuracy.trials import TRIALS_FILE, Trial, play
    from training.experiments.run_folder import plain

    console, folder = call.begin()

    def tell(row: dict[str, Any]) -> str:
        return f"seed {row['seed']}, {row['method']}" + (f" {row['particles']}" if row["particles"] else "")

    trials = call.config.trials()
    part = TrialSet(file=TRIALS_FILE, kind=Trial, play=play, trials=trials, tell=tell, workers=workers)
    rows = run_trial_set(console, folder, part)
    lines = plain(summarise(rows))
    print_tables(console, lines)
    call.write({"summary": lines, "trials": rows})
    folder.write_text("tables.md", markdown(lines))
    if lines:
        draw_accuracy(folder.path / "accuracy.png", lines)
    call.finish()


def _losses_in_worlds(call: Call[AccuracyConfig], workers: int) -> None:
    """Run episodes and split the errors of their filters into losses."""
    from training.bench.accuracy.losses import EPISODES_FILE, LONGEST_DECISION, play
    from training.bench.accuracy.losses_report import draw_losses, markdown, print_tables, summarise
    from training.bench.exploration.players import parted
    from training.bench.exploration.trials import first_steps
    from training.experiments.run_folder import plain

    config = call.config
    trials = config.episodes()
    firsts = {(t.policy, t.world, t.robots): t for t in reversed(trials)}.values()
    checks = (partial(first_steps, config.environment(t), parted(t.policy), t.seed, LONGEST_DECISION) for t in firsts)
    console, folder = call.begin(*checks)
    part = TrialSet(
        file=EPISODES_FILE, kind=EpisodeTrial, play=partial(play, config), trials=trials, workers=workers,
        tell=lambda row: f"{row['world']}, seed {row['seed']}: {row['position_rms_m']['filter']:.3f} m",
    )  # fmt: skip
    rows = run_trial_set(console, folder, part)
    lines = plain(summarise(rows))
    print_tables(console, lines)
    call.write({"summary": lines, "trials": rows})
    folder.write_text("tables.md", markdown(lines))
    if lines:
        draw_losses(folder.path / "losses.png", lines)
    call.finish()
    if part.failures:
        raise typer.Exit(2)


@bench.command("stereo")
@options(
    StereoBenchConfig, "bench stereo",
    quick={"sizes": (320,), "landmarks": (100,), "walls": (40,), "steps": 30, "views": 15},
    quick_help="One size, 30 timed pairs, 15 views.",
)  # fmt: skip
def bench_stereo(
    call: Call[StereoBenchConfig],
    real: Annotated[
        Path | None,
        typer.Option(
            help="Folder with image pairs: NAMEA, NAMEB, NAME_model.txt (homography), or left and right "
            "images with calib.txt or two sensor.yaml; subfolders are included.",
            show_default="$VSLAM_DATA, if set",
        ),
    ] = None,
) -> None:
    """Time rendering and the front end, and evaluate disparities, match checks and descriptors on image pairs."""
    import os

    from rich.markdown import Markdown

    from training.bench.stereo.bench import run_stereo_bench
    from training.bench.stereo.report import draw_stereo, markdown

    data = Path(os.environ["VSLAM_DATA"]) if real is None and "VSLAM_DATA" in os.environ else real
    descriptors = call.config.descriptors
    parts = [] if data is None or (real is None and not data.is_dir()) else _parts(data, descriptors, real)
    console, folder = call.begin()
    with trial_progress(console, None) as (on_part, interrupted):
        result = run_stereo_bench(call.config, parts, on_part, interrupted)
    tables = markdown(result)
    console.print(Markdown(tables))
    folder.write_text("tables.md", tables)
    call.write(result)
    if result["quality"] and result["retrieval"]:
        draw_stereo(folder.path / "stereo.png", result)
    call.finish()
    if result.get("failed"):
        for name, why in result["failed"].items():
            print_error(f"{name}: {why}")
        raise typer.Exit(2)


def _parts(data: Path, descriptors: Sequence[str], real: Path | None) -> "list[RealPart]":
    """Return the real images to measure, and refuse a folder without any if it was given explicitly."""
    from slam_backend.core.validation import argument_error
    from training.bench.stereo.real_images import EXPECTED, find_parts

    if not data.is_dir():
        raise argument_error("real", "a folder of real images", "no such folder", f"Check {str(data)!r}.")
    parts = find_parts(data, descriptors)
    if real is not None and not parts:
        raise argument_error("real", f"a folder with {EXPECTED}", "no such files", f"Check {str(data)!r}.")
    return parts


@bench.command("exploration")
@options(
    ExplorationConfig, "bench exploration", continues=True,
    quick={"worlds": ("office",), "duration": 60.0, "seeds": 3},
    quick_help="Office worlds only, 60 s, 3 seeds; with --plan 2 worlds of four families.",
)  # fmt: skip
def bench_exploration(
    call: Call[ExplorationConfig], plan: PlanName = None, workers: Workers = 1, ray: Cluster = None,
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


@bench.command("train")
@options(TrainBenchConfig, "bench train")
def bench_train(call: Call[TrainBenchConfig]) -> None:
    """Time environment, adapter, network and update per decision of a robot, and environments by worker count."""
    require_extra()
    from training.bench.train.bench import TRIALS, print_result, run_bench

    console, _ = call.begin()
    with trial_progress(console, TRIALS) as (on_trial, interrupted):
        result = run_bench(call.config, on_trial, interrupted)
    print_result(console, result)
    call.write(result)
    call.finish()


def _say_where(name: str, hint: str) -> None:
    """Add a hidden command that says where a command has gone."""

    @bench.command(name, hidden=True, context_settings={"ignore_unknown_options": True})
    def moved(arguments: Annotated[list[str] | None, typer.Argument()] = None) -> None:
        from slam_backend.core.validation import argument_error

        raise argument_error("bench", "another command", name, hint)


for _name in ("alignment", "scale"):
    _say_where(_name, f"In a clone: python -m studies.{_name}.")
for _name in ("filter", "env", "start"):
    _say_where(_name, f"Use vslam bench speed {_name}.")


@bench.command("mrclam")
@options(MrclamPairsConfig, "bench mrclam", log=MRCLAM_LOG)
def bench_mrclam(call: Call[MrclamPairsConfig]) -> None:
    """Align maps of five real robots that mapped alone, for all pairs, with known and unknown barcodes.

    Errors are relative to the transform between the fits of both maps to the true landmarks. The odometry noise was
    calibrated on data sets 7 and 4 of MR.CLAM.
    """
    from training.bench.alignment.mrclam import HEADINGS, align_log, cells, summarise
    from training.experiments.tables import console_table, markdown_table

    console, folder = call.begin()
    with share_progress(console, "single-robot mapping") as update:
        rows = align_log(call.config, update)
    lines = summarise(rows)
    shown = [cells(line) for line in lines]
    console.print(console_table("Pairwise alignment of maps of real robots", HEADINGS, shown))
    folder.write_text("table.md", markdown_table(HEADINGS, shown))
    call.write({"summary": lines, "pairs": rows})
    call.finish()
