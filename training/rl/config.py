"""`TrainConfig` and `EvaluateConfig`: configuration of training and evaluation, and their environments."""

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field

from training.experiments.config import ExperimentConfig, NoisePreset, Positive, first_seed, option, setting
from training.experiments.policy_names import check_labels, parted_label

if TYPE_CHECKING:  # numerical modules are imported when a command runs, so that --help is fast
    from vslam_env.config import EnvConfig

SPLIT_TRAIN, SPLIT_TRY = "train", "validation"
EXTRAS = {  # packages of the extras for training, and how they are installed
    "train": (
        ("torch", "stable_baselines3", "sb3_contrib", "tensorboard"),
        'Install them: pip install "vslam-env[train]".',
    ),
    "jax": (("jax", "optax"), 'Install them: pip install "vslam-env[jax]", and jax[cuda12] for an accelerator.'),
}
MODEL = "model"
LEARNED = "learned"  # the shipped model
ONE = "Give a number >= 1."
Share = Annotated[float, Field(gt=0.0, le=1.0)]
# The environment as it is by default, in which policies are compared; `quick` simulates less.
AS_COMPARED = {"particles": 100, "straighten": True, "decision_ticks": 10, "max_cycles": 120}
TRAIN_PRESETS: dict[str, dict[str, Any]] = {
    "quick": {},
    "imitate": {
        "teacher": "next_best_view", "rounds": 3, "world": "office,maze,loops,hall", **AS_COMPARED, "thin": 4,
        "steps": 103_680, "learning_rate": 1e-3, "epochs": 5,
    },
    # A policy that is good already is refined by small steps near it, and its critic learns first.
    "ppo": {
        "start": "learned", "anchor": 0.1, "value_rollouts": 4, "world": "office,maze,loops,hall", **AS_COMPARED,
        "reward": {"map_error": 3.0, "own_recall": 10.0, "own_coverage": 2.0}, "envs": 32, "steps": 230_400,
        "batch": 720, "epochs": 3, "learning_rate": 3e-4, "gamma": 0.99, "gae_lambda": 0.7, "clip": 0.15,
    },
    # Takes seconds; checks that everything works.
    "smoke": {"world": "fig5", "robots": 2, "particles": 5, "max_cycles": 4, "envs": 2, "steps": 48, "batch": 16,
              "epochs": 2, "checkpoint_updates": 1},
}  # fmt: skip


class TrainConfig(ExperimentConfig):
    """Training of one network for all robots and `goal` actions: MaskablePPO, or imitation of a planner.

    A rollout is one episode of every robot. Omitted values come from the preset `quick`.
    """

    preset: Literal["quick", "imitate", "ppo", "smoke"] = option(
        "quick", "Preset: quick or smoke (PPO), imitate (a planner), or ppo (from the policy learned)."
    )
    teacher: Literal["next_best_view"] | None = setting(None, "Planner to imitate; None: PPO.")
    start: str | None = option(
        None, "Model of vslam train to begin with, its run folder, or learned.", shown="learned with ppo"
    )
    anchor: float = option(
        0.0,
        "Weight of PPO's KL divergence from the policy of the start model [1/nat].",
        shown="0.1 with ppo",
        ge=0.0,
        hint="Use 0 for no anchor.",
    )
    value_rollouts: int = setting(0, "Number of PPO's first rollouts that train the value head alone.", ge=0)
    rounds: Positive | None = option(
        None, "Rounds of an imitation; the pupil drives in all but the first.", shown="3 with imitate", hint=ONE
    )
    temperature: float = setting(0.25, "Divisor of the teacher's log preferences in its soft choices.", gt=0.0)
    thin: Positive = setting(2, "Number of decisions of an imitation for each that is kept as a label.")
    world: str = option("office", "World family or path, or several, comma-separated; see vslam worlds list.")
    robots: int = option(3, "Number of robots, 1 to 8.", ge=1, le=8, hint="Use 1 to 8 robots.")
    noise: NoisePreset = setting("standard", "Noise preset of the environment.")
    particles: Positive = setting(30, "Number of particles of each filter.")
    straighten: bool = setting(
        False,
        "Rejuvenate filters, and smooth maps before merging, as the environment does by default. "
        "This makes maps more accurate and avoids false merges, but takes most of the time of a training.",
    )
    decision_ticks: Positive = setting(20, "Number of ticks of 0.1 s between decisions.")
    max_cycles: Positive = setting(45, "Number of decisions per episode.")
    reward: Mapping[str, float] = setting({"map_error": 3.0, "own_coverage": 10.0}, "Weights of the reward terms.")
    envs: int = option(16, "Number of parallel environments.", ge=1, hint=ONE)
    steps: int = option(64_800, "Decisions of all robots in total, rounded up to whole rollouts.", ge=1, hint=ONE)
    batch: int = setting(360, "Minibatch size of the optimiser; PPO normalises advantages per minibatch.", ge=2)
    epochs: Positive = setting(4, "Number of passes over each rollout, or in each round of an imitation.")
    learning_rate: float = setting(1.5e-3, "Initial learning rate; it decays linearly to zero.", gt=0.0)
    gamma: Share = setting(
        0.95, "Discount per decision, the discount per tick to the power of `decision_ticks`: 0.999 per tick is 0.98."
    )
    gae_lambda: Share = setting(0.5, "Lambda of the generalised advantage estimate.")
    clip: float = setting(0.2, "Clip range of PPO's probability ratio.", gt=0.0)
    entropy: float = setting(0.002, "Weight of the entropy bonus.", ge=0.0)
    checkpoint_updates: Positive = setting(5, "Number of rollouts between PPO's checkpoints.")

    def check(self) -> None:
        """Refuse values that the environment refuses."""
        from slam_backend.core.validation import argument_error
        from vslam_env.world import check_source

        if self.start_file is not None:
            from agents.trained import load_model

            load_model(self.start_file, "start")
        if self.anchor and (self.start is None or self.teacher is not None):
            got = "no start" if self.start is None else "a planner to imitate"
            raise argument_error("anchor", "PPO that begins with a model", got, "Give --start, or no --anchor.")
        if self.value_rollouts and (self.start is None or self.teacher is not None):
            expected = "0 without a model to begin with" if self.teacher is None else "0 in an imitation"
            raise argument_error("value_rollouts", expected, self.value_rollouts, "Leave it out.")
        for world in self.worlds:
            check_source(world)
        self.make_env_configs(SPLIT_TRAIN)
        if self.envs % len(self.worlds):
            expected = f"a multiple of the {len(self.worlds)} worlds"
            raise argument_error("envs", expected, self.envs, "Each world has as many environments.")
        if self.thin > self.max_cycles:
            hint = "Keep a label of each episode."
            raise argument_error("thin", f"at most max_cycles, {self.max_cycles}", self.thin, hint)
        if (self.teacher is None) != (self.rounds is None):
            expected = "no number, without a teacher" if self.teacher is None else "a number of rounds for the teacher"
            raise argument_error("rounds", expected, self.rounds, "Use --preset imitate.")
        if self.value_rollouts >= self.updates:
            expected = f"fewer than the rollouts, {self.updates}"
            raise argument_error("value_rollouts", expected, self.value_rollouts, "Use fewer, or more --steps.")
        if self.rounds is not None and self.rounds > self.updates:
            hint = "Use fewer rounds or more --steps."
            raise argument_error("rounds", f"at most one per rollout, {self.updates}", self.rounds, hint)

    @classmethod
    def implied(cls, values: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the values of the preset."""
        return TRAIN_PRESETS.get(str(values.get("preset")), {})

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values that repeat this training from any folder, except the seed."""
        from vslam_env.world import portable_source

        values = super().to_mapping() | {"world": ",".join(str(portable_source(world)) for world in self.worlds)}
        return values if self.start in (None, LEARNED) else values | {"start": str(Path(self.start).resolve())}

    @property
    def start_file(self) -> Path | None:
        """File or run folder of the model to begin with; None: random weights."""
        if self.start == LEARNED:
            from agents.registry import model_file

            return model_file(LEARNED)
        return None if self.start is None else Path(self.start)

    @property
    def worlds(self) -> tuple[str, ...]:
        """World families and paths."""
        return tuple(self.world.split(","))

    @property
    def rollout(self) -> int:
        """Number of decisions of all robots in a rollout."""
        return self.envs * self.robots * self.max_cycles

    @property
    def updates(self) -> int:
        """Number of rollouts, each followed by an update of the network."""
        return -(-self.steps // self.rollout)

    def make_env_configs(self, split: str | None) -> "tuple[EnvConfig, ...]":
        """Return an environment for each of the worlds; see `make_env_config`."""
        return tuple(self.make_env_config(split, world) for world in self.worlds)

    def make_env_config(self, split: str | None, world: str | None = None) -> "EnvConfig":
        """Return the environment for worlds of a split; a world with a single layout has no splits.

        Args:
            split: Split of the worlds.
            world: World; None: the first.
        """
        from agents.goal_network import NAMES
        from vslam_env.belief.belief import motion_without_smoother
        from vslam_env.presets import preset_config
        from vslam_env.world import is_single_layout

        config = preset_config(self.noise)
        assumed: dict[str, Any] = {"num_particles": self.particles}
        if not self.straighten:
            assumed |= {"rejuvenate_every": None, "motion": motion_without_smoother(config.belief.filter.motion)}
        world = self.worlds[0] if world is None else world
        return config.replace(
            world=world, world_split=None if is_single_layout(world) else split, num_robots=self.robots,
            action_type="goal", decision_ticks=self.decision_ticks, max_cycles=self.max_cycles,
            reward=dict(self.reward), observation_keys=NAMES,
            belief={"filter": assumed, "merging": {"smooth_first": self.straighten}},
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class EvaluateTrial:
    """One episode of one policy."""

    policy: str
    seed: int


class EvaluateConfig(ExperimentConfig):
    """Evaluation of a trained model and baseline policies; all decide at the interval of the training."""

    model: str = option(..., "Model of vslam train, or its run folder.", is_path=True, is_argument=True)
    policies: tuple[str, ...] = option(
        ("random_goals", "frontier"),
        "Baseline policies, comma-separated; LABEL= may come before each.",
        shown="random_goals,frontier; for models that drive random_walk,frontier",
    )
    split: Literal["validation", "test"] | None = option(
        None, "Split of the worlds: validation or test.", name="world_split", shown="validation"
    )
    world: str | None = option(None, "World family or path.", shown="as in the training")
    robots: int | None = option(None, "Number of robots, 1 to 8.", shown="as in the training")
    max_cycles: int | None = option(None, "Number of decisions per episode.", shown="as in the training")
    max_seconds: float | None = option(
        None, "Simulated time of an episode [s], instead of max_cycles.", shown="as in the training"
    )
    greedy: bool = option(False, "Take the model's best action instead of sampling from its distribution.")
    seeds: int = option(20, "Number of episodes of each policy.", ge=2, hint="A confidence interval needs two or more.")
    seed: int = first_seed()

    def check(self) -> None:
        """Refuse policies that do not exist or do not support the model's actions, and two limits of the episode."""
        from agents.registry import make_policy
        from agents.trained import drives
        from vslam_env.config import check_one_limit

        check_one_limit(self.max_cycles, self.max_seconds)
        check_labels(self.policies)
        action_type = "continuous" if drives(self.model, "model") else "goal"
        for name in self.policies:
            make_policy(parted_label(name)[1], action_type)

    @classmethod
    def completed(cls, values: Mapping[str, Any]) -> Mapping[str, Any]:
        """Refuse a configuration without a model; models that drive have other baselines."""
        from agents.trained import drives
        from slam_backend.core.validation import argument_error

        if "model" not in values:
            raise argument_error("model", "a model that vslam train wrote", "no model", "Name it, or its run folder.")
        if "policies" in values or not drives(values["model"], "model"):
            return values
        return {**values, "policies": ("random_walk", "frontier")}

    @classmethod
    def merged(cls, earlier: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
        """Return plain values in which a given limit of the episode removes the other one of an earlier run."""
        from vslam_env.config import replace_limit

        return {**earlier, **replace_limit(given)}

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values that repeat this evaluation from any folder, except the seed."""
        return super().to_mapping() | {"model": str(Path(self.model).resolve())}

    def environment(self) -> "EnvConfig":
        """Return the environment. Its reward is the decrease of the map error, whatever the reward of the training.

        Policies observe all keys. Those that drive act at every tick; a model holds its decisions as in its training.

        Raises:
            ValueError: If the model cannot be read, its environment is not supported, or a single layout has a split.
        """
        from slam_backend.core.validation import argument_error
        from training.episodes.config import training_environment
        from vslam_env.world import is_single_layout

        config = training_environment(self.model, "model")
        given = {
            "world": self.world, "num_robots": self.robots, "max_cycles": self.max_cycles,
            "max_seconds": self.max_seconds,
        }  # fmt: skip
        changes: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
        has_splits = not is_single_layout(world := changes.get("world", config.world))
        if self.split and not has_splits:
            hint = "Omit --world-split: starts and noise differ from the training anyway."
            raise argument_error("world_split", "a world family or folder", world, hint)
        changes["world_split"] = (self.split or "validation") if has_splits else None
        if config.action_type != "goal":
            if self.max_cycles is None and self.max_seconds is None and config.max_cycles is not None:
                changes["max_cycles"] = config.max_cycles * config.ticks_per_step
            changes["decision_ticks"] = None
        return config.replace(**changes, reward={"map_error": 1.0}, shared_reward=False, observation_keys="all")

    def trials(self) -> list[EvaluateTrial]:
        """Return all trials, ordered by seed."""
        names = (MODEL, *self.policies)
        return [EvaluateTrial(name, seed) for seed in range(self.seed, self.seed + self.seeds) for name in names]


def require_extra(extra: str = "train") -> None:
    """Refuse to continue without the packages of an extra of `EXTRAS`.

    Raises:
        ValueError: If a package is missing.
    """
    from slam_backend.core.validation import argument_error

    needed, hint = EXTRAS[extra]
    missing = [name for name in needed if find_spec(name) is None]
    if missing:
        raise argument_error(extra, f"the packages of the extra {extra!r}", f"no {', '.join(missing)}", hint)
