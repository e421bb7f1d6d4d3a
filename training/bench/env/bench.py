"""Benchmark `vslam bench env`: trials and tables."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

from rich.console import Console

from training.bench.config import EnvBenchConfig
from training.bench.env.profile import measure_budget
from training.bench.env.timing import (
    PEER,
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
from training.experiments.tables import console_table
from training.experiments.timing import describe_machine, print_caveats, run_named_trials
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
TIMES = ("steps/s", "mean", "median", "99 %", "undis-\nturbed")  # the last: median over the best repeat of each call
MICROS = ("mean_us", "median_us", "p99_us", "undisturbed_us")


class EnvLoad(NamedTuple):
    """Environment to be timed: robots, particles, world, and mode of observations and actions."""

    robots: int
    particles: int
    world: str
    mode: str

    def config(self) -> EnvConfig:
        """Return the configuration of the environment."""
        # Not every building has eight starts 5 m apart.
        apart = {"min_start_distance": 2.0, "shared_start_view": True} if self.robots > 4 else {}
        belief = {"filter": {"num_particles": self.particles}}
        config = EnvConfig().replace(**MODES[self.mode][1])
        return config.replace(world=self.world, num_robots=self.robots, belief=belief, **apart)

    @property
    def title(self) -> str:
        """Description of the load."""
        return f"{self.robots} robots, {self.particles} particles, {self.world}: {MODES[self.mode][0]}"


def run_bench(
    config: EnvBenchConfig,
    on_trial: Callable[[str], None] = lambda name: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> dict[str, Any]:
    """Time all loads, and the base load by part; unfinished results are empty or None.

    Returns:
        `rows`, one per load with the number of `walls` of its world and its times; for the base load `simulator`,
        `budget`, `reset` and `snapshots`; `peer`, simple_spread with the same number of agents, and `ratio_to_peer`,
        the ratio of the first row's step time to the peer's, measured in alternating bursts; `machine`, and `complete`.
    """
    seed, steps, loads = config.seed, config.steps, config.loads()
    base = loads[0].config()
    result: dict[str, Any] = {
        "machine": describe_machine(), "rows": [], "simulator": None, "budget": [], "reset": None, "snapshots": {},
        "peer": None, "ratio_to_peer": None,
    }  # fmt: skip

    def time_row(load: EnvLoad, with_peer: bool = False) -> None:
        env = vslam_v1.parallel_env(config=load.config())
        plays = [play_env(env, seed, steps)]
        if with_peer and (peer := play_peer(load.robots, seed, steps)) is not None:
            plays.append(peer)
        own, *beside = play_alternating(plays, config.plays)
        result["rows"].append({**load._asdict(), "walls": len(env.world.walls), **summarise_us(own)})
        if beside:
            result.update(peer=summarise_us(beside[0]), ratio_to_peer=ratio_of_bursts(own, beside[0]))

    def time_budget() -> None:
        env = vslam_v1.parallel_env(config=base)
        actions = record_actions(env, seed, steps)
        env.reset(seed=seed)
        result["budget"] = measure_budget(env.step, actions)

    def time_others(name: str) -> None:
        env = vslam_v1.parallel_env(config=base)
        if name == "reset":
            result[name] = time_resets(env, seed, min(20, steps))
        else:
            result[name] = time_snapshots(env, seed, min(300, steps), min(60, 4 + steps))

    trials: list[tuple[str, Callable[[], None]]] = [
        (loads[0].title, partial(time_row, loads[0], config.peer)), ("budget", time_budget),
        ("simulator", lambda: result.update(simulator=time_simulator(base, seed, steps))),
        ("reset", partial(time_others, "reset")), ("snapshots", partial(time_others, "snapshots")),
        *((load.title, partial(time_row, load)) for load in loads[1:]),
    ]  # fmt: skip
    result["complete"] = run_named_trials(trials, on_trial, should_stop)
    return result


def count_trials(config: EnvBenchConfig) -> int:
    """Return the number of calls of `on_trial` by `run_bench`."""
    return len(config.loads()) + 4


def print_env_result(console: Console, result: Mapping[str, Any], asked_peer: bool) -> None:
    """Print the rows, the budget of a step, and the other results."""
    rows, peer = result["rows"], result["peer"]
    if rows:
        cells = [
            (f"{row['robots']} {row['particles']} {row['world']} {MODES[row['mode']][0]}", *_times(row)) for row in rows
        ]
        title = "env.step over whole episodes, times in us: robots, particles, world, what is in the loop"
        console.print(console_table(title, ("", *TIMES), cells))
    if result["budget"]:
        columns = ("median_us", "mean_us")
        budget = [(part["phase"], *(f"{part[name]:.0f}" for name in columns)) for part in result["budget"]]
        sums = (f"{sum(part[name] for part in result['budget']):.0f}" for name in columns)
        headings = ("part of a step", "median", "mean")
        console.print(console_table("Budget, first row [us]", headings, [*budget, ("sum", *sums)]))
    others = {"simulator only": result["simulator"], "reset": result["reset"], **result["snapshots"]}
    others[f"{PEER} simple_spread"] = peer
    beside = [(name, *_times(times)) for name, times in others.items() if times is not None]
    console.print(console_table(f"Comparison [us]; {PEER} has neither walls nor SLAM", ("", *TIMES), beside))
    if peer is not None:
        ratio = rows[0]["undisturbed_us"] / peer["undisturbed_us"]
        ratios = (
            f"{result['ratio_to_peer']:.2f} times as long as one of simple_spread in alternation, {ratio:.2f} times"
        )
        console.print(f"A step of the first row takes {ratios} undisturbed.")
    if asked_peer and peer is None and result["complete"]:
        console.print(f"{PEER} is not installed: no peer was timed (pip install {PEER}).")
    print_caveats(console, result)


def _times(times: Mapping[str, Any]) -> tuple[str, ...]:
    return f"{times['per_second_mean']:,.0f}", *(f"{times[name]:.0f}" for name in MICROS)
