"""`time_workers`: environments over worker processes, timed side by side; what they gain, and where the rest goes."""

import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.validation import BoolArray, FloatArray
from training.experiments.statistics import interval
from training.experiments.step_timing import no_garbage_collection
from training.vec_env import make_vec_env
from vslam_env.config import EnvConfig

WARM_UP = 3
CLOCK, PROCESSOR = 0, 1  # columns of what the environments of each process took


@dataclass(frozen=True, slots=True, eq=False)
class WorkerTimes:
    """Durations of N steps with a number of workers, each step with the same actions as with the other numbers [s].

    Attributes:
        workers: Processes; 0: the measuring one alone.
        masks: (N,) on the clock. Asking for the masks.
        steps: (N,) on the clock. The steps.
        spent: (N, P, 2). What the environments of each process took of them: on the clock, and of its processor.
    """

    workers: int
    masks: FloatArray
    steps: FloatArray
    spent: FloatArray

    @property
    def whole(self) -> FloatArray:
        """(N,) on the clock. Masks and steps."""
        return self.masks + self.steps

    @property
    def beside(self) -> FloatArray:
        """(N,) on the clock. What steps took beside the environments of the slowest process: adapter and pipes."""
        beside: FloatArray = self.steps - self.spent[:, :, CLOCK].max(axis=1)
        return beside


@dataclass(frozen=True, slots=True)
class WorkerRow:
    """What a number of workers gives; medians over the steps where nothing else is said.

    Attributes:
        workers: How many; 0: no process but the measuring one.
        per_second: Decisions of robots per second, by the median step.
        best_per_second: By the fastest step.
        mean_per_second: By all steps together.
        beside_us: What a decision takes beside the environments of the slowest process [us].
        balance: Mean over maximum of what the environments of the processes took of their processors: the share of its
            time that the mean worker works, where none is interrupted.
        work: What all environments took of the processors, as a multiple of what they take in one worker: above 1 where
            the processes get into each other's way. None for one worker, and where none was timed.
        gain: Decisions per second as a multiple of those of one worker, which takes each step in turn with it.
        gain_low: The end of its 95 % bootstrap interval over the steps.
        gain_high: The other end.
    """

    workers: int
    per_second: float
    best_per_second: float
    mean_per_second: float
    beside_us: float
    balance: float
    work: float | None = None
    gain: float | None = None
    gain_low: float | None = None
    gain_high: float | None = None


def time_workers(
    config: EnvConfig, num_envs: int, workers: Sequence[int], steps: int, seed: int
) -> tuple[WorkerTimes, ...]:
    """Time environments under random valid goals, in this process or over workers.

    All of them play the same episodes, and take turns at each step: what else the machine does meets them all alike.

    Args:
        config: Of the environments.
        num_envs: E.
        workers: Numbers of processes; 0: this one alone.
        steps: Timed with each of them; a few more come before.
        seed: Of the episodes.
    """
    with ExitStack() as open_now:
        envs = []
        for count in workers:
            env = make_vec_env(config, num_envs, count, seed)
            open_now.callback(env.close)
            env.reset()
            envs.append(env)
        rng = np.random.default_rng(seed)
        seconds = np.empty((len(envs), steps + WARM_UP, 2))
        spent = [np.empty((steps + WARM_UP, *env.spent.shape)) for env in envs]
        with no_garbage_collection():
            for step in range(steps + WARM_UP):
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
        WorkerTimes(count, times[WARM_UP:, 0], times[WARM_UP:, 1], took[WARM_UP:])
        for count, times, took in zip(workers, seconds, spent, strict=True)
    )


def summarise_workers(times: Sequence[WorkerTimes], slots: int) -> tuple[WorkerRow, ...]:
    """Return a row for each number of workers.

    Args:
        times: Of all numbers, of the same steps.
        slots: Decisions in a step.
    """
    alone = {each.workers: each for each in times}.get(1)
    rows = []
    for each in times:
        whole, of_processors = each.whole, each.spent[:, :, PROCESSOR]
        row = WorkerRow(
            workers=each.workers,
            per_second=slots / float(np.median(whole)),
            best_per_second=slots / float(whole.min()),
            mean_per_second=slots * len(whole) / float(whole.sum()),
            beside_us=1e6 / slots * float(np.median(each.beside)),
            balance=float(np.median(of_processors.mean(axis=1) / of_processors.max(axis=1))),
        )
        rows.append(row if alone is None or each is alone else _beside_one(row, each, alone))
    return tuple(rows)


def _beside_one(row: WorkerRow, times: WorkerTimes, alone: WorkerTimes) -> WorkerRow:
    """Return a row with what is compared with one worker, step by step."""
    work = times.spent[:, :, PROCESSOR].sum(axis=1) / alone.spent[:, :, PROCESSOR].sum(axis=1)
    ratios = alone.whole / times.whole
    low, high = interval(ratios, np.median)
    return replace(row, work=float(np.median(work)), gain=float(np.median(ratios)), gain_low=low, gain_high=high)


def _drawn(masks: Sequence[BoolArray], rng: np.random.Generator) -> NDArray[np.int64]:
    return np.array([rng.choice(np.flatnonzero(mask)) for mask in masks], np.int64)
