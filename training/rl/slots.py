"""`SlotBatch`: several environments side by side, each robot of each in a slot of its own, stepped one by one."""

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
WHOLE = ""  # names the one array of observations that are not dicts
MASK = "action_mask"
NOTHING_SENT = "step_wait: expected actions that were sent, got none. Call step_async() first."
Layout = tuple[tuple[str, tuple[int, ...], np.dtype[Any]], ...]  # names, shapes and types of observations


@dataclass(frozen=True, slots=True, eq=False)
class Stepped:
    """What all slots saw in a step."""

    observations: dict[str, NDArray[Any]]  # Arrays (S, ...) by name, as `stacked` makes them; nobody else holds them
    rewards: Float32Array  # (S,) float32
    dones: BoolArray  # (S,) bool. The slot's episode has ended and its observation is the first of the next one.
    infos: Infos  # One dict per slot
    # (P, 2) float64 [s]. What the environments of each process took: on the clock, and of its processor.
    spent: FloatArray


@dataclass(frozen=True, slots=True)
class Slot:
    """One robot of one environment; what it lacks itself is its environment's."""

    env: Any
    agent: str

    def __getattr__(self, name: str) -> Any:
        return getattr(self.env, name)


def row_layout(space: spaces.Space[Any]) -> Layout:
    """Return names, shapes and types of the observations of a space; a plain box has the name `""`.

    Raises:
        ValueError: If the space is neither a box nor a dict of boxes.
    """
    boxes = dict(space.spaces) if isinstance(space, spaces.Dict) else {WHOLE: space}
    if not all(isinstance(box, spaces.Box) for box in boxes.values()):
        raise argument_error("observation_space", "a Box or a Dict of these", space, "Flatten what is nested.")
    return tuple((name, box.shape or (), np.dtype(box.dtype)) for name, box in boxes.items())


def buffers(layout: Layout, slots: int) -> dict[str, NDArray[Any]]:
    """Return uninitialised arrays (slots, ...) by name."""
    return {name: np.empty((slots, *shape), dtype) for name, shape, dtype in layout}


def stacked(layout: Layout, observations: Sequence[Any]) -> dict[str, NDArray[Any]]:
    """Return new arrays (S, ...) by name, a row for each of S observations; they share no memory with these.

    Each name's rows are joined by one call: one assignment per row takes twice as long.
    """
    found = {}
    for name, rows in buffers(layout, len(observations)).items():
        parts = observations if name == WHOLE else [one[name] for one in observations]
        if rows.ndim == 1:
            rows[:] = parts
        else:
            np.concatenate(parts, out=rows.reshape(-1, *rows.shape[2:]))
        found[name] = rows
    return found


class SlotBatch:
    """Environments in this process. Slots are ordered by environment, then by agent.

    An environment whose episode ends is reset at once. What each environment returns is what it would return alone.

    Args:
        makers: Each makes an environment; all agents of all of them have the same spaces.

    Attributes:
        observation_space: Of a slot.
        action_space: Of a slot.
        render_mode: Of the environments.
        counts: How many slots each environment has.
        layout: Of the observations of a slot.

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
                    raise argument_error(kind, "the same for all agents", theirs, "Give robots of one kind.")
            if slot.env.render_mode != self.render_mode:
                raise argument_error("render_mode", "the same for all", slot.env.render_mode, "Make all alike.")
        self.layout = row_layout(self.observation_space)
        self._results: Stepped | None = None

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
        told = [
            env.reset(seed=seed, options=dict(option))
            for env, seed, option in zip(self.envs, seeds, options, strict=True)
        ]
        observations, infos = map(self._by_slot, zip(*told, strict=True))
        return stacked(self.layout, observations), infos

    def step(self, actions: NDArray[Any]) -> Stepped:
        """Step all environments with actions (S, ...)."""
        chosen = iter(actions)  # each environment takes as many as it has agents
        wanted = [dict(zip(agents, chosen, strict=False)) for agents in self._agents]
        begin = time.perf_counter(), time.process_time()
        # Nothing else is done between the steps: they take the caches, and what runs after each of them is slow.
        told = [env.step(each) for env, each in zip(self.envs, wanted, strict=True)]
        begun = [each[0] if env.agents else env.reset()[0] for env, each in zip(self.envs, told, strict=True)]
        spent = np.array([[time.perf_counter() - begin[0], time.process_time() - begin[1]]])
        last, rewards, over, cut, infos = map(self._by_slot, zip(*told, strict=True))
        for info, terminated, truncated, observation in zip(infos, over, cut, last, strict=True):
            info["TimeLimit.truncated"] = truncated and not terminated
            if terminated or truncated:
                info["terminal_observation"] = observation
        observations = stacked(self.layout, self._by_slot(begun))
        return Stepped(observations, np.array(rewards, np.float32), np.logical_or(over, cut), infos, spent)

    def send(self, actions: NDArray[Any]) -> None:
        """Step with actions (S, ...); `receive` hands out what came of it."""
        self._results = self.step(actions)

    def receive(self) -> Stepped:
        """Return what the last `send` led to.

        Raises:
            RuntimeError: If nothing was sent.
        """
        if self._results is None:
            raise RuntimeError(NOTHING_SENT)
        results, self._results = self._results, None
        return results

    def ask(self, command: str, slots: Sequence[int], name: str, *rest: Any) -> list[Any]:
        """Get, set, look for or call an attribute of some slots, once per slot.

        Args:
            command: `"get"`, `"set"`, `"has"` or `"call"`.
            name: The attribute; one that a slot lacks is its environment's.
            rest: Value to set, or arguments and keyword arguments of the call.
        """
        chosen = [self.slots[slot] for slot in slots]
        if command == "has":
            return [hasattr(slot, name) for slot in chosen]
        if command == "set":
            for slot in chosen:
                setattr(slot.env, name, *rest)
            return [None] * len(chosen)
        found = [getattr(slot, name) for slot in chosen]
        return found if command == "get" else [method(*rest[0], **rest[1]) for method in found]

    def close(self) -> None:
        """Close all environments."""
        for env in self.envs:
            env.close()

    def _by_slot(self, by_env: Sequence[Mapping[str, Any]]) -> list[Any]:
        """Return what each environment tells of each of its agents, slot by slot."""
        return [of[agent] for of, agents in zip(by_env, self._agents, strict=True) for agent in agents]
