"""Timing of environments step by step with recorded actions, so that no policy is timed."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np

from agents.registry import make_policy
from slam_backend.core.validation import FloatArray
from training.experiments.machine.timing import clock, no_garbage_collection
from vslam_env import vslam_v1
from vslam_env.config import TICK, EnvConfig
from vslam_env.environment import ExplorationEnv
from vslam_env.simulation.scenario import sample_scenario
from vslam_env.world import Simulator, read_odometry

PEER = "mpe2"  # package of simple_spread, the comparison
SNAPSHOTS = ("get_state", "set_state, same episode", "set_state, another seed", "clone")
BURST = 50  # consecutive calls of one play before the next


def summarise_us(seconds: FloatArray) -> dict[str, float]:
    """Summarise durations (n,) or (repeats, n) [s] of n `calls`.

    `undisturbed_us` is the median over calls of their best repeat; `mean_us` includes rare events and the load of
    other programs; rates are from the median and from the mean.
    """
    micros = 1e6 * np.atleast_2d(seconds)
    median, high = (float(q) for q in np.quantile(micros, (0.5, 0.99)))
    mean, undisturbed = float(micros.mean()), float(np.median(micros.min(axis=0)))
    return {
        "median_us": median, "mean_us": mean, "p99_us": high, "min_us": float(micros.min()),
        "undisturbed_us": undisturbed, "per_second": 1e6 / median, "per_second_mean": 1e6 / mean,
        "calls": micros.shape[1],
    }  # fmt: skip


def record_actions(env: ExplorationEnv, seed: int, steps: int) -> list[dict[str, Any]]:
    """Run an episode with the nearest-frontier policy; return its actions for later plays."""
    env.max_cycles = max(env.max_cycles, steps + 1)
    policies = {agent: make_policy("frontier", env.config.action_type) for agent in env.possible_agents}
    rng = np.random.default_rng(seed)
    observations, _ = env.reset(seed=seed)
    actions = []
    for _ in range(steps):
        # The policy uses only the belief, so that a flat observation works too.
        actions.append({a: policies[a].act(observations[a], env.belief(a), rng) for a in env.agents})
        observations = env.step(actions[-1])[0]
    return actions


@dataclass(frozen=True, slots=True, eq=False)
class Play:
    """Sequence of calls that can be repeated exactly."""

    begin: Callable[[], object]  # Function called before each play
    call: Callable[[Any], Any]  # Timed function
    arguments: Sequence[Any]  # Arguments of its calls, in order


def play_alternating(plays: Sequence[Play], repeats: int) -> FloatArray:
    """Return the durations of the calls of each play (plays, repeats, n) [s]; all plays have n calls.

    Plays alternate in bursts of calls, each with its own order, so that variations of the machine's speed affect all
    of them equally.
    """
    count = len(plays[0].arguments)
    durations = np.empty((len(plays), repeats, count))
    for repeat in range(repeats):
        for play in plays:
            play.begin()
        with no_garbage_collection():
            for burst, first in enumerate(range(0, count, BURST)):
                chosen = slice(first, first + BURST)
                for k in range(len(plays))[:: 1 if (burst + repeat) % 2 == 0 else -1]:
                    durations[k, repeat, chosen] = clock(plays[k].call, plays[k].arguments[chosen])
    return durations


def ratio_of_bursts(ours: FloatArray, others: FloatArray) -> float:
    """Return the ratio of durations (repeats, n) [s] of calls to others run in alternation: the median over bursts."""
    firsts = range(0, ours.shape[1], BURST)
    own, beside = (
        np.array([np.median(each[:, first : first + BURST], axis=1) for first in firsts]) for each in (ours, others)
    )
    return float(np.median(own / beside))


def play_env(env: ExplorationEnv, seed: int, steps: int) -> Play:
    """Return a whole episode of the nearest-frontier policy as a play."""
    actions = record_actions(env, seed, steps)
    env.max_cycles = steps
    return Play(partial(env.reset, seed=seed), env.step, actions)


def time_simulator(config: EnvConfig, seed: int, steps: int) -> dict[str, float]:
    """Time ticks of the simulator: physics, odometry, landmark sensor and scans, without filter and observations."""
    scenario, _ = sample_scenario(config, config.world, np.random.SeedSequence(seed).spawn(1)[0])
    simulator = Simulator(scenario.world, scenario.true_starts, config.robot_radius, TICK)
    odometry, sensor, scan = (np.random.default_rng(seed + i) for i in range(3))
    rng = np.random.default_rng(seed)

    def tick(commands: FloatArray) -> None:
        before = simulator.poses
        simulator.step(commands)
        after = simulator.poses
        read_odometry(before, after, scenario.bias, config.odometry, odometry)
        scenario.sensor.measure(after, sensor)
        scenario.scan.measure(after, scan)

    commands, turn = [], np.zeros(config.num_robots)
    for _ in range(steps):  # random drives with occasional wall contacts
        turn = np.clip(0.9 * turn + 0.4 * rng.standard_normal(config.num_robots), -1.5, 1.5)
        commands.append(np.column_stack([np.full(config.num_robots, 0.5), turn]))
    return _timed(tick, commands, 0)


def _timed(call: Callable[[Any], Any], arguments: Sequence[Any], warm_up: int) -> dict[str, float]:
    """Time calls and discard their results."""
    with no_garbage_collection():
        return summarise_us(clock(call, arguments)[warm_up:])


def time_resets(env: ExplorationEnv, first_seed: int, resets: int) -> dict[str, float]:
    """Time resets with different seeds, not counting the first."""
    return _timed(lambda seed: env.reset(seed=seed), range(first_seed, first_seed + resets + 1), 1)


def time_snapshots(env: ExplorationEnv, seed: int, steps: int, repeats: int) -> dict[str, dict[str, float]]:
    """Time get_state, set_state and clones after `steps` steps of the nearest-frontier policy."""
    record_actions(env, seed, steps)
    state = env.get_state()
    other = vslam_v1.parallel_env(config=env.config)
    other.reset(seed=seed + 1)
    states = [other.get_state(), state]
    some: list[int] = list(range(repeats))
    times = (
        _timed(lambda _: env.get_state(), some, 1), _timed(lambda _: env.set_state(state), some, 1),
        _timed(lambda i: other.set_state(states[i % 2]), some, 2), _timed(lambda _: env.clone(), some, 1),
    )  # fmt: skip
    return dict(zip(SNAPSHOTS, times, strict=True))


def play_peer(agents: int, seed: int, steps: int) -> Play | None:
    """Return an episode of MPE2's simple_spread with random actions as a play, or None if it is not installed."""
    if find_spec(PEER) is None:
        return None
    peer = import_module(f"{PEER}.simple_spread_v3").parallel_env(N=agents, max_cycles=steps + 1)
    peer.reset(seed=seed)
    for agent in peer.agents:
        peer.action_space(agent).seed(seed)
    actions = [{a: peer.action_space(a).sample() for a in peer.agents} for _ in range(steps)]
    return Play(partial(peer.reset, seed=seed), peer.step, actions)
