"""What a decision of a training costs beside its environment: the adapter, the network, and its updates."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pettingzoo import ParallelEnv
from sb3_contrib import MaskablePPO

from slam_backend.core.validation import FloatArray
from training.bench.env.timing import time_steps
from training.rl.config import TrainConfig
from training.rl.network import GoalPolicy
from training.vec_env import ExplorationVecEnv
from vslam_env import vslam_v0
from vslam_env.config import EnvConfig

ADAPTER_STEPS = 400
WARM_UP = 20
RECORDED = 20  # steps of an environment that are played again and again
ADAPTER_ALONE = "adapter alone"


@dataclass(frozen=True, slots=True)
class Part:
    """One part of a training's time, per decision of a robot [us]."""

    name: str
    median_us: float
    min_us: float

    @classmethod
    def of(cls, name: str, seconds: FloatArray, decisions: int) -> "Part":
        """Sum up durations (n,) [s], each of so many decisions."""
        return cls(name, 1e6 / decisions * float(np.median(seconds)), 1e6 / decisions * float(seconds.min()))


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """What an environment returned under random valid goals: spaces, its reset, and `RECORDED` steps."""

    agents: Sequence[str]
    spaces: tuple[Any, Any]
    first: Any
    told: Sequence[Any]


def record(config: EnvConfig, seed: int) -> Recording:
    """Play some steps of an environment with `goal` actions."""
    env = vslam_v0.parallel_env(config=config.replace(max_cycles=RECORDED + 1))
    spaces = env.observation_space(env.possible_agents[0]), env.action_space(env.possible_agents[0])
    rng = np.random.default_rng(seed)
    first, told = env.reset(seed=seed), []
    seen = first[0]
    for _ in range(RECORDED):
        actions = {agent: int(rng.choice(np.flatnonzero(seen[agent]["action_mask"]))) for agent in env.agents}
        told.append(env.step(actions))
        seen = told[-1][0]
    return Recording(tuple(env.possible_agents), spaces, first, told)


class Replay(ParallelEnv[str, Any, Any]):  # type: ignore[misc]   # PettingZoo has no type information
    """Gives back what an environment once returned, so that nothing but the adapter around it takes time.

    All replays of a recording hand out the same few arrays, which stay near the processor, as those do that an
    environment has just made.
    """

    render_mode = None

    def __init__(self, recording: Recording) -> None:
        self._recording, self._next = recording, 0
        self.possible_agents = self.agents = list(recording.agents)

    def observation_space(self, agent: str) -> Any:
        """Return that of the environment."""
        return self._recording.spaces[0]

    def action_space(self, agent: str) -> Any:
        """Return that of the environment."""
        return self._recording.spaces[1]

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        """Return what the environment's reset returned."""
        return self._recording.first

    def step(self, actions: Any) -> Any:
        """Return what its next step returned, from the beginning again after the last."""
        self._next = (self._next + 1) % RECORDED
        return self._recording.told[self._next]


def time_adapter(recording: Recording, num_envs: int) -> list[Part]:
    """Return what the adapter adds to a decision, and what the masks cost, over environments that take no time."""
    env = ExplorationVecEnv([lambda: Replay(recording)] * num_envs)
    env.reset()
    actions = [np.zeros(env.num_envs, np.int64)] * (ADAPTER_STEPS + WARM_UP)
    alone = [Replay(recording) for _ in range(num_envs)]
    # Reads what the steps return, in turn and once a step: the replay's own time, which is no adapter's.
    bare = time_steps(lambda _: [one.step(None) for one in alone], actions, WARM_UP)
    stepped = time_steps(env.step, actions, WARM_UP)
    masks = time_steps(lambda _: np.stack(env.env_method("action_masks")), actions, WARM_UP)
    without = Part.of("", bare, env.num_envs)
    whole = Part.of(ADAPTER_ALONE, stepped, env.num_envs)
    return [
        Part(ADAPTER_ALONE, whole.median_us - without.median_us, whole.min_us - without.min_us),
        Part.of("masks", masks, env.num_envs),
    ]


def time_learner(recording: Recording, config: TrainConfig) -> list[Part]:
    """Return what drawing actions from the network and updating it cost per decision, on one thread."""
    torch.set_num_threads(1)
    env = ExplorationVecEnv([lambda: Replay(recording)] * config.envs)
    model = MaskablePPO(
        GoalPolicy, env, n_steps=config.max_cycles, batch_size=config.batch, n_epochs=config.epochs, seed=0,
        device="cpu",
    )  # fmt: skip
    seen: Mapping[str, NDArray[Any]] = env.reset()
    masks: NDArray[Any] = np.stack(env.env_method("action_masks"))

    def act(_: Any) -> None:
        with torch.no_grad():
            model.policy(model.policy.obs_to_tensor(seen)[0], action_masks=masks)

    drawn = time_steps(act, [None] * 60, 10)
    model.learn(config.rollout)  # fills the buffer, and warms the update up
    updates = []
    for _ in range(3):
        begin = time.perf_counter()
        model.train()
        updates.append(time.perf_counter() - begin)
    return [
        Part.of("network, drawing", drawn, env.num_envs),
        Part.of("network, updating", np.array(updates), config.rollout),
    ]
