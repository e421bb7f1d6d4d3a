"""`RunConfig`: all that decides a run, and the environment and policies that it stands for."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agents.policy import Policy
from agents.registry import is_model, make_policy
from agents.trained import load_model
from slam_backend.core.validation import check_choice, check_int
from training.experiments.config import PlainConfig
from vslam_env import vslam_v0
from vslam_env.config import ACTION_TYPES, GOAL_DECISION_TICKS, SENSORS, TICK, EnvConfig
from vslam_env.environment import ExplorationEnv
from vslam_env.presets import PRESETS, preset_config
from vslam_env.world import WORLD_FAMILIES

# Time for three robots to see the office and to meet each other's traces there [s].
EPISODE_S = 180.0


@dataclass(frozen=True, slots=True, kw_only=True)
class RunConfig(PlainConfig):
    """A run, as its command line says it.

    Attributes:
        world: A family name, or the path of a floor plan, a JSON file or a folder.
        robots: How many.
        policy: A name of the registry of policies, the path of a trained model, or `module:name` of one's own; the
            same for all robots.
        action_type: `"continuous"`, `"discrete"` or `"goal"`.
        max_cycles: Steps of the episode; None: as many as `EPISODE_S` takes.
        particles: Per filter.
        rejuvenate_every: Ticks of 0.1 s after which the particles of a filter are drawn anew from smoothed paths, as
            `FilterOptions` has it; 0: never; None: as the environment has it.
        preset: Of the environment's noise.
        sensor: `"landmark"` or `"stereo"`.
        seed: Of all random draws.
    """

    world: str = "office"
    robots: int = 3
    policy: str = "frontier"
    action_type: str = "continuous"
    max_cycles: int | None = None
    particles: int = 100
    rejuvenate_every: int | None = None
    preset: str = "standard"
    sensor: str = "landmark"
    seed: int = 0

    def __post_init__(self) -> None:
        check_int("robots", self.robots, 1, "Use 1 to 8 robots.")
        check_choice("action_type", self.action_type, ACTION_TYPES)
        check_choice("preset", self.preset, PRESETS)
        check_choice("sensor", self.sensor, SENSORS)
        check_int("particles", self.particles, 1, "Use at least one particle; 100 is a good start.")
        if self.rejuvenate_every is not None:
            check_int("rejuvenate_every", self.rejuvenate_every, 0, "Give a number of ticks, or 0 for never.")
        check_int("seed", self.seed, 0, "Use 0 or a positive number.")
        if self.max_cycles is not None:
            check_int("max_cycles", self.max_cycles, 1, "Give a number of steps.")

    def to_mapping(self) -> dict[str, Any]:
        """Return the plain values that repeat this run from any folder, the seed apart."""
        is_path = self.world not in WORLD_FAMILIES
        told = {"world": str(Path(self.world).resolve()) if is_path else self.world, "max_cycles": self.num_steps}
        if is_model(self.policy):
            told["policy"] = str(Path(self.policy).resolve())
        return PlainConfig.to_mapping(self) | told

    @property
    def step_s(self) -> float:
        """Duration of a step [s]."""
        if self.action_type != "goal":
            return TICK
        return TICK * (GOAL_DECISION_TICKS if self.decision_ticks is None else self.decision_ticks)

    @property
    def decision_ticks(self) -> int | None:
        """Ticks between decisions: as many as a trained policy was trained with; None for others: the usual ones."""
        if not is_model(self.policy):
            return None
        trained = EnvConfig.from_toml_text(load_model(self.policy)[1]["environment"])
        return None if self.action_type != "goal" else trained.decision_ticks

    @property
    def num_steps(self) -> int:
        """Steps of the episode."""
        return round(EPISODE_S / self.step_s) if self.max_cycles is None else self.max_cycles

    def environment(self) -> EnvConfig:
        """Return the environment's configuration."""
        assumed: dict[str, Any] = {"num_particles": self.particles}
        if self.rejuvenate_every is not None:
            assumed["rejuvenate_every"] = self.rejuvenate_every or None
        return preset_config(self.preset, self.sensor).replace(
            belief={"filter": assumed},
            world=self.world,
            num_robots=self.robots,
            action_type=self.action_type,
            decision_ticks=self.decision_ticks,
            max_cycles=self.num_steps,
        )

    def make_env(self) -> ExplorationEnv:
        """Build the environment."""
        return vslam_v0.parallel_env(config=self.environment())

    def make_policies(self, env: ExplorationEnv) -> dict[str, Policy]:
        """Build one policy for each agent."""
        return {agent: make_policy(self.policy, self.action_type) for agent in env.possible_agents}
