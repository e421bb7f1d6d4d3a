"""Time of a decision outside the environments, and of environments in worker processes."""

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from slam_backend.core.validation import BoolArray, FloatArray
from training.experiments.statistics import interval
from training.experiments.timing import clock, no_garbage_collection
from training.rl.config import TrainConfig
from training.rl.ppo import GoalPPO
from training.vec_env import ExplorationVecEnv, make_vec_env
from vslam_env import vslam_v1
from vslam_env.config import EnvConfig

ADAPTER_STEPS = 400
WARM_UP = 20
RECORDED = 20  # number of steps that are replayed repeatedly
ADAPTER_ALONE = "adapter alone"

WORKERS_WARM_UP = 3
CLOCK, PROCESSOR = 0, 1  # columns of the times of each process


class Part(NamedTuple):
    """Part of the time of a training, per decision of a robot [us]."""

    name: str
    median_us: float
    min_us: float

    @classmethod
    def of(cls, name: str, seconds: FloatArray, decisions: int) -> "Part":
        """Summarise durations (n,) [s] of calls with `decisions` decisions each."""
        return cls(name, 1e6 / decisions * float(np.median(seconds)), 1e6 / decisions * float(seconds.min()))


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """Spaces, reset and `RECORDED` steps of an environment with random valid goals."""

    agents: Sequence[str]
    spaces: tuple[Any, Any]
    first: Any
    steps: Sequence[Any]


def record(config: EnvConfig, seed: int) -> Recording:
    """Record some steps of an environment with `goal` actions."""
    env = vslam_v1.parallel_env(config=config.replace(max_cycles=RECORDED + 1))
    spaces = env.observation_space(env.possible_agents[0]), env.action_space(env.possible_agents[0])
    rng = np.random.default_rng(seed)
    first, steps = env.reset(seed=seed), []
    seen = first[0]
    for _ in range(RECORDED):
        actions = {agent: int(rng.choice(np.flatnonzero(seen[agent]["action_mask"]))) for agent in env.agents}
        steps.append(env.step(actions))
        seen = steps[-1][0]
    return Recording(tuple(env.possible_agents), spaces, first, steps)


class Replay(ParallelEnv[str, Any, Any]):  # type: ignore[misc]   # PettingZoo has no type information
    """Environment that returns recorded values, so that only the adapter around it takes time.

    All replays of a recording return the same few arrays, which stay in the cache, like arrays that an environment
    has just written.
    """

    render_mode = None

    def __init__(self, recording: Recording) -> None:
        self._recording, self._next = recording, 0
        self.possible_agents = self.agents = list(recording.agents)

    def observation_space(self, agent: str) -> Any:
        """Return the observation space of the environment."""
        return self._recording.spaces[0]

    def action_space(self, agent: str) -> Any:
        """Return the action space of the environment."""
        return self._recording.spaces[1]

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        """Return the result of the recorded reset."""
        return self._recording.first

    def step(self, actions: Any) -> Any:
        """Return the result of the next recorded step, starting over after the last."""
        self._next = (self._next + 1) % RECORDED
        return self._recording.steps[self._next]


def _seconds(call: Callable[[Any], Any], arguments: Sequence[Any], warm_up: int) -> FloatArray:
    """Return the durations of calls (n - warm_up,) [s] and discard their results."""
    with no_garbage_collection():
        return clock(call, arguments)[warm_up:]


def time_adapter(recording: Recording, num_envs: int) -> list[Part]:
    """Return the time that the adapter and the masks add to a decision, with replayed environments."""
    env = ExplorationVecEnv([lambda: Replay(recording)] * num_envs)
    env.reset()
    actions = [np.zeros(env.num_envs, np.int64)] * (ADAPTER_STEPS + WARM_UP)
    alone = [Replay(recording) for _ in range(num_envs)]
    # Accesses the results once per step: the time of the replay itself, not of the adapter.
    bare = _seconds(lambda _: [one.step(None) for one in alone], actions, WARM_UP)
    stepped = _seconds(env.step, actions, WARM_UP)
    masks = _seconds(lambda _: np.stack(env.env_method("action_masks")), actions, WARM_UP)
    without = Part.of("", bare, env.num_envs)
    whole = Part.of(ADAPTER_ALONE, stepped, env.num_envs)
    return [
        Part(ADAPTER_ALONE, whole.median_us - without.median_us, whole.min_us - without.min_us),
        Part.of("masks", masks, env.num_envs),
    ]


def time_learner(recording: Recording, config: TrainConfig) -> list[Part]:
    """Return the time per decision of sampling actions from the network and of updating it, on one thread."""
    torch.set_num_threads(1)
    env = ExplorationVecEnv([lambda: Replay(recording)] * config.envs)
    model = GoalPPO(
        env=env, n_steps=config.max_cycles, batch_size=config.batch, n_epochs=config.epochs, seed=0, device="cpu"
    )
    seen: Mapping[str, NDArray[Any]] = env.reset()
    masks: NDArray[Any] = np.stack(env.env_method("action_masks"))

    def act(_: Any) -> None:
        with torch.no_grad():
            model.policy(model.policy.obs_to_tensor(seen)[0], action_masks=masks)

    drawn = _seconds(act, [None] * 60, 10)
    model.learn(config.rollout)  # fills the buffer and warms up the update
    updates = []
    for _ in range(3):
        begin = time.perf_counter()
        model.train()
        model.finish_update()
        updates.append(time.perf_counter() - begin)
    return [
        Part.of("network, sampling", drawn, env.num_envs),
        Part.of("network, update", np.array(updates), config.rollout),
    ]


@dataclass(frozen=True, slots=True, eq=False)
class WorkerTimes:
    """Durations [s] of N steps with a number of workers; all numbers of workers use the same actions."""

    workers: int  # Number of worker processes; 0: this process
    masks: FloatArray  # (N,) Wall-clock time of requesting the masks
    steps: FloatArray  # (N,) Wall-clock time of the steps
    # (N, P, 2) Wall-clock time and processor time of the environments of each process
    spent: FloatArray

    @property
    def whole(self) -> FloatArray:
        """(N,) Wall-clock time of masks and steps."""
        return self.masks + self.steps

    @property
    def beside(self) -> FloatArray:
        """(N,) Wall-clock time of steps outside the environments of the slowest process: adapter and pipes."""
        beside: FloatArray = self.steps - self.spent[:, :, CLOCK].max(axis=1)
        return beside


def time_workers(
    config: EnvConfig, num_envs: int, workers: Sequence[int], steps: int, seed: int
) -> tuple[WorkerTimes, ...]:
    """Time environments with random valid goals, in this process or in workers.

    All numbers of workers run the same episodes and alternate at each step, so that other load affects all equally.

    Args:
        workers: Numbers of worker processes; 0: this process.
    """
    with ExitStack() as open_now:
        envs = []
        for count in workers:
            env = make_vec_env(config, num_envs, count, seed, monitor=False)
            open_now.callback(env.close)
            env.reset()
            envs.append(env)
        rng = np.random.default_rng(seed)
        seconds = np.empty((len(envs), steps + WORKERS_WARM_UP, 2))
        spent = [np.empty((steps + WORKERS_WARM_UP, *env.spent.shape)) for env in envs]
        with no_garbage_collection():
            for step in range(steps + WORKERS_WARM_UP):
                actions: NDArray[np.int64] | None = None
                for row, env in enumerate(envs):
                    begin = time.perf_counter()
                    masks = env.env_method("action_masks")
                    asked = time.perf_counter()
                    actions = _drawn(masks, rng) if actions is None else actions
                    chosen = time.perf_counter()
                    env.step(actions)
                    seconds[row, step] = asked - begin, time.perf_counter() - chosen
                    spent[row][step] = env.spent
    return tuple(
        WorkerTimes(count, times[WORKERS_WARM_UP:, 0], times[WORKERS_WARM_UP:, 1], took[WORKERS_WARM_UP:])
        for count, times, took in zip(workers, seconds, spent, strict=True)
    )


def summarise_workers(times: Sequence[WorkerTimes], slots: int) -> list[dict[str, Any]]:
    """Return a row for each number of workers; medians over the steps unless noted otherwise.

    Returns:
        Rows of `workers`; decisions of robots `per_second` by the median step, `best_per_second` by the fastest,
        `mean_per_second` by all; `beside_us`, the time of a decision outside the environments of the slowest process;
        `balance`, the mean over the maximum of the processes' processor times. Relative to one worker, else None:
        `work`, the total processor time of the environments, above 1 if processes slow each other down; `gain` in
        decisions per second, step by step, with its 95 % bootstrap interval.
    """
    alone = {each.workers: each for each in times}.get(1)
    rows = []
    for each in times:
        whole, of_processors = each.whole, each.spent[:, :, PROCESSOR]
        row: dict[str, Any] = {
            "workers": each.workers, "per_second": slots / float(np.median(whole)),
            "best_per_second": slots / float(whole.min()), "mean_per_second": slots * len(whole) / float(whole.sum()),
            "beside_us": 1e6 / slots * float(np.median(each.beside)),
            "balance": float(np.median(of_processors.mean(axis=1) / of_processors.max(axis=1))),
        } | dict.fromkeys(("work", "gain", "gain_low", "gain_high"))  # fmt: skip
        if alone is not None and each is not alone:
            ratios, work = alone.whole / whole, of_processors.sum(axis=1) / alone.spent[:, :, PROCESSOR].sum(axis=1)
            low, high = interval(ratios, np.median)
            gain = {"gain": float(np.median(ratios)), "gain_low": low, "gain_high": high}
            row |= {"work": float(np.median(work)), **gain}
        rows.append(row)
    return rows


def _drawn(masks: Sequence[BoolArray], rng: np.random.Generator) -> NDArray[np.int64]:
    return np.array([rng.choice(np.flatnonzero(mask)) for mask in masks], np.int64)
