"""Configurations of the exploration benchmark: its trials, and the range of every value."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from training.experiments.config import (
    ONE_PARTICLE,
    ExperimentConfig,
    NoisePreset,
    RobotCount,
    Sensor,
    first_seed,
    option,
    setting,
)
from training.experiments.policy_names import check_labels, parted_label

if TYPE_CHECKING:  # numerical modules are imported when a command runs, so that --help is fast
    from vslam_env.config import EnvConfig

ORACLES = ("pose", "association", "merge")
NO_ORACLE, ALL_ORACLES = "none", "all"
ANY_SPLIT = "any"


@dataclass(frozen=True, slots=True)
class Trial:
    """One episode of one policy: name, path or `module:name`, optionally with `@` and the action type."""

    policy: str
    world: str
    robots: int
    oracle: str
    seed: int


class ExplorationConfig(ExperimentConfig):
    """Exploration benchmark: all combinations of worlds, numbers of robots and oracles, with each policy."""

    policies: tuple[str, ...] = option(
        ("frontier", "random_goals", "random_walk"),
        "Policies by name, path of a model, MODULE:NAME, or LABEL= and one of these; NAME@discrete selects the action "
        "type, NAME@team the central team policy, oracles@bound and rollout@bound are bounds. The others are compared "
        "with the first.",
    )
    worlds: tuple[str, ...] = option(("office", "maze", "loops", "hall"), "World families or paths.")
    split: Literal["train", "validation", "test", "any"] = option(
        "validation", "Split of the worlds: train, validation, test, or any.", name="world_split"
    )
    robots: tuple[RobotCount, ...] = option((3,), "Numbers of robots in a team.", hint="Use 1 to 8 robots.")
    oracles: tuple[Literal["none", "pose", "association", "merge", "all"], ...] = option(
        (NO_ORACLE, ALL_ORACLES), "Ground truth given to robots: none, pose, association, merge, all."
    )
    duration: float = option(
        120.0, "Simulated time of an episode [s].", name="max_seconds", also="--duration", ge=1.0, hint="Give seconds."
    )
    particles: int = option(100, "Number of particles per filter.", ge=1, hint=ONE_PARTICLE)
    rejuvenate_every: int | None = option(
        None, "Ticks between rejuvenations of the particles; 0: never.", shown="50", ge=0
    )
    preset: NoisePreset = option("standard", "Noise preset: easy, standard or hard.")
    sensor: Sensor = option("landmark", "Sensor: landmark, or stereo (rendered images).")
    decision_limit: float = option(
        2.0,
        "Longest time of a decision [s]; a slower policy fails. Bounds have no limit.",
        gt=0.0,
        hint="Give seconds.",
    )
    seeds: int = option(10, "Number of episodes of each policy.", ge=1, hint="Use at least one episode.")
    seed: int = first_seed()

    def check(self) -> None:
        """Refuse policies and worlds that do not exist."""
        from training.bench.exploration.players import parted

        check_labels(self.policies)
        for policy in self.policies:
            parted(policy)
        for robots, world in product(self.robots, self.worlds):
            self.environment(Trial(self.policies[0], world, robots, self.oracles[0], self.seed))

    @classmethod
    def completed(cls, values: Mapping[str, Any]) -> Mapping[str, Any]:
        """Make paths absolute, so that a configuration and its trials can be repeated from any folder."""
        return with_absolute_paths(values)

    def trials(self) -> list[Trial]:
        """Return all trials, ordered by seed, then by combination."""
        seeds = range(self.seed, self.seed + self.seeds)
        combined = product(seeds, self.worlds, self.robots, self.oracles, self.policies)
        return [Trial(policy, world, k, oracle, seed) for seed, world, k, oracle, policy in combined]

    def environment(self, trial: Trial) -> "EnvConfig":
        """Return the environment of a trial: all policies have the same world for one seed and combination."""
        from training.bench.exploration.players import environment_of

        return environment_of(
            trial.policy, trial.oracle, trial.world, self.split, robots=trial.robots, max_seconds=self.duration,
            particles=self.particles, rejuvenate_every=self.rejuvenate_every, preset=self.preset, sensor=self.sensor,
        )  # fmt: skip


class PlanConfig(ExperimentConfig):
    """Run of a benchmark plan, which fixes all but the policies."""

    plan: str = setting("vslam-bench-v1", "Name or TOML file of the plan.")
    plan_hash: str = setting("", "Hash of the plan's content.")
    policies: tuple[str, ...] | None = setting(None, "Labels of the policies; None: those of the plan.")
    tracks: tuple[str, ...] | None = setting(None, "Names of the tracks; None: all.")
    extent: Literal["all", "base", "quick"] = setting(
        "all", "Episodes that are played: all, those that a row needs (base), or a few (quick)."
    )
    decision_limit: float = setting(2.0, "Longest time of a decision [s].", gt=0.0)

    def check(self) -> None:
        """Refuse policies that do not exist."""
        from training.bench.exploration.players import parted

        check_labels(self.policies or ())
        for policy in self.policies or ():
            parted(policy)

    @classmethod
    def completed(cls, values: Mapping[str, Any]) -> Mapping[str, Any]:
        """Make paths of models and of the plan absolute, so that a run can be resumed from any folder."""
        found = with_absolute_paths(values)
        if isinstance(found.get("plan"), str) and Path(found["plan"]).is_file():
            found["plan"] = str(Path(found["plan"]).resolve())
        return found


def with_absolute_paths(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return plain values of a configuration with absolute paths of worlds and of models."""
    from vslam_env.world import portable_source

    found = dict(values)
    if isinstance(found.get("worlds"), list | tuple):
        found["worlds"] = [portable_source(str(world)) for world in found["worlds"]]
    if isinstance(found.get("policies"), list | tuple):
        found["policies"] = [_portable_policy(policy) for policy in found["policies"]]
    return found


def _portable_policy(text: Any) -> Any:
    """Return a policy on the command line with an absolute path of its model, if it is one."""
    from agents.registry import is_model

    label, policy = parted_label(text) if isinstance(text, str) else ("", text)
    return text if not is_model(policy) else f"{label}{'=' if label else ''}{Path(policy).resolve()}"
