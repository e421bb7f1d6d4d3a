"""Study of `vslam bench speed env`: steps of environments, their parts, resets and snapshots."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from importlib.util import find_spec
from typing import Any

from training.bench.speed.config import EnvSpeedConfig
from training.bench.speed.plays import (
    PEER,
    SNAPSHOTS,
    play_alternating,
    play_env,
    play_peer,
    ratio_of_bursts,
    record_actions,
    summarise_us,
    time_resets,
    time_simulator,
    time_snapshots,
)
from training.bench.speed.profile import PHASES, REST, measure_budget
from training.experiments.study import Column, ResultTable, Study
from vslam_env import vslam_v1
from vslam_env.config import EnvConfig

ALONE = {"attempts": {"enabled": False}, "filter": {"rejuvenate_every": None}}  # belief without merges and smoothing
MODES: dict[str, tuple[str, dict[str, Any]]] = {  # title and configuration of what is in the loop
    "driver": ("all of version 1", {"observation_keys": "driver"}),
    "poses": ("known poses", {"observation_keys": "driver", "belief": ALONE, "oracle_pose": True}),
    "odometry": ("odometry alone", {
        "observation_keys": "driver", "belief": ALONE,
        "landmark_sensor": {"detection_probability": 0.0, "false_points": 0.0},
    }),
    "identities": ("known identities", {"observation_keys": "driver", "belief": ALONE, "oracle_association": True}),
    "association": ("unknown association", {"observation_keys": "driver", "belief": ALONE}),
    "merging": ("and merging", {"observation_keys": "driver", "belief": {"filter": {"rejuvenate_every": None}}}),
    "all": ("version 1 with candidates and pictures", {"observation_keys": "all"}),
    "flat": ("the same as vectors", {"observation_keys": "all", "observation_type": "flat"}),
    "goal": ("goal actions at each tick", {"observation_keys": "goal", "action_type": "goal", "decision_ticks": 1}),
}  # fmt: skip
STEP, PART, OTHER = "step", "part", "other"  # kinds of trials
SIMULATOR, RESET, SPREAD = "simulator only", "reset", f"{PEER} simple_spread"


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """What is timed, in one environment."""

    kind: str  # `STEP`: `env.step` over an episode; `PART`: part of a step; `OTHER`
    name: str  # Name of the part, or of what else is timed; empty for `STEP`
    robots: int  # K
    particles: int  # M
    world: str  # Family or path
    mode: str  # Key of `MODES`

    def environment(self) -> EnvConfig:
        """Return the configuration of the environment."""
        # Not every building has eight starts 5 m apart.
        apart = {"min_start_distance": 2.0, "shared_start_view": True} if self.robots > 4 else {}
        belief = {"filter": {"num_particles": self.particles}}
        config = EnvConfig().replace(**MODES[self.mode][1])
        return config.replace(world=self.world, num_robots=self.robots, belief=belief, **apart)


def trials(config: EnvSpeedConfig) -> list[Trial]:
    """Return all trials: steps of the base, its parts and all else about it, then steps with one number changed."""
    base = Trial(
        kind=STEP, name="", robots=config.robots[0], particles=config.particles[0], world=config.worlds[0],
        mode=config.modes[0],
    )  # fmt: skip
    with_peer = config.peer and find_spec(PEER) is not None
    others = (*((SPREAD,) if with_peer else ()), SIMULATOR, RESET, *SNAPSHOTS)
    names = "robots", "particles", "world", "mode"
    lists = zip(names, (config.robots, config.particles, config.worlds, config.modes), strict=True)
    changed: list[dict[str, Any]] = [{name: value} for name, values in lists for value in values[1:]]
    return [
        base, *(replace(base, kind=PART, name=name) for name in (*(phase.name for phase in PHASES), REST)),
        *(replace(base, kind=OTHER, name=name) for name in others), *(replace(base, **change) for change in changed),
    ]  # fmt: skip


def play(config: EnvSpeedConfig, trial: Trial) -> dict[str, Any]:
    """Time a trial; what is measured together is measured once.

    Returns:
        Times as `summarise_us` gives them; for `STEP` also the number of `walls` of its world, for `SPREAD` also
        `ratio`, that of a step of the base to it, in alternating bursts; for `PART` `median_us` and `mean_us`.
    """
    load = replace(trial, kind=STEP, name="")
    if trial.kind == PART:
        return _parts(load, config.seed, config.steps)[trial.name]
    if trial.kind == STEP or trial.name == SPREAD:
        return _steps(load, config, load == trials(config)[0])[trial.name]
    if trial.name == SIMULATOR:
        return time_simulator(load.environment(), config.seed, config.steps)
    if trial.name == RESET:
        return time_resets(vslam_v1.parallel_env(config=load.environment()), config.seed, min(20, config.steps))
    return _snapshots(load, config.seed, min(300, config.steps), min(60, 4 + config.steps))[trial.name]


@lru_cache(maxsize=1)
def _steps(load: Trial, config: EnvSpeedConfig, is_base: bool) -> dict[str, dict[str, Any]]:
    """Time whole episodes, of the base in alternation with simple_spread of as many agents."""
    env = vslam_v1.parallel_env(config=load.environment())
    plays = [play_env(env, config.seed, config.steps)]
    if is_base and config.peer and (peer := play_peer(load.robots, config.seed, config.steps)) is not None:
        plays.append(peer)
    own, *beside = play_alternating(plays, config.plays)
    found: dict[str, dict[str, Any]] = {"": summarise_us(own) | {"walls": len(env.world.walls)}}
    if beside:
        found[SPREAD] = summarise_us(beside[0]) | {"ratio": ratio_of_bursts(own, beside[0])}
    return found


@lru_cache(maxsize=1)
def _parts(load: Trial, seed: int, steps: int) -> dict[str, dict[str, Any]]:
    """Time the parts of a step over an episode."""
    env = vslam_v1.parallel_env(config=load.environment())
    actions = record_actions(env, seed, steps)
    env.reset(seed=seed)
    return measure_budget(env.step, actions)


@lru_cache(maxsize=1)
def _snapshots(load: Trial, seed: int, steps: int, repeats: int) -> dict[str, dict[str, float]]:
    """Time snapshots in the course of an episode."""
    return time_snapshots(vslam_v1.parallel_env(config=load.environment()), seed, steps, repeats)


def checks(config: EnvSpeedConfig) -> list[Callable[[], object]]:
    """Return the construction of each environment."""
    return [partial(vslam_v1.parallel_env, config=t.environment()) for t in trials(config) if t.kind == STEP]


TIMES = (
    Column("per_second_mean", "steps/s", digits=0), Column("mean_us", "mean [us]", digits=0),
    Column("median_us", "median [us]", digits=0), Column("p99_us", "99 % [us]", digits=0),
    Column("undisturbed_us", "undisturbed [us]", digits=0),
)  # fmt: skip

STUDY = Study(
    name="env",
    config=EnvSpeedConfig,
    trial=Trial,
    trials=trials,
    play=play,
    timed=True,
    checks=checks,
    tables=(
        ResultTable(
            name="steps", title="env.step over whole episodes", by=("robots", "particles", "world", "mode"),
            columns=TIMES, words={"mode": ("in the loop", lambda mode: MODES[mode][0])},
            where=lambda row: row["kind"] == STEP,
            note="undisturbed: median over calls of the best repeat.",
        ),
        ResultTable(
            name="parts", title="Parts of a step, first row", by=("name",), pooled=("name",),
            columns=(
                Column("median_us", "median [us]", "sum", digits=0), Column("mean_us", "mean [us]", "sum", digits=0)
            ),
            where=lambda row: row["kind"] == PART,
        ),
        ResultTable(
            name="others", title="All else, first row", by=("name",), where=lambda row: row["kind"] == OTHER,
            columns=(*TIMES, Column("ratio", digits=2)),
            note=f"{PEER}, where it is installed, has neither walls nor SLAM; ratio: a step of the first row over "
            "one of its, in alternation.",
        ),
    ),
)  # fmt: skip
