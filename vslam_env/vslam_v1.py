"""Version 1 of the environment, with PettingZoo's constructors `parallel_env`, `env` and `raw_env`.

Observations have the keys that drivers or choosers of goals read; those of version 0 have all.
"""

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import Any

from pettingzoo import AECEnv
from pettingzoo.utils.conversions import parallel_to_aec_wrapper
from pettingzoo.utils.wrappers import OrderEnforcingWrapper

from slam_backend.core.validation import argument_error
from vslam_env.belief.observation_keys import default_set
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
    max_seconds: float | None = None,
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
    observation_keys: str | Collection[str] | None = None,
    comm_outage_seconds: float | None = None,
    oracle_floor: bool | None = None,
) -> ExplorationEnv:
    """Make the parallel environment, see `ExplorationEnv` for the task.

    Arguments that are None keep the value of the configuration or preset.

    Args:
        world: `"office"` (default), `"maze"`, `"loops"`, `"hall"`, `"rooms"`, `"campus"`, `"fig5"`; the path of a floor
            plan (.png, .jpg, .pgm), of a ROS map (.yaml), of a .json file of walls or of a folder of these; a `World`;
            or a function that takes a random generator and returns a `World`.
        num_robots: Number of robots, 1 to 8; default 3.
        sensor: `"landmark"` (default): simulated measurements. `"stereo"`: rendered images of textured walls, measured
            by the stereo front end.
        action_type: `"continuous"` (default), `"discrete"` or `"goal"`.
        decision_ticks: Ticks of 0.1 s per step; default 1, or 10 with `goal`.
        num_particles: Number of particles of each filter; default 100.
        max_cycles: Number of steps after which the episode is truncated; default: as many as `max_seconds` takes.
        max_seconds: Simulated time after which the episode is truncated [s]; default 100. Give one of the two.
        preset: `"easy"`, `"standard"` (default), `"hard"` or `"large"`; see `preset_config`.
        reward: Weights of terms by name (default `{"map_error": 1.0}`), or a list of custom terms. Learners should use
            a discount of at least 0.999 per tick: `gamma ** decision_ticks` per step.
        observation_type: `"dict"` (default) or `"flat"`.
        observe_images: Whether observations contain the left image, `"image"` (H, W, 1) uint8; with `sensor="stereo"`.
        oracle_pose: Whether each filter receives the true pose in the robot's start frame.
        oracle_association: Whether data association is replaced by the truth.
        oracle_merge: Whether groups in contact that share three true landmarks merge with the true transform.
        comm_range: Largest distance of two robots in contact [m]; default unlimited.
        comm_line_of_sight: Whether walls block contacts; default no.
        comm_loss: Share of the time in which a contact fails; default 0.
        stop_at_recall: Map recall of all robots at which the episode terminates; default never.
        render_mode: `"human"`, `"rgb_array"` or None.
        config: `EnvConfig` or path of its TOML file, instead of a preset.
        world_split: `"train"`, `"validation"` or `"test"`: worlds from that range of world seeds, or that part of
            the files in a folder; default any.
        shared_reward: Whether each robot gets the mean of all robots' rewards; default no.
        observation_keys: `"driver"`, `"goal"` or `"all"`, sets of keys, or keys in any order; default: those of
            `config`, without one `"goal"` with `goal` actions, else `"driver"`.
        comm_outage_seconds: Mean duration for which a contact fails [s]; default 0, drawn in each tick by itself.
        oracle_floor: Whether the occupancy grid of each robot begins with the true floor plan.

    Raises:
        ValueError: If an argument is invalid; the message names it.
    """
    if config is not None and preset is not None:
        raise argument_error("preset", "None together with a config", preset, "Give one of the two.")
    if isinstance(config, (str, Path)):
        config = EnvConfig.from_toml(config)
    elif config is None:
        config = preset_config("standard" if preset is None else preset, "landmark" if sensor is None else sensor)
        if observation_keys is None:
            observation_keys = default_set(config.action_type if action_type is None else action_type)
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
        "max_seconds": max_seconds,
        "observation_type": observation_type,
        "observation_keys": observation_keys,
        "observe_images": observe_images,
        "shared_reward": shared_reward,
        "oracle_pose": oracle_pose,
        "oracle_association": oracle_association,
        "oracle_merge": oracle_merge,
        "oracle_floor": oracle_floor,
        "comm_range": comm_range,
        "comm_line_of_sight": comm_line_of_sight,
        "comm_loss": comm_loss,
        "comm_outage_seconds": comm_outage_seconds,
        "stop_at_recall": stop_at_recall,
        "belief": None if num_particles is None else {"filter": {"num_particles": num_particles}},
    }
    config = config.replace(**{name: value for name, value in changes.items() if value is not None})
    return ExplorationEnv(config, world=world, reward=reward, render_mode=render_mode)


class _TurnBasedEnv(parallel_to_aec_wrapper[str, Any, Any]):  # type: ignore[misc]   # its types are not checked
    """PettingZoo's turn-based form of a parallel environment, whose interrupted steps and resets are not continued."""

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        """Reset; see `ExplorationEnv.reset`."""
        with self._whole_or_marked():
            super().reset(seed, options)

    def step(self, action: Any) -> None:
        """Take the action of an agent, and step when all agents have one; see `ExplorationEnv.step`."""
        self.env.unwrapped.check_whole("step")  # whichever agent is next
        with self._whole_or_marked():
            super().step(action)

    @contextmanager
    def _whole_or_marked(self) -> Iterator[None]:
        """Mark the parallel environment as cut short by an interrupt; it marks its own errors itself."""
        try:
            yield
        except Exception:
            raise
        except BaseException:
            self.env.unwrapped._is_whole = False
            raise


@wraps(parallel_env, assigned=())  # only the signature
def raw_env(*args: Any, **kwargs: Any) -> AECEnv[str, Any, Any]:
    """Make the turn-based (AEC) environment, unwrapped; see `parallel_env` for the arguments."""
    return turn_based(parallel_env(*args, **kwargs))


@wraps(parallel_env, assigned=())
def env(*args: Any, **kwargs: Any) -> AECEnv[str, Any, Any]:
    """Make the turn-based (AEC) environment with PettingZoo's check of the call order."""
    return OrderEnforcingWrapper(raw_env(*args, **kwargs))


def turn_based(env: ExplorationEnv) -> AECEnv[str, Any, Any]:
    """Return the turn-based (AEC) form of a parallel environment."""
    return OrderEnforcingWrapper(_TurnBasedEnv(env))


def _world_name(world: WorldSource) -> str:
    """Return the name of a world in the configuration."""
    if isinstance(world, (str, Path)):
        return str(world)
    if isinstance(world, World):
        return world.name
    return getattr(world, "__name__", type(world).__name__)
