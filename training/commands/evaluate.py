"""The command `vslam evaluate`: a trained model beside scripted policies on worlds that it was not trained on."""

from functools import partial
from typing import Any

from training.commands._options import Processes, options
from training.commands._progress import KeptPart, play_kept
from training.commands._run_folder import Call
from training.rl.config import EvaluateConfig, EvaluateTrial

TRIALS_FILE = "trials.jsonl"


@options(EvaluateConfig, "evaluate", continues=True)
def evaluate(call: Call[EvaluateConfig], processes: Processes = 1) -> None:
    """Compare a model with random valid goals and the nearest frontier on the same unseen worlds, with intervals.

    All see the same worlds, starts and noise, and decide equally often.
    Ctrl-C finishes the episode under way; the same command with --out FOLDER
    goes on from there.
    """
    from slam_backend.core.validation import argument_error
    from training.experiments.run_folder import plain
    from training.rl.evaluation import leads, play, print_evaluation, summarise
    from vslam_env import vslam_v0

    chosen = call.config
    env = vslam_v0.parallel_env(config=chosen.environment())  # what cannot be built shows before there is a folder
    if "split" in call.given and env.config.world_split is None:
        cure = "Leave --split out: starts and noise differ from those of the training all the same."
        raise argument_error("split", "worlds of which there are many", env.config.world, cure)
    console, folder = call.begin(lambda: _one_step(env, chosen))
    part = KeptPart(
        file=TRIALS_FILE, kind=EvaluateTrial, play=partial(play, chosen), trials=chosen.trials(), processes=processes,
        tell=lambda row: f"{row['policy']}, seed {row['seed']}: return {row['return']:.3f}",
    )  # fmt: skip
    (rows,) = play_kept(console, folder, part)
    lines, ahead = plain(summarise(rows)), plain(leads(rows))
    print_evaluation(console, lines, ahead, env.config.world_split)
    call.write({"policies": lines, "leads": ahead, "trials": rows})
    call.finish()


def _one_step(env: Any, config: EvaluateConfig) -> None:
    """Let the model act once, so that one that knows another kind of observation is refused at once."""
    import numpy as np

    from agents.trained import TrainedGoalPolicy, load_model

    observations, _ = env.reset(seed=config.seed)
    policy, rng = TrainedGoalPolicy(load_model(config.model)[0]), np.random.default_rng(0)
    env.step({agent: policy.act(observations[agent], env.belief(agent), rng) for agent in env.agents})
