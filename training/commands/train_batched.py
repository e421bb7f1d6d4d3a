"""Command `vslam train-batched`: training of a driver by PPO in batched environments on an accelerator."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from training.commands.helpers.options import options
from training.commands.helpers.progress import training_bar
from training.commands.helpers.run_folder import Call
from training.rl.batched_config import BatchedTrainConfig
from training.rl.config import require_extra

if TYPE_CHECKING:  # numerical modules are imported when the command runs, so that --help is fast
    from training.rl.batched_ppo import BatchedTraining
    from vslam_env.batched.environment import BatchedExploration


@options(
    BatchedTrainConfig, "train-batched",
    quick={"world": "fig5", "robots": 2, "duration": 4.0, "num_worlds": 2, "rows": 64, "batch": 8, "steps": 8,
           "updates": 2, "decision_ticks": 10},
    quick_help="fig5, 2 robots, 8 environments, 2 rollouts: minutes on a processor, most of them for compiling.",
)  # fmt: skip
def train_batched(
    call: Call[BatchedTrainConfig],
    resume: Annotated[
        Path | None, typer.Option(help="Run folder of a stopped training to resume.", show_default=False)
    ] = None,
) -> None:
    """Train one driver for all robots by PPO, with many environments stepped at once; for accelerators.

    On a processor this is slower than vslam train. Worlds are those of the training split. The model drives by itself:
    vslam evaluate FOLDER compares it in the environment, and vslam run --policy FOLDER shows it.

    Ctrl-C stops after the current rollout and saves. --resume FOLDER continues from the last checkpoint with new
    episodes.
    """
    from training.experiments.output.compilation import prepare
    from training.experiments.run_folder import RunFolder, installed_versions

    made: list[BatchedExploration] = []

    def draw_worlds() -> None:
        """Make the environment; jax is imported here, for it is slow and other errors come first."""
        from training.rl.batched_ppo import make_env

        made.append(make_env(chosen))

    chosen = call.config if resume is None else call.resumed(resume, "--json")
    require_extra("jax")
    if resume is not None:
        prepare(draw_worlds)
        call.folder = RunFolder(resume, call.command, chosen.to_mapping(), chosen.seed, installed_versions())
    else:
        call.begin(draw_worlds)
    from training.rl.batched_ppo import BatchedTraining

    training = BatchedTraining(chosen, made[0], call.folder.path)
    if resume is not None:
        training.restore()
    begin = time.perf_counter()
    complete = _run_live(call, training)
    _finish(call, training, complete, time.perf_counter() - begin)


def _run_live(call: Call[BatchedTrainConfig], training: "BatchedTraining") -> bool:
    """Train under a progress bar; Ctrl-C stops after the current rollout, which is then saved.

    Returns:
        Whether the training is complete.
    """
    from training.experiments.machine.interrupt import interrupt_flag

    config, begin = training.config, time.perf_counter()
    with training_bar(call.console) as bar, interrupt_flag() as interrupted:
        task = bar.add_task("", total=config.updates, completed=len(training.rows), status="compiling")

        def is_over() -> bool:
            late = config.minutes is not None and time.perf_counter() - begin > 60.0 * config.minutes
            return len(training.rows) >= config.updates or late

        while not is_over() and not interrupted():
            row = training.update()
            status = f"E {row['map_error']:.3f} m" if row["episodes"] else "no episode ended in this rollout"
            bar.update(task, completed=len(training.rows), status=status)
            if len(training.rows) % config.checkpoint_updates == 0:
                training.save()
        if training.rows:
            training.save()
    return is_over()


def _finish(call: Call[BatchedTrainConfig], training: "BatchedTraining", complete: bool, seconds: float) -> None:
    """Write and print the results of the training."""
    from training.experiments.output.tables import csv_of
    from training.rl.curves import draw_learning, first_and_last_tenth

    rows, folder = [row for row in training.rows if row["episodes"]], call.folder
    metrics: dict[str, Any] = {"complete": complete, "seconds_this_time": seconds}
    if rows:
        folder.write_text("curves.csv", csv_of(rows))
        draw_learning(folder.path / "learning.png", rows)
        metrics |= {"decisions": int(rows[-1]["steps"]), **first_and_last_tenth(rows)}
    call.write(metrics)
    call.finish()
    text = f"vslam evaluate {folder.path}" if complete else f"vslam train-batched --resume {folder.path}"
    call.console.print(f"Next: {text}" if training.rows else "Stopped before the first rollout: nothing was saved.")
