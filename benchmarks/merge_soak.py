"""Are wrong merges avoided, or found and undone? Episodes in random worlds whose landmarks look alike, back to back.

    python benchmarks/merge_soak.py --minutes 10 --json merge_soak.json
    python benchmarks/merge_soak.py --minutes 10 --forced

Worlds, numbers of robots, radios and the share of landmarks that look like others change from episode to episode. A
merge is false if it is more than 0.5 m or 5 degrees off; it counts if it is in force 200 steps later or at the end.
With `--forced` robots do not merge by themselves: once two maps are large enough they are merged by a wrong motion,
with the pairs of landmarks that it brings closest, and the question is how many of these the team undoes, and when.
"""

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")

import json
import time
from dataclasses import asdict, dataclass
from itertools import count
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console

from agents.registry import make_policy
from slam_backend.alignment import Alignment
from slam_backend.errors import FloatArray, bad_argument, check_int
from slam_backend.geometry import between, compose
from training.episode import is_false_merge
from training.run_folder import check_writable, plain
from vslam_env import ExplorationEnv, preset_config

WORLDS = ("office", "loops", "maze", "hall", "fig5")
REPEATED = (0.0, 0.5, 1.0)  # shares of landmarks that look like another one
RADIOS: tuple[dict[str, Any], ...] = ({}, {"comm_range": 8.0}, {"comm_line_of_sight": True}, {"comm_loss": 0.2})
WINDOW = 200  # [steps] after which a false merge counts
ENOUGH = 20  # landmarks of either map before a merge is forced
PAIRS = 8  # that a forced merge takes for common


@dataclass(slots=True)
class MergeFate:
    """What became of a merge.

    Attributes:
        seed: Of its episode.
        world: Family.
        repeated: Share of landmarks that look like another one.
        step: When it was made.
        robots_a, robots_b: Which groups.
        error_m, error_deg: Of its motion.
        undone_after: Steps until it was undone; None: it was not.
        ended_after: Steps until the episode ended.
    """

    seed: int
    world: str
    repeated: float
    step: int
    robots_a: tuple[int, ...]
    robots_b: tuple[int, ...]
    error_m: float
    error_deg: float
    undone_after: int | None
    ended_after: int

    @property
    def is_false(self) -> bool:
        """Whether its motion was plainly wrong."""
        return is_false_merge(self.error_m, self.error_deg)

    @property
    def counts(self) -> bool:
        """Whether it was in force after the window, or at the end."""
        return self.undone_after is None or self.undone_after > WINDOW


def make_env(seed: int, cycles: int, forced: bool) -> ExplorationEnv:
    """Return the environment of an episode: the seed decides about everything."""
    rng = np.random.default_rng([seed, 17])
    config = preset_config("standard").replace(
        world=str(rng.choice(WORLDS)),
        num_robots=int(rng.integers(2, 5)),
        max_cycles=cycles,
        landmarks={"repeated": float(rng.choice(REPEATED))},
        belief={"attempts": {"enabled": not forced}},
        **({} if forced else RADIOS[int(rng.integers(len(RADIOS)))]),
    )
    return ExplorationEnv(config)


def play(seed: int, cycles: int, forced: bool) -> list[MergeFate]:
    """Run one episode and return what became of its merges."""
    env = make_env(seed, cycles, forced)
    rng = np.random.default_rng([seed, 18])
    policies = [make_policy("frontier", env.config.action_type) for _ in env.possible_agents]
    observations, _ = env.reset(seed=seed)
    while env.agents:
        if forced and not env.events:
            force(env, rng)
        actions = {
            agent: policy.act(observations[agent], env.belief(agent), rng)
            for agent, policy in zip(env.agents, policies, strict=True)
        }
        observations = env.step(actions)[0]
    return fates(env, seed)


def force(env: ExplorationEnv, rng: np.random.Generator) -> None:
    """Merge robots 0 and 1 wrongly, if their maps are large enough."""
    belief, ledger = env.episode.belief, env.episode.ledger
    map_a, map_b = belief.filter_map(0), belief.filter_map(1)
    if min(len(map_a), len(map_b)) < ENOUGH:
        return
    angle = rng.uniform(-np.pi, np.pi)
    offset = rng.uniform(0.7, 3.0) * np.array([np.cos(angle), np.sin(angle), 0.0])
    offset[2] = rng.normal(0.0, 0.2)
    motion = between(*env.true_start_poses[:2]) + offset
    points_b = np.column_stack([map_b.means[:, :2], np.zeros(len(map_b))])
    pairs = nearest_pairs(map_a.means[:, :2], compose(motion, points_b)[:, :2])
    wrong = Alignment(True, "", *motion.tolist(), np.diag([1e-3, 1e-3, 1e-4]), pairs, 0.0)
    ledger.rename(belief.merge(0, 1, wrong))


def nearest_pairs(points_a: FloatArray, points_b: FloatArray) -> Any:
    """Return the rows (a, b) of the closest pairs, one-to-one."""
    distances = np.linalg.norm(points_a[:, None] - points_b, axis=2)
    pairs = []
    for _ in range(PAIRS):
        row, column = np.unravel_index(distances.argmin(), distances.shape)
        pairs.append((row, column))
        distances[row] = distances[:, column] = np.inf
    return np.array(pairs)


def fates(env: ExplorationEnv, seed: int) -> list[MergeFate]:
    """Return what became of the merges of an episode that has ended."""
    starts, events = env.true_start_poses, env.events
    found = []
    for i, event in enumerate(events):
        if event.kind == "merge":
            error = between(between(starts[event.robots_a[0]], starts[event.robots_b[0]]), event.alignment.transform)
            undone = next((e.step for e in events[i:] if e.kind == "undo" and e.alignment is event.alignment), None)
            found.append(
                MergeFate(
                    seed, env.config.world, env.config.landmarks.repeated, event.step, event.robots_a, event.robots_b,
                    float(np.hypot(*error[:2])), float(abs(np.degrees(error[2]))),
                    None if undone is None else undone - event.step, env.episode.tick - event.step,
                )
            )  # fmt: skip
    return found


def summarise(merges: list[MergeFate], episodes: int, steps: int) -> dict[str, Any]:
    """Return the figures of all episodes together."""
    false = [merge for merge in merges if merge.is_false]
    right = [merge for merge in merges if not merge.is_false]
    after = [merge.undone_after for merge in false if merge.undone_after is not None]
    return {
        "episodes": episodes,
        "steps": steps,
        "merges": len(merges),
        "right_merges": len(right),
        "right_merges_undone": sum(merge.undone_after is not None for merge in right),
        "false_merges": len(false),
        "false_merges_undone": len(after),
        "false_merges_in_force": sum(merge.counts for merge in false),
        "steps_until_undone_median": float(np.median(after)) if after else float("nan"),
    }


def main(
    minutes: Annotated[float, typer.Option(help="How long; the last episode is played to its end.")] = 10.0,
    first_seed: Annotated[int, typer.Option(help="Of the first episode.")] = 100,
    cycles: Annotated[int, typer.Option(help="Steps of an episode.")] = 1500,
    forced: Annotated[bool, typer.Option(help="Merge wrongly on purpose.")] = False,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write all figures to this file.")] = None,
) -> None:
    """Run the soak and print it."""
    if not minutes > 0.0:
        raise bad_argument("minutes", "a number above 0", minutes, "Run for some time.")
    check_int("cycles", cycles, 1, "Give a number of steps.")
    check_int("first_seed", first_seed, 0, "Seeds are not negative.")
    if json_file is not None:
        check_writable(json_file, "json")
    console = Console(highlight=False, soft_wrap=True)
    begin, merges, played = time.monotonic(), [], 0
    for seed in count(first_seed):
        if time.monotonic() - begin > 60.0 * minutes:
            break
        found = play(seed, cycles, forced)
        merges, played = merges + found, played + 1
        for merge in found:
            fate = "in force" if merge.undone_after is None else f"undone after {merge.undone_after} steps"
            console.print(
                f"seed {merge.seed} {merge.world} ({merge.repeated:.0%} alike): {merge.robots_a} + {merge.robots_b} at "
                f"{merge.step}, {merge.error_m:.2f} m {merge.error_deg:.1f} deg off"
                f"{', FALSE' if merge.is_false else ''}, {fate}"
            )
    summary = summarise(merges, played, played * cycles)
    for name, value in summary.items():
        console.print(f"{name:30s} {value}")
    if json_file is not None:
        json_file.write_text(json.dumps(plain({"summary": summary, "merges": [asdict(m) for m in merges]}), indent=2))


if __name__ == "__main__":
    typer.run(main)
