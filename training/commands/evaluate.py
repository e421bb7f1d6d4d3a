"""Command `vslam evaluate`: comparison of a trained model with baseline policies on unseen worlds."""

from functools import partial
from typing import Any

from training.commands._options import Workers, options
from training.commands._progress import TrialSet, run_trial_set
from training.commands._run_folder import Call
from training.rl.config import EvaluateConfig, EvaluateTrial

TRIALS_FILE = "trials.jsonl"


@options(EvaluateConfig, "evaluate", continues=True)
def evaluate(call: Call[EvaluateConfig], workers: Workers = 1) -> None:
    """Compare a model with baseline policies on the same unseen worlds, with confidence intervals.

    All policies have the same worlds, starts and noise, and the same decision interval.
    Ctrl-C finishes the current episode; the same command with --out FOLDER
    resumes the evaluation.
    """
    from slam_backend.core.validation import argument_error
    from training.experiments.run_folder import plain
    from training.rl.evaluation import leads, play, print_evaluation, summarise
    from vslam_env import vslam_v1

    chosen = call.config
    env = vslam_v1.parallel_env(config=chosen.environment())  # detects bad input before the folder is created
    if "split" in call.given and env.config.world_split is None:
        hint = "Omit --world-split: starts and noise differ from the training anyway."
        raise argument_error("world_split", "a world family or folder", env.config.world, hint)
    console, folder = call.begin(lambda: _one_step(env, chosen))
    part = TrialSet(
        file=TRIALS_FILE, kind=EvaluateTrial, play=partial(play, chosen), trials=chosen.trials(), workers=workers,
        tell=lambda row: f"{row['policy']}, seed {row['seed']}: return {row['return']:.3f}",
    )  # fmt: skip
    rows = run_trial_set(console, folder, part)
    lines, ahead = plain(summarise(rows)), plain(leads(rows))
    print_evaluation(console, lines, ahead, env.config.world_split)
    call.write({"policies": lines, "leads": ahead, "trials": rows})
    call.finish()


def _one_step(env: Any, config: EvaluateConfig) -> None:
    """Run one decision of the model, to detect an unsupported observation early."""
    import numpy as np

    from agents.trained import TrainedGoalPolicy, load_model

    observations, _ = env.reset(seed=config.seed)
    policy, rng = TrainedGoalPolicy(load_model(config.model)[0]), np.random.default_rng(0)
    env.step({agent: policy.act(observations[agent], env.belief(agent), rng) for agent in env.agents})
