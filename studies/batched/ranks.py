"""Ranks of drivers in batched teams and in the environment: what is better there, must be better here.

python -m studies.batched.ranks --world office --policies random,spin,wall,frontier,runs/driver
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import kendalltau

from agents.driver_network import outputs
from agents.trained import load_model
from slam_backend.core.validation import FloatArray, argument_error
from training.bench.exploration.players import label
from training.commands.study import run_program
from training.experiments.config import ExperimentConfig, NoisePreset, RobotCount, first_seed, option
from training.experiments.study import Column, ResultTable, Row, Study
from training.rl.config import require_extra
from vslam_env import vslam_v1
from vslam_env.config import EnvConfig
from vslam_env.navigation import CELL
from vslam_env.presets import preset_config

Driver = Callable[[Mapping[str, Any], np.random.Generator], FloatArray]  # speed and turn in [-1, 1]
TICKS, ROBOT_WIDTH = 10, 0.5
LEAST_TAU = 0.8  # with which ranks count as the same

# ---------------------------------------------------------------------- drivers


def _avoiding(speed: float, turn: float, scan: NDArray[np.float32]) -> FloatArray:
    """Return an action that turns to the freer side before walls."""
    middle = len(scan) // 2
    ahead = scan[middle - 6 : middle + 6].min()
    if ahead < 1.2:
        turn = 0.7 if scan[middle:].mean() > scan[:middle].mean() else -0.7
    return np.array([min(speed, max(ahead - 0.5, 0.0)), turn])


def random(seen: Mapping[str, Any], rng: np.random.Generator) -> FloatArray:
    """Drive on, and turn at random."""
    return _avoiding(0.6, rng.normal(0.0, 0.4), seen["scan"])


def spin(seen: Mapping[str, Any], rng: np.random.Generator) -> FloatArray:
    """Turn on the spot."""
    return np.array([0.0, 0.5])


def wall(seen: Mapping[str, Any], rng: np.random.Generator) -> FloatArray:
    """Keep a wall on the right at a metre, as the rightmost rays see it."""
    scan = seen["scan"]
    return _avoiding(0.6, float(np.clip(0.5 * (2.2 - scan[:4].min()), -0.5, 0.5)), scan)


def frontier(seen: Mapping[str, Any], rng: np.random.Generator) -> FloatArray:
    """Drive towards the nearest free cell in the picture that lies beside an unknown one, the straight ones first."""
    free, occupied = (seen["local_grid"][channel] > 0 for channel in (0, 1))
    unknown = np.pad(~(free | occupied), 1)
    beside = unknown[:-2, 1:-1] | unknown[2:, 1:-1] | unknown[1:-1, :-2] | unknown[1:-1, 2:]
    rows, columns = np.nonzero(free & beside)
    ahead, left = (23.5 - rows) * CELL, (23.5 - columns) * CELL
    far = np.hypot(ahead, left)
    keep = far > 2.0 * ROBOT_WIDTH
    if not keep.any():
        return _avoiding(0.6, 0.0, seen["scan"])
    bearing = np.arctan2(left, ahead)[keep]
    best = np.argmin(far[keep] + 2.0 * np.abs(bearing))
    turn = float(np.clip(bearing[best] / 1.5, -1.0, 1.0))
    return _avoiding(0.6 * max(np.cos(bearing[best]), 0.0), turn, seen["scan"])


DRIVERS: dict[str, Driver] = {"random": random, "spin": spin, "wall": wall, "frontier": frontier}


def driver(name: str) -> Driver:
    """Return a driver by name, or the model at a path, which takes its means."""
    if name in DRIVERS:
        return DRIVERS[name]
    weights, _ = load_model(name, "policies")

    def act(seen: Mapping[str, Any], rng: np.random.Generator) -> FloatArray:
        batch = {key: np.asarray(values)[None] for key, values in seen.items()}
        return np.asarray(np.clip(outputs(weights, batch)[0], -1.0, 1.0))

    return act


# ---------------------------------------------------------------------- trials


class Config(ExperimentConfig):
    """Episodes of each driver in the same worlds, in batched teams and in the environment."""

    seeds: int = option(8, "Number of seeds.", ge=1, hint="Use at least one seed.")
    seed: int = first_seed()
    world: str = option("office", "World family or path.")
    preset: NoisePreset = option("standard", "Noise preset: easy, standard, hard.")
    robots: RobotCount = option(3, "Number of robots.", hint="Use 1 to 8 robots.")
    rows: int = option(256, "Number of landmarks for which a belief has room.", ge=16, hint="Use 16 rows or more.")
    policies: tuple[str, ...] = option(tuple(DRIVERS), "Drivers: random, spin, wall, frontier, or paths of models.")
    duration: float = option(
        100.0, "Simulated time of an episode [s].", name="max_seconds", ge=1.0, hint="Give seconds."
    )

    def check(self) -> None:
        """Refuse drivers that do not exist, a single one, and what batched teams cannot do."""
        if len(self.policies) < 2:
            raise argument_error("policies", "at least two", self.policies, "One has no rank.")
        for name in self.policies:
            driver(name)
        require_extra("jax")
        environment(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One driver in one world."""

    policy: str
    seed: int


def trials(config: Config) -> list[Trial]:
    """Return all trials, ordered by seed."""
    seeds = range(config.seed, config.seed + config.seeds)
    return [Trial(policy=policy, seed=seed) for seed in seeds for policy in config.policies]


def environment(config: Config) -> EnvConfig:
    """Return the environment of all episodes; decisions hold for a second."""
    return preset_config(config.preset).replace(
        world=config.world, num_robots=config.robots, decision_ticks=TICKS, max_seconds=config.duration,
        observation_keys="driver",
    )  # fmt: skip


def play(config: Config, trial: Trial) -> dict[str, float]:
    """Run a driver in a world of both.

    Returns:
        `exact` and `batched`: map error E [m] at the end, mean over the robots.
    """
    drive = driver(trial.policy)
    env, rng = vslam_v1.parallel_env(config=environment(config)), np.random.default_rng(trial.seed)
    seen, infos = env.reset(seed=trial.seed)
    while env.agents:
        seen, *_, infos = env.step({agent: _action(drive(seen[agent], rng)) for agent in env.agents})
    exact = float(np.mean([info["map_error"] for info in infos.values()]))
    return {"exact": exact, "batched": _in_batch(config, drive, trial.seed)}


def _action(action: FloatArray) -> NDArray[np.float32]:
    return np.clip(action, -1.0, 1.0).astype(np.float32)


@lru_cache(maxsize=1)
def _compiled(config: Config) -> tuple[Any, Any, Any]:
    """Return the batched environment with all worlds, and its compiled functions."""
    import jax

    from vslam_env.batched.environment import BatchedExploration

    env = BatchedExploration(environment(config), num_worlds=config.seeds, first_seed=config.seed, rows=config.rows)
    return env, env.reset_in, jax.jit(env.step_env)


def _in_batch(config: Config, drive: Driver, seed: int) -> float:
    """Return the map error at the end of an episode of a batched team."""
    import jax

    env, reset, step = _compiled(config)
    rng, keys = np.random.default_rng(seed), jax.random.split(jax.random.key(seed), env.rules.cycles + 1)
    seen, state = reset(seed - config.seed, keys[0])
    for key in keys[1:]:
        named = jax.tree.map(np.asarray, seen)
        seen, state, _, _, infos = step(key, state, {agent: _action(drive(named[agent], rng)) for agent in env.agents})
    return float(np.mean(infos["map_error"]))


# ---------------------------------------------------------------------- results


def tau(rows: Sequence[Row]) -> float:
    """Return Kendall's tau between the drivers' mean errors in both."""
    names = sorted({row["policy"] for row in rows})
    means = [[np.mean([row[kind] for row in rows if row["policy"] == name]) for name in names] for kind in KINDS]
    return float(kendalltau(*means).statistic)


KINDS = "exact", "batched"
STUDY = Study(
    name="ranks",
    about="""Rank drivers in batched teams and in the environment, in the same worlds.

    Drivers see the picture of their surroundings, the scan and teammates, and decide once a second. Their order by map
    error counts as the same if Kendall's tau is at least 0.8.
    """,
    config=Config,
    trial=Trial,
    trials=trials,
    play=play,
    checks=lambda config: (partial(vslam_v1.parallel_env, config=environment(config)),),
    quick={"world": "fig5", "robots": 2, "seeds": 1, "duration": 5.0, "policies": ("random", "spin"), "rows": 64},
    tables=(
        ResultTable(
            name="errors", title="Map error E [m] at the end", by=("policy",),
            words={"policy": ("policy", label)},
            columns=(
                Column("exact", "environment", interval=True), Column("batched", "batched", interval=True),
            ),
        ),
        ResultTable(
            name="ranks", title="Do both have the same order?", by=(),
            columns=(Column("tau", "Kendall's tau", tau, digits=2),),
        ),
    ),
)  # fmt: skip

if __name__ == "__main__":
    run_program(STUDY)
