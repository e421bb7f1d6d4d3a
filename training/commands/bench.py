"""The commands `vslam bench ...`: how good and how fast filters, environments and trainings are."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape

from training.bench.config import (
    AccuracyConfig,
    AlignmentBenchConfig,
    EnvBenchConfig,
    ExplorationBenchConfig,
    ExplorationTrial,
    FilterBenchConfig,
    MrclamPairsConfig,
    StereoBenchConfig,
    TrainBenchConfig,
)
from training.commands._options import Processes, options
from training.commands._progress import KeptPart, play_kept, share_shown, trials_shown
from training.commands._run_folder import Call
from training.commands.replay import MRCLAM_LOG
from training.rl.config import require_extra

if TYPE_CHECKING:  # what computes is imported when the command runs, so that --help answers at once
    from training.bench.stereo.real_images import RealPart

bench = typer.Typer(help="Measure how good and how fast filters, environments and trainings are.", no_args_is_help=True)


@bench.command("accuracy")
@options(AccuracyConfig, "bench accuracy", continues=True)
def bench_accuracy(call: Call[AccuracyConfig], processes: Processes = 1) -> None:
    """How far filters are from the truth on simulated stereo runs, beside dead reckoning and what could be reached.

    Options in the singular take several values with commas between; all combinations are tried. Ctrl-C finishes the
    trial under way and sums up what there is; the same command with --out FOLDER goes on from there.
    """
    from training.bench.accuracy.report import draw_accuracy, markdown, print_tables, summarise
    from training.bench.accuracy.trials import TRIALS_FILE, Trial, play
    from training.experiments.run_folder import plain

    console, folder = call.begin()

    def tell(row: dict[str, Any]) -> str:
        return f"seed {row['seed']}, {row['method']}" + (f" {row['particles']}" if row["particles"] else "")

    trials = call.config.trials()
    part = KeptPart(file=TRIALS_FILE, kind=Trial, play=play, trials=trials, tell=tell, processes=processes)
    (rows,) = play_kept(console, folder, part)
    lines = plain(summarise(rows))
    print_tables(console, lines)
    call.write({"summary": lines, "trials": rows})
    folder.write_text("tables.md", markdown(lines))
    if lines:
        draw_accuracy(folder.path / "accuracy.png", lines)
    call.finish()


@bench.command("filter")
@options(
    FilterBenchConfig, "bench filter", quick={"measurements": (15,), "robots": (1,), "steps": 100},
    quick_help="B=15, K=1, 100 steps.",
)  # fmt: skip
def bench_filter(call: Call[FilterBenchConfig]) -> None:
    """Time steps of the filter over particles, landmarks, measurements and robots, on one thread."""
    from training.bench.filter.bench import count_trials, run_bench
    from training.bench.filter.report import draw_speed, print_result

    console, folder = call.begin()
    with trials_shown(console, count_trials(call.config)) as (on_trial, interrupted):
        result = run_bench(call.config, on_trial, interrupted)
    print_result(console, result)
    call.write(result)
    draw_speed(folder.path / "speed.png", result)
    call.finish()


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
            help="Folder of pairs with a model file: NAMEA, NAMEB, NAME_model.txt (homography), or left and right "
            "images with calib.txt or two sensor.yaml; folders in it, too.",
            show_default="$VSLAM_DATA, if set",
        ),
    ] = None,
) -> None:
    """Time rendering and front end, and measure disparities, guards and descriptors on rendered and real pairs."""
    import os

    from rich.markdown import Markdown

    from training.bench.stereo.bench import run_stereo_bench
    from training.bench.stereo.report import draw_stereo, markdown

    data = Path(os.environ["VSLAM_DATA"]) if real is None and "VSLAM_DATA" in os.environ else real
    descriptors = call.config.descriptors
    parts = [] if data is None or (real is None and not data.is_dir()) else _parts(data, descriptors, real)
    console, folder = call.begin()
    with trials_shown(console, None) as (on_part, interrupted):
        result = run_stereo_bench(call.config, parts, on_part, interrupted)
    tables = markdown(result)
    console.print(Markdown(tables))
    folder.write_text("tables.md", tables)
    call.write(result)
    if result["quality"] and result["retrieval"]:
        draw_stereo(folder.path / "stereo.png", result)
    call.finish()
    if result.get("failed"):
        errors = Console(stderr=True, soft_wrap=True, highlight=False)
        for name, why in result["failed"].items():
            errors.print(f"[red]error[/] {escape(f'{name}: {why}')}")
        raise typer.Exit(2)


def _parts(data: Path, descriptors: Sequence[str], real: Path | None) -> "list[RealPart]":
    """Return what is to be measured of real images, and refuse a folder that was named and holds none."""
    from slam_backend.core.validation import argument_error
    from training.bench.stereo.real_images import EXPECTED, find_parts

    if not data.is_dir():
        raise argument_error("real", "a folder of real images", "no such folder", f"Check {str(data)!r}.")
    parts = find_parts(data, descriptors)
    if real is not None and not parts:
        raise argument_error("real", f"a folder with {EXPECTED}", "no such files", f"Check {str(data)!r}.")
    return parts


@bench.command("env")
@options(
    EnvBenchConfig, "bench env",
    quick={"robots": (3,), "particles": (100,), "worlds": ("office",), "modes": ("dict",), "steps": 300},
    quick_help="Base configuration only, 300 steps.",
)  # fmt: skip
def bench_env(call: Call[EnvBenchConfig]) -> None:
    """Time steps of environments with the filter in the loop, on one thread, and tell where the time goes."""
    from training.bench.env.bench import count_trials, print_env_result, run_bench
    from vslam_env import vslam_v0

    for load in call.config.loads():  # what cannot be built shows before there is a folder
        vslam_v0.parallel_env(config=load.config())
    console, _ = call.begin()
    with trials_shown(console, count_trials(call.config)) as (on_trial, interrupted):
        result = run_bench(call.config, on_trial, interrupted)
    print_env_result(console, result, call.config.peer)
    call.write(result)
    call.finish()


@bench.command("exploration")
@options(
    ExplorationBenchConfig, "bench exploration", continues=True,
    quick={"worlds": ("office",), "duration": 60.0, "seeds": 3}, quick_help="Offices alone, 60 s, 3 seeds.",
)  # fmt: skip
def bench_exploration(call: Call[ExplorationBenchConfig], processes: Processes = 1) -> None:
    """Compare scripted policies, and your own, over worlds: floor seen, maps, poses, merges, with intervals.

    All policies of a seed meet the same worlds, starts and noise. Plurals take several values with commas between; all
    combinations are played. Robots that are told poses, names of landmarks and merges show what estimation costs.
    Ctrl-C finishes the episode under way; the same command with --out FOLDER goes on from there.
    """
    from training.bench.exploration import report
    from training.bench.exploration.trials import TRIALS_FILE, play
    from training.experiments.run_folder import plain

    trials = call.config.trials()
    firsts = {(t.policy, t.world, t.robots): t for t in reversed(trials)}.values()
    console, folder = call.begin(*(partial(_first_steps, call.config, trial) for trial in firsts))
    part = KeptPart(
        file=TRIALS_FILE, kind=ExplorationTrial, play=partial(play, call.config), trials=trials, processes=processes,
        tell=lambda row: f"{row['world']}, {row['policy']}, seed {row['seed']}: {row['coverage']:.0%} seen",
    )  # fmt: skip
    (rows,) = play_kept(console, folder, part)
    lines, over_time = plain(report.summarise(rows)), plain(report.curves(rows))
    policies_differ, oracles_differ = plain(report.compare_policies(rows)), plain(report.compare_oracles(rows))
    report.print_tables(console, lines, policies_differ, oracles_differ)
    metrics = {"summary": lines, "policies_differ": policies_differ, "oracles_differ": oracles_differ, "trials": rows}
    call.write(metrics)
    folder.write_text("tables.md", report.markdown(lines, policies_differ, oracles_differ))
    folder.write_text("trials.csv", report.to_csv(rows))
    folder.write_text("curves.csv", report.to_csv(over_time))
    if over_time:
        report.draw_exploration(folder.path / "exploration.png", over_time)
    call.finish()


def _first_steps(config: ExplorationBenchConfig, trial: ExplorationTrial) -> None:
    """Play the first two steps of a trial: a world that cannot be had, or a policy that fails, shows at once."""
    from training.episodes.runner import run_episode
    from vslam_env import vslam_v0

    steps = iter(range(2))
    env = vslam_v0.parallel_env(config=config.environment(trial))
    run_episode(env, config.run(trial).make_policies(env), trial.seed, should_stop=lambda: next(steps, None) is None)
    env.close()


@bench.command("train")
@options(TrainBenchConfig, "bench train")
def bench_train(call: Call[TrainBenchConfig]) -> None:
    """Time environment, adapter, network and update per decision of a robot, and the environments over workers."""
    require_extra()
    from training.bench.train.bench import TRIALS, print_result, run_bench

    console, _ = call.begin()
    with trials_shown(console, TRIALS) as (on_trial, interrupted):
        result = run_bench(call.config, on_trial, interrupted)
    print_result(console, result)
    call.write(result)
    call.finish()


@bench.command("alignment")
@options(
    AlignmentBenchConfig, "bench alignment", continues=True, quick={"seeds": 10, "hard": 45},
    quick_help="10 trials of each cell, 45 of each hard set.",
)  # fmt: skip
def bench_alignment(call: Call[AlignmentBenchConfig]) -> None:
    """Success, error over the Cramer-Rao bound and time of all alignment methods, on pairs of simulated maps.

    A grid over the share of common landmarks and of wrong look-alikes; U: maps that must not be aligned; I: maps that
    just can be. One process, one thread, so that times count. Ctrl-C ends the bench after the trial under way and sums
    up what there is; the same command with --out FOLDER goes on from there.
    """
    from training.bench.alignment.report import draw_alignment, markdown, print_tables, summarise
    from training.bench.alignment.trials import TRIALS_FILE, Trial, play
    from training.experiments.run_folder import plain

    console, folder = call.begin()
    part = KeptPart(
        file=TRIALS_FILE, kind=Trial, play=play, trials=call.config.trials(),
        tell=lambda row: f"{row['kind']} {row['case']}".strip(),
    )  # fmt: skip
    (rows,) = play_kept(console, folder, part, timed=True)
    lines = plain(summarise(rows))
    print_tables(console, lines)
    call.write({"summary": lines})
    folder.write_text("tables.md", markdown(lines))
    draw_alignment(folder.path / "alignment.png", lines)
    call.finish()


@bench.command("mrclam")
@options(MrclamPairsConfig, "bench mrclam", log=MRCLAM_LOG)
def bench_mrclam(call: Call[MrclamPairsConfig]) -> None:
    """Five real robots map alone from their own starts; all pairs of maps are aligned, barcodes seen and hidden.

    Errors are against the motion between the fits of both maps to the true landmarks. The odometry noise was calibrated
    on data sets 7 and 4 of MR.CLAM.
    """
    from training.bench.alignment.mrclam import HEADINGS, align_log, cells, summarise
    from training.experiments.tables import console_table, markdown_table

    console, folder = call.begin()
    with share_shown(console, "robots map alone") as update:
        rows = align_log(call.config, update)
    lines = summarise(rows)
    shown = [cells(line) for line in lines]
    console.print(console_table("Maps of real robots, aligned pairwise", HEADINGS, shown))
    folder.write_text("table.md", markdown_table(HEADINGS, shown))
    call.write({"summary": lines, "pairs": rows})
    call.finish()
