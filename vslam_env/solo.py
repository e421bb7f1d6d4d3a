"""Gymnasium environment of one robot."""

from collections.abc import Callable
from typing import Any, ClassVar

import gymnasium
import numpy as np
from numpy.typing import NDArray

from slam_backend.core.validation import argument_error, check_int
from slam_backend.team.reports import MergeEvent
from vslam_env import vslam_v0, vslam_v1
from vslam_env.belief.team_belief import Belief
from vslam_env.config import EnvConfig
from vslam_env.environment import ExplorationEnv

AGENT = "robot_0"
VERSIONS: dict[int, Callable[..., ExplorationEnv]] = {0: vslam_v0.parallel_env, 1: vslam_v1.parallel_env}


class SoloExplorationEnv(gymnasium.Env[Any, Any]):
    """Exploration and mapping of a building by one robot with an unknown start pose.

    Args:
        render_mode: `"human"`, `"rgb_array"` or None.
        version: 1, or 0 for all keys of observations by default.
        wrap: Function that wraps the parallel environment, such as `vslam_env.wrappers.Scaled`; None: it stays as it
            is.
        **kwargs: Arguments of `vslam_v1.parallel_env` except `num_robots`.

    Attributes:
        parallel: Underlying parallel environment of one robot, with `belief`, `events` and `scene`.
    """

    metadata: ClassVar[dict[str, Any]] = {  # type: ignore[misc]   # Gymnasium declares an instance variable
        "render_modes": ExplorationEnv.metadata["render_modes"],
        "render_fps": ExplorationEnv.metadata["render_fps"],
    }

    def __init__(
        self,
        render_mode: str | None = None,
        version: int = 1,
        wrap: Callable[[Any], Any] | None = None,
        **kwargs: Any,
    ) -> None:
        if kwargs.get("num_robots", 1) != 1:
            raise argument_error("num_robots", "1", kwargs["num_robots"], "Use vslam_v1.parallel_env for a team.")
        if version not in VERSIONS:
            raise argument_error("version", "0 or 1", version, "Omit it for the current version.")
        self.parallel = VERSIONS[version](**kwargs | {"num_robots": 1, "render_mode": render_mode})
        self.render_mode = render_mode
        self._wrapped = self.parallel if wrap is None else wrap(self.parallel)
        self.observation_space = self._wrapped.observation_space(AGENT)
        self.action_space = self._wrapped.action_space(AGENT)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode; see `ExplorationEnv.reset`."""
        seed = None if seed is None else check_int("seed", seed, 0, "Give an int >= 0, or None.")
        super().reset(seed=seed)
        observations, infos = self._wrapped.reset(seed, options)
        return observations[AGENT], infos[AGENT]

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Execute an action; see `ExplorationEnv.step`."""
        observations, rewards, terminations, truncations, infos = self._wrapped.step({AGENT: action})
        return observations[AGENT], rewards[AGENT], terminations[AGENT], truncations[AGENT], infos[AGENT]

    def render(self) -> NDArray[np.uint8] | None:
        """Return or show a picture; see `ExplorationEnv.render`."""
        return self.parallel.render()

    @property
    def config(self) -> EnvConfig:
        """Configuration of the environment."""
        return self.parallel.config

    @property
    def events(self) -> tuple[MergeEvent, ...]:
        """Merge events since the reset: always empty for a single robot."""
        return self.parallel.events

    def belief(self) -> Belief:
        """Return the belief of the robot; see `ExplorationEnv.belief`."""
        return self.parallel.belief(AGENT)

    def action_masks(self) -> NDArray[np.bool_]:
        """Return which `goal` actions are valid (33,) bool; sb3-contrib's MaskablePPO calls this method."""
        valid = self.belief().candidates.valid
        return np.concatenate([[True], valid])

    def close(self) -> None:
        """Close the window, if there is one."""
        self.parallel.close()
