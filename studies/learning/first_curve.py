"""Curves of learners in halls beside policies that need no training: what a first training looks like.

python -m studies.learning.first_curve --robots 1,3
python -m studies.learning.first_curve --robots 1,3 --learners ippo,mappo     # where BenchMARL is installed
"""

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np

from agents import make_policy
from agents.policy import Policy
from examples.first_curve import REWARD, task, train
from training.commands.study import run_program
from training.experiments.config import ExperimentConfig, RobotCount, first_seed, option
from training.experiments.study import Column, Curves, ResultTable, Study
from vslam_env import vslam_v1
from vslam_env.wrappers import Scaled

PPO, SCRIPTED = "ppo", ("random_goals", "frontier")
POINTS = 15  # of a curve
Choose = Callable[[Mapping[str, Any], bool], int]  # of a scaled observation; whether the most probable action is asked


class Config(ExperimentConfig):
    """Trainings of several seeds, and scripted policies in as many worlds."""

    robots: tuple[RobotCount, ...] = option((1, 3), "Numbers of robots.", hint="Use 1 to 8 robots.")
    learners: tuple[Literal["ppo", "ippo", "mappo"], ...] = option(
        (PPO,), "Learners: ppo of Stable-Baselines3, ippo and mappo of BenchMARL."
    )
    decisions: int = option(60_000, "Decisions of a training by each robot.", ge=800, hint="Use at least an update.")
    seeds: int = option(3, "Number of trainings.", ge=1, hint="Use one or more.")
    seed: int = first_seed()
    episodes: int = option(20, "Episodes on validation worlds, of each model and scripted policy.", ge=1, hint="Use 1.")


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One training, or the episodes of a scripted policy."""

    robots: int  # K
    policy: str  # A learner, or one of `SCRIPTED`
    seed: int


def trials(config: Config) -> list[Trial]:
    """Return all trials, the scripted policies of each number of robots first."""
    seeds = range(config.seed, config.seed + config.seeds)
    return [
        Trial(robots=robots, policy=policy, seed=seed)
        for robots in config.robots
        for policy in (*SCRIPTED, *config.learners)
        for seed in (seeds[:1] if policy in SCRIPTED else seeds)
    ]


def play(config: Config, trial: Trial) -> dict[str, Any]:
    """Train a model, or take a scripted policy, and play it in validation worlds.

    Returns:
        `curves`: mean return in the training [m] by thousands of decisions of a robot, a level line for scripted
        policies; `sampled` and `greedy`: mean return in validation worlds [m] of sampled actions and of the most
        probable ones.
    """
    if trial.policy in SCRIPTED:
        level = mean_return(trial.robots, config.episodes, partial(_scripted, trial.policy))
        curve = {"time_s": [0.0, config.decisions / 1000], "return_m": [level, level]}
        return {"curves": curve, "sampled": level, "greedy": level}
    choose, points = _trained(trial.policy, trial.robots, config.decisions * trial.robots, trial.seed)
    parts = np.array_split(np.array(points), min(POINTS, len(points)))
    sampled, greedy = (
        mean_return(trial.robots, config.episodes, partial(_Model, choose, is_greedy)) for is_greedy in (False, True)
    )
    curve = {
        "time_s": [float(part[-1, 0]) / trial.robots / 1000 for part in parts],
        "return_m": [float(part[:, 1].mean()) for part in parts],
    }
    return {"curves": curve, "sampled": sampled, "greedy": greedy}


def _trained(learner: str, robots: int, decisions: int, seed: int) -> tuple[Choose, list[tuple[int, float]]]:
    """Train one network for all robots."""
    if learner != PPO:  # imported by its name: BenchMARL lives in an environment of its own
        trained: tuple[Choose, list[tuple[int, float]]] = importlib.import_module(
            "studies.learning.benchmarl_task"
        ).train(learner, robots, decisions, seed)
        return trained
    model, points = train(robots, decisions, seed)
    return lambda seen, is_greedy: int(model.predict(seen, deterministic=is_greedy)[0]), points


class _Model:
    """Policy of a trained network."""

    def __init__(self, choose: Choose, is_greedy: bool) -> None:
        self._choose, self._is_greedy = choose, is_greedy

    def reset(self) -> None:
        """Keep nothing of the last episode."""

    def act(self, observation: Any, belief: Any, rng: np.random.Generator) -> int:
        """Return the action for a scaled observation."""
        return self._choose(observation, self._is_greedy)


def _scripted(name: str) -> Policy:
    return make_policy(name, "goal")


def mean_return(robots: int, episodes: int, make: Callable[[], Policy]) -> float:
    """Return the mean return [m] of the robots of a policy over validation worlds."""
    env: Any = Scaled(vslam_v1.parallel_env(config=task(robots, "validation")))
    policies: dict[str, Policy] = {agent: make() for agent in env.possible_agents}
    returns = []
    for seed in range(episodes):
        observations, _ = env.reset(seed=seed)
        rng, total = np.random.default_rng(seed), 0.0
        for policy in policies.values():
            policy.reset()
        while env.agents:
            actions = {agent: policies[agent].act(observations[agent], env.belief(agent), rng) for agent in env.agents}
            observations, rewards, *_ = env.step(actions)
            total += sum(rewards.values())
        returns.append(total / robots / REWARD)
    return float(np.mean(returns))


NAMES = {
    PPO: "PPO",
    "ippo": "IPPO",
    "mappo": "MAPPO",
    "random_goals": "random valid goals",
    "frontier": "nearest frontier",
}
WORDS = {
    "robots": ("robots", lambda robots: "one robot" if robots == 1 else f"{robots} robots"),
    "policy": ("policy", NAMES.__getitem__),
}
COLUMNS = (
    Column("sampled", "actions sampled [m]", interval=True),
    Column("greedy", "most probable action [m]", interval=True),
)
STUDY = Study(
    name="first_curve", about="Draw the curves of learners in halls.", config=Config, trial=Trial, trials=trials,
    play=play,
    tables=(
        ResultTable(
            name="returns", title="Return in validation worlds, mean over the trainings", by=("robots", "policy"),
            columns=COLUMNS, words=WORDS,
        ),
    ),
    curves=Curves(
        by=("robots", "policy"), columns=(Column("return_m", "return [m]", interval=True),), rows=("robots",),
        axis="thousands of decisions of a robot", words=WORDS,
    ),
)  # fmt: skip

if __name__ == "__main__":
    run_program(STUDY)
