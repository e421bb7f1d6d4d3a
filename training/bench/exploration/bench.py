"""`ExplorationBenchConfig`: what `vslam bench exploration` compares, and the trials that this takes."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from agents.registry import action_types, is_model
from slam_backend.core.validation import bad_argument, check_choice, check_float, check_int
from training.episodes.config import RunConfig
from training.experiments.config import PlainConfig, check_each_once
from vslam_env.config import EnvConfig
from vslam_env.world import SPLITS, WORLD_FAMILIES, is_one_building

COMMAND = "bench exploration"
TRIALS_FILE = "trials.jsonl"
ORACLES = ("pose", "association", "merge")
NO_ORACLE, ALL_ORACLES = "none", "all"
ANY_SPLIT = "any"


@dataclass(frozen=True, slots=True)
class ExplorationTrial:
    """One policy in one episode.

    Attributes:
        policy: A name, a path or `module:name`, perhaps with `@` and the type of action.
        world: A family or a path.
        robots: How many.
        oracle: What the robots are told: `"none"`, one of `ORACLES`, or `"all"` of them.
        seed: Of the episode.
    """

    policy: str
    world: str
    robots: int
    oracle: str
    seed: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ExplorationBenchConfig(PlainConfig):
    """All that decides the comparison. Worlds, numbers of robots and oracles are combined; policies meet in each.

    Attributes:
        policies: The first is the one that the others are compared with. `name@action_type` chooses how it acts; else
            it sets goals if it knows how to.
        worlds: Families, or paths of floor plans, JSON files or folders.
        split: Worlds of `"train"`, `"validation"` or `"test"`, or `"any"`. One building is not split.
        robots: How many explore together.
        oracles: What they are told.
        duration: Of an episode [s].
        particles: Per filter.
        rejuvenate_every: As `RunConfig` has it.
        preset: Of the environment's noise.
        sensor: `"landmark"` or `"stereo"`.
        seeds: Episodes of each policy in each combination.
        seed: Of the first; the others follow.
    """

    policies: tuple[str, ...] = ("frontier", "random_goals", "random_walk")
    worlds: tuple[str, ...] = ("office", "maze", "loops", "hall")
    split: str = "validation"
    robots: tuple[int, ...] = (3,)
    oracles: tuple[str, ...] = (NO_ORACLE, ALL_ORACLES)
    duration: float = 120.0
    particles: int = 100
    rejuvenate_every: int | None = None
    preset: str = "standard"
    sensor: str = "landmark"
    seeds: int = 10
    seed: int = 0

    def __post_init__(self) -> None:
        check_int("seeds", self.seeds, 1, "Play one episode or more.")
        check_float("duration", self.duration, "Give seconds.", at_least=1.0)
        check_choice("split", self.split, (*SPLITS, ANY_SPLIT))
        for name in ("policies", "worlds", "robots", "oracles"):
            check_each_once(name, getattr(self, name))
        for oracle in self.oracles:
            check_choice("oracles", oracle, (NO_ORACLE, *ORACLES, ALL_ORACLES))
        for policy in self.policies:
            _parted(policy)
        for robots, world in product(self.robots, self.worlds):
            self.environment(ExplorationTrial(self.policies[0], world, robots, self.oracles[0], self.seed))

    @classmethod
    def completed(cls, values: Mapping[str, Any]) -> Mapping[str, Any]:
        """Make paths absolute, so that a configuration and its trials repeat from anywhere."""
        found = dict(values)
        if isinstance(found.get("worlds"), list | tuple):
            found["worlds"] = [w if w in WORLD_FAMILIES else str(Path(str(w)).resolve()) for w in found["worlds"]]
        if isinstance(found.get("policies"), list | tuple):
            found["policies"] = [str(Path(p).resolve()) if is_model(p) else p for p in found["policies"]]
        return found

    def trials(self) -> list[ExplorationTrial]:
        """Return all trials: seed by seed, and in a seed combination by combination."""
        seeds = range(self.seed, self.seed + self.seeds)
        combined = product(seeds, self.worlds, self.robots, self.oracles, self.policies)
        return [ExplorationTrial(policy, world, k, oracle, seed) for seed, world, k, oracle, policy in combined]

    def run(self, trial: ExplorationTrial) -> RunConfig:
        """Return the trial as a run."""
        policy, action_type = _parted(trial.policy)
        shared: dict[str, Any] = {
            "world": trial.world, "robots": trial.robots, "policy": policy, "action_type": action_type,
            "particles": self.particles, "rejuvenate_every": self.rejuvenate_every, "preset": self.preset,
            "sensor": self.sensor, "seed": trial.seed,
        }  # fmt: skip
        step_s = RunConfig(**shared).step_s
        return RunConfig(**shared, max_cycles=max(1, round(self.duration / step_s)))

    def environment(self, trial: ExplorationTrial) -> EnvConfig:
        """Return the environment of a trial: of all policies with one seed in one combination the same world."""
        split = None if self.split == ANY_SPLIT or is_one_building(trial.world) else self.split
        told = {f"oracle_{name}": trial.oracle in (name, ALL_ORACLES) for name in ORACLES}
        return self.run(trial).environment().replace(world_split=split, **told)


def _parted(policy: str) -> tuple[str, str]:
    """Return a policy's name and its type of action.

    Raises:
        ValueError: If there is no such policy, or it does not know this type of action.
    """
    if not isinstance(policy, str):
        raise bad_argument("policies", "names", policy, "Write them as text.")
    name, at, wanted = policy.rpartition("@") if "@" in policy else (policy, "", "")
    known = action_types(name)
    return name, check_choice(f"{name}@", wanted, known, "These are the actions that it knows.") if at else known[0]
