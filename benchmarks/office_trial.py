"""Do robots that start apart find together? The episode of `vslam run` over many seeds, without pictures.

    python benchmarks/office_trial.py --seeds 20 --json office_trial.json

Prints per seed and in summary: whether all robots end in one group, when they merged and how wrong the merges were, and
the path error of SLAM over that of dead reckoning, both after SE(2) alignment.
"""

import os

# One process per core: libraries that start threads of their own would only get in each other's way.
os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")

import json
import time
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console

from slam_backend.errors import check_int
from slam_backend.files import check_writable, write_file
from training.episode import run_episode
from training.episode_scores import score_episode
from training.run_config import RunConfig
from training.run_folder import plain


def play(config: RunConfig) -> dict[str, Any]:
    """Run one episode and return its metrics, with its seed and the seconds it took."""
    begin = time.perf_counter()
    env = config.make_env()
    metrics = score_episode(run_episode(env, config.make_policies(env), config.seed))
    env.close()
    return metrics | {"seed": config.seed, "seconds": time.perf_counter() - begin}


def ratio(metrics: Mapping[str, Any]) -> float:
    """Return the mean path error of a seed's robots over that of their dead reckoning, both aligned."""
    team = metrics["team"]
    return float(team["ate_aligned_m"] / team["dead_reckoning_ate_aligned_m"])


def summarise(trials: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the figures of all seeds together."""
    joined = [trial for trial in trials if len(trial["groups"]) == 1]
    merges = [merge for trial in trials for merge in trial["merges"]]
    teams = [trial["team"] for trial in trials]
    return {
        "seeds": len(trials),
        "all_in_one_group": len(joined),
        "merges": len(merges),
        "false_merges": sum(merge["false"] and merge["undone_s"] is None for merge in merges),
        "merges_undone": sum(merge["undone_s"] is not None for merge in merges),
        "last_merge_s_median": _median([trial["merges"][-1]["time_s"] for trial in joined if trial["merges"]]),
        "merge_error_m_median": _median([merge["error_m"] for merge in merges]),
        "merge_error_deg_median": _median([merge["error_deg"] for merge in merges]),
        "path_error_ratio_median": _median([ratio(trial) for trial in trials]),
        "dead_reckoning_end_percent_median": _median([team["dead_reckoning_end_percent"] for team in teams]),
        "coverage_median": _median([trial["coverage"] for trial in trials]),
        **{
            f"{key}_median": _median([team[key] for team in teams])
            for key in ("ate_aligned_m", "map_error", "map_rmse_m", "map_recall", "map_precision")
        },
    }


def _median(values: list[float]) -> float:
    return float(np.median(values)) if values else float("nan")


def describe(trial: Mapping[str, Any]) -> str:
    """Return one line about a seed."""
    merges = ", ".join(
        f"{m['time_s']:.0f} s ({m['error_m']:.2f} m {m['error_deg']:.1f} deg{', FALSE' if m['false'] else ''}"
        f"{', undone' if m['undone_s'] is not None else ''})"
        for m in trial["merges"]
    )
    team = trial["team"]
    return (
        f"seed {trial['seed']:3d}: {len(trial['groups'])} group(s), merges at {merges or '-'}; "
        f"path error x {ratio(trial):.2f} of odometry ({team['dead_reckoning_end_percent']:.1f} % of path); "
        f"E {team['map_error']:.3f} m, RMSE {team['map_rmse_m']:.3f} m, recall {team['map_recall']:.0%}, "
        f"precision {team['map_precision']:.0%}, seen {trial['coverage']:.0%}; {trial['seconds']:.0f} s"
    )


def main(
    seeds: Annotated[int, typer.Option(help="How many.")] = 20,
    first_seed: Annotated[int, typer.Option(help="The first of them.")] = 0,
    world: Annotated[str, typer.Option(help="A family name or a path.")] = "office",
    robots: Annotated[int, typer.Option(help="How many.")] = 3,
    action_type: Annotated[str, typer.Option(help="continuous, discrete or goal.")] = "continuous",
    max_cycles: Annotated[int | None, typer.Option(help="Steps of an episode.", show_default="180 s worth")] = None,
    processes: Annotated[int, typer.Option(help="At a time.")] = os.cpu_count() or 1,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write all figures to this file.")] = None,
) -> None:
    """Run the trial and print it."""
    check_int("seeds", seeds, 1, "Run at least one episode.")
    check_int("first_seed", first_seed, 0, "Seeds are not negative.")
    if json_file is not None:
        check_writable(json_file, "json")
    configs = [
        RunConfig(world=world, robots=robots, action_type=action_type, max_cycles=max_cycles, seed=seed)
        for seed in range(first_seed, first_seed + seeds)
    ]
    console = Console(highlight=False, soft_wrap=True)
    trials = []
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        for trial in pool.map(play, configs):
            trials.append(trial)
            console.print(describe(trial))
    summary = summarise(trials)
    for name, value in summary.items():
        console.print(f"{name:36s} {value:.3f}" if isinstance(value, float) else f"{name:36s} {value}")
    if json_file is not None:
        write_file(json_file, json.dumps(plain({"summary": summary, "trials": trials}), indent=2) + "\n", "json")


if __name__ == "__main__":
    typer.run(main)
