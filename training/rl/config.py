"""`TrainConfig`: all that decides a training, its presets, and the environments that it stands for."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from slam_backend.core.validation import bad_argument, check_choice, check_float, check_int
from training.experiments.config import PlainConfig
from vslam_env.config import MAX_ROBOTS, EnvConfig
from vslam_env.presets import PRESETS, preset_config
from vslam_env.world import WORLD_FAMILIES, check_source, is_one_building

SPLIT_TRAIN, SPLIT_TRY = "train", "validation"


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainConfig(PlainConfig):
    """MaskablePPO with one network for all robots and `goal` actions.

    A rollout is one episode of every robot. What is left out has the value of the preset `quick`.

    Attributes:
        preset: The name that it began with.
        world: A family name, or the path of a floor plan, a JSON file or a folder.
        robots: K.
        noise: `"easy"`, `"standard"` or `"hard"`: the preset of the environment.
        particles: Of each filter.
        straighten: Whether filters are rejuvenated, and maps straightened before they are merged, as in the environment
            by default: it makes maps truer and keeps wrong merges out, and here takes most of the time.
        decision_ticks: Ticks of 0.1 s from a decision to the next.
        max_cycles: Decisions of an episode.
        reward: Weights of the named reward terms.
        envs: Environments side by side.
        steps: Decisions of all robots together, rounded up to whole rollouts.
        batch: Decisions per step of the optimiser.
        epochs: Times that each rollout is gone through.
        learning_rate: At the start; it falls linearly to zero.
        gamma: Discount per decision: one per tick, to the power of `decision_ticks`. 0.999 per tick would be 0.98.
        gae_lambda: Of the generalised advantage estimate.
        clip: Of PPO's ratio.
        entropy: Weight of the entropy bonus.
        checkpoint_updates: A checkpoint is written every so many rollouts.
        seed: Of all random draws.
    """

    preset: str = "quick"
    world: str = "office"
    robots: int = 3
    noise: str = "standard"
    particles: int = 30
    straighten: bool = False
    decision_ticks: int = 20
    max_cycles: int = 45
    reward: Mapping[str, float] = field(default_factory=lambda: {"map_error": 3.0, "own_coverage": 10.0})
    envs: int = 16
    steps: int = 64_800
    batch: int = 360
    epochs: int = 10
    learning_rate: float = 1.5e-3
    gamma: float = 0.95
    gae_lambda: float = 0.5
    clip: float = 0.2
    entropy: float = 0.002
    checkpoint_updates: int = 5
    seed: int = 0

    def __post_init__(self) -> None:
        check_choice("preset", self.preset, tuple(TRAIN_PRESETS))
        check_choice("noise", self.noise, PRESETS)
        if check_int("robots", self.robots, 1, "Use 1 to 8 robots.") > MAX_ROBOTS:
            raise bad_argument("robots", f"an int from 1 to {MAX_ROBOTS}", self.robots, "Use 1 to 8 robots.")
        for name in ("particles", "decision_ticks", "max_cycles", "envs", "steps", "epochs", "checkpoint_updates"):
            check_int(name, getattr(self, name), 1, "Give a number of at least one.")
        check_int("batch", self.batch, 2, "The advantages of a batch are compared: give two or more.")
        check_int("seed", self.seed, 0, "Use 0 or a positive number.")
        check_float("learning_rate", self.learning_rate, "1e-3 is a good start.", above=0.0)
        for name in ("gamma", "gae_lambda"):
            check_float(name, getattr(self, name), "Use a share, e.g. 0.98.", above=0.0, at_most=1.0)
        check_float("clip", self.clip, "0.2 is usual.", above=0.0)
        check_float("entropy", self.entropy, "Use 0 for no bonus.", at_least=0.0)
        check_source(self.world)
        self.make_env_config(SPLIT_TRAIN)  # what the environment refuses shows here

    @classmethod
    def completed(cls, values: Mapping[str, Any]) -> Mapping[str, Any]:
        """Take what is left out from the preset."""
        preset = check_choice("preset", values.get("preset", "quick"), tuple(TRAIN_PRESETS))
        return {**TRAIN_PRESETS[preset], "preset": preset, **values}

    def to_mapping(self) -> dict[str, Any]:
        """Return the plain values that repeat this training from any folder, the seed apart."""
        is_path = self.world not in WORLD_FAMILIES
        told = {"world": str(Path(self.world).resolve()) if is_path else self.world}
        return PlainConfig.to_mapping(self) | told

    @property
    def rollout(self) -> int:
        """Decisions of all robots in a rollout."""
        return self.envs * self.robots * self.max_cycles

    @property
    def updates(self) -> int:
        """Rollouts, each followed by an update of the network."""
        return -(-self.steps // self.rollout)

    def make_env_config(self, split: str | None) -> EnvConfig:
        """Return the environment for worlds of a split; files of one building have none."""
        return preset_config(self.noise).replace(
            world=self.world,
            world_split=split if self.has_splits else None,
            num_robots=self.robots,
            action_type="goal",
            decision_ticks=self.decision_ticks,
            max_cycles=self.max_cycles,
            reward=dict(self.reward),
            belief={
                "filter": {"num_particles": self.particles} | ({} if self.straighten else {"rejuvenate_every": None}),
                "merging": {"straighten": self.straighten},
            },
        )

    @property
    def has_splits(self) -> bool:
        """Whether its worlds are many, so that some can be kept for validation."""
        return not is_one_building(self.world)


TRAIN_PRESETS: dict[str, dict[str, Any]] = {
    "quick": {},
    # Seconds only: to see that everything works.
    "smoke": {"world": "fig5", "robots": 2, "particles": 5, "max_cycles": 4, "envs": 2, "steps": 48, "batch": 16,
              "epochs": 2, "checkpoint_updates": 1},
}  # fmt: skip
