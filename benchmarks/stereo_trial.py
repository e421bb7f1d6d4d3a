"""Three robots with rendered eyes over many seeds, at full length: path errors against odometry, merges, maps.

    python benchmarks/stereo_trial.py --seeds 10 --out stereo_trial

Each seed is the episode of `vslam run --sensor stereo` without pictures. Finished seeds are kept in the folder: stopped
and begun again with the same options, the trial goes on where it was.
"""

import os

# One thread: the figures of an episode are the same whatever the machine does beside.
os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer
from rich.console import Console
from scipy.stats import binom

from agents.registry import make_policy
from slam_backend.errors import check_choice, check_int
from training.command_progress import KeptPart, play_kept
from training.episode import run_episode
from training.episode_scores import score_episode
from training.kept_trials import open_folder
from training.run_folder import plain
from vslam_env import preset_config, vslam_v0
from vslam_env.sensors.stereo_textures import STYLES

KEPT = "trials.jsonl"
CONFIDENCE = 0.95  # at least that of the interval of a median


@dataclass(frozen=True, slots=True, kw_only=True)
class StereoTrial:
    """An episode of the trial.

    Attributes:
        seed: Of all random draws.
        style: Of the walls' textures, as `TextureConfig` has it.
        cycles: Ticks of 0.1 s.
        num_robots: How many.
    """

    seed: int
    style: str
    cycles: int
    num_robots: int


def play(trial: StereoTrial) -> dict[str, Any]:
    """Run an episode and return its metrics, and the seconds it took."""
    cv2.setNumThreads(1)
    begin = time.perf_counter()
    told = {"num_robots": trial.num_robots, "max_cycles": trial.cycles, "stereo": {"textures": {"style": trial.style}}}
    config = preset_config("standard", "stereo").replace(world="office", **told)
    env = vslam_v0.parallel_env(config=config)
    policies = {agent: make_policy("frontier", config.action_type) for agent in env.possible_agents}
    scores = score_episode(run_episode(env, policies, trial.seed))
    env.close()
    return asdict(trial) | scores | {"seconds": time.perf_counter() - begin}


def ratio(row: dict[str, Any]) -> float:
    """Return the mean path error of an episode's robots over that of their odometry, both after SE(2) alignment."""
    return float(row["team"]["ate_aligned_m"] / row["team"]["dead_reckoning_ate_aligned_m"])


def interval(values: Sequence[float]) -> tuple[float, float]:
    """Return an interval of the median that holds whatever the distribution: two of the sorted values.

    It covers the median with at least `CONFIDENCE`; of fewer than six values, which cannot, it is all of them.

    >>> interval([5.0, 1.0, 4.0, 2.0, 3.0, 6.0, 8.0, 7.0, 10.0, 9.0])
    (2.0, 9.0)
    """
    ordered = sorted(values)
    outside = max(1, int(binom.ppf(0.5 * (1.0 - CONFIDENCE), len(ordered), 0.5)))  # values left out at either end, + 1
    return ordered[outside - 1], ordered[len(ordered) - outside]


def summarise(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the figures of all episodes together."""
    robots = [robot for row in rows for robot in row["robots"]]
    merges = [merge for row in rows for merge in row["merges"]]
    ratios = [ratio(row) for row in rows]
    paths = [robot["ate_aligned_m"] / robot["dead_reckoning_ate_aligned_m"] for robot in robots]
    low, high = interval(ratios)

    def spread(name: str, values: Sequence[float]) -> dict[str, float]:
        return {f"{name}_median": float(np.median(values)), f"{name}_worst": float(np.max(values))}

    return {
        "episodes": len(rows),
        "path_error_ratio_median": float(np.median(ratios)),
        "path_error_ratio_low": low,
        "path_error_ratio_high": high,
        **spread("path_error_ratio_of_robots", paths),
        **spread("path_error_m", [robot["ate_aligned_m"] for robot in robots]),
        **spread("odometry_error_m", [robot["dead_reckoning_ate_aligned_m"] for robot in robots]),
        "merges": len(merges),
        "merges_undone": sum(merge["undone_s"] is not None for merge in merges),
        "false_merges": sum(bool(merge["false"]) for merge in merges),
        "false_merges_in_force": sum(bool(merge["false"]) and merge["undone_s"] is None for merge in merges),
        **(spread("merge_error_m", [merge["error_m"] for merge in merges]) if merges else {}),
        **(spread("merge_error_deg", [merge["error_deg"] for merge in merges]) if merges else {}),
        "all_in_one_group": sum(len(row["groups"]) == 1 for row in rows),
        **spread("map_error_m", [robot["map_error"] for robot in robots]),
        **spread("map_rmse_m", [robot["map_rmse_m"] for robot in robots]),
        "map_recall_median": float(np.median([robot["map_recall"] for robot in robots])),
        "map_precision_median": float(np.median([robot["map_precision"] for robot in robots])),
        "coverage_median": float(np.median([row["coverage"] for row in rows])),
        "seconds_median": float(np.median([row["seconds"] for row in rows])),
    }


def tell(row: dict[str, Any]) -> str:
    """Return a few words about an episode."""
    return f"seed {row['seed']}: path error x {ratio(row):.2f} of odometry, {len(row['merges'])} merges"


def main(
    seeds: Annotated[int, typer.Option(help="How many.")] = 10,
    first_seed: Annotated[int, typer.Option(help="The first of them.")] = 0,
    style: Annotated[str, typer.Option(help=f"What walls look like: {', '.join(STYLES)}.")] = "distinct",
    cycles: Annotated[int, typer.Option(help="Ticks of 0.1 s.")] = 1800,
    robots: Annotated[int, typer.Option(help="How many.")] = 3,
    processes: Annotated[int, typer.Option(help="At a time.")] = 1,
    out: Annotated[Path | None, typer.Option(help="Run folder.", show_default="runs/stereo-trial-SEED-N")] = None,
) -> None:
    """Run the trial, or what is left of it, and print it."""
    check_int("seeds", seeds, 1, "Run at least one episode.")
    check_int("first_seed", first_seed, 0, "Seeds are not negative.")
    check_choice("style", style, STYLES)
    check_int("cycles", cycles, 1, "Give a number of ticks.")
    check_int("robots", robots, 1, "Use 1 to 8 robots.")
    trials = [
        StereoTrial(seed=seed, style=style, cycles=cycles, num_robots=robots)
        for seed in range(first_seed, first_seed + seeds)
    ]
    shared = {"seeds": seeds, "style": style, "cycles": cycles, "robots": robots}
    folder = open_folder(out, "stereo trial", shared, first_seed)
    console = Console(highlight=False, soft_wrap=True)
    part = KeptPart(file=KEPT, kind=StereoTrial, play=play, trials=trials, tell=tell, processes=processes)
    (rows,) = play_kept(console, folder, part)
    for row in rows:
        merged = ", ".join(
            f"{merge['time_s']:.0f} s ({merge['error_m']:.2f} m {merge['error_deg']:.1f} deg"
            f"{', FALSE' if merge['false'] else ''}{', undone' if merge['undone_s'] is not None else ''})"
            for merge in row["merges"]
        )
        team = row["team"]
        console.print(
            f"seed {row['seed']:3d}: {len(row['groups'])} group(s), merges at {merged or '-'}; path error x "
            f"{ratio(row):.2f} of odometry; E {team['map_error']:.3f} m, RMSE {team['map_rmse_m']:.3f} m, recall "
            f"{team['map_recall']:.0%}, precision {team['map_precision']:.0%}, seen {row['coverage']:.0%}"
        )
    if rows:
        summary = plain(summarise(rows))
        for name, value in summary.items():
            console.print(f"{name:36s} {value:.3f}" if isinstance(value, float) else f"{name:36s} {value}")
        folder.write_metrics({"summary": summary})


if __name__ == "__main__":
    typer.run(main)
