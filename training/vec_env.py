"""`ExplorationVecEnv`: environments as Stable-Baselines3 wants them, one slot per robot of each environment."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from slam_backend.core.validation import BoolArray, FloatArray, argument_error, check_int
from training.experiments.compilation import prepare
from training.rl.slots import MASK, WHOLE, MakeEnv, SlotBatch, Stepped
from training.rl.workers import SlotWorkers
from vslam_env import vslam_v0, warm_up
from vslam_env.config import EnvConfig


def make_vec_env(
    config: EnvConfig, num_envs: int, workers: int = 0, seed: int | None = None, render_mode: str | None = None
) -> "ExplorationVecEnv":
    """Make environments of one configuration.

    Args:
        num_envs: E; there are E x K slots.
        workers: Processes among which they are divided; 0: this one. Results do not depend on it. A script that asks
            for workers needs the guard `if __name__ == "__main__":`, for each of them imports it.
        seed: Of all; None: leave it to the learner's own `seed`.

    Raises:
        ValueError: If a number is refused.
    """
    check_int("num_envs", num_envs, 1, "Use at least one environment.")
    make = partial(vslam_v0.parallel_env, config=config, render_mode=render_mode)
    load = partial(load_kernels, config)
    if workers > 0:
        prepare(load)  # what has to be compiled is compiled once, and told; workers then take it from the cache
    env = ExplorationVecEnv([make] * num_envs, workers, load)
    if seed is not None:
        env.seed(seed)
    return env


def load_kernels(config: EnvConfig) -> None:
    """Load or compile the kernels that an environment needs in its first steps, then those of later ones."""
    env = vslam_v0.parallel_env(config=config)
    env.reset(seed=0)
    for _ in range(min(2, config.max_cycles)):
        env.step({agent: env.action_space(agent).sample() for agent in env.agents})
    warm_up()


def env_seeds(seed: int, num_envs: int) -> list[int]:
    """Return the seeds of the first resets of all environments; those of neighbouring `seed`s have none in common.

    More environments leave the seeds of the first ones as they are.
    """
    seed = check_int("seed", seed, 0, "Give an int >= 0, or None.")
    return [int(word) for word in np.random.SeedSequence(seed).generate_state(num_envs)]


class ExplorationVecEnv(VecEnv):  # type: ignore[misc]   # its types are not looked at
    """Robots in slots, ordered by environment, then by agent; what SB3 calls an environment is a slot.

    Observations, rewards and infos are those that each environment returns by itself, and nobody else holds their
    arrays. An environment whose episode ends is reset at once; the infos of its slots then hold `terminal_observation`,
    and at a time limit `TimeLimit.truncated` is true, so that learners bootstrap. `env_method("action_masks")` gives
    sb3-contrib's MaskablePPO the masks of `goal` actions. Other methods and attributes are those of the environment of
    a slot, once per slot: give `indices=env.first_slots` to ask each environment once.

    Args:
        makers: Each makes a parallel environment. With workers they must be picklable.
        workers: Processes among which they are divided; 0: this one.
        prepare: Called once in each worker before its environments are made; what it loads keeps no step waiting.

    Attributes:
        first_slots: The first slot of each environment.
        spent: (P, 2) float64 [s]. What the environments of each of P processes took in the last step: on the clock, and
            of the processor. Zeros before the first one.

    Raises:
        ValueError: If there is no environment, spaces differ, or there are more workers than environments.
    """

    def __init__(
        self, makers: Sequence[MakeEnv], workers: int = 0, prepare: Callable[[], object] = lambda: None
    ) -> None:
        check_int("workers", workers, 0, "Use 0 for none, or a number of processes.")
        self._slots: SlotBatch | SlotWorkers = SlotWorkers(makers, workers, prepare) if workers else SlotBatch(makers)
        self._masks: BoolArray | None = None
        ends = np.cumsum(self._slots.counts)
        self.first_slots: list[int] = [0, *ends[:-1].tolist()]
        self.spent: FloatArray = np.zeros((max(workers, 1), 2))
        super().__init__(int(ends[-1]), self._slots.observation_space, self._slots.action_space)

    def seed(self, seed: int | None = None) -> list[int | None]:
        """Seed the next reset of all environments with `env_seeds`; None: from anywhere. Returned by slot."""
        counts = self._slots.counts
        if seed is None:
            seed = int(np.random.SeedSequence().generate_state(1)[0])
        self._seeds = np.repeat(env_seeds(seed, len(counts)), counts).tolist()
        return list(self._seeds)

    def reset(self) -> Any:
        """Reset all environments, with the seeds and options given since the last reset."""
        seeds = [self._seeds[slot] for slot in self.first_slots]
        options = [self._options[slot] for slot in self.first_slots]
        observations, self.reset_infos = self._slots.reset(seeds, options)
        self._reset_seeds()
        self._reset_options()
        return self._handed(observations)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Begin a step with actions (S, ...).

        Raises:
            ValueError: If there are not as many actions as slots, or one is outside its space.
        """
        if len(actions) != self.num_envs:
            raise argument_error("actions", f"{self.num_envs} of them", len(actions), "Give one for each slot.")
        self._slots.send(np.asarray(actions))

    def step_wait(self) -> tuple[Any, NDArray[np.float32], BoolArray, list[dict[str, Any]]]:
        """Return observations, rewards (S,), dones (S,) and infos of the step that was begun."""
        stepped: Stepped = self._slots.receive()
        self.spent = stepped.spent
        return self._handed(stepped.observations), stepped.rewards, stepped.dones, stepped.infos

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Call a method of the environment of each slot; `action_masks` gives (17,) bool per slot."""
        slots = self._indices(indices)
        if method_name == "action_masks" and self._masks is not None:
            return [self._masks[slot].copy() for slot in slots]
        return self._slots.ask("call", slots, method_name, method_args, method_kwargs)

    def has_attr(self, attr_name: str) -> bool:
        """Tell whether the environments have an attribute; `action_masks` is there with `goal` actions."""
        if attr_name == "action_masks":
            return MASK in getattr(self.observation_space, "spaces", {})
        return all(self._slots.ask("has", range(self.num_envs), attr_name))

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the environment of each slot."""
        return self._slots.ask("get", self._indices(indices), attr_name)

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of the environment of each slot."""
        self._slots.ask("set", self._indices(indices), attr_name, value)

    def env_is_wrapped(self, wrapper_class: Callable[..., Any], indices: Any = None) -> list[bool]:
        """Say no for each slot: there are no Gymnasium wrappers around parallel environments."""
        return [False] * len(self._indices(indices))

    def get_images(self) -> list[NDArray[np.uint8] | None]:
        """Return one picture per environment, not per slot."""
        return self.env_method("render", indices=self.first_slots)

    def get_state(self) -> dict[str, Any]:
        """Return all that decides how the environments go on, and the masks of their last observations."""
        return {"environments": self.env_method("get_state", indices=self.first_slots), "masks": self._masks}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Go on exactly as the environments that gave `state`; the observations of that moment are the caller's.

        Raises:
            ValueError: If it is of another number of environments, or one of them refuses its part.
        """
        given = state["environments"]
        if len(given) != len(self.first_slots):
            raise argument_error("state", f"one of {len(self.first_slots)} environments", len(given), "Make as many.")
        for slot, one in zip(self.first_slots, given, strict=True):
            self.env_method("set_state", one, indices=[slot])
        self._masks = state["masks"]

    def close(self) -> None:
        """Close all environments and processes."""
        self._slots.close()

    def _indices(self, indices: Any) -> list[int]:
        return [int(slot) for slot in self._get_indices(indices)]

    def _handed(self, observations: dict[str, NDArray[Any]]) -> Any:
        """Keep the masks, and return observations in the form of their space."""
        if MASK in observations:
            self._masks = observations[MASK] != 0
        return observations.get(WHOLE, observations)
