"""Wrappers for learners: observations in the order of one, and masks of `goal` actions in the form of a library."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo.utils.wrappers import BaseParallelWrapper

from slam_backend.core.validation import Float32Array, argument_error
from vslam_env.belief.observation import GRIDS, flatten, observation_space
from vslam_env.belief.observation_keys import MASK, SCALES, in_order_of_one, key_spaces
from vslam_env.environment import STATE_PER_ROBOT, STATE_POSITIONS, ExplorationEnv

VECTOR, WHOLE, IMAGE = "observation", "observations", "image"
BLOCK = 4  # cells of a grid along a side that become one


class _Wrapper(BaseParallelWrapper):  # type: ignore[misc]   # its types are not checked
    """Environment whose observations and infos are changed."""

    def __init__(self, env: ExplorationEnv) -> None:
        super().__init__(env)
        self._config = env.unwrapped.config
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


class Scaled(_Wrapper):
    """Observations in the order of one, as learners without a normalisation of their own need them; all float32.

    Metres, radians, seconds and numbers are multiplied by `observation_keys.SCALES`; grids become shares from 0 to 1
    in blocks of 4 x 4 cells, so that (3, 48, 48) uint8 become (3, 12, 12). Flat observations stay vectors, of less
    than a tenth of the length. Metres in `state()` are multiplied as well. The mask of `goal` actions and images stay
    as they are.

    Args:
        env: Environment with dict or flat observations.
    """

    def __init__(self, env: ExplorationEnv) -> None:
        config = env.unwrapped.config
        scan = config.scan
        boxes = key_spaces(scan.num_rays, scan.max_range)
        self._shapes = {name: boxes[name].shape for name in config.observed if name != MASK}
        super().__init__(env)

    def state(self) -> NDArray[np.float32]:
        """Return the true state for centralised critics; see `ExplorationEnv.state`."""
        state: NDArray[np.float32] = self.env.state()
        robots = state[: STATE_PER_ROBOT * self._config.num_robots].reshape(-1, STATE_PER_ROBOT)
        for first in STATE_POSITIONS:
            robots[:, first : first + 2] *= np.float32(SCALES["pose"][0])
        return state

    def _space(self, space: Any) -> spaces.Space[Any]:
        if isinstance(space, spaces.Box):
            return self._part_space(VECTOR, space)
        return spaces.Dict({name: self._part_space(name, box) for name, box in space.items()})

    def _part_space(self, name: str, box: Any) -> spaces.Space[Any]:
        low, high = self._part(name, box.low), self._part(name, box.high)
        return spaces.Box(low, high, dtype=low.dtype)

    def _changed(self, observations: Any, infos: Any) -> tuple[Any, Any]:
        changed = {
            agent: {name: self._part(name, values) for name, values in seen.items()}
            if isinstance(seen, Mapping)
            else self._part(VECTOR, seen)
            for agent, seen in observations.items()
        }
        return changed, infos

    def _part(self, name: str, values: NDArray[Any]) -> NDArray[Any]:
        """Return one array of an observation in the order of one; grids in a vector are shares already."""
        if name in (MASK, IMAGE):
            return values
        if name != VECTOR:
            scaled: NDArray[Any] = in_order_of_one(name, values)
            return _blocks(scaled) if name in GRIDS else scaled
        parts, begin = [], 0
        for key, shape in self._shapes.items():
            end = begin + int(np.prod(shape))
            part = values[begin:end].reshape(shape)
            parts.append((_blocks(part) if key in GRIDS else in_order_of_one(key, part)).ravel())
            begin = end
        return np.concatenate(parts)


def _blocks(grid: Float32Array) -> Float32Array:
    """Return the means of blocks of cells, (c, S, S) becomes (c, S / 4, S / 4)."""
    channels, size, _ = grid.shape
    blocks = grid.reshape(channels, size // BLOCK, BLOCK, size // BLOCK, BLOCK)
    return np.asarray(blocks.mean(axis=(2, 4)), np.float32)


class _MaskWrapper(_Wrapper):
    """Environment with masks whose observations and infos are changed.

    Raises:
        ValueError: If the environment has no masks.
    """

    def __init__(self, env: ExplorationEnv) -> None:
        kind = env.unwrapped.config.action_type
        if kind != "goal":
            raise argument_error("action_type", "'goal', whose actions have masks", kind, "Choose goal actions.")
        super().__init__(env)


class MasksBesideVectors(_MaskWrapper):
    """Observations `{"observations", "action_mask"}`, both float32 vectors, for RLlib's `ActionMaskingTorchRLModule`.

    Dict observations are joined to the vectors that flat ones are.

    Args:
        env: Environment with `goal` actions, and dict or flat observations.

    Raises:
        ValueError: If the environment has no masks, or observations have images.
    """

    def _space(self, space: Any) -> spaces.Space[Any]:
        if IMAGE in space.spaces:
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
