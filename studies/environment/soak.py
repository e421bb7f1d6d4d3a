"""Soak test of environments with random configurations; invariants are checked at every step.

python -m studies.environment.soak --episodes 700
"""

import hashlib
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from studies.environment.scale import memory_mb
from training.commands.study import run_program
from training.experiments.config import ExperimentConfig, first_seed, option
from training.experiments.study import Column, ResultTable, Row, Study
from vslam_env import EnvConfig, ExplorationEnv, preset_config, vslam_v1
from vslam_env.belief.observation_keys import SETS
from vslam_env.world import WORLD_FAMILIES
from vslam_env.world.clearance import distances_to_walls

SKIN = 0.005  # allowed penetration of a robot into walls and robots [m]
AGAIN_STEPS = 40  # number of repeated steps of an episode
EVERY = 8  # interval of repeated episodes


class Config(ExperimentConfig):
    """Episodes with random configurations and actions."""

    episodes: int = option(700, "Number of episodes.", ge=1, hint="Use at least one episode.")
    seed: int = first_seed()


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One episode."""

    seed: int  # Seed of the configuration, the episode and the actions


def trials(config: Config) -> list[Trial]:
    """Return all trials."""
    return [Trial(seed=seed) for seed in range(config.seed, config.seed + config.episodes)]


def play(config: Config, trial: Trial) -> dict[str, Any]:
    """Run an episode of random actions, and check what each step returns.

    The beginning of each eighth episode is repeated beside another environment, from a state, and in another process
    with another hash seed: all must return the same bytes.

    Returns:
        `action_type`; number of `steps`; whether it was `repeated`; `digest` of all that was returned; `memory_mb`.

    Raises:
        AssertionError: If an invariant is violated.
    """
    seed, repeated = trial.seed, trial.seed % EVERY == 0
    if repeated:
        reference = beginning(seed)
        assert beginning(seed, beside=True) == reference, f"episode {seed} differs beside another environment"
        assert beginning(seed, restored_at=AGAIN_STEPS // 2) == reference, f"episode {seed} differs from a state"
        assert in_another_process(seed, 1 + seed) == reference, f"episode {seed} differs in another process"
    rng, total, steps = np.random.default_rng(seed), hashlib.sha256(), 0
    env = vslam_v1.parallel_env(config=random_config(rng))
    returned: tuple[Any, ...] = env.reset(seed=seed)
    check(env, returned)
    digest(returned, total)
    while env.agents:
        returned = env.step(random_actions(env, rng))
        check(env, returned)
        digest(returned, total)
        steps += 1
    return {
        "action_type": env.config.action_type, "steps": steps, "repeated": repeated, "digest": total.hexdigest(),
        "memory_mb": memory_mb(),
    }  # fmt: skip


def random_config(rng: np.random.Generator) -> EnvConfig:
    """Sample a configuration; few particles, for many steps."""
    robots, loss = int(rng.integers(1, 6)), 0.0 if rng.random() < 0.5 else float(rng.uniform(0.1, 0.8))
    action_type = str(rng.choice(["continuous", "discrete", "goal"]))
    return preset_config(str(rng.choice(["easy", "standard", "hard"]))).replace(
        world=str(rng.choice(sorted(WORLD_FAMILIES))),
        num_robots=robots,
        action_type=action_type,
        decision_ticks=int(rng.integers(1, 6)) if action_type == "goal" else int(rng.integers(1, 3)),
        observation_type=str(rng.choice(["dict", "flat"])),
        observation_keys=str(rng.choice(list(SETS))),
        max_cycles=int(rng.integers(50, 500)),
        min_start_distance=float(rng.uniform(1.0, 4.0)),
        shared_start_view=True,
        stop_at_recall=None if rng.random() < 0.8 else 0.3,
        oracle_pose=bool(rng.random() < 0.1),
        oracle_association=bool(rng.random() < 0.2),
        oracle_merge=bool(rng.random() < 0.2),
        oracle_floor=bool(rng.random() < 0.2),
        comm_range=None if rng.random() < 0.5 else float(rng.uniform(3.0, 12.0)),
        comm_line_of_sight=bool(rng.random() < 0.2),
        comm_loss=loss,
        comm_outage_seconds=0.0 if loss == 0.0 or rng.random() < 0.5 else float(rng.uniform(1.0, 30.0)),
        reward={"map_error": 1.0, "coverage": 0.1, "recall": 0.1, "collisions": 0.01, "pose_uncertainty": 0.1},
        belief={"filter": {"num_particles": int(rng.integers(3, 40))}},
    )


def random_actions(env: ExplorationEnv, rng: np.random.Generator) -> dict[str, Any]:
    """Sample an action for each robot, biased ahead, so that robots travel and hit walls."""
    if env.config.action_type == "continuous":
        return {a: np.array([rng.uniform(-0.2, 1.0), 0.5 * rng.uniform(-1, 1)], np.float32) for a in env.agents}
    count = 4 if env.config.action_type == "discrete" else 17
    return {agent: int(rng.choice([1, int(rng.integers(count))])) for agent in env.agents}


def digest(value: Any, into: "hashlib._Hash") -> None:
    """Feed nested dicts, sequences, arrays and numbers into a hash."""
    if isinstance(value, Mapping):
        for key, entry in value.items():
            into.update(repr(key).encode())
            digest(entry, into)
    elif isinstance(value, (tuple, list)):
        for entry in value:
            digest(entry, into)
    else:
        into.update(np.asarray(value).tobytes())


def check(env: ExplorationEnv, returned: tuple[Any, ...]) -> None:
    """Raise AssertionError if an invariant is violated."""
    observations, infos = returned[0], returned[-1]
    for agent, observation in observations.items():
        assert env.observation_space(agent).contains(observation), f"observation of {agent} outside its space"
    for agent, info in infos.items():
        assert all(np.isfinite(value) for value in info.values()), f"info of {agent} not finite: {info}"
        assert all(0.0 <= info[share] <= 1.0 for share in ("coverage", "map_recall", "map_precision")), info
    if len(returned) == 5:
        assert all(np.isfinite(reward) for reward in returned[1].values()), "a reward is not finite"
    assert np.isfinite(env.state()).all(), "state() is not finite"
    places, radius = env.true_poses[:, :2], env.config.robot_radius
    assert distances_to_walls(places, env.world.walls).min() >= radius - SKIN, "a robot is inside a wall"
    gaps = [float(np.linalg.norm(places[i] - places[j])) for i, j in combinations(range(len(places)), 2)]
    assert min(gaps, default=np.inf) >= 2.0 * radius - 2.0 * SKIN, "two robots overlap"


def beginning(
    seed: int, steps: int = AGAIN_STEPS, beside: bool = False, restored_at: int | None = None
) -> str:  # fmt: skip
    """Return the hash of the first steps of an episode in a new environment.

    Args:
        beside: Whether another environment steps in between.
        restored_at: Step after which an environment made from the state goes on; None: none.
    """
    rng = np.random.default_rng(seed)
    env = vslam_v1.parallel_env(config=random_config(rng))
    other, other_rng = vslam_v1.parallel_env(world="fig5", num_robots=2, num_particles=5), np.random.default_rng(1)
    if beside:
        other.reset(seed=seed + 1)
    total = hashlib.sha256()
    digest(env.reset(seed=seed), total)
    for step in range(steps):
        if not env.agents:
            break
        if step == restored_at:
            state, env = env.get_state(), vslam_v1.parallel_env(config=env.config)
            env.set_state(state)
        digest(env.step(random_actions(env, rng)), total)
        if beside and other.agents:
            other.step(random_actions(other, other_rng))
    return total.hexdigest()


def in_another_process(seed: int, hash_seed: int, steps: int = AGAIN_STEPS) -> str:
    """Return the result of `beginning` in another process with another hash seed."""
    program = f"from studies.environment import soak; print(soak.beginning({seed}, {steps}))"
    root, own = str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")
    changed = {"PYTHONHASHSEED": str(hash_seed), "PYTHONPATH": os.pathsep.join(filter(None, (root, own)))}
    done = subprocess.run(
        [sys.executable, "-c", program], env=os.environ | changed, capture_output=True, text=True, check=True
    )
    return done.stdout.split()[-1]


def _memory(place: int, rows: Sequence[Row]) -> float | None:
    """Return the memory after an episode, in the order of the rows [MB]."""
    found: float | None = rows[place]["memory_mb"]
    return found


STUDY = Study(
    name="env_soak",
    about="""Run episodes with random configurations and actions, and check invariants at each step.

    No robot is inside a wall or another robot; observations are in their spaces; rewards, infos and `state()` are
    finite; shares are in [0, 1]. The beginning of each eighth episode is repeated beside another environment, from a
    state, and in another process. The first violated invariant ends the test with an AssertionError; the same command
    with --out FOLDER goes on.
    """,
    config=Config,
    trial=Trial,
    trials=trials,
    play=play,
    quick={"episodes": 8},
    tables=(
        ResultTable(
            name="episodes", title="Episodes in which all invariants hold", by=("action_type",),
            pooled=("action_type",),
            columns=(
                Column("episodes", statistic=len, digits=0), Column("steps", statistic="sum", digits=0),
                Column("repeated", statistic="sum", digits=0),
                Column("memory_mb", "memory after the first [MB]", partial(_memory, 0), digits=0),
                Column("memory_mb", "after the last [MB]", partial(_memory, -1), digits=0),
            ),
        ),
    ),
)  # fmt: skip

if __name__ == "__main__":
    run_program(STUDY)
