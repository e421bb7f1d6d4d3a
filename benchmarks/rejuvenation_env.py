"""What rejuvenation does for an environment, and what its steps cost: episodes of `vslam run` with it and without.

    python benchmarks/rejuvenation_env.py --first-seed 100 --seeds 10
    python benchmarks/rejuvenation_env.py --every 100 --keys 120 --slice-steps 60

Each seed is played without and with, one after the other in this process; times are this thread's processor times of
`env.step`, [ms]. Without options the filters of the environment's default are taken.
"""

import os

# One process per core: libraries that start threads of their own would only get in each other's way.
os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")

import time
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console

from slam_backend.errors import check_int
from slam_backend.warming import warm_up
from training.episode import run_episode
from training.episode_scores import score_episode
from training.run_config import RunConfig
from vslam_env import vslam_v0

FIGURES = ("map_rmse_m", "map_error", "ate_aligned_m", "map_recall")


def play(config: RunConfig, filters: dict[str, Any]) -> dict[str, float]:
    """Run one episode and return its figures."""
    chosen = config.make_env().config
    env = vslam_v0.parallel_env(config=chosen.replace(belief={"filter": filters}))
    spent, step = [], env.step

    def timed(actions: Any) -> Any:
        begin = time.thread_time()
        result = step(actions)
        spent.append(1e3 * (time.thread_time() - begin))
        return result

    env.step = timed  # type: ignore[method-assign]
    scores = score_episode(run_episode(env, config.make_policies(env), config.seed))
    env.close()
    false = sum(merge["false"] and merge["undone_s"] is None for merge in scores["merges"])
    return {name: float(scores["team"][name]) for name in FIGURES} | {
        "false_merges": false, "mean_ms": float(np.mean(spent)), "p99_ms": float(np.percentile(spent, 99)),
        "longest_ms": max(spent),
    }  # fmt: skip


def main(
    seeds: Annotated[int, typer.Option(help="How many.")] = 10,
    first_seed: Annotated[int, typer.Option(help="The first of them.")] = 100,
    world: Annotated[str, typer.Option(help="A family name or a path.")] = "office",
    robots: Annotated[int, typer.Option(help="How many.")] = 3,
    every: Annotated[int | None, typer.Option(help="Ticks between rejuvenations.")] = None,
    keys: Annotated[int | None, typer.Option(help="Most key poses.")] = None,
    slice_steps: Annotated[int | None, typer.Option(help="New steps of a slice.")] = None,
) -> None:
    """Play, and print figures by seed and their means and medians."""
    check_int("seeds", seeds, 1, "Play at least one.")
    warm_up()
    smoothing = {name: value for name, value in (("max_keys", keys), ("slice_steps", slice_steps)) if value is not None}
    with_it = ({} if every is None else {"rejuvenate_every": every}) | ({"smoothing": smoothing} if smoothing else {})
    console = Console(highlight=False, soft_wrap=True)
    found: dict[str, list[dict[str, float]]] = {"never": [], "rejuvenated": []}
    for seed in range(first_seed, first_seed + seeds):
        config = RunConfig(world=world, robots=robots, seed=seed)
        for name, filters in (("never", {"rejuvenate_every": None}), ("rejuvenated", with_it)):
            found[name].append(row := play(config, filters))
            console.print(f"seed {seed:3d} {name:12s}", ", ".join(f"{key} {value:.3g}" for key, value in row.items()))
    for name, rows in found.items():
        for kind, over in (("mean", np.mean), ("median", np.median)):
            summary = {key: float(over([row[key] for row in rows])) for key in rows[0]}
            console.print(f"{kind:8s} {name:12s}", ", ".join(f"{key} {value:.3g}" for key, value in summary.items()))


if __name__ == "__main__":
    typer.run(main)
