"""Study of `vslam evaluate`: a trained model and baseline policies on the same unseen worlds."""

from functools import cache, partial

import numpy as np

from agents.policy import Policy
from agents.registry import make_policy
from agents.trained import trained_policy
from training.bench.exploration.players import label
from training.episodes.runner import run_episode
from training.experiments.output.tables import E_SCALE
from training.experiments.policy_names import parted_label
from training.experiments.study import Column, ResultTable, Study, Words
from training.rl.config import MODEL, EvaluateConfig, EvaluateTrial
from vslam_env import vslam_v1
from vslam_env.environment import ExplorationEnv

LAST = ("map_error", "map_recall", "map_precision", "coverage", "merges", "collisions", "distance")
WORDS: Words = {"policy": ("policy", label)}
RETURN = Column("return", interval=True)
MAP_ERROR = Column("map_error", "E [m]", interval=True)


def play(config: EvaluateConfig, trial: EvaluateTrial) -> dict[str, float]:
    """Run an episode; return its metrics as means over the robots."""
    env = _environment(config)
    policies = {agent: _policy(config, trial.policy) for agent in env.possible_agents}
    rewards: list[float] = []
    record = run_episode(env, policies, trial.seed, lambda step: rewards.extend(step.rewards.values()))
    last = {name: float(np.mean([info[name] for info in record.infos])) for name in LAST}
    return {"return": sum(rewards) / len(policies)} | last


@cache
def _environment(config: EvaluateConfig) -> ExplorationEnv:
    return vslam_v1.parallel_env(config=config.environment())


def _policy(config: EvaluateConfig, name: str) -> Policy:
    if name == MODEL:
        return trained_policy(config.model, "model", config.greedy)
    return make_policy(parted_label(name)[1], config.environment().action_type)


def first_decision(config: EvaluateConfig) -> None:
    """Run one decision of the model, to detect an unsupported observation early."""
    env, rng = _environment(config), np.random.default_rng(0)
    observations, _ = env.reset(seed=config.seed)
    policy = _policy(config, MODEL)
    env.step({agent: policy.act(observations[agent], env.belief(agent), rng) for agent in env.agents})


STUDY = Study(
    name="evaluate",
    config=EvaluateConfig,
    trial=EvaluateTrial,
    trials=EvaluateConfig.trials,
    play=play,
    checks=lambda config: (partial(first_decision, config),),
    tables=(
        ResultTable(
            name="policies", title="All policies in the same worlds", by=("policy",), words=WORDS, note=E_SCALE,
            columns=(
                RETURN, MAP_ERROR, Column("map_recall", digits=0), Column("coverage", digits=0),
                Column("merges", digits=2), Column("distance", "path [m]", digits=1),
            ),
        ),
        ResultTable(
            name="differences", title="Paired differences to the model", by=("policy",), words=WORDS,
            against="policy", base=MODEL,
            columns=(
                Column("seeds", statistic=len, digits=0), RETURN,
                Column("return", "higher [%]", "share above 0", 0, 100.0), MAP_ERROR,
            ),
        ),
    ),
)  # fmt: skip
