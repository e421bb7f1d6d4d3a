"""The command `vslam train`: one network learns to choose goals for all robots; curves, checkpoints, a model."""

import os
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from training.commands._options import options
from training.commands._run_folder import Call
from training.experiments.compilation import prepare
from training.rl.config import SPLIT_TRAIN, TrainConfig, require_extra

if TYPE_CHECKING:  # what computes is imported when the command runs, so that --help answers at once
    from training.rl.callbacks import Row
    from training.rl.trainer import Training


@options(TrainConfig, "train")
def train(
    call: Call[TrainConfig],
    workers: Annotated[
        int | None,
        typer.Option(help="Processes that step them; 0: this one. Weights do not depend on it.", show_default="cores"),
    ] = None,
    device: Annotated[str, typer.Option(help="cpu, or cuda for the updates of the network.")] = "cpu",
    resume: Annotated[
        Path | None,
        typer.Option(help="Run folder of a training that stopped: go on as if it had not.", show_default=False),
    ] = None,
) -> None:
    """Train one network for all robots by PPO with masked goal actions; play it with vslam run --policy FOLDER.

    A config.toml decides all else. Its gamma is the discount of a decision:
    that of a tick, at least 0.999, to the power of decision_ticks.

    Ctrl-C ends it after the running rollout and saves; pressed again, it ends
    at once. --resume FOLDER then goes on from the last checkpoint and ends with
    the same weights as a training that never stopped, even if it was killed.
    """
    from slam_backend.core.validation import argument_error, check_int
    from training.experiments.run_folder import RunFolder, installed_versions, read_config

    require_extra()
    from training.rl.trainer import Training, check_device, kept_of
    from training.vec_env import load_kernels

    if workers is not None:
        check_int("workers", workers, 0, "Use 0 for none, or a number of processes.")
    check_device(device)
    if resume is None:
        chosen = call.config
    else:
        others = [*call.given, *(name for name, value in (("out", call.out), ("config", call.file)) if value)]
        if others:
            cure = "A training goes on with its own; --workers, --device and --json may be given."
            raise argument_error("resume", "no other options that decide the training", others, cure)
        values, seed = read_config(resume, call.command, "resume")
        chosen = TrainConfig.from_mapping(values | {"seed": seed})
        kept = kept_of(resume, chosen)  # what is wrong with it shows before anything is compiled
    crew = default_workers(chosen) if workers is None else workers
    if resume is None:
        # A bad world shows before there is a folder.
        call.begin(lambda: load_kernels(chosen.make_env_config(SPLIT_TRAIN)))
    else:
        prepare()
        call.folder = RunFolder(resume, call.command, chosen.to_mapping(), chosen.seed, installed_versions())
    training = Training(chosen, call.folder.path, crew, device)
    try:
        if resume is not None:
            training.restore(kept)
        complete, seconds = _run_live(call.console, training)
        _finish(call, training, complete, seconds)
    except KeyboardInterrupt:
        _tell_how_to_go_on(call.console, call.folder.path)
        raise
    finally:
        training.close()


def default_workers(config: TrainConfig) -> int:
    """Return how many processes step the environments if nobody says it: the cores, at most one per environment."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return 0 if cores == 1 else min(cores, config.envs)


def _run_live(console: Console, training: "Training") -> tuple[bool, float]:
    """Train under a progress bar with the time left; Ctrl-C ends it after the running rollout.

    Returns:
        Whether it is complete, and how long it took [s].
    """
    import time
    from contextlib import ExitStack

    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    from training.experiments.interrupt import interrupt_flag

    columns = (
        TextColumn("{task.completed:,.0f} of {task.total:,.0f}"), BarColumn(None), TextColumn("{task.fields[told]}"),
        TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn(),
    )  # fmt: skip
    config, begin = training.config, time.perf_counter()
    total, done = config.updates * config.rollout, len(training.rows) * config.rollout
    if done >= total:
        console.print("This training is complete already.")
        return True, 0.0
    with ExitStack() as stack:
        bar = stack.enter_context(Progress(*columns, console=console, expand=True, speed_estimate_period=300.0))
        told = _told(training.rows[-1]) if done else "first rollout"
        task = bar.add_task("", total=total, completed=done, told=told)
        on_press = partial(bar.update, task, told="stopping: saves after this rollout")
        interrupted = stack.enter_context(interrupt_flag(on_press))

        def on_update(row: "Row") -> None:
            if not interrupted():
                bar.update(task, told=_told(row))

        training.watch.listen(on_update, interrupted, lambda decisions: bar.update(task, completed=decisions))
        complete = training.run()
    if not complete:
        console.print("Stopped; the checkpoint holds all until here.")
    return complete, time.perf_counter() - begin


def _told(row: "Row") -> str:
    """Return what the bar says of a rollout."""
    return f"return {row['return']:.2f}, E {row['map_error']:.2f} m, recall {row['map_recall']:.2f}"


def _finish(call: Call[TrainConfig], training: "Training", complete: bool, seconds: float) -> None:
    """Write and show what the training led to."""
    from training.rl.curves import draw_learning, ends_of, to_csv

    rows, console, folder = training.rows, call.console, call.folder
    folder.write_text("curves.csv", to_csv(rows))
    draw_learning(folder.path / "learning.png", rows)
    ends: dict[str, Any] = ends_of(rows)
    first, last = ends["first"], ends["last"]
    console.print(
        f"Return of the first tenth {first['return']:.3f}, of the last {last['return']:.3f}; "
        f"map error {first['map_error']:.3f} m, {last['map_error']:.3f} m."
    )
    call.write({"complete": complete, "decisions": int(rows[-1]["steps"]), "seconds_this_time": seconds, **ends})
    call.finish()
    if complete:
        console.print(f"Next: vslam evaluate {folder.path}", soft_wrap=True)
    else:
        _tell_how_to_go_on(console, folder.path)


def _tell_how_to_go_on(console: Console, folder: Path) -> None:
    """Say how a training that was stopped goes on, if it can."""
    from training.rl.checkpoint import CHECKPOINT_FILE

    text = "Stopped before the first checkpoint: nothing was saved."
    if (folder / CHECKPOINT_FILE).is_file():
        text = f"Go on: vslam train --resume {folder}"
    console.print(text, soft_wrap=True)
