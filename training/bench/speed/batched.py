"""Study of `vslam bench speed batched`: batched teams beside processes of the environment, on this machine."""

import multiprocessing
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from training.bench.speed.config import BatchedSpeedConfig
from training.experiments.study import Column, ResultTable, Study
from training.rl.config import require_extra
from vslam_env import vslam_v1
from vslam_env.config import EnvConfig

BATCHED, EXACT = "batched", "environment"


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One measurement."""

    kind: str  # `BATCHED` or `EXACT`
    number: int  # Environments of a batch, or processes


def trials(config: BatchedSpeedConfig) -> list[Trial]:
    """Return all trials, the environment first."""
    exact = [Trial(kind=EXACT, number=config.beside)] if config.beside else []
    return [*exact, *(Trial(kind=BATCHED, number=batch) for batch in config.batches)]


def environment(config: BatchedSpeedConfig) -> EnvConfig:
    """Return the environment, which both simulate."""
    return EnvConfig(
        world=config.world, num_robots=config.robots, observation_keys="driver", decision_ticks=config.decision_ticks,
        max_cycles=config.steps + 1,
    )  # fmt: skip


def play(config: BatchedSpeedConfig, trial: Trial) -> dict[str, Any]:
    """Time random driving from the starts on; compiling and resets are not in the rate.

    Returns:
        `ticks_per_second` of all environments together; of batched ones also `compile_s`, `memory_gb` of all states and
        what a step adds, and the number `not_finite` of episodes with a number that is none.
    """
    if trial.kind == EXACT:
        return {"ticks_per_second": _exact(config, trial.number)}
    return _batched(config, trial.number)


def _exact(config: BatchedSpeedConfig, processes: int) -> float:
    """Return the ticks per second of some processes together."""
    seeds = range(config.seed, config.seed + processes)
    # Processes that jax's threads have not touched
    with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn")) as pool:
        spans = list(pool.map(partial(_drive, config), seeds))
    begin, end = min(span[0] for span in spans), max(span[1] for span in spans)
    return processes * config.steps * config.decision_ticks / (end - begin)


def _drive(config: BatchedSpeedConfig, seed: int) -> tuple[float, float]:
    """Run an episode, and return when its first step began and its last one ended [s]."""
    env, rng = vslam_v1.parallel_env(config=environment(config)), np.random.default_rng(seed)
    env.reset(seed=seed)
    env.step({agent: np.zeros(2, np.float32) for agent in env.agents})  # compiles what is not cached
    begin = time.time()
    for _ in range(config.steps):
        env.step({agent: rng.uniform(-1.0, 1.0, 2).astype(np.float32) for agent in env.possible_agents})
    return begin, time.time()


def _batched(config: BatchedSpeedConfig, batch: int) -> dict[str, Any]:
    """Return figures of a batch."""
    import jax
    import jax.numpy as jnp

    from vslam_env.batched.environment import BatchedExploration

    env = BatchedExploration(
        environment(config), num_worlds=min(batch, config.num_worlds), first_seed=config.seed, rows=config.rows
    )
    env.check_batch(batch)

    def decide(state: Any, key: Any) -> Any:
        of_actions, of_step = jax.random.split(key)
        actions = {
            agent: jax.random.uniform(own, (batch, 2), minval=-1.0, maxval=1.0)
            for agent, own in zip(env.agents, jax.random.split(of_actions, len(env.agents)), strict=True)
        }
        observed, state, rewards, *_ = jax.vmap(env.step)(jax.random.split(of_step, batch), state, actions)
        parts = jax.tree.leaves((observed, rewards, state.episode.belief.covariance))
        sums = sum(values.reshape(batch, -1).astype("float32").sum(axis=1) for values in parts)
        return state, jnp.isfinite(sums)  # all observations count

    begin = time.perf_counter()
    reset = jax.jit(jax.vmap(env.reset))
    run: Callable[..., Any] = jax.jit(partial(jax.lax.scan, decide), donate_argnums=0)
    keys = jax.random.split(jax.random.key(config.seed), (config.plays, config.steps))
    _, state = reset(jax.random.split(jax.random.key(0), batch))
    compiled = run.lower(state, keys[0]).compile()  # type: ignore[attr-defined]
    compile_s, seconds, not_finite = time.perf_counter() - begin, 0.0, 0
    for play, of_steps in enumerate(keys):
        _, state = jax.block_until_ready(reset(jax.random.split(jax.random.key(play), batch)))
        begin = time.perf_counter()
        _, is_finite = jax.block_until_ready(compiled(state, of_steps))
        seconds += time.perf_counter() - begin
        not_finite += int((~is_finite).any(axis=0).sum())
    told = compiled.memory_analysis()
    memory = sum(getattr(told, f"{part}_size_in_bytes", 0) for part in ("argument", "output", "temp")) if told else 0
    ticks = config.plays * batch * config.steps * config.decision_ticks
    return {
        "ticks_per_second": ticks / seconds, "compile_s": compile_s, "memory_gb": memory / 1e9,
        "not_finite": not_finite,
    }  # fmt: skip


def checks(config: BatchedSpeedConfig) -> list[Callable[[], object]]:
    """Return the check for the packages, and the construction of the environment."""
    return [partial(require_extra, "jax"), partial(vslam_v1.parallel_env, config=environment(config))]


STUDY = Study(
    name="bench speed batched",
    config=BatchedSpeedConfig,
    trial=Trial,
    trials=trials,
    play=play,
    checks=checks,
    tables=(
        ResultTable(
            name="speed", title="Simulated ticks of 0.1 s a second, all environments together", by=("kind", "number"),
            columns=(
                Column("ticks_per_second", "ticks/s", digits=0), Column("compile_s", "compiling [s]", digits=0),
                Column("memory_gb", "memory [GB]", digits=2), Column("not_finite", "not finite", "sum", digits=0),
            ),
        ),
    ),
)  # fmt: skip
