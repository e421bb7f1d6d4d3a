"""Configurations of all benchmarks: trials, and the range of every value."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

from training.experiments.config import (
    ONE_PARTICLE,
    ExperimentConfig,
    NoisePreset,
    Positive,
    Proposal,
    RobotCount,
    Sensor,
    first_seed,
    option,
    setting,
)
from training.experiments.policy_names import check_labels, parted_label

if TYPE_CHECKING:  # numerical modules are imported when a command runs, so that --help is fast
    from training.bench.env.bench import EnvLoad
    from training.bench.filter.workload import FilterLoad
    from training.episodes.config import RunConfig
    from vslam_env.config import EnvConfig

ORACLES = ("pose", "association", "merge")
NO_ORACLE, ALL_ORACLES = "none", "all"
ANY_SPLIT = "any"


def world_split(split: str, world: str) -> str | None:
    """Return the split of an environment, None where a world is not drawn or any will do."""
    from vslam_env.world import is_single_layout

    return None if split == ANY_SPLIT or is_single_layout(world) else split


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


Mode = Literal["driver", "poses", "odometry", "identities", "association", "merging", "all", "flat", "goal"]


class EnvBenchConfig(ExperimentConfig):
    """Environment benchmark. Each row changes one number of the base, which has the first entry of each list."""

    robots: tuple[RobotCount, ...] = option(
        (3, 1, 2, 4, 6, 8), "Numbers of robots K, starting with the base.", hint="Use 1 to 8 robots."
    )
    particles: tuple[Positive, ...] = option((100, 30, 300, 1000), "Numbers of particles M.", hint=ONE_PARTICLE)
    worlds: tuple[str, ...] = option(("office", "fig5", "maze", "hall", "loops"), "World families or paths.")
    modes: tuple[Mode, ...] = option(
        get_args(Mode), "Parts in the loop, from known poses to goal actions.", shown="all"
    )
    steps: int = option(1000, "Number of steps of an episode.", ge=2, hint="Use at least two steps.")
    plays: int = setting(5, "Number of repeats of each episode, to reduce the influence of other load.", ge=1)
    seed: int = option(100, "Seed of the episodes.", ge=0, hint="Use 0 or a positive number.")
    peer: bool = option(True, "Time simple_spread of MPE2 interleaved with the first row.")

    def loads(self) -> list["EnvLoad"]:
        """Return the timed loads, row by row, starting with the base."""
        from training.bench.env.bench import EnvLoad

        base = EnvLoad(self.robots[0], self.particles[0], self.worlds[0], self.modes[0])
        rows = [base]
        rows += [base._replace(robots=robots) for robots in self.robots[1:]]
        rows += [base._replace(particles=particles) for particles in self.particles[1:]]
        rows += [base._replace(world=world) for world in self.worlds[1:]]
        return rows + [base._replace(mode=mode) for mode in self.modes[1:]]


@dataclass(frozen=True, slots=True)
class ExplorationTrial:
    """One episode of one policy: name, path or `module:name`, optionally with `@` and the action type."""

    policy: str
    world: str
    robots: int
    oracle: str
    seed: int


class ExplorationBenchConfig(ExperimentConfig):
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
            self.environment(ExplorationTrial(self.policies[0], world, robots, self.oracles[0], self.seed))

    @classmethod
    def completed(cls, values: Mapping[str, Any]) -> Mapping[str, Any]:
        """Make paths absolute, so that a configuration and its trials can be repeated from any folder."""
        return with_absolute_paths(values)

    def trials(self) -> list[ExplorationTrial]:
        """Return all trials, ordered by seed, then by combination."""
        seeds = range(self.seed, self.seed + self.seeds)
        combined = product(seeds, self.worlds, self.robots, self.oracles, self.policies)
        return [ExplorationTrial(policy, world, k, oracle, seed) for seed, world, k, oracle, policy in combined]

    def run(self, trial: ExplorationTrial) -> "RunConfig":
        """Return the configuration of a trial's run."""
        from training.bench.exploration.players import parted
        from training.episodes.config import RunConfig

        player = parted(trial.policy)
        shared: dict[str, Any] = {
            "world": trial.world, "robots": trial.robots, "policy": player.policy, "action_type": player.action_type,
            "particles": self.particles, "rejuvenate_every": self.rejuvenate_every, "preset": self.preset,
            "sensor": self.sensor, "seed": trial.seed,
        }  # fmt: skip
        return RunConfig(**shared, max_seconds=self.duration)

    def environment(self, trial: ExplorationTrial) -> "EnvConfig":
        """Return the environment of a trial: all policies have the same world for one seed and combination."""
        from training.bench.exploration.players import parted

        has_all = trial.oracle == ALL_ORACLES or parted(trial.policy).needs_oracles
        oracles = {f"oracle_{name}": has_all or trial.oracle == name for name in ORACLES}
        split = world_split(self.split, trial.world)
        return self.run(trial).environment().replace(world_split=split, **oracles)


class PlanBenchConfig(ExperimentConfig):
    """Run of a benchmark plan, which fixes all but the policies."""

    plan: str = setting("vslam-bench-v0", "Name or TOML file of the plan.")
    plan_hash: str = setting("", "Hash of the plan's content.")
    policies: tuple[str, ...] | None = setting(None, "Labels of the policies; None: those of the plan.")
    quick: bool = setting(False, "Whether only the first seeds of the base part are played.")
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


class FilterBenchConfig(ExperimentConfig):
    """Filter benchmark; rows are all combinations of the given numbers."""

    particles: tuple[Positive, ...] = option((100, 1000), "Numbers of particles M.", hint=ONE_PARTICLE)
    landmarks: tuple[int, ...] = option((100, 300, 1000), "Numbers of landmarks N in the map of each particle.")
    measurements: tuple[int, ...] = option((5, 15), "Numbers of measurements B per step, of all robots together.")
    robots: tuple[Positive, ...] = option((1, 2, 3), "Numbers of robots K.", hint="Use 1 to 8 robots.")
    proposals: tuple[Proposal, ...] = ("fastslam1", "fastslam2")
    lookalikes: int = option(
        1, "Number of landmarks that share one descriptor.", name="look_alikes", ge=1,
        hint="Use 1 for distinct descriptors.",
    )  # fmt: skip
    steps: int = option(300, "Number of timed steps per row.", ge=1, hint="Use at least one step.")
    large: bool = option(False, "Include 10,000 particles with 300 and 1,000 landmarks.")
    compile: bool = option(False, "Include the compilation time of all kernels with an empty cache.")

    def check(self) -> None:
        """Refuse combinations that cannot be timed."""
        self.loads()

    def loads(self) -> list["FilterLoad"]:
        """Return the timed loads, row by row."""
        from training.bench.filter.workload import LARGE_LOADS, FilterLoad

        numbers = product(self.proposals, self.particles, self.landmarks, self.measurements, self.robots)
        rows = [
            FilterLoad(
                proposal=p, particles=m, landmarks=n, measurements=b, robots=k, lookalikes=self.lookalikes,
                seed=self.seed,
            )
            for p, m, n, b, k in numbers
        ]  # fmt: skip
        if not self.large:
            return rows
        return rows + [
            FilterLoad(**load, proposal=p, lookalikes=self.lookalikes, seed=self.seed)
            for p, load in product(self.proposals, LARGE_LOADS)
        ]


class StartBenchConfig(ExperimentConfig):
    """The start-up bench: what a user waits for at first."""

    parts: tuple[Literal["demo", "kernels", "steps", "wheel", "import", "count"], ...] = option(
        ("demo", "kernels", "steps", "import", "count"), "Parts to time: demo, kernels, steps, wheel, import, count."
    )
    repeats: int = option(3, "Runs of each part.", ge=1, hint="Time at least one run.")
    wheel: str | None = option(None, "Wheel of kernels, which adds the part wheel.", shown="none", is_path=True)
    seed: int = setting(0, "Seed; the bench draws nothing.", ge=0)

    def with_wheel(self) -> "StartBenchConfig":
        """Return the configuration with the part `wheel`, if there is a wheel."""
        if self.wheel is None or "wheel" in self.parts:
            return self
        return self.model_copy(update={"parts": (*self.parts, "wheel")})
