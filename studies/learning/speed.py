"""Time of a robot's decision in training: environment, adapter, network and update; environments in worker processes.

python -m studies.learning.speed
"""

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.validation import BoolArray, FloatArray, argument_error
from training.commands.study import run_program
from training.experiments.config import ExperimentConfig, NonNegative, option
from training.experiments.machine.timing import clock, no_garbage_collection
from training.experiments.statistics import interval
from training.experiments.study import Column, Estimate, ResultTable, Row, Study
from training.rl.config import SPLIT_TRAIN, TrainConfig, require_extra
from vslam_env.config import EnvConfig

CALLS, WARM_UP = 50, 10  # of masks and network
UPDATES = 3
WORKERS_WARM_UP = 3
CLOCK, PROCESSOR = 0, 1  # columns of the times of each process

# ---------------------------------------------------------------------- trials

Part = Literal["environment", "adapter", "masks", "sampling", "update", "workers"]


class Config(ExperimentConfig):
    """Training whose environments are those of the preset `quick` of `vslam train`."""

    world: str = option("office", "World family or path.")
    robots: int = option(3, "Number of robots, 1 to 8.", ge=1, le=8, hint="Use 1 to 8 robots.")
    envs: int = option(16, "Number of parallel environments.", ge=1, hint="Use at least one environment.")
    workers: tuple[NonNegative, ...] = option(
        (0, 1, 2), "Numbers of worker processes, 0: this process.", hint="Use 0 for this process."
    )
    steps: int = option(40, "Number of timed steps per number of workers.", ge=2, hint="Use at least two steps.")
    seed: int = option(100, "Seed of the episodes.", ge=0, hint="Use 0 or a positive number.")

    def check(self) -> None:
        """Refuse more workers than environments, and worlds that do not exist."""
        if (most := max(self.workers)) > self.envs:
            raise argument_error("workers", f"at most one per environment, {self.envs}", most, "Use fewer workers.")
        self.environment()

    def training(self) -> TrainConfig:
        """Return the timed training."""
        return TrainConfig(world=self.world, robots=self.robots, envs=self.envs)

    def environment(self) -> EnvConfig:
        """Return the configuration of the environments."""
        return self.training().make_env_config(SPLIT_TRAIN)


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One part of a training, or its environments with a number of workers."""

    part: Part
    workers: int | None  # Number of worker processes; None: a part, in this process


def trials(config: Config) -> list[Trial]:
    """Return the parts, then the numbers of workers."""
    *parts, with_workers = get_args(Part)
    return [Trial(part=part, workers=None) for part in parts] + [
        Trial(part=with_workers, workers=workers) for workers in config.workers
    ]


def play(config: Config, trial: Trial) -> dict[str, Any]:
    """Time a part, or the environments with a number of workers.

    Returns:
        Time of a robot's decision in a part, `median_us` and `min_us`. With workers the `rates` of decisions in each
        step [1/s]; `rate`, over all steps; `beside_us`, the time of a decision outside the environments of the
        slowest process; `balance`, the mean over the maximum of the processes' processor times; relative to one worker
        in the same steps `gains`, in decisions per second, and `work`, the total processor time of the environments,
        above 1 if processes slow each other down.
    """
    slots = config.envs * config.robots
    if trial.workers is None:
        seconds, decisions = PARTS[trial.part](config)
        each = 1e6 / decisions * seconds
        return {"median_us": float(np.median(each)), "min_us": float(each.min())}
    counts = tuple(dict.fromkeys((trial.workers, 1)))
    own, alone = (times := time_workers(config, counts))[0], times[-1]
    whole, of_processors = own.masks + own.steps, own.spent[:, :, PROCESSOR]
    work = of_processors.sum(axis=1) / alone.spent[:, :, PROCESSOR].sum(axis=1)
    return {
        "rates": slots / whole, "rate": slots * len(whole) / float(whole.sum()),
        "beside_us": 1e6 / slots * float(np.median(own.beside)),
        "balance": float(np.median(of_processors.mean(axis=1) / of_processors.max(axis=1))),
        "gains": (alone.masks + alone.steps) / whole, "work": float(np.median(work)),
    }  # fmt: skip


# ---------------------------------------------------------------------- parts


def make_env(config: Config, workers: int = 0) -> Any:
    """Return the environments of the training, after a reset."""
    from training.vec_env import make_vec_env

    env = make_vec_env(config.environment(), config.envs, workers, config.seed, monitor=False)
    env.reset()
    return env


def make_learner(config: Config) -> Any:
    """Return a learner in the environments of the training, on one thread."""
    import torch

    from training.rl.ppo import GoalPPO

    torch.set_num_threads(1)
    training = config.training()
    return GoalPPO(
        env=make_env(config), n_steps=training.max_cycles, batch_size=training.batch, n_epochs=training.epochs, seed=0,
        device="cpu",
    )  # fmt: skip


def seconds_of(call: Callable[[Any], Any], count: int) -> FloatArray:
    """Return the durations of calls (count,) [s] after others that warm up."""
    with no_garbage_collection():
        return clock(call, [None] * (WARM_UP + count))[WARM_UP:]


def time_masks(config: Config) -> tuple[FloatArray, int]:
    """Time the request of all masks."""
    env = make_env(config)
    return seconds_of(lambda _: np.stack(env.env_method("action_masks")), CALLS), env.num_envs


def time_sampling(config: Config) -> tuple[FloatArray, int]:
    """Time the sampling of actions from the network."""
    import torch

    model = make_learner(config)
    seen: Mapping[str, NDArray[Any]] = model.env.reset()
    masks: NDArray[Any] = np.stack(model.env.env_method("action_masks"))

    def act(_: Any) -> None:
        with torch.no_grad():
            model.policy(model.policy.obs_to_tensor(seen)[0], action_masks=masks)

    return seconds_of(act, CALLS), model.env.num_envs


def time_update(config: Config) -> tuple[FloatArray, int]:
    """Time updates of the network from one rollout."""
    model, training = make_learner(config), config.training()
    model.learn(training.rollout)  # fills the buffer and warms up the update

    def update(_: Any) -> None:
        model.train()
        model.finish_update()

    with no_garbage_collection():
        return clock(update, [None] * UPDATES), training.rollout


def time_environment(config: Config) -> tuple[FloatArray, int]:
    """Time the environments, without an adapter."""
    return time_workers(config, (0,))[0].spent[:, 0, CLOCK], config.envs * config.robots


def time_adapter(config: Config) -> tuple[FloatArray, int]:
    """Time the adapter around the environments, outside these."""
    return time_workers(config, (0,))[0].beside, config.envs * config.robots


PARTS: dict[Part, Callable[[Config], tuple[FloatArray, int]]] = {  # durations of calls [s], and decisions of each
    "environment": time_environment, "adapter": time_adapter, "masks": time_masks, "sampling": time_sampling,
    "update": time_update,
}  # fmt: skip


class WorkerTimes(NamedTuple):
    """Durations [s] of N steps with a number of workers; all numbers of workers use the same actions."""

    masks: FloatArray  # (N,) Wall-clock time of requesting the masks
    steps: FloatArray  # (N,) Wall-clock time of the steps
    # (N, P, 2) Wall-clock time and processor time of the environments of each process
    spent: FloatArray

    @property
    def beside(self) -> FloatArray:
        """(N,) Wall-clock time of steps outside the environments of the slowest process: adapter and pipes."""
        return np.asarray(self.steps - self.spent[:, :, CLOCK].max(axis=1))


@lru_cache(maxsize=1)
def time_workers(config: Config, workers: tuple[int, ...]) -> tuple[WorkerTimes, ...]:
    """Time environments with random valid goals, in this process (0 workers) or in workers.

    All numbers of workers run the same episodes and alternate at each step, so that other load affects all equally.
    """
    total = config.steps + WORKERS_WARM_UP
    with ExitStack() as open_now:
        envs = []
        for count in workers:
            envs.append(make_env(config, count))
            open_now.callback(envs[-1].close)
        rng = np.random.default_rng(config.seed)
        times = [WorkerTimes(np.empty(total), np.empty(total), np.empty((total, *env.spent.shape))) for env in envs]
        with no_garbage_collection():
            for step in range(total):
                actions: NDArray[np.int64] | None = None
                for own, env in zip(times, envs, strict=True):
                    begin = time.perf_counter()
                    masks = env.env_method("action_masks")
                    asked = time.perf_counter()
                    actions = drawn(masks, rng) if actions is None else actions
                    chosen = time.perf_counter()
                    env.step(actions)
                    own.masks[step], own.steps[step] = asked - begin, time.perf_counter() - chosen
                    own.spent[step] = env.spent
    return tuple(WorkerTimes(*(each[WORKERS_WARM_UP:] for each in own)) for own in times)


def drawn(masks: Sequence[BoolArray], rng: np.random.Generator) -> NDArray[np.int64]:
    """Return a random valid goal of each robot."""
    return np.array([rng.choice(np.flatnonzero(mask)) for mask in masks], np.int64)


# ---------------------------------------------------------------------- results


def _speedup(rows: Sequence[Row]) -> Estimate:
    """Return the median gain over one worker, step by step, with its 95 % bootstrap interval."""
    gains = np.concatenate([row["gains"] for row in rows])
    return Estimate(float(np.median(gains)), *interval(gains, np.median))


def _median_rate(rows: Sequence[Row]) -> float:
    return float(np.median(np.concatenate([row["rates"] for row in rows])))


def _best_rate(rows: Sequence[Row]) -> float:
    return float(max(max(row["rates"]) for row in rows))


STUDY = Study(
    name="training_speed",
    about="""Time environment, adapter, network and update per decision of a robot, and environments by worker count.

    In processor time: balance is the mean over the slowest worker, work is the total relative to one worker; an
    undisturbed step gains workers x balance / work. Outside: time of a decision outside the environments. Ctrl-C
    finishes the current part; the same command with --out FOLDER resumes the run.
    """,
    config=Config,
    trial=Trial,
    trials=trials,
    play=play,
    checks=lambda config: (require_extra,),
    timed=True,
    tables=(
        ResultTable(
            name="parts", title="Time of one robot's decision, in one process", by=("part",),
            where=lambda row: row["workers"] is None,
            columns=(Column("median_us", "median [us]", digits=1), Column("min_us", "least [us]", digits=1)),
        ),
        ResultTable(
            name="workers", title="Environments only, decisions per second", by=("workers",),
            where=lambda row: row["workers"] is not None,
            columns=(
                Column("median", "median", _median_rate, digits=0), Column("fastest", "fastest", _best_rate, digits=0),
                Column("rate", "mean", digits=0), Column("speedup", "speedup", _speedup, digits=2),
                Column("balance", digits=2), Column("work", digits=2), Column("beside_us", "outside [us]", digits=0),
            ),
        ),
    ),
)  # fmt: skip

if __name__ == "__main__":
    run_program(STUDY)
