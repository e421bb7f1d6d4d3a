"""Version 0 of the environment under PettingZoo's names: `parallel_env`, `env`, `raw_env`."""

from functools import wraps
from pathlib import Path
from typing import Any

from pettingzoo import AECEnv
from pettingzoo.utils.conversions import parallel_to_aec
from pettingzoo.utils.wrappers import OrderEnforcingWrapper

from slam_backend.core.validation import argument_error
from vslam_env.config import EnvConfig
from vslam_env.environment import ExplorationEnv
from vslam_env.presets import preset_config
from vslam_env.reward import RewardSpec
from vslam_env.world import World, WorldSource


def parallel_env(
    world: WorldSource | None = None,
    num_robots: int | None = None,
    sensor: str | None = None,
    action_type: str | None = None,
    decision_ticks: int | None = None,
    num_particles: int | None = None,
    max_cycles: int | None = None,
    preset: str | None = None,
    reward: RewardSpec | None = None,
    observation_type: str | None = None,
    observe_images: bool | None = None,
    oracle_pose: bool | None = None,
    oracle_association: bool | None = None,
    oracle_merge: bool | None = None,
    comm_range: float | None = None,
    comm_line_of_sight: bool | None = None,
    comm_loss: float | None = None,
    stop_at_recall: float | None = None,
    render_mode: str | None = None,
    config: EnvConfig | str | Path | None = None,
    world_split: str | None = None,
    shared_reward: bool | None = None,
) -> ExplorationEnv:
    """Make the parallel environment. An argument that is None leaves what the configuration or preset says.

    Args:
        world: `"office"` (default), `"maze"`, `"loops"`, `"hall"`, `"fig5"`; the path of a floor plan (.png, .jpg,
            .pgm), of a ROS map (.yaml), of a .json file of walls or of a folder of these; a `World`; or a function of
            a generator that returns one.
        num_robots: 1 to 8; default 3.
        sensor: `"landmark"` (default): simulated measurements. `"stereo"`: rendered eyes see textured walls; with the
            stereo front end their images become measurements.
        action_type: `"continuous"` (default): (speed, turn) in [-1, 1], zeros stand still. `"discrete"`: stay, ahead,
            left, right. `"goal"`: 0 stays, 1 to 16 drive to a candidate of the last observation.
        decision_ticks: Ticks of 0.1 s per step; default 1, with `goal` 10.
        num_particles: Of each filter; default 100.
        max_cycles: Steps until the episode is truncated; default 1000.
        preset: `"easy"`, `"standard"` (default) or `"hard"`; see `preset_config`.
        reward: Weights of terms by name (default `{"map_error": 1.0}`), or a list of terms of your own. Learners
            discount it by at least 0.999 per tick: `gamma ** decision_ticks` per step.
        observation_type: `"dict"` (default) or `"flat"`.
        observe_images: With `sensor="stereo"`: observations hold the left image, `"image"` (H, W, 1) uint8.
        oracle_pose: The robots know their poses in their own start frames.
        oracle_association: They know which landmark is which.
        oracle_merge: Groups in contact that share three landmarks merge with the true transform.
        comm_range: Robots hear each other no farther than this [m]; default any distance.
        comm_line_of_sight: Walls keep robots from hearing each other; default no.
        comm_loss: Probability that two robots do not hear each other in a tick; default 0.
        stop_at_recall: Terminate when each map holds this share of the landmarks; default never.
        render_mode: `"human"`, `"rgb_array"` or None.
        config: An `EnvConfig` or the path of its TOML file, instead of a preset.
        world_split: `"train"`, `"validation"` or `"test"`: worlds of that range of world seeds only, or files of a
            folder by turns; default any.
        shared_reward: Each robot gets the mean of all robots' rewards; default its own.

    Raises:
        ValueError: If an argument is refused; the text names it, what was expected and the cure.
    """
    if config is not None and preset is not None:
        raise argument_error("preset", "None beside a config", preset, "Give one of the two.")
    if isinstance(config, (str, Path)):
        config = EnvConfig.from_toml(config)
    elif config is None:
        config = preset_config("standard" if preset is None else preset, "landmark" if sensor is None else sensor)
    elif not isinstance(config, EnvConfig):
        raise argument_error("config", "an EnvConfig, a path or None", config, "Build one with EnvConfig(...).")
    changes: dict[str, Any] = {
        "world": None if world is None else _world_name(world),
        "world_split": world_split,
        "num_robots": num_robots,
        "sensor": sensor,
        "action_type": action_type,
        "decision_ticks": decision_ticks,
        "max_cycles": max_cycles,
        "observation_type": observation_type,
        "observe_images": observe_images,
        "shared_reward": shared_reward,
        "oracle_pose": oracle_pose,
        "oracle_association": oracle_association,
        "oracle_merge": oracle_merge,
        "comm_range": comm_range,
        "comm_line_of_sight": comm_line_of_sight,
        "comm_loss": comm_loss,
        "stop_at_recall": stop_at_recall,
        "belief": None if num_particles is None else {"filter": {"num_particles": num_particles}},
    }
    config = config.replace(**{name: value for name, value in changes.items() if value is not None})
    return ExplorationEnv(config, world=world, reward=reward, render_mode=render_mode)


@wraps(parallel_env, assigned=())  # the signature alone
def raw_env(*args: Any, **kwargs: Any) -> AECEnv[str, Any, Any]:
    """Make the turn-based (AEC) environment, unwrapped; arguments as of `parallel_env`."""
    return parallel_to_aec(parallel_env(*args, **kwargs))


@wraps(parallel_env, assigned=())
def env(*args: Any, **kwargs: Any) -> AECEnv[str, Any, Any]:
    """Make the turn-based (AEC) environment with PettingZoo's checks of the order of calls."""
    return OrderEnforcingWrapper(raw_env(*args, **kwargs))


def _world_name(world: WorldSource) -> str:
    """Return what the configuration calls a world."""
    if isinstance(world, (str, Path)):
        return str(world)
    if isinstance(world, World):
        return world.name
    return getattr(world, "__name__", type(world).__name__)
