"""The command `vslam evaluate`: a trained model beside scripted policies on worlds that it was not trained on."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from training.commands._options import Config, FirstSeed, Json, OutToGoOn, Processes, words
from training.commands._progress import KeptPart, play_kept
from training.commands._run_folder import begin, choose, finish

if TYPE_CHECKING:  # what computes is imported when the command runs, so that --help answers at once
    from training.rl.evaluation import EvaluateConfig

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
    first_seed: FirstSeed = None,
    processes: Processes = 1,
    out: OutToGoOn = None,
    json: Json = None,
    config: Config = None,
) -> None:
    """Compare a model with random valid goals and the nearest frontier on the same unseen worlds, with intervals.

    All see the same worlds, starts and noise, and decide equally often.
    Ctrl-C finishes the episode under way; the same command with --out FOLDER
    goes on from there.
    """
    from functools import partial

    from slam_backend.core.validation import bad_argument, check_int
    from training.experiments.run_folder import plain
    from training.rl.evaluation import COMMAND, EvaluateConfig, EvaluateTrial, play
    from training.rl.evaluation_summary import leads, print_evaluation, summarise
    from vslam_env import vslam_v0

    check_int("processes", processes, 1, "Use one process or more.")
    given = {
        "model": model,
        "policies": words(policies),
        "split": split,
        "world": world,
        "robots": robots,
        "max_cycles": max_cycles,
        "greedy": greedy,
        "seeds": seeds,
        "seed": first_seed,
    }
    chosen = choose(EvaluateConfig, COMMAND, given, config=config, json=json, out=out)
    env = vslam_v0.parallel_env(config=chosen.environment())  # what cannot be built shows before there is a folder
    if split is not None and env.config.world_split is None:
        cure = "Leave --split out: starts and noise differ from those of the training all the same."
        raise bad_argument("split", "worlds of which there are many", env.config.world, cure)
    console, folder = begin(COMMAND, chosen, out, lambda: _one_step(env, chosen), goes_on=True)
    part = KeptPart(
        file=TRIALS_FILE, kind=EvaluateTrial, play=partial(play, chosen), trials=chosen.trials(), processes=processes,
        tell=lambda row: f"{row['policy']}, seed {row['seed']}: return {row['return']:.3f}",
    )  # fmt: skip
    (rows,) = play_kept(console, folder, part)
    lines, ahead = plain(summarise(rows)), plain(leads(rows))
    print_evaluation(console, lines, ahead, env.config.world_split)
    finish(console, folder, folder.write_metrics({"policies": lines, "leads": ahead, "trials": rows}), json)


def _one_step(env: Any, config: "EvaluateConfig") -> None:
    """Let the model act once, so that one that knows another kind of observation is refused at once."""
    import numpy as np

    from agents.trained import TrainedGoals, load_model

    observations, _ = env.reset(seed=config.seed)
    policy, rng = TrainedGoals(load_model(config.model)[0]), np.random.default_rng(0)
    env.step({agent: policy.act(observations[agent], env.belief(agent), rng) for agent in env.agents})
