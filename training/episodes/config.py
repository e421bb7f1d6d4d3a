"""`RunConfig`: configuration of a run, with its environment and policies."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from training.experiments.config import ONE_PARTICLE, ActionType, ExperimentConfig, Preset, Sensor, option

if TYPE_CHECKING:  # numerical modules are imported when a command runs, so that --help is fast
    from training.episodes.guard import GuardedTeam
    from vslam_env.config import EnvConfig
    from vslam_env.environment import ExplorationEnv

POSES = "Write them like 2,3,0; 5,3,1.57."
EPISODE_S = 180.0  # enough for three robots to explore the office and to overlap their maps [s]


class RunConfig(ExperimentConfig):
    """Configuration of a run; all robots have the same policy."""

    world: str = option("office", "World family or path; see vslam worlds list.")
    world_split: Literal["train", "validation", "test"] | None = option(
        None, "Split of the worlds: train, validation or test.", shown="any", hint="Choose one of these names."
    )
    robots: int = option(3, "Number of robots, 1 to 8.", ge=1, le=8, hint="Use 1 to 8 robots.")
    policy: str = option(
        "frontier", "Policy by name (docs/how-to/exploration.md lists them), path of a trained model, or MODULE:NAME."
    )
    action_type: ActionType = option(
        "continuous", "Action type: continuous, discrete or goal.", shown="continuous if supported, goal for models"
    )
    max_cycles: int | None = option(
        None, "Number of steps of the episode.", shown="180 s", ge=1, hint="Give a number of steps."
    )
    max_seconds: float | None = option(
        None, "Simulated time of the episode [s], instead of max_cycles.", shown="180", gt=0.0, hint="Give seconds."
    )
    particles: int = option(100, "Number of particles per filter.", ge=1, hint=ONE_PARTICLE)
    rejuvenate_every: int | None = option(
        None, "Ticks between rejuvenations of the particles; 0: never.", shown="50", ge=0,
        hint="Give a number of ticks, or 0 for never.",
    )  # fmt: skip
    preset: Preset = option(
        "standard", "Noise preset: easy, standard or hard; large: standard noise, and 1800 s in 120 x 120 m with goals."
    )
    sensor: Sensor = option("landmark", "Sensor: landmark, or stereo (rendered images).")
    start_poses: str | None = option(
        None, 'Start poses of all robots, "x,y,theta; x,y,theta; ..." [m, m, rad], world frame.', shown="random",
        hint=POSES,
    )  # fmt: skip
    decision_limit: float = option(
        30.0, "Longest time of a decision [s]; a slower policy ends the run.", gt=0.0, hint="Give seconds."
    )

    def check(self) -> None:
        """Refuse two limits of the episode, and start poses of other robots."""
        from vslam_env.config import check_one_limit

        check_one_limit(self.max_cycles, self.max_seconds)
        self.reset_options()

    @classmethod
    def implied(cls, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return the values of the preset, and the action type that the policy needs."""
        from agents.registry import action_types, model_file
        from vslam_env.config import LIMITS
        from vslam_env.presets import LARGE

        found = {name: value for name, value in LARGE.items() if values.get("preset") == "large"}
        if any(name in values for name in LIMITS):
            found.pop("max_seconds", None)
        policy = values.get("policy")
        if policy is not None:
            known = action_types(policy)
            # Models have learned from goal actions.
            if model_file(policy) is not None or found.get("action_type", "continuous") not in known:
                found["action_type"] = known[0]
        return found

    @classmethod
    def merged(cls, earlier: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
        """Return plain values in which a given limit of the episode removes the other one of an earlier run."""
        from vslam_env.config import replace_limit

        return {**earlier, **replace_limit({**cls.implied(given), **given})}

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values that repeat this run from any folder, except the seed."""
        from agents.registry import is_model
        from vslam_env.world import portable_source

        changed: dict[str, Any] = self._limit | {"world": portable_source(self.world)}
        if is_model(self.policy):
            changed["policy"] = str(Path(self.policy).resolve())
        return super().to_mapping() | changed

    @property
    def step_s(self) -> float:
        """Duration of a step [s]."""
        from vslam_env.config import GOAL_DECISION_TICKS, TICK

        if self.action_type != "goal":
            return TICK
        return TICK * (GOAL_DECISION_TICKS if self.decision_ticks is None else self.decision_ticks)

    @property
    def decision_ticks(self) -> int | None:
        """Ticks between decisions of a trained policy, as in its training; None for other policies: the default."""
        from agents.registry import is_model

        if not is_model(self.policy):
            return None
        trained = training_environment(self.policy, "policy")
        return None if self.action_type != "goal" else trained.decision_ticks

    @property
    def num_steps(self) -> int:
        """Number of steps of the episode."""
        from vslam_env.config import num_cycles

        limit = self._limit
        return limit["max_cycles"] if "max_cycles" in limit else num_cycles(limit["max_seconds"], self.step_s)

    @property
    def _limit(self) -> dict[str, Any]:
        """The limit of the episode, steps or seconds."""
        if self.max_cycles is not None:
            return {"max_cycles": self.max_cycles}
        return {"max_seconds": EPISODE_S if self.max_seconds is None else self.max_seconds}

    def reset_options(self) -> dict[str, Any]:
        """Return the options of `env.reset`.

        Raises:
            ValueError: If the start poses are not three numbers for each robot.
        """
        from slam_backend.core.validation import argument_error

        if self.start_poses is None:
            return {}
        try:
            poses = [[float(number) for number in pose.split(",")] for pose in self.start_poses.split(";")]
        except ValueError as error:
            raise argument_error("start_poses", "numbers x,y,theta; x,y,theta; ...", self.start_poses, POSES) from error
        if [len(pose) for pose in poses] != [3] * self.robots:
            expected = f"a pose x,y,theta of each of {self.robots} robots, with a semicolon between them"
            raise argument_error("start_poses", expected, self.start_poses, "Add poses, or change --robots.")
        return {"start_poses": poses}

    def environment(self) -> "EnvConfig":
        """Return the configuration of the environment."""
        from vslam_env.presets import preset_config

        assumed: dict[str, Any] = {"num_particles": self.particles}
        if self.rejuvenate_every is not None:
            assumed["rejuvenate_every"] = self.rejuvenate_every or None
        return preset_config(self.preset, self.sensor).replace(
            belief={"filter": assumed}, world=self.world, world_split=self.world_split, num_robots=self.robots,
            action_type=self.action_type, decision_ticks=self.decision_ticks, **self._limit,
        )  # fmt: skip

    def make_env(self) -> "ExplorationEnv":
        """Build the environment, which observes `observation_keys`."""
        from vslam_env import vslam_v1

        return vslam_v1.parallel_env(config=self.environment(), observation_keys=self.observation_keys())

    def observation_keys(self) -> str | tuple[str, ...]:
        """Return the keys of observations that the policy reads."""
        from agents.policy import keys_for
        from agents.registry import make_policy

        return keys_for(make_policy(self.policy, self.action_type), self.action_type)

    def make_policies(self, env: "ExplorationEnv") -> "GuardedTeam":
        """Build one policy for each agent."""
        from agents.registry import make_policy
        from training.episodes.guard import GuardedTeam

        policies = {agent: make_policy(self.policy, self.action_type) for agent in env.possible_agents}
        return GuardedTeam(policies, self.policy, self.action_type, self.decision_limit)


def training_environment(path: str, argument: str) -> "EnvConfig":
    """Return the environment in which a model was trained.

    Args:
        path: Path of the model, or of the run folder that contains it.
        argument: Name of the path in errors.

    Raises:
        ValueError: If the model cannot be read, or its environment cannot be made.
    """
    from agents.trained import DRIVER, load_model
    from slam_backend.core.validation import argument_error
    from vslam_env.config import EnvConfig

    about = load_model(path, argument)[1]
    action_type = "continuous" if about.get("network") == DRIVER else "goal"
    try:
        config = EnvConfig.from_toml_text(about["environment"])
        if config.action_type != action_type:
            expected = f"{action_type}, as its training has it"
            raise argument_error("action_type", expected, config.action_type, "Check the model.")
        return config
    except ValueError as error:
        hint = f"Train again, {str(path)!r} cannot be used: {error}"
        raise argument_error(argument, "a model of an environment of this version", "another one", hint) from error
