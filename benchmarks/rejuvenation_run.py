"""One long run with and without rejuvenation: map error and honesty as they go, drawn, and what it costs.

    python benchmarks/rejuvenation_run.py --length 400 --seed 0 --figure rejuvenation.png --json rejuvenation.json

The two filters take the same readings of a simulated stereo run (good stereo, known association, M = 100). The figure
shows, against the distance driven, the map's RMS error and the NEES of the pose, the latter beside what is ideal.
"""

import os

# One process per core: libraries that start threads of their own would only get in each other's way.
os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")

import json as json_format
import time
from pathlib import Path
from typing import Annotated, Any

import matplotlib as mpl
import numpy as np
import typer
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.console import Console

from slam_backend.files import check_writable, write_file
from slam_backend.filter import FastSlam
from slam_backend.geometry import wrap_angle
from slam_backend.metrics import nees
from training.accuracy_trials import LEAST_SIGMA, REJUVENATE_EVERY
from training.stereo_runs import STEP, RunSpec, StereoRun, simulate_run

SMOOTH = 40  # steps over which the median of the NEES is drawn
IDEAL = 2.366  # median of chi-squared of 3 degrees of freedom
EVERY = 10  # steps between looks at the map
COLOURS = {"plain": "#0072B2", "rejuvenated": "#E69F00"}


def follow(run: StereoRun, slam: FastSlam) -> dict[str, Any]:
    """Let a filter take the run; return map errors [m] and NEES by step, and processor times [s]."""
    looked, errors, honesty, plain, rejuvenating = [], [], [], 0.0, []
    for step, reading in enumerate(run.readings()):
        begin = time.process_time()
        report = slam.step(**reading)
        spent = time.process_time() - begin
        if report.rejuvenation is None:
            plain += spent
        else:
            rejuvenating.append(spent)
        pose = slam.pose(0)
        off = pose.mean - run.true_paths[0, step]
        off[2] = wrap_angle(off[2])
        honesty.append(float(nees(off[None], pose.covariance[None] + LEAST_SIGMA**2 * np.eye(3))[0]))
        if step % EVERY == 0:
            looked.append(step)
            errors.append(_map_error(run, slam))
    return {
        "steps": looked, "map_rmse_m": errors, "nees": honesty, "plain_s": plain, "rejuvenations": len(rejuvenating),
        "rejuvenating_s": float(sum(rejuvenating)),
        "rejuvenation_ms_median": 1e3 * float(np.median(rejuvenating)) if rejuvenating else None,
        "nees_median": float(np.median(honesty)), "nees_mean": float(np.mean(honesty)),
        "map_end_m": errors[-1],
    }  # fmt: skip


def _map_error(run: StereoRun, slam: FastSlam) -> float:
    """Return the RMS error [m] of the landmarks of the map, which bear the run's own names."""
    held = slam.map()
    names = {int(i): int(n) for i, n in zip(slam._maps.ids, slam._maps.identities, strict=True) if i >= 0}
    true = run.landmarks[[names[int(i)] for i in held.ids]]
    return float(np.sqrt(((held.means - true) ** 2).sum(axis=1).mean()))


def draw(file: Path, found: dict[str, dict[str, Any]]) -> None:
    """Draw both filters into a PNG file."""
    with mpl.rc_context({"font.size": 9}):
        figure = Figure(figsize=(8.0, 4.6), layout="constrained")
        FigureCanvasAgg(figure)
        above, below = figure.subplots(2, 1, sharex=True)
        for name, row in found.items():
            above.plot(STEP * np.array(row["steps"]), row["map_rmse_m"], color=COLOURS[name], label=name)
            values = np.array(row["nees"])[: len(row["nees"]) // SMOOTH * SMOOTH].reshape(-1, SMOOTH)
            at = STEP * SMOOTH * (np.arange(len(values)) + 0.5)
            below.plot(at, np.median(values, axis=1), color=COLOURS[name], label=name)
        below.axhline(IDEAL, color="#7f7f7f", linestyle=":", label="ideal")
        for ax, label in ((above, "map error, RMS [m]"), (below, f"NEES, median of {SMOOTH} steps")):
            ax.set_yscale("log")
            ax.set_ylabel(label)
            ax.grid(alpha=0.2, which="both")
        figure.legend(*below.get_legend_handles_labels(), loc="outside upper right", ncols=3)
        below.set_xlabel("distance driven [m]")
        figure.savefig(file, dpi=150)


def main(
    length: Annotated[float, typer.Option(help="Of the path [m].")] = 400.0,
    landmarks: Annotated[int, typer.Option(help="In the office.")] = 300,
    seed: Annotated[int, typer.Option(help="Of the run and of the filters.")] = 0,
    every: Annotated[int, typer.Option(help="Steps between rejuvenations.")] = REJUVENATE_EVERY,
    figure: Annotated[Path, typer.Option(help="PNG file to draw.")] = Path("rejuvenation.png"),
    json: Annotated[Path | None, typer.Option(help="Write all figures to this file too.")] = None,
) -> None:
    """Drive, filter twice, print and draw."""
    for name, file in (("figure", figure), ("json", json)):
        if file is not None:
            check_writable(file, name)
    run = simulate_run(RunSpec(length=length, landmarks=landmarks), seed)
    console, found = Console(), {}
    for name, interval in (("plain", None), ("rejuvenated", every)):
        found[name] = row = follow(run, run.build_filter(100, "fastslam2", seed, rejuvenate_every=interval))
        told = {key: value for key, value in row.items() if not isinstance(value, list)}
        console.print(name, {key: round(v, 4) if isinstance(v, float) else v for key, v in told.items()})
    draw(figure, found)
    if json is not None:
        write_file(json, json_format.dumps(found), "json")


if __name__ == "__main__":
    typer.run(main)
