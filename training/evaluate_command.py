"""The command `vslam evaluate`: a trained model beside scripted policies on worlds that it was not trained on."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from training.command_options import Config, Json, finish, gather
from training.compiling import prepare

if TYPE_CHECKING:  # what computes is imported when the command runs, so that --help answers at once
    from training.evaluation import EvaluateConfig
    from training.run_folder import RunFolder

TRIALS_FILE = "trials.jsonl"


def evaluate(
    model: Annotated[
        Path | None, typer.Argument(help="A model that vslam train wrote, or its run folder.", show_default=False)
    ] = None,
    policies: Annotated[
        str | None, typer.Option(help="Beside it, with commas between.", show_default="random_goals,frontier")
    ] = None,
    split: Annotated[str | None, typer.Option(help="validation or test worlds.", show_default="validation")] = None,
    world: Annotated[str | None, typer.Option(help="A family or a path.", show_default="that of the training")] = None,
    robots: Annotated[int | None, typer.Option(help="1 to 8.", show_default="those of the training")] = None,
    max_cycles: Annotated[
        int | None, typer.Option(help="Decisions of an episode.", show_default="as in the training")
    ] = None,
    greedy: Annotated[
        bool | None, typer.Option(help="The model's best action, not one of its distribution.", show_default="no")
    ] = None,
    seeds: Annotated[int | None, typer.Option(help="Episodes of each policy.", show_default="20")] = None,
    seed: Annotated[int | None, typer.Option(help="Of the first of them.", show_default="0")] = None,
    processes: Annotated[int, typer.Option(help="At a time.")] = 1,
    out: Annotated[
        Path | None,
        typer.Option(help="Run folder: new, or that of an evaluation to go on with.", show_default="the next in runs"),
    ] = None,
    json: Json = None,
    config: Config = None,
) -> None:
    """Compare a model with random valid goals and the nearest frontier on the same unseen worlds, with intervals.

    All see the same worlds, starts and noise, and decide equally often. Ctrl-C finishes the episode under way; the
    same command with --out FOLDER goes on from there.
    """
    from functools import partial

    from slam_backend.errors import check_int
    from training.evaluation import COMMAND, EvaluateConfig, EvaluateTrial, play
    from training.evaluation_summary import leads, print_evaluation, summarise
    from training.kept_trials import finished_trials, open_folder
    from training.run_folder import plain
    from vslam_env import vslam_v0

    check_int("processes", processes, 1, "Use one process or more.")
    given = {
        "model": model,
        "policies": None if policies is None else tuple(word.strip() for word in policies.split(",")),
        "split": split,
        "world": world,
        "robots": robots,
        "max_cycles": max_cycles,
        "greedy": greedy,
        "seeds": seeds,
        "seed": seed,
    }
    chosen = EvaluateConfig.from_mapping(gather(COMMAND, given, config, json, out))
    env = vslam_v0.parallel_env(config=chosen.environment())  # what cannot be built shows before there is a folder
    prepare(lambda: _one_step(env, chosen))
    folder = open_folder(out, COMMAND, chosen.to_mapping(), chosen.seed)
    console = Console()
    kept = finished_trials(folder, TRIALS_FILE, EvaluateTrial)
    _run_live(console, folder, chosen, partial(play, chosen), kept, processes)
    rows = [kept[trial] for trial in chosen.trials() if trial in kept]
    lines, ahead = plain(summarise(rows)), plain(leads(rows))
    print_evaluation(console, lines, ahead)
    finish(console, folder, folder.write_metrics({"policies": lines, "leads": ahead, "trials": rows}), json)


def _one_step(env: Any, config: "EvaluateConfig") -> None:
    """Let the model act once, so that one that knows another kind of observation is refused at once."""
    import numpy as np

    from agents.trained import TrainedGoals, load_model

    observations, _ = env.reset(seed=config.seed)
    policy, rng = TrainedGoals(load_model(config.model)[0]), np.random.default_rng(0)
    env.step({agent: policy.act(observations[agent], env.belief(agent), rng) for agent in env.agents})


def _run_live(
    console: Console, folder: "RunFolder", config: "EvaluateConfig", play: Any, kept: dict[Any, Any], processes: int
) -> None:
    """Play what is not yet played under a progress bar, and add it to `kept`."""
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    from training.evaluation import EvaluateTrial
    from training.interrupt import interrupt_flag
    from training.kept_trials import run_trials, trial_of

    trials = config.trials()
    columns = (
        MofNCompleteColumn(),
        BarColumn(20),
        TextColumn("{task.description}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with interrupt_flag() as interrupted, Progress(*columns, console=console) as progress:
        task = progress.add_task("", total=len(trials), completed=sum(trial in kept for trial in trials))

        def on_trial(row: dict[str, Any]) -> None:
            kept[trial_of(row, EvaluateTrial)] = row
            told = f"{row['policy']}, seed {row['seed']}: return {row['return']:.3f}"
            progress.update(task, advance=1, description=told)

        waiting = [trial for trial in trials if trial not in kept]
        run_trials(folder, TRIALS_FILE, play, waiting, processes, interrupted, on_trial)
