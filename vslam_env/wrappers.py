"""Wrappers that give masks of `goal` actions the form of a learning library."""

from typing import Any

import numpy as np
from gymnasium import spaces
from pettingzoo.utils.wrappers import BaseParallelWrapper

from slam_backend.core.validation import argument_error
from vslam_env.belief.observation import flatten, observation_space
from vslam_env.belief.observation_keys import MASK
from vslam_env.environment import ExplorationEnv

VECTOR, WHOLE = "observation", "observations"


class _MaskWrapper(BaseParallelWrapper):  # type: ignore[misc]   # its types are not checked
    """Environment with masks whose observations and infos are changed.

    Raises:
        ValueError: If the environment has no masks.
    """

    def __init__(self, env: ExplorationEnv) -> None:
        super().__init__(env)
        self._config = env.unwrapped.config
        kind = self._config.action_type
        if kind != "goal":
            raise argument_error("action_type", "'goal', whose actions have masks", kind, "Choose goal actions.")
        self.observation_spaces = {agent: self._space(env.observation_space(agent)) for agent in env.possible_agents}

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """Return the observation space of an agent."""
        return self.observation_spaces[agent]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        """Reset; see `ExplorationEnv.reset`."""
        return self._changed(*self.env.reset(seed=seed, options=options))

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, Any]:
        """Step; see `ExplorationEnv.step`."""
        observations, rewards, terminations, truncations, infos = self.env.step(actions)
        observations, infos = self._changed(observations, infos)
        return observations, rewards, terminations, truncations, infos

    def _space(self, space: Any) -> spaces.Space[Any]:
        raise NotImplementedError

    def _changed(self, observations: Any, infos: Any) -> tuple[Any, Any]:
        raise NotImplementedError


class MasksBesideVectors(_MaskWrapper):
    """Observations `{"observations", "action_mask"}`, both float32 vectors, for RLlib's `ActionMaskingTorchRLModule`.

    Dict observations are joined to the vectors that flat ones are.

    Args:
        env: Environment with `goal` actions, and dict or flat observations.

    Raises:
        ValueError: If the environment has no masks, or observations have images.
    """

    def _space(self, space: Any) -> spaces.Space[Any]:
        if "image" in space.spaces:
            raise argument_error("observe_images", "False: images are no part of a vector", True, "Omit it.")
        scan = self._config.scan
        flat = observation_space(self._config.observed, scan.num_rays, scan.max_range, flat=True)
        vector = flat[VECTOR]  # type: ignore[index]
        return spaces.Dict({WHOLE: vector, MASK: spaces.Box(0.0, 1.0, space[MASK].shape, np.float32)})

    def _changed(self, observations: Any, infos: Any) -> tuple[Any, Any]:
        changed = {
            agent: {WHOLE: seen[VECTOR] if VECTOR in seen else flatten(seen), MASK: seen[MASK].astype(np.float32)}
            for agent, seen in observations.items()
        }
        return changed, infos


class MasksInInfos(_MaskWrapper):
    """Masks in the infos, where AgileRL looks for them; observations have none, and flat ones are vectors.

    Args:
        env: Environment with `goal` actions, and dict or flat observations.

    Raises:
        ValueError: If the environment has no masks.
    """

    def _space(self, space: Any) -> spaces.Space[Any]:
        if VECTOR in space.spaces:
            return space[VECTOR]  # type: ignore[no-any-return]
        return spaces.Dict({name: box for name, box in space.items() if name != MASK})

    def _changed(self, observations: Any, infos: Any) -> tuple[Any, Any]:
        changed = {
            agent: seen[VECTOR] if VECTOR in seen else {name: seen[name] for name in seen if name != MASK}
            for agent, seen in observations.items()
        }
        return changed, {agent: {**infos[agent], MASK: seen[MASK]} for agent, seen in observations.items()}
