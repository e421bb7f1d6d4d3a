"""`SlotBatch`: several environments side by side, each robot of each in a slot of its own, stepped one by one."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from slam_backend.errors import BoolArray, Float32Array, bad_argument

MakeEnv = Callable[[], ParallelEnv[str, Any, Any]]
Infos = list[dict[str, Any]]
WHOLE = ""  # names the one array of observations that are not dicts
MASK = "action_mask"


@dataclass(frozen=True, slots=True, eq=False)
class Stepped:
    """What all slots saw in a step.

    Attributes:
        observations: Arrays (S, ...) by name, as `buffers` makes them; nobody else holds them.
        rewards: (S,) float32.
        dones: (S,) bool. The slot's episode has ended and its observation is the first of the next one.
        infos: One dict per slot.
    """

    observations: dict[str, NDArray[Any]]
    rewards: Float32Array
    dones: BoolArray
    infos: Infos


@dataclass(frozen=True, slots=True)
class Slot:
    """One robot of one environment; what it lacks itself is its environment's."""

    env: Any
    agent: str

    def __getattr__(self, name: str) -> Any:
        return getattr(self.env, name)


def buffers(space: spaces.Space[Any], slots: int) -> dict[str, NDArray[Any]]:
    """Return uninitialised arrays (slots, ...) for observations of a space, by name; a plain box has the name `""`.

    Raises:
        ValueError: If the space is neither a box nor a dict of boxes.
    """
    boxes = dict(space.spaces) if isinstance(space, spaces.Dict) else {WHOLE: space}
    if not all(isinstance(box, spaces.Box) for box in boxes.values()):
        raise bad_argument("observation_space", "a Box or a Dict of these", space, "Flatten what is nested.")
    return {name: np.empty((slots, *(box.shape or ())), box.dtype) for name, box in boxes.items()}


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

    Raises:
        ValueError: If there is no environment, or spaces or render modes differ.
    """

    def __init__(self, makers: Sequence[MakeEnv]) -> None:
        if not makers:
            raise bad_argument("makers", "at least one function", list(makers), "Give a function per environment.")
        self.envs: list[Any] = [make() for make in makers]
        self.slots = [Slot(env, agent) for env in self.envs for agent in env.possible_agents]
        self.counts = [len(env.possible_agents) for env in self.envs]
        first = self.slots[0]
        self.observation_space = first.env.observation_space(first.agent)
        self.action_space = first.env.action_space(first.agent)
        self.render_mode: str | None = first.env.render_mode
        for slot in self.slots:
            for kind in ("observation_space", "action_space"):
                theirs = getattr(slot.env, kind)(slot.agent)
                if theirs != getattr(self, kind):
                    raise bad_argument(kind, "the same for all agents", theirs, "Give robots of one kind.")
            if slot.env.render_mode != self.render_mode:
                raise bad_argument("render_mode", "the same for all", slot.env.render_mode, "Make all alike.")
        buffers(self.observation_space, 0)  # refuses spaces that cannot be stacked
        self._results: Stepped | None = None

    @property
    def num_slots(self) -> int:
        """S."""
        return len(self.slots)

    def reset(
        self, seeds: Sequence[int | None], options: Sequence[Mapping[str, Any]]
    ) -> tuple[dict[str, NDArray[Any]], Infos]:
        """Reset all environments.

        Args:
            seeds: Per environment; None: go on with its stream.
            options: Per environment.

        Returns:
            Observations (S, ...) by name, and infos.
        """
        out, infos = buffers(self.observation_space, len(self.slots)), []
        for env, first, seed, option in zip(self.envs, self._firsts(), seeds, options, strict=True):
            observations, told = env.reset(seed=seed, options=dict(option))
            for slot, agent in enumerate(env.possible_agents, first):
                _enter(out, slot, observations[agent])
                infos.append(told[agent])
        return out, infos

    def send(self, actions: NDArray[Any]) -> None:
        """Step all environments with actions (S, ...); `receive` hands out what came of it."""
        out, infos = buffers(self.observation_space, len(self.slots)), []
        rewards, dones = np.empty(len(self.slots), np.float32), np.empty(len(self.slots), np.bool_)
        chosen, slot = list(actions), 0
        for env in self.envs:
            agents = env.possible_agents
            begin, end = slot, slot + len(agents)
            observations, gained, terminated, truncated, told = env.step(
                dict(zip(agents, chosen[begin:end], strict=True))
            )
            fresh = env.reset()[0] if not env.agents else observations
            for agent in agents:
                over, cut = terminated[agent], truncated[agent]
                info = told[agent]
                info["TimeLimit.truncated"] = cut and not over
                if over or cut:
                    info["terminal_observation"] = observations[agent]
                _enter(out, slot, fresh[agent])
                rewards[slot], dones[slot] = gained[agent], over or cut
                infos.append(info)
                slot += 1
        self._results = Stepped(out, rewards, dones, infos)

    def receive(self) -> Stepped:
        """Return what the last `send` led to.

        Raises:
            RuntimeError: If nothing was sent.
        """
        if self._results is None:
            raise RuntimeError("step_wait: expected actions that were sent, got none. Call step_async() first.")
        results, self._results = self._results, None
        return results

    def get(self, name: str, slots: Sequence[int]) -> list[Any]:
        """Return an attribute of the environments of some slots."""
        return [getattr(self.slots[slot], name) for slot in slots]

    def has(self, name: str) -> bool:
        """Tell whether all slots have an attribute."""
        return all(hasattr(slot, name) for slot in self.slots)

    def set(self, name: str, slots: Sequence[int], value: Any) -> None:
        """Set an attribute of the environments of some slots."""
        for slot in slots:
            setattr(self.slots[slot].env, name, value)

    def call(self, name: str, slots: Sequence[int], args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> list[Any]:
        """Call a method of the environments of some slots, once per slot."""
        return [getattr(self.slots[slot], name)(*args, **kwargs) for slot in slots]

    def images(self) -> list[NDArray[np.uint8] | None]:
        """Return a picture of each environment."""
        return [env.render() for env in self.envs]

    def close(self) -> None:
        """Close all environments."""
        for env in self.envs:
            env.close()

    def _firsts(self) -> list[int]:
        """Return the first slot of each environment."""
        return [0, *np.cumsum(self.counts)[:-1].tolist()]


def _enter(out: dict[str, NDArray[Any]], slot: int, observation: Any) -> None:
    """Copy one agent's observation into its row."""
    if WHOLE in out:
        out[WHOLE][slot] = observation
    else:
        for name, rows in out.items():
            rows[slot] = observation[name]
