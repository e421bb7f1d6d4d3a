"""Soak test of environments with random configurations; invariants are checked at every step.

    python -m studies.env_soak --steps 200000 --keep soak.state

The same command resumes from the last snapshot after a kill. Checked at each step: no robot is inside a wall or another
robot; observations are in their spaces; rewards, infos and `state()` are finite; shares are in [0, 1]. At intervals,
the beginning of an episode is repeated in a new environment, with another environment stepping in between, and in
another process with another hash seed: all must return the same bytes. Memory use is recorded. The chained hash of all
returned values is printed; it is the same for a run that was killed and resumed.
"""

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")

import hashlib
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from slam_backend.core.validation import check_int
from vslam_env import EnvConfig, ExplorationEnv, load_state, preset_config, save_state, vslam_v1
from vslam_env.belief.observation_keys import SETS
from vslam_env.world import WORLD_FAMILIES
from vslam_env.world.clearance import distances_to_walls

SKIN = 0.005  # allowed penetration of a robot into walls and robots [m]
AGAIN_STEPS = 40  # number of repeated steps of an episode
EVERY = 8  # interval of repeated episodes
ANSWER = "digest "


def random_config(rng: np.random.Generator) -> EnvConfig:
    """Sample a configuration; few particles, for many steps."""
    robots = int(rng.integers(1, 6))
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
        comm_range=None if rng.random() < 0.5 else float(rng.uniform(3.0, 12.0)),
        comm_line_of_sight=bool(rng.random() < 0.2),
        comm_loss=0.0 if rng.random() < 0.5 else float(rng.uniform(0.0, 0.8)),
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


def beginning(seed: int, steps: int, beside: bool) -> str:
    """Return the hash of the first steps of an episode in a new environment, optionally with another in between."""
    rng = np.random.default_rng(seed)
    env = vslam_v1.parallel_env(config=random_config(rng))
    other, other_rng = vslam_v1.parallel_env(world="fig5", num_robots=2, num_particles=5), np.random.default_rng(1)
    if beside:
        other.reset(seed=seed + 1)
    total = hashlib.sha256()
    digest(env.reset(seed=seed), total)
    for _ in range(steps):
        if not env.agents:
            break
        digest(env.step(random_actions(env, rng)), total)
        if beside and other.agents:
            other.step(random_actions(other, other_rng))
    return total.hexdigest()


def in_another_process(seed: int, steps: int, hash_seed: int) -> str:
    """Return the result of `beginning` in another process with another hash seed."""
    done = subprocess.run(
        [sys.executable, __file__, "--beginning", str(seed), "--steps", str(steps)],
        env=os.environ | {"PYTHONHASHSEED": str(hash_seed)},
        capture_output=True,
        text=True,
        check=True,
    )
    return next(line for line in done.stdout.splitlines() if line.startswith(ANSWER)).removeprefix(ANSWER)


def memory_mb() -> float:
    """Return the resident memory of this process [MB], or NaN if the system does not report it."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except OSError:
        return float("nan")
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


@dataclass(slots=True)
class Soak:
    """Progress of a soak test: its complete state, except for the environment."""

    seed: int
    steps: int = 0
    episodes: int = 0
    chain: str = ""
    again: int = 0
    rng_state: Any = None

    def run(self, until: int, keep: Path | None, keep_every: int = 2000, log: Any = lambda text: None) -> None:
        """Step until the given number of steps, with regular snapshots if a file is given."""
        env, rng = self._restored(keep) if self.rng_state is not None else self._begun()
        begin, first, memory = time.perf_counter(), self.steps, float("nan")
        while self.steps < until:
            if not env.agents:
                env, rng = self._begun()
            returned = env.step(random_actions(env, rng))
            self.steps += 1
            self._take(env, returned)
            if self.steps - first == max((until - first) // 4, 1):
                memory = memory_mb()  # after a quarter kernels are loaded and caches are full
            if keep is not None and (self.steps % keep_every == 0 or self.steps == until):
                self.rng_state = rng.bit_generator.state
                save_state(env.get_state() | {"soak": self._numbers()}, keep)
                rate = (self.steps - first) / (time.perf_counter() - begin)
                log(f"{self.steps} steps, {self.episodes} episodes, {rate:.0f} per second, {memory_mb():.0f} MB")
        log(f"memory: {memory:.0f} MB after a quarter, {memory_mb():.0f} MB at the end")

    @classmethod
    def resumed(cls, keep: Path) -> "Soak":
        """Return the soak test from the snapshot in a file."""
        return cls(**load_state(keep)["soak"])

    def _numbers(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in self.__slots__}

    def _restored(self, keep: Path | None) -> tuple[ExplorationEnv, np.random.Generator]:
        assert keep is not None
        state, rng = load_state(keep), np.random.default_rng()
        rng.bit_generator.state = self.rng_state
        env = vslam_v1.parallel_env(config=state["config"])
        env.set_state(state)
        return env, rng

    def _begun(self) -> tuple[ExplorationEnv, np.random.Generator]:
        """Start the next episode; every eighth is also repeated beside another environment and in another process."""
        seed = 1000 * self.seed + self.episodes
        if self.episodes % EVERY == 0:
            reference = beginning(seed, AGAIN_STEPS, False)
            assert beginning(seed, AGAIN_STEPS, True) == reference, (
                f"episode {seed} differs with another environment in between"
            )
            assert in_another_process(seed, AGAIN_STEPS, 1 + seed) == reference, (
                f"episode {seed} differs in another process"
            )
            self.again += 1
        rng = np.random.default_rng(seed)
        env = vslam_v1.parallel_env(config=random_config(rng))
        self._take(env, env.reset(seed=seed))
        self.episodes += 1
        return env, rng

    def _take(self, env: ExplorationEnv, returned: tuple[Any, ...]) -> None:
        check(env, returned)
        total = hashlib.sha256(self.chain.encode())
        digest(returned, total)
        self.chain = total.hexdigest()


def main(
    steps: Annotated[int, typer.Option(help="Total number of environment steps.")] = 200_000,
    seed: Annotated[int, typer.Option(help="Seed of configurations and actions.")] = 0,
    keep: Annotated[Path | None, typer.Option(help="File of snapshots; an existing one is resumed.")] = None,
    beginning_of: Annotated[
        int | None, typer.Option("--beginning", help="Only print the hash of the first steps of this seed's episode.")
    ] = None,
) -> None:
    """Run the soak test; the first violated invariant ends it with an AssertionError."""
    check_int("steps", steps, 1, "Use at least one step.")
    if beginning_of is not None:
        typer.echo(ANSWER + beginning(check_int("beginning", beginning_of, 0, "Give a seed."), steps, False))
        return
    soak = Soak.resumed(keep) if keep is not None and keep.exists() else Soak(seed)
    if soak.steps:
        typer.echo(f"Resuming after {soak.steps} steps.")
    soak.run(steps, keep, log=typer.echo)
    typer.echo(
        f"{soak.steps} steps in {soak.episodes} episodes, {soak.again} repeated: all invariants hold. {soak.chain}"
    )


if __name__ == "__main__":
    typer.run(main)
