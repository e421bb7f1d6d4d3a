"""`BatchedTrainConfig`: configuration of the training of batched teams on an accelerator, and its environment."""

from typing import TYPE_CHECKING

from training.experiments.config import ExperimentConfig, NoisePreset, Positive, option, setting
from training.rl.config import ONE, SPLIT_TRAIN, Share

if TYPE_CHECKING:  # numerical modules are imported when a command runs, so that --help is fast
    from vslam_env.config import EnvConfig


class BatchedTrainConfig(ExperimentConfig):
    """Training of one driver for all robots by PPO; a batch of environments is stepped at once."""

    world: str = option("office", "World family or path; see vslam worlds list.")
    robots: int = option(3, "Number of robots, 1 to 8.", ge=1, le=8, hint="Use 1 to 8 robots.")
    preset: NoisePreset = option("standard", "Noise preset: easy, standard, hard.")
    duration: float = option(
        120.0, "Simulated time of an episode [s].", name="max_seconds", ge=1.0, hint="Give at least a second."
    )
    decision_ticks: Positive = option(5, "Ticks of 0.1 s for which a decision holds.")
    num_worlds: Positive = option(256, "Number of worlds of the training split.")
    rows: int = option(
        384, "Number of landmarks for which the belief of a team has room.", ge=16, hint="Use 16 rows or more."
    )
    batch: Positive = option(1024, "Number of environments.", hint=ONE)
    steps: Positive = option(32, "Decisions of each robot in a rollout.", hint=ONE)
    updates: Positive = option(500, "Number of rollouts.", hint=ONE)
    minutes: float | None = option(
        None, "Time after which the training ends [min].", shown="none", gt=0.0, hint="Give minutes."
    )
    learning_rate: float = setting(5e-4, "Learning rate of Adam.", gt=0.0)
    gamma: Share = setting(0.995, "Discount per decision.")
    gae_lambda: Share = setting(0.95, "Lambda of the generalised advantage estimate.")
    clip: float = setting(0.2, "Clip range of PPO's probability ratio.", gt=0.0)
    entropy: float = setting(0.003, "Weight of the entropy bonus.", ge=0.0)
    epochs: Positive = setting(4, "Number of passes over each rollout.")
    minibatches: Positive = setting(8, "Number of parts of a rollout, each for a step of the optimiser.")
    checkpoint_updates: Positive = setting(10, "Number of rollouts between checkpoints.")
    std: float = setting(0.5, "Standard deviation of the first actions.", gt=0.0)

    def check(self) -> None:
        """Refuse values that the environment refuses, and minibatches that are no equal parts."""
        from slam_backend.core.validation import argument_error

        self.environment()
        if self.batch * self.steps % self.minibatches:
            expected = f"a divisor of batch x steps, {self.batch * self.steps}"
            raise argument_error("minibatches", expected, self.minibatches, "Minibatches have equal sizes.")

    def environment(self) -> "EnvConfig":
        """Return the environment, with worlds of the training split where there are splits."""
        from vslam_env.presets import preset_config
        from vslam_env.world import check_source, is_single_layout

        check_source(self.world)
        return preset_config(self.preset).replace(
            world=self.world, world_split=None if is_single_layout(self.world) else SPLIT_TRAIN,
            num_robots=self.robots, action_type="continuous", decision_ticks=self.decision_ticks,
            max_seconds=self.duration, observation_keys="driver",
        )  # fmt: skip
