"""`ExplorationVecEnv`: Stable-Baselines3 vector environment with one slot per robot of each environment."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

from slam_backend.core.validation import BoolArray, FloatArray, argument_error, check_int
from training.experiments.output.compilation import prepare
from training.rl.envs import MASK, WHOLE, MakeEnv, StepResult, SyncEnvs, WorkerEnvs
from vslam_env import vslam_v1, warm_up
from vslam_env.config import EnvConfig
from vslam_env.reward import RewardSpec


def make_vec_env(
    config: EnvConfig | Sequence[EnvConfig],
    num_envs: int,
    workers: int = 0,
    seed: int | None = None,
    render_mode: str | None = None,
    reward: RewardSpec | None = None,
    cluster: str | None = None,
    monitor: bool = True,
    wrap: Callable[[Any], Any] | None = None,
) -> "ExplorationVecEnv | VecMonitor":
    """Make environments of one configuration, or of several.

    Args:
        config: Configuration, or several that alternate, e.g. with worlds of different families.
        num_envs: Number of environments E; there are E x K slots.
        workers: Number of worker processes; 0: this process. Results do not depend on it. A script that uses workers
            needs the guard `if __name__ == "__main__":`, because each worker imports it.
        seed: Seed of all environments; None: the learner's own `seed` decides.
        reward: Reward in place of that of `config`, such as a list with custom terms, see `vslam_v1.parallel_env`. The
            environments of a process share these terms, which must keep no state.
        cluster: Address of a Ray cluster that runs the workers, see `ray.init`; 0 workers are then one per core, at
            most one per environment. None: this machine.
        monitor: Whether a `VecMonitor`, which has the attributes of the environments, too, records return and length of
            episodes for the logs of learners.
        wrap: Function that wraps each parallel environment; cloudpickle must support it. None: they stay as they are.

    Raises:
        ValueError: If a number is out of range, or the cluster cannot be used.
    """
    check_int("num_envs", num_envs, 1, "Use at least one environment.")
    configs = [config] if isinstance(config, EnvConfig) else list(config)
    if not configs:
        raise argument_error("config", "at least one configuration", configs, "Give an EnvConfig.")
    make = partial(vslam_v1.parallel_env, render_mode=render_mode, reward=reward)
    makers: list[MakeEnv] = [partial(make, config=configs[i % len(configs)]) for i in range(num_envs)]
    if wrap is not None:
        makers = [partial(_wrapped, maker, wrap) for maker in makers]
    load = partial(load_kernels, configs[0])
    if workers > 0 and cluster is None:
        prepare(load)  # compiles once, with a message; workers then load from the cache
    env = ExplorationVecEnv(makers, workers, load, cluster)
    if seed is not None:
        env.seed(seed)
    return VecMonitor(env) if monitor else env


def _wrapped(make: MakeEnv, wrap: Callable[[Any], Any]) -> Any:
    return wrap(make())


def load_kernels(config: EnvConfig) -> None:
    """Load or compile the kernels that an environment needs, those of the first steps first."""
    env = vslam_v1.parallel_env(config=config)
    env.reset(seed=0)
    for _ in range(min(2, config.num_cycles)):
        env.step({agent: env.action_space(agent).sample() for agent in env.agents})
    warm_up()


def env_seeds(seed: int, num_envs: int) -> list[int]:
    """Return the seeds of the first resets of all environments; different values of `seed` share no seeds.

    The seeds of the first environments do not depend on the number of environments.
    """
    seed = check_int("seed", seed, 0, "Give an int >= 0, or None.")
    return [int(word) for word in np.random.SeedSequence(seed).generate_state(num_envs)]


class ExplorationVecEnv(VecEnv):  # type: ignore[misc]   # its types are not checked
    """SB3 vector environment whose slots are robots, ordered by environment, then by agent.

    Observations, rewards and infos are equal to those of each environment alone, and their arrays are not shared. An
    environment whose episode ends is reset at once; the infos of its slots then contain `terminal_observation`, and at
    a time limit `TimeLimit.truncated` is true, so that learners bootstrap. `env_method("action_masks")` returns the
    masks of `goal` actions for sb3-contrib's MaskablePPO. Other methods and attributes come from the environment of a
    slot, once per slot; `indices=env.first_slots` accesses each environment once.

    Args:
        makers: Functions that each make a parallel environment; picklable if there are workers.
        workers: Number of worker processes; 0: this process.
        prepare: Function called once in each worker before its environments are made, e.g. to load kernels.
        cluster: Address of a Ray cluster that runs the workers; 0 of them are then one per core. None: this machine.

    Attributes:
        first_slots: First slot of each environment.
        spent: (P, 2) float64 [s]. Wall-clock time and processor time that the environments of each of P processes took
            in the last step; zeros before the first step.

    Raises:
        ValueError: If there is no environment, spaces differ, there are more workers than environments, or the cluster
            cannot be used.
    """

    def __init__(
        self,
        makers: Sequence[MakeEnv],
        workers: int = 0,
        prepare: Callable[[], object] = lambda: None,
        cluster: str | None = None,
    ) -> None:
        check_int("workers", workers, 0, "Use 0 for this process, or a number of processes.")
        is_here = workers == 0 and cluster is None
        self._slots = SyncEnvs(makers) if is_here else WorkerEnvs(makers, workers, prepare, cluster)
        self._masks: BoolArray | None = None
        ends = np.cumsum(self._slots.counts)
        self.first_slots: list[int] = [0, *ends[:-1].tolist()]
        processes = self._slots.num_workers if isinstance(self._slots, WorkerEnvs) else 1
        self.spent: FloatArray = np.zeros((processes, 2))
        super().__init__(int(ends[-1]), self._slots.observation_space, self._slots.action_space)

    def seed(self, seed: int | None = None) -> list[int | None]:
        """Seed the next reset of all environments with `env_seeds`; None: random seeds. Return the seeds by slot."""
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
        return self._split_masks(observations)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Start a step with actions (S, ...).

        Raises:
            ValueError: If the number of actions is not the number of slots, or an action is outside its space.
        """
        if len(actions) != self.num_envs:
            raise argument_error("actions", f"{self.num_envs} actions", len(actions), "Give one for each slot.")
        self._slots.step_async(np.asarray(actions))

    def step_wait(self) -> tuple[Any, NDArray[np.float32], BoolArray, list[dict[str, Any]]]:
        """Return observations, rewards (S,), dones (S,) and infos of the started step."""
        stepped: StepResult = self._slots.step_wait()
        self.spent = stepped.spent
        return self._split_masks(stepped.observations), stepped.rewards, stepped.dones, stepped.infos

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Call a method of the environment of each slot; `action_masks` returns (33,) bool per slot."""
        slots = self._indices(indices)
        if method_name == "action_masks" and self._masks is not None:
            return [self._masks[slot].copy() for slot in slots]
        return self._slots.ask("call", slots, method_name, method_args, method_kwargs)

    def has_attr(self, attr_name: str) -> bool:
        """Return whether the environments have an attribute; `action_masks` exists for `goal` actions."""
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
        """Return False for each slot: parallel environments have no Gymnasium wrappers."""
        return [False] * len(self._indices(indices))

    def get_images(self) -> list[NDArray[np.uint8] | None]:
        """Return one image per environment, not per slot."""
        return self.env_method("render", indices=self.first_slots)

    def get_state(self) -> dict[str, Any]:
        """Return the complete state of the environments, with the masks of their last observations."""
        return {"environments": self.env_method("get_state", indices=self.first_slots), "masks": self._masks}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Restore a state of `get_state`; later steps are identical. The caller keeps the last observations.

        Raises:
            ValueError: If the number of environments differs, or an environment refuses its part.
        """
        given = state["environments"]
        if len(given) != len(self.first_slots):
            raise argument_error(
                "state", f"a state of {len(self.first_slots)} environments", len(given), "Make as many."
            )
        for slot, one in zip(self.first_slots, given, strict=True):
            self.env_method("set_state", one, indices=[slot])
        self._masks = state["masks"]

    def close(self) -> None:
        """Close all environments and processes."""
        self._slots.close()

    def _indices(self, indices: Any) -> list[int]:
        return [int(slot) for slot in self._get_indices(indices)]

    def _split_masks(self, observations: dict[str, NDArray[Any]]) -> Any:
        """Keep the action masks, and return observations in the form of their space."""
        if MASK in observations:
            self._masks = observations[MASK] != 0
        return observations.get(WHOLE, observations)
