"""`EnvBenchConfig`: what `vslam bench env` times; `run_bench`: its trials, one after the other."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

from slam_backend.core.validation import bad_argument, check_int
from training.bench.env.profile import BudgetRow, measure_budget
from training.bench.env.timing import (
    StepTimes,
    play_env,
    play_in_turn,
    play_peer,
    ratio_of_bursts,
    record_actions,
    time_env,
    time_resets,
    time_simulator,
    time_snapshots,
)
from training.experiments.config import PlainConfig, check_each_once
from training.experiments.timed_bench import describe_machine, run_in_turn
from vslam_env import vslam_v0
from vslam_env.config import MAX_ROBOTS, EnvConfig

WARM_UP = 60  # steps: the maps have landmarks then
MODES: dict[str, dict[str, Any]] = {
    "dict": {},
    "flat": {"observation_type": "flat"},
    "goal": {"action_type": "goal", "decision_ticks": 1},
}


@dataclass(frozen=True, slots=True, kw_only=True)
class EnvBenchConfig(PlainConfig):
    """All that decides the benchmark. One number at a time differs from the base, the first of each list.

    Attributes:
        robots: K.
        particles: M of each filter.
        worlds: Families or paths.
        modes: Of observations and actions; `goal` decides at every tick.
        steps: Timed per row.
        plays: How often the episode of a row is played, for the times that other programs do not disturb.
        seed: Of the episodes.
        peer: Also simple_spread of MPE2, in turn with the first row.
    """

    robots: tuple[int, ...] = (3, 1, 2, 4, 6, 8)
    particles: tuple[int, ...] = (100, 30, 300, 1000)
    worlds: tuple[str, ...] = ("office", "fig5", "maze", "hall", "loops")
    modes: tuple[str, ...] = ("dict", "flat", "goal")
    steps: int = 600
    plays: int = 5
    seed: int = 100
    peer: bool = True

    def __post_init__(self) -> None:
        check_int("steps", self.steps, 2, "Time a few steps.")
        check_int("plays", self.plays, 1, "Play each episode once or more.")
        check_int("seed", self.seed, 0, "Use 0 or a positive number.")
        for name in ("robots", "particles", "worlds", "modes"):
            check_each_once(name, getattr(self, name))
        for robots in self.robots:
            if not 1 <= check_int("robots", robots, 1, "Use 1 to 8 robots.") <= MAX_ROBOTS:
                raise bad_argument("robots", f"ints from 1 to {MAX_ROBOTS}", robots, "Use 1 to 8 robots.")
        for mode in self.modes:
            if mode not in MODES:
                raise bad_argument("modes", "some of " + ", ".join(MODES), mode, "Check the spelling.")

    def loads(self) -> list["EnvLoad"]:
        """Return what is timed, row by row, the base first."""
        base = EnvLoad(self.robots[0], self.particles[0], self.worlds[0], self.modes[0])
        rows = [base]
        rows += [EnvLoad(robots, base.particles, base.world, base.mode) for robots in self.robots[1:]]
        rows += [EnvLoad(base.robots, particles, base.world, base.mode) for particles in self.particles[1:]]
        rows += [EnvLoad(base.robots, base.particles, world, base.mode) for world in self.worlds[1:]]
        return rows + [EnvLoad(base.robots, base.particles, base.world, mode) for mode in self.modes[1:]]


@dataclass(frozen=True, slots=True)
class EnvLoad:
    """An environment to time: robots, particles, world, and mode of observations and actions."""

    robots: int
    particles: int
    world: str
    mode: str

    def config(self) -> EnvConfig:
        """Return the environment's configuration."""
        # Eight robots find no starts 5 m apart in every building.
        apart = {"min_start_distance": 2.0, "shared_start_view": True} if self.robots > 4 else {}
        return EnvConfig().replace(
            world=self.world,
            num_robots=self.robots,
            belief={"filter": {"num_particles": self.particles}},
            **MODES[self.mode],
            **apart,
        )


@dataclass(frozen=True, slots=True)
class EnvRow:
    """One load, timed; `walls` of the episode's world."""

    load: EnvLoad
    walls: int
    times: StepTimes

    def to_mapping(self) -> dict[str, Any]:
        """Return it as plain values."""
        return asdict(self.load) | {"walls": self.walls} | asdict(self.times)


@dataclass(frozen=True, slots=True, eq=False)
class EnvBenchResult:
    """What was measured; later parts are empty or None where the user stopped.

    Attributes:
        machine: As `describe_machine` tells.
        rows: In the order of the loads.
        simulator: Ticks of the simulator alone, under the base load.
        budget: Of a step under the base load.
        reset: Of the base environment.
        snapshots: By name.
        peer: simple_spread with as many agents, or None where it is not installed or not asked for.
        ratio: How many times as long as the peer's a step of the first row takes, burst by burst beside it; or None.
        complete: Whether nothing is missing.
    """

    machine: dict[str, Any]
    rows: tuple[EnvRow, ...]
    simulator: StepTimes | None
    budget: tuple[BudgetRow, ...]
    reset: StepTimes | None
    snapshots: Mapping[str, StepTimes]
    peer: StepTimes | None
    ratio: float | None
    complete: bool

    def to_mapping(self) -> dict[str, Any]:
        """Return it as plain values."""
        return {
            "machine": self.machine,
            "rows": [row.to_mapping() for row in self.rows],
            "simulator": None if self.simulator is None else asdict(self.simulator),
            "budget": [asdict(row) for row in self.budget],
            "reset": None if self.reset is None else asdict(self.reset),
            "snapshots": {name: asdict(times) for name, times in self.snapshots.items()},
            "peer": None if self.peer is None else asdict(self.peer),
            "ratio_to_peer": self.ratio,
            "complete": self.complete,
        }


def run_bench(
    config: EnvBenchConfig,
    on_trial: Callable[[str], None] = lambda name: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> EnvBenchResult:
    """Time all loads, and the base load in parts.

    Args:
        config: What is timed.
        on_trial: Called with the name of each trial before it begins.
        should_stop: Asked between trials.
    """
    seed, steps = config.seed, config.steps
    loads = config.loads()
    base = loads[0].config()
    rows: list[EnvRow] = []
    results: dict[str, Any] = {
        "simulator": None,
        "budget": [],
        "reset": None,
        "snapshots": {},
        "peer": None,
        "ratio": None,
    }

    def first_row(load: EnvLoad) -> None:
        env = vslam_v0.parallel_env(config=load.config())
        plays = [play_env(env, seed, WARM_UP + steps)]
        if config.peer and (peer := play_peer(load.robots, seed, WARM_UP + steps)) is not None:
            plays.append(peer)
        own, *beside = play_in_turn(plays, WARM_UP, config.plays)
        rows.append(EnvRow(load, len(env.world.walls), StepTimes.of(own)))
        if beside:
            results.update(peer=StepTimes.of(beside[0]), ratio=ratio_of_bursts(own, beside[0]))

    def row(load: EnvLoad) -> None:
        env = vslam_v0.parallel_env(config=load.config())
        times = time_env(env, seed, steps, WARM_UP, config.plays)
        rows.append(EnvRow(load, len(env.world.walls), times))

    def budget() -> None:
        env = vslam_v0.parallel_env(config=base)
        actions = record_actions(env, seed, WARM_UP + steps)
        env.reset(seed=seed)
        for action in actions[:WARM_UP]:
            env.step(action)
        results["budget"] = measure_budget(env.step, actions[WARM_UP:])

    def keep(name: str, call: Callable[[], Any]) -> Callable[[], None]:
        return lambda: results.update({name: call()})

    trials: list[tuple[str, Callable[[], None]]] = [(_title(loads[0]), partial(first_row, loads[0]))]
    trials += [(_title(load), partial(row, load)) for load in loads[1:]]
    trials.insert(1, ("budget", budget))
    trials.insert(2, ("simulator", keep("simulator", lambda: time_simulator(base, seed, steps, WARM_UP))))
    resets = keep("reset", lambda: time_resets(vslam_v0.parallel_env(config=base), seed, min(20, steps)))
    trials.insert(3, ("reset", resets))
    begun, often = min(300, steps), min(60, 4 + steps)
    snapshots = keep("snapshots", lambda: time_snapshots(vslam_v0.parallel_env(config=base), seed, begun, often))
    trials.insert(4, ("snapshots", snapshots))
    complete = run_in_turn(trials, on_trial, should_stop)
    return EnvBenchResult(
        machine=describe_machine(),
        rows=tuple(rows),
        simulator=results["simulator"],
        budget=tuple(results["budget"]),
        reset=results["reset"],
        snapshots=results["snapshots"],
        peer=results["peer"],
        ratio=results["ratio"],
        complete=complete,
    )


def count_trials(config: EnvBenchConfig) -> int:
    """Return how often `run_bench` calls `on_trial`."""
    return len(config.loads()) + 4


def _title(load: EnvLoad) -> str:
    return f"{load.robots} robots, {load.particles} particles, {load.world}, {load.mode}"
