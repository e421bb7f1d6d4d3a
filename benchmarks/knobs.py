"""What each preset and each knob of difficulty does to map errors and merges of nearest-frontier explorers.

    python benchmarks/knobs.py --seeds 6 --json knobs.json --figure docs/figures/knobs.png

Three robots explore offices for 150 s. Each knob is turned by itself from the standard preset to a value as hard as
that of the hard preset, or harder; `--only preset` plays the presets alone.
"""

import os

# One thread: the figures of an episode are the same whatever the machine does beside.
os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import track
from rich.table import Table

from agents import make_policy
from slam_backend.errors import check_int
from slam_backend.files import check_writable, write_file
from training.episode import run_episode
from training.run_folder import plain, to_json
from vslam_env import EnvConfig, preset_config, vslam_v0

DECISIONS = 150  # of a second each
ROBOTS = 3
STANDARD = "preset standard"

KNOBS: dict[str, dict[str, Any]] = {
    "odometry noise x 2": {
        "odometry": {"sigma_distance": 0.1, "sigma_heading_per_metre": 0.0698},
        "belief": {"filter": {"motion": {"sigma_along": 0.1, "sigma_across": 0.04, "sigma_heading": 0.0698}}},
    },
    "odometry bias x 4": {"odometry": {"bias_distance": 0.08, "bias_heading_per_metre": 0.035}},
    "2 measurements a tick": {"landmark_sensor": {"max_measurements": 2}},
    "range 4 m": {
        "landmark_sensor": {"camera": {"max_range": 4.0}},
        "belief": {"filter": {"camera": {"max_range": 4.0}}},
    },
    "field of view 30 degrees": {
        "landmark_sensor": {"camera": {"width": 172}},
        "belief": {"filter": {"camera": {"width": 172}}},
    },
    "descriptor noise 0.3": {"landmark_sensor": {"descriptor_noise": 0.3}},
    "40 % repeated textures": {"landmarks": {"repeated": 0.4}},
    "0.5 false points a tick": {"landmark_sensor": {"false_points": 0.5}},
    "detection 0.5": {"landmark_sensor": {"detection_probability": 0.5}},
    "radio range 5 m": {"comm_range": 5.0},
    "radio needs line of sight": {"comm_line_of_sight": True},
    "radio loses half": {"comm_loss": 0.5},
}


def variants() -> dict[str, EnvConfig]:
    """Return the presets and the knobs, each turned by itself."""
    common = {"num_robots": ROBOTS, "action_type": "goal", "max_cycles": DECISIONS}
    presets = {f"preset {name}": preset_config(name).replace(**common) for name in ("easy", "standard", "hard")}
    return presets | {name: presets[STANDARD].replace(**changes) for name, changes in KNOBS.items()}


def play(config: EnvConfig, seed: int) -> dict[str, Any]:
    """Run an episode and return what it came to, means over the robots."""
    env = vslam_v0.parallel_env(config=config)
    record = run_episode(env, {agent: make_policy("frontier", "goal") for agent in env.possible_agents}, seed)
    last = record.infos
    return {
        "seed": seed,
        "map_error": float(record.map_errors[:, -1].mean()),
        "map_recall": float(np.mean([info["map_recall"] for info in last])),
        "pose_error": float(np.mean([info["pose_error"] for info in last])),
        "merges": len(record.merges),
        "false_merges": sum(merge.is_false for merge in record.merges),
        "one_group": len(record.groups) == 1,
    }


def summary(trials: list[dict[str, Any]]) -> dict[str, float]:
    """Return means over seeds."""
    return {name: float(np.mean([trial[name] for trial in trials])) for name in trials[0] if name != "seed"}


def draw(results: dict[str, list[dict[str, Any]]], path: Path) -> None:
    """Draw the map error of each episode with its mean, and the mean number of merges."""
    figure = Figure(figsize=(9.0, 0.34 * len(results) + 1.2), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=(2, 1))
    standard = summary(results[STANDARD])["map_error"]
    for row, trials in enumerate(results.values()):
        errors = [trial["map_error"] for trial in trials]
        left.plot(errors, np.full(len(errors), row), "o", color="0.6", markersize=4, zorder=2)
        left.plot(np.mean(errors), row, "D", color="tab:blue", zorder=3)
        merges, false = (np.mean([trial[name] for trial in trials]) for name in ("merges", "false_merges"))
        right.barh(row, merges, color="tab:blue", height=0.6)
        right.barh(row, false, color="tab:red", height=0.6)
    left.axvline(standard, color="tab:blue", linewidth=0.8, linestyle=":")
    left.set_yticks(range(len(results)), list(results))
    left.invert_yaxis()
    left.set_xlabel("map error at the end, mean over robots [m]\nepisodes grey, mean blue")
    right.set_xlabel("merges per episode\n(red: false)")
    for axes in (left, right):
        axes.set_xlim(left=0.0)
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=110)


def main(
    seeds: Annotated[int, typer.Option(help="Episodes of each variant.")] = 6,
    first_seed: Annotated[int, typer.Option(help="Of them.")] = 0,
    only: Annotated[str | None, typer.Option(help="Variants whose names contain this.")] = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write all trials to this file.")] = None,
    figure: Annotated[Path | None, typer.Option(help="Draw them into this file.")] = None,
) -> None:
    """Play all variants and print their means."""
    check_int("seeds", seeds, 1, "Play one episode or more.")
    check_int("first_seed", first_seed, 0, "Give an int >= 0.")
    for path in (json_file, figure):
        if path is not None:
            check_writable(path, "json" if path is json_file else "figure")
    chosen = {n: c for n, c in variants().items() if only is None or only in n or n == STANDARD}
    jobs = [(name, seed) for name in chosen for seed in range(first_seed, first_seed + seeds)]
    results: dict[str, list[dict[str, Any]]] = {name: [] for name in chosen}
    for name, seed in track(jobs, "Episodes", transient=True):
        results[name].append(play(chosen[name], seed))
    table = Table("variant", "map error, m", "recall", "pose error, m", "merges", "false", "all in one group")
    for name, trials in results.items():
        mean = summary(trials)
        numbers = (f"{mean['map_error']:.3f}", f"{mean['map_recall']:.2f}", f"{mean['pose_error']:.2f}")
        counts = (f"{mean[key]:.2f}" for key in ("merges", "false_merges", "one_group"))
        table.add_row(name, *numbers, *counts)
    Console().print(table)
    if json_file is not None:
        means = {name: summary(trials) for name, trials in results.items()}
        write_file(json_file, to_json(plain({"trials": results, "means": means})), "json")
    if figure is not None:
        draw(results, figure)


if __name__ == "__main__":
    typer.run(main)
