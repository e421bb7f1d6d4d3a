"""`EvaluateConfig`: a trained model beside scripted policies, each on the same worlds it has never seen; one trial."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from agents.policy import Policy
from agents.registry import make_policy
from agents.trained import TrainedGoals, load_model
from slam_backend.core.validation import bad_argument, check_choice, check_int
from training.episodes.runner import run_episode
from training.experiments.config import PlainConfig
from vslam_env import vslam_v0
from vslam_env.config import EnvConfig
from vslam_env.environment import ExplorationEnv
from vslam_env.world import is_one_building

COMMAND = "evaluate"
MODEL = "model"
BASELINES = ("random_goals", "frontier")
SPLITS = ("validation", "test")
LAST = ("map_error", "map_recall", "map_precision", "coverage", "merges", "collisions", "distance")
FIGURES = ("return", *LAST)


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluateConfig(PlainConfig):
    """All that decides an evaluation. All policies decide as often as the model was trained to.

    Attributes:
        model: Path of the model, or of its run folder.
        policies: Beside the model.
        split: Worlds of `"validation"` or `"test"`.
        world: None: that of the training.
        robots: None: as many as in the training.
        max_cycles: Decisions of an episode; None: as in the training.
        greedy: Whether the model takes what it holds for best; else it draws from its distribution.
        seeds: How many episodes of each policy.
        seed: Of the first; the others follow.
    """

    model: str
    policies: tuple[str, ...] = BASELINES
    split: str = "validation"
    world: str | None = None
    robots: int | None = None
    max_cycles: int | None = None
    greedy: bool = False
    seeds: int = 20
    seed: int = 0

    def __post_init__(self) -> None:
        check_int("seeds", self.seeds, 2, "An interval needs two or more.")
        check_int("seed", self.seed, 0, "Use 0 or a positive number.")
        check_choice("split", self.split, SPLITS)
        for name in self.policies:
            make_policy(name, "goal")  # refuses what is not there, or cannot choose goals

    @classmethod
    def completed(cls, values: Mapping[str, Any]) -> Mapping[str, Any]:
        """Refuse an evaluation of no model."""
        if "model" not in values:
            raise bad_argument("model", "a model that vslam train wrote", "no model", "Name it, or its run folder.")
        return values

    def to_mapping(self) -> dict[str, Any]:
        """Return the plain values that repeat this evaluation from any folder, the seed apart."""
        return PlainConfig.to_mapping(self) | {"model": str(Path(self.model).resolve())}

    def environment(self) -> EnvConfig:
        """Return the environment; its return is the fall of the map error, whatever the model was paid for.

        Raises:
            ValueError: If the model cannot be read, or knows another kind of environment.
        """
        _, about = load_model(self.model)
        config = EnvConfig.from_toml_text(about["environment"])
        given = {"world": self.world, "num_robots": self.robots, "max_cycles": self.max_cycles}
        changes: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
        world = changes.get("world", config.world)
        changes["world_split"] = None if is_one_building(world) else self.split
        return config.replace(**changes, reward={"map_error": 1.0}, shared_reward=False)

    def trials(self) -> list["EvaluateTrial"]:
        """Return all trials, seed by seed."""
        names = (MODEL, *self.policies)
        return [EvaluateTrial(name, seed) for seed in range(self.seed, self.seed + self.seeds) for name in names]


@dataclass(frozen=True, slots=True)
class EvaluateTrial:
    """One policy in one episode."""

    policy: str
    seed: int


def play(config: EvaluateConfig, trial: EvaluateTrial) -> dict[str, Any]:
    """Play an episode; return the trial and its figures, means over the robots."""
    env = _environment(config)
    policies = {agent: _policy(config, trial.policy) for agent in env.possible_agents}
    rewards: list[float] = []
    record = run_episode(env, policies, trial.seed, lambda step: rewards.extend(step.rewards.values()))
    last = {name: float(np.mean([info[name] for info in record.infos])) for name in LAST}
    return asdict(trial) | {"return": sum(rewards) / len(policies)} | last


@cache
def _environment(config: EvaluateConfig) -> ExplorationEnv:
    return vslam_v0.parallel_env(config=config.environment())


def _policy(config: EvaluateConfig, name: str) -> Policy:
    return TrainedGoals(load_model(config.model)[0], config.greedy) if name == MODEL else make_policy(name, "goal")
