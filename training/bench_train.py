"""`TrainBenchConfig`: what `vslam bench train` times; where the time of a training goes, and what workers gain."""

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pettingzoo import ParallelEnv
from sb3_contrib import MaskablePPO

from slam_backend.errors import bad_argument, check_int
from training.env_timing import time_steps
from training.learn_config import SPLIT_TRAIN, TrainConfig
from training.learn_network import GoalPolicy
from training.machine_rates import describe_machine
from training.plain_config import PlainConfig
from training.step_timing import no_garbage_collection
from training.timed_bench import goal, run_in_turn
from training.vec_env import ExplorationVecEnv, make_vec_env
from vslam_env import vslam_v0
from vslam_env.config import EnvConfig

GOAL_ADAPTER_US, GOAL_TWO_WORKERS = 5.0, 1.8
ADAPTER_STEPS = 400
WARM_UP = 3
RECORDED = 20  # steps of an environment that are played again and again


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainBenchConfig(PlainConfig):
    """All that decides the benchmark; the environments are those of `vslam train`'s preset `quick`.

    Attributes:
        world: A family or a path.
        robots: K.
        envs: Environments side by side.
        workers: Numbers of processes to time; 0: this one alone.
        steps: Of the environments, timed per number of workers.
        seed: Of the episodes.
    """

    world: str = "office"
    robots: int = 3
    envs: int = 16
    workers: tuple[int, ...] = (0, 1, 2)
    steps: int = 40
    seed: int = 100

    def __post_init__(self) -> None:
        check_int("envs", self.envs, 1, "Use at least one environment.")
        check_int("steps", self.steps, 2, "Time a few steps.")
        check_int("seed", self.seed, 0, "Use 0 or a positive number.")
        for workers in self.workers:
            if not 0 <= check_int("workers", workers, 0, "Use 0 for none.") <= self.envs:
                raise bad_argument("workers", f"at most one per environment, {self.envs}", workers, "Use fewer.")
        self.environment()

    def environment(self) -> EnvConfig:
        """Return the environments' configuration."""
        return TrainConfig(world=self.world, robots=self.robots).make_env_config(SPLIT_TRAIN)


@dataclass(frozen=True, slots=True)
class Part:
    """One part of a training's time, per decision of a robot [us]."""

    name: str
    median_us: float
    min_us: float


@dataclass(frozen=True, slots=True)
class WorkerRow:
    """Decisions of robots per second with a number of workers: by the median step, by the fastest, and by all."""

    workers: int
    per_second: float
    best_per_second: float
    mean_per_second: float


@dataclass(frozen=True, slots=True, eq=False)
class TrainBenchResult:
    """What was measured.

    Attributes:
        machine: As `describe_machine` tells.
        parts: Of a training in one process.
        workers: In the order asked for.
        complete: Whether nothing is missing.
    """

    machine: dict[str, Any]
    parts: tuple[Part, ...]
    workers: tuple[WorkerRow, ...]
    complete: bool

    def goals(self) -> list[dict[str, Any]]:
        """Return goals with what was measured."""
        found = []
        for part in self.parts:
            if part.name == "adapter":
                found.append(goal("adapter, us per decision", part.median_us, GOAL_ADAPTER_US))
        rates = {row.workers: row.per_second for row in self.workers}
        if 2 in rates and 1 in rates:
            found.append(goal("two workers over one", rates[2] / rates[1], GOAL_TWO_WORKERS, at_least=True))
        return found

    def to_mapping(self) -> dict[str, Any]:
        """Return it as plain values."""
        return {
            "machine": self.machine,
            "parts": [asdict(part) for part in self.parts],
            "workers": [asdict(row) for row in self.workers],
            "goals": self.goals(),
            "complete": self.complete,
        }


class Replay(ParallelEnv[str, Any, Any]):  # type: ignore[misc]   # PettingZoo has no type information
    """Gives back what an environment once returned, so that nothing but the adapter around it takes time."""

    render_mode = None

    def __init__(self, config: EnvConfig, seed: int) -> None:
        env = vslam_v0.parallel_env(config=config.replace(max_cycles=RECORDED + 1))
        self.possible_agents = env.possible_agents
        self.agents = env.possible_agents
        self._spaces = env.observation_space(self.agents[0]), env.action_space(self.agents[0])
        rng = np.random.default_rng(seed)
        self._first = env.reset(seed=seed)
        seen, self._told = self._first[0], []
        for _ in range(RECORDED):
            actions = {agent: int(rng.choice(np.flatnonzero(seen[agent]["action_mask"]))) for agent in env.agents}
            self._told.append(env.step(actions))
            seen = self._told[-1][0]
        self._next = 0

    def observation_space(self, agent: str) -> Any:
        """Return that of the environment."""
        return self._spaces[0]

    def action_space(self, agent: str) -> Any:
        """Return that of the environment."""
        return self._spaces[1]

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        """Return what the environment's reset returned."""
        return self._first

    def step(self, actions: Any) -> Any:
        """Return what its next step returned, from the beginning again after the last."""
        self._next = (self._next + 1) % RECORDED
        return self._told[self._next]


def run_bench(
    config: TrainBenchConfig,
    on_trial: Callable[[str], None] = lambda name: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> TrainBenchResult:
    """Time the parts of a training, then the environments alone over workers.

    Args:
        config: What is timed.
        on_trial: Called with the name of each trial before it begins.
        should_stop: Asked between trials.
    """
    parts: list[Part] = []
    rows: list[WorkerRow] = []
    trials: list[tuple[str, Callable[[], None]]] = [
        ("adapter", lambda: parts.extend(time_adapter(config))),
        ("learner", lambda: parts.extend(time_learner(config))),
    ]
    if config.workers:
        trials.append(("workers", lambda: rows.extend(time_workers(config))))
    complete = run_in_turn(trials, on_trial, should_stop)
    for row in rows:
        if row.workers == 0:
            parts.insert(0, Part("environment", 1e6 / row.per_second, 1e6 / row.best_per_second))
    return TrainBenchResult(describe_machine(), tuple(parts), tuple(rows), complete)


def count_trials(config: TrainBenchConfig) -> int:
    """Return how often `run_bench` calls `on_trial`."""
    return 2 + bool(config.workers)


def time_adapter(config: TrainBenchConfig) -> list[Part]:
    """Return what the adapter adds to a decision, and what the masks cost, over environments that take no time."""
    make = partial(Replay, config.environment(), config.seed)
    env = ExplorationVecEnv([make] * config.envs)
    env.reset()
    actions = [np.zeros(env.num_envs, np.int64)] * (ADAPTER_STEPS + 20)
    alone = [make() for _ in range(config.envs)]
    # Reads what the steps return, in turn and once a step: the replay's own time, which is no adapter's.
    bare = time_steps(lambda _: [one.step(None) for one in alone], actions, 20)
    stepped = time_steps(env.step, actions, 20)
    masks = time_steps(lambda _: np.stack(env.env_method("action_masks")), actions, 20)
    per = 1e6 / env.num_envs
    adapter = Part(
        "adapter", per * float(np.median(stepped) - np.median(bare)), per * float(stepped.min() - bare.min())
    )
    return [adapter, Part("masks", per * float(np.median(masks)), per * float(masks.min()))]


def time_learner(config: TrainBenchConfig) -> list[Part]:
    """Return what drawing actions from the network and updating it cost per decision, on one thread."""
    torch.set_num_threads(1)
    chosen = TrainConfig(world=config.world, robots=config.robots, envs=config.envs)
    env = ExplorationVecEnv([partial(Replay, config.environment(), config.seed)] * config.envs)
    model = MaskablePPO(
        GoalPolicy, env, n_steps=chosen.max_cycles, batch_size=chosen.batch, n_epochs=chosen.epochs, seed=0,
        device="cpu",
    )  # fmt: skip
    seen = env.reset()
    masks: NDArray[Any] = np.stack(env.env_method("action_masks"))

    def act(_: Any) -> None:
        with torch.no_grad():
            model.policy(model.policy.obs_to_tensor(seen)[0], action_masks=masks)

    drawn = time_steps(act, [None] * 60, 10)
    model.learn(env.num_envs * chosen.max_cycles)  # fills the buffer, and warms the update up
    updates = []
    for _ in range(3):
        begin = time.perf_counter()
        model.train()
        updates.append(time.perf_counter() - begin)
    per, whole = 1e6 / env.num_envs, 1e6 / (env.num_envs * chosen.max_cycles)
    return [
        Part("network, drawing", per * float(np.median(drawn)), per * float(drawn.min())),
        Part("network, updating", whole * float(np.median(updates)), whole * min(updates)),
    ]


def time_workers(config: TrainBenchConfig) -> list[WorkerRow]:
    """Time the environments under random valid goals, in this process or over workers.

    All of them play the same episodes, and take turns at each step: what else the machine does meets them all alike.
    """
    with ExitStack() as open_now:
        envs = []
        for workers in config.workers:
            env = make_vec_env(config.environment(), config.envs, workers, config.seed)
            open_now.callback(env.close)
            env.reset()
            envs.append(env)
        rng = np.random.default_rng(config.seed)
        seconds = np.empty((len(envs), config.steps + WARM_UP))
        with no_garbage_collection():
            for step in range(config.steps + WARM_UP):
                actions: NDArray[np.int64] | None = None
                for row, env in enumerate(envs):
                    begin = time.perf_counter()
                    masks = env.env_method("action_masks")
                    actions = _drawn(masks, rng) if actions is None else actions
                    env.step(actions)
                    seconds[row, step] = time.perf_counter() - begin
    slots = config.envs * config.robots
    return [
        WorkerRow(
            workers,
            slots / float(np.median(times)),
            slots / float(times.min()),
            slots * len(times) / float(times.sum()),
        )
        for workers, times in zip(config.workers, seconds[:, WARM_UP:], strict=True)
    ]


def _drawn(masks: Sequence[NDArray[Any]], rng: np.random.Generator) -> NDArray[np.int64]:
    return np.array([rng.choice(np.flatnonzero(mask)) for mask in masks], np.int64)
