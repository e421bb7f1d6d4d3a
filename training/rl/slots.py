"""`SyncEnvs`: several environments in one process, one slot per robot, stepped in sequence."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from slam_backend.core.validation import BoolArray, Float32Array, FloatArray, argument_error

MakeEnv = Callable[[], ParallelEnv[str, Any, Any]]
Infos = list[dict[str, Any]]
WHOLE = ""  # name of the array of a plain box observation
MASK = "action_mask"
NOTHING_SENT = "step_wait: expected actions, got none. Call step_async() first."
Layout = tuple[tuple[str, tuple[int, ...], np.dtype[Any]], ...]  # names, shapes and types of observations


@dataclass(frozen=True, slots=True, eq=False)
class StepResult:
    """Result of a step for all slots."""

    observations: dict[str, NDArray[Any]]  # Arrays (S, ...) by name; not shared
    rewards: Float32Array  # (S,) float32
    dones: BoolArray  # (S,) bool. Whether the episode ended; the observation is then the first of the next.
    infos: Infos  # One dict per slot
    # (P, 2) float64 [s]. Wall-clock time and processor time that the environments of each process took.
    spent: FloatArray


@dataclass(frozen=True, slots=True)
class Slot:
    """One robot of one environment; missing attributes are looked up in the environment."""

    env: Any
    agent: str

    def __getattr__(self, name: str) -> Any:
        return getattr(self.env, name)


def row_layout(space: spaces.Space[Any]) -> Layout:
    """Return names, shapes and dtypes of the observations of a space; a plain box has the name `""`.

    Raises:
        ValueError: If the space is neither a box nor a dict of boxes.
    """
    boxes = dict(space.spaces) if isinstance(space, spaces.Dict) else {WHOLE: space}
    if not all(isinstance(box, spaces.Box) for box in boxes.values()):
        raise argument_error("observation_space", "a Box or a Dict of boxes", space, "Flatten nested spaces.")
    return tuple((name, box.shape or (), np.dtype(box.dtype)) for name, box in boxes.items())


def buffers(layout: Layout, slots: int) -> dict[str, NDArray[Any]]:
    """Return uninitialised arrays (slots, ...) by name."""
    return {name: np.empty((slots, *shape), dtype) for name, shape, dtype in layout}


def stacked(layout: Layout, observations: Sequence[Any]) -> dict[str, NDArray[Any]]:
    """Return new arrays (S, ...) by name, with one row for each of S observations; no memory is shared.

    One call joins the rows of each name: one assignment per row takes twice as long.
    """
    values = {}
    for name, rows in buffers(layout, len(observations)).items():
        parts = observations if name == WHOLE else [one[name] for one in observations]
        if rows.ndim == 1:
            rows[:] = parts
        else:
            np.concatenate(parts, out=rows.reshape(-1, *rows.shape[2:]))
        values[name] = rows
    return values


class SyncEnvs:
    """Environments in this process, with slots ordered by environment, then by agent.

    An environment whose episode ends is reset at once. Each environment gives the same results as it would alone.

    Args:
        makers: Functions that each make an environment; all agents of all environments have the same spaces.

    Attributes:
        observation_space: Observation space of a slot.
        action_space: Action space of a slot.
        render_mode: Render mode of the environments.
        counts: Number of slots of each environment.
        layout: Layout of the observations of a slot.

    Raises:
        ValueError: If there is no environment, or spaces or render modes differ.
    """

    def __init__(self, makers: Sequence[MakeEnv]) -> None:
        if not makers:
            raise argument_error("makers", "at least one function", list(makers), "Give a function per environment.")
        self.envs: list[Any] = [make() for make in makers]
        self.slots = [Slot(env, agent) for env in self.envs for agent in env.possible_agents]
        self._agents: list[tuple[str, ...]] = [tuple(env.possible_agents) for env in self.envs]
        self.counts = [len(agents) for agents in self._agents]
        first = self.slots[0]
        self.observation_space = first.env.observation_space(first.agent)
        self.action_space = first.env.action_space(first.agent)
        self.render_mode: str | None = first.env.render_mode
        for slot in self.slots:
            for kind in ("observation_space", "action_space"):
                theirs = getattr(slot.env, kind)(slot.agent)
                if theirs != getattr(self, kind):
                    raise argument_error(kind, "the same for all agents", theirs, "Use one configuration.")
            if slot.env.render_mode != self.render_mode:
                raise argument_error("render_mode", "the same for all", slot.env.render_mode, "Use one configuration.")
        self.layout = row_layout(self.observation_space)
        self._results: StepResult | None = None

    @property
    def num_slots(self) -> int:
        """S."""
        return len(self.slots)

    def reset(
        self, seeds: Sequence[int | None], options: Sequence[Mapping[str, Any]]
    ) -> tuple[dict[str, NDArray[Any]], Infos]:
        """Reset all environments.

        Returns:
            Observations (S, ...) by name, and infos.
        """
        results = [
            env.reset(seed=seed, options=dict(option))
            for env, seed, option in zip(self.envs, seeds, options, strict=True)
        ]
        observations, infos = map(self._by_slot, zip(*results, strict=True))
        return stacked(self.layout, observations), infos

    def step(self, actions: NDArray[Any]) -> StepResult:
        """Step all environments with actions (S, ...)."""
        chosen = iter(actions)  # each environment takes one action per agent
        wanted = [dict(zip(agents, chosen, strict=False)) for agents in self._agents]
        begin = time.perf_counter(), time.process_time()
        # No other work is done between the steps: they evict the caches, so that work after each step is slow.
        results = [env.step(each) for env, each in zip(self.envs, wanted, strict=True)]
        begun = [each[0] if env.agents else env.reset()[0] for env, each in zip(self.envs, results, strict=True)]
        spent = np.array([[time.perf_counter() - begin[0], time.process_time() - begin[1]]])
        last, rewards, over, cut, infos = map(self._by_slot, zip(*results, strict=True))
        for info, terminated, truncated, observation in zip(infos, over, cut, last, strict=True):
            info["TimeLimit.truncated"] = truncated and not terminated
            if terminated or truncated:
                info["terminal_observation"] = observation
        observations = stacked(self.layout, self._by_slot(begun))
        return StepResult(observations, np.array(rewards, np.float32), np.logical_or(over, cut), infos, spent)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Step with actions (S, ...); `step_wait` returns the result."""
        self._results = self.step(actions)

    def step_wait(self) -> StepResult:
        """Return the result of the last `step_async`.

        Raises:
            RuntimeError: If no actions were sent.
        """
        if self._results is None:
            raise RuntimeError(NOTHING_SENT)
        results, self._results = self._results, None
        return results

    def ask(self, command: str, slots: Sequence[int], name: str, *rest: Any) -> list[Any]:
        """Get, set, test for or call an attribute of some slots, once per slot.

        Args:
            command: `"get"`, `"set"`, `"has"` or `"call"`.
            name: Name of the attribute; if a slot lacks it, the environment's attribute is used.
            rest: Value to set, or positional and keyword arguments of the call.
        """
        chosen = [self.slots[slot] for slot in slots]
        if command == "has":
            return [hasattr(slot, name) for slot in chosen]
        if command == "set":
            for slot in chosen:
                setattr(slot.env, name, *rest)
            return [None] * len(chosen)
        values = [getattr(slot, name) for slot in chosen]
        return values if command == "get" else [method(*rest[0], **rest[1]) for method in values]

    def close(self) -> None:
        """Close all environments."""
        for env in self.envs:
            env.close()

    def _by_slot(self, by_env: Sequence[Mapping[str, Any]]) -> list[Any]:
        """Return the values of all agents, slot by slot."""
        return [of[agent] for of, agents in zip(by_env, self._agents, strict=True) for agent in agents]
