"""Commands `vslam train`, of one goal-selection network by PPO or imitation, and `vslam evaluate`, on unseen worlds."""

import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from training.commands.helpers.options import Workers, options
from training.commands.helpers.progress import training_bar
from training.commands.helpers.run_folder import Call
from training.commands.study import run_study
from training.experiments.output.compilation import prepare
from training.rl.config import SPLIT_TRAIN, EvaluateConfig, TrainConfig, require_extra

if TYPE_CHECKING:  # numerical modules are imported when the command runs, so that --help is fast
    from training.rl.imitation import Imitation
    from training.rl.ppo import Row, Training


@options(TrainConfig, "train")
def train(
    call: Call[TrainConfig],
    workers: Annotated[
        int | None,
        typer.Option(
            help="Number of environment processes; 0: this one. Weights do not depend on it.",
            show_default="cores, with --ray those of the cluster",
        ),
    ] = None,
    device: Annotated[str, typer.Option(help="Device of the network updates: cpu or cuda.")] = "cpu",
    ray: Annotated[
        str | None,
        typer.Option(
            help="Address of a Ray cluster that steps the environments, or auto; see ray start.",
            show_default="this machine",
        ),
    ] = None,
    resume: Annotated[
        Path | None,
        typer.Option(help="Run folder of a stopped training to resume.", show_default=False),
    ] = None,
) -> None:
    """Train one network for all robots by PPO with masked goal actions; use it with vslam run --policy FOLDER.

    Worlds are those of the training split. --preset imitate clones a planner instead: it labels decisions, in later
    rounds those of the pupil. --steps counts decisions; every second is a label.

    A config.toml sets all other values. Its gamma is the discount per decision:
    the discount per tick, at least 0.999, to the power of decision_ticks.

    Ctrl-C stops after the current rollout, file of labels or epoch, and saves; a second Ctrl-C stops at
    once. --resume FOLDER continues from the last checkpoint and gives the same
    weights as an uninterrupted training, even if the process was killed.
    """
    from slam_backend.core.validation import argument_error, check_int
    from training.experiments.machine.cluster import LostWorkerError, connected
    from training.experiments.run_folder import RunFolder, installed_versions

    require_extra()
    from training.rl.checkpoint import check_device, stored_checkpoint
    from training.rl.ppo import Training
    from training.vec_env import load_kernels

    if workers is not None:
        check_int("workers", workers, 0, "Use 0 for this process, or a number of processes.")
        if workers == 0 and ray is not None:
            raise argument_error("workers", "an int >= 1 with --ray", 0, "Omit it to use all cores of the cluster.")
    check_device(device)
    if resume is None:
        chosen = call.config
    else:
        chosen = call.resumed(resume, "--workers, --ray, --device and --json")
        kept = stored_checkpoint(resume, chosen)  # detects a bad checkpoint before kernels are compiled
    if ray is not None:
        with connected(ray):  # detects a bad address before the folder is created
            pass
    crew = (default_workers(chosen) if ray is None else 0) if workers is None else workers
    if resume is None:
        # Detect a world that cannot be built before the folder is created.
        call.begin(lambda: load_kernels(chosen.make_env_config(SPLIT_TRAIN)))
    else:
        prepare()
        call.folder = RunFolder(resume, call.command, chosen.to_mapping(), chosen.seed, installed_versions())
    kind: Any = Training
    if chosen.teacher is not None:
        from training.rl.imitation import Imitation

        kind = Imitation
    training = kind(chosen, call.folder.path, crew, device, ray)
    try:
        if resume is not None:
            training.restore(kept)
        if chosen.teacher is None:
            complete, seconds = _run_live(call.console, training)
            _finish(call, training, complete, seconds)
        else:
            complete, seconds = _imitate_live(call.console, training)
            _finish_imitation(call, training, complete, seconds)
    except (KeyboardInterrupt, LostWorkerError):
        _print_resume_command(call.console, call.folder.path)
        raise
    finally:
        training.close()


@options(EvaluateConfig, "evaluate", continues=True)
def evaluate(call: Call[EvaluateConfig], workers: Workers = 1) -> None:
    """Compare a model with baseline policies on the same unseen worlds, with confidence intervals.

    All policies have the same worlds, starts and noise, and the same decision interval.
    Ctrl-C finishes the current episode; the same command with --out FOLDER
    resumes the evaluation.
    """
    from training.rl.evaluation import STUDY

    run_study(call, STUDY, workers)


def default_workers(config: TrainConfig) -> int:
    """Return the default number of environment processes: the cores, at most one per environment."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return 0 if cores == 1 else min(cores, config.envs)


def _run_live(console: Console, training: "Training") -> tuple[bool, float]:
    """Train under a progress bar with the time left; Ctrl-C stops after the current rollout.

    Returns:
        Whether the training is complete, and its duration [s].
    """
    import time
    from contextlib import ExitStack

    from training.experiments.machine.interrupt import interrupt_flag

    config, begin = training.config, time.perf_counter()
    total, done = config.updates * config.rollout, len(training.rows) * config.rollout
    if done >= total:
        console.print("This training is complete already.")
        return True, 0.0
    if done:
        rollouts = f"{len(training.rows)} of {config.updates} rollouts are finished"
        console.print(f"Resuming: {rollouts}, {config.updates - len(training.rows)} are left.")
    with ExitStack() as stack:
        bar = stack.enter_context(training_bar(console))
        status = _rollout_text(training.rows[-1]) if done else "first rollout"
        task = bar.add_task("", total=total, completed=done, status=status)
        on_press = partial(bar.update, task, status="stopping after this rollout")
        interrupted = stack.enter_context(interrupt_flag(on_press))

        def on_update(row: "Row") -> None:
            if not interrupted():
                bar.update(task, status=_rollout_text(row))

        training.watch.listen(on_update, interrupted, lambda decisions: bar.update(task, completed=decisions))
        complete = training.run()
    if not complete:
        console.print("Stopped; the checkpoint contains all finished rollouts.")
    return complete, time.perf_counter() - begin


def _imitate_live(console: Console, imitation: "Imitation") -> tuple[bool, float]:
    """Imitate under a bar with the time left; Ctrl-C stops after the current file of labels or epoch.

    Returns:
        Whether the training is complete, and its duration [s].
    """
    import time

    from training.experiments.machine.interrupt import interrupt_flag

    begin = time.perf_counter()
    epochs, config = imitation.config.epochs * (imitation.config.rounds or 0), imitation.config
    if len(imitation.rows) >= epochs:
        console.print("This training is complete already.")
        return True, 0.0
    if imitation.rows:
        console.print(f"Resuming: {len(imitation.rows)} of {epochs} epochs are finished.")
    with training_bar(console, "{task.description}") as bar, interrupt_flag() as interrupted:
        task = None

        def on_progress(stage: str, done: float, total: float) -> None:
            nonlocal task
            status = "stopping after this part" if interrupted() else _epoch_text(imitation.rows)
            if task is None:  # the time left counts from here, also in a run that was resumed
                task = bar.add_task(stage, total=total, completed=int(done), status=status)
            bar.update(task, description=stage, completed=done, status=status)

        complete = imitation.run(on_progress, interrupted)
    if not complete:
        console.print("Stopped; the checkpoint contains all finished epochs, the folder all files of labels.")
    console.print(f"Teacher: {config.teacher}; labels take {imitation.label_bytes / 1e6:.1f} MB.")
    return complete, time.perf_counter() - begin


def _epoch_text(rows: "Sequence[Row]") -> str:
    """Return the text of the bar about the last epoch."""
    return f"agreement {rows[-1]['agreement']:.2f}" if rows else "first epoch"


def _finish_imitation(call: Call[TrainConfig], imitation: "Imitation", complete: bool, seconds: float) -> None:
    """Write and print the results of the imitation."""
    from training.experiments.output.tables import csv_of
    from training.rl.curves import draw_imitation

    rows, console, folder = imitation.rows, call.console, call.folder
    best: dict[str, Any] = {}
    if rows:
        best = dict(imitation.best_row)
        folder.write_text("curves.csv", csv_of(rows))
        draw_imitation(folder.path / "learning.png", rows)
        console.print(
            f"On validation worlds the pupil agrees with the teacher in {100.0 * best['agreement']:.1f} % of the "
            f"decisions where the teacher drives, in {100.0 * best['driven_agreement']:.1f} % where the pupil drives.",
            soft_wrap=True,
        )
    sums = {"label_bytes": imitation.label_bytes, "seconds_this_time": seconds}
    call.write({"complete": complete, "labels": int(best.get("labels", 0)), **sums, "best": best})
    call.finish()
    if complete:
        console.print(f"Next: vslam evaluate {folder.path} --policies frontier,next_best_view", soft_wrap=True)
    else:
        _print_resume_command(console, folder.path)


def _rollout_text(row: "Row") -> str:
    """Return the text of the bar about a rollout."""
    return f"return {row['return']:.2f}, E {row['map_error']:.2f} m, recall {row['map_recall']:.2f}"


def _finish(call: Call[TrainConfig], training: "Training", complete: bool, seconds: float) -> None:
    """Write and print the results of the training."""
    from training.experiments.output.tables import E_SCALE, csv_of
    from training.rl.curves import draw_learning, first_and_last_tenth

    rows, console, folder = training.rows, call.console, call.folder
    folder.write_text("curves.csv", csv_of(rows))
    draw_learning(folder.path / "learning.png", rows)
    ends: dict[str, Any] = first_and_last_tenth(rows)
    first, last = ends["first"], ends["last"]
    console.print(
        f"Return in the first tenth {first['return']:.3f}, in the last {last['return']:.3f}; "
        f"E {first['map_error']:.3f} m, {last['map_error']:.3f} m."
    )
    console.print(E_SCALE)
    call.write({"complete": complete, "decisions": int(rows[-1]["steps"]), "seconds_this_time": seconds, **ends})
    call.finish()
    if complete:
        console.print(f"Next: vslam evaluate {folder.path}", soft_wrap=True)
    else:
        _print_resume_command(console, folder.path)


def _print_resume_command(console: Console, folder: Path) -> None:
    """Print how to resume a stopped training, if possible."""
    from training.rl.checkpoint import CHECKPOINT_FILE

    text = "Stopped before the first checkpoint: nothing was saved."
    if (folder / CHECKPOINT_FILE).is_file():
        text = f"Resume: vslam train --resume {folder}"
    console.print(text, soft_wrap=True)
