"""What rejuvenation costs: a single one, and a long run with it over the same run without.

    python benchmarks/rejuvenation_time.py single --keys 180 --keys 120
    python benchmarks/rejuvenation_time.py long --steps 10000 --landmarks 2000

Processor times of this process. `single` repeats the same rejuvenation from a snapshot; `long` lets both filters take
each reading in turn, so that whatever else the machine does falls on both.
"""

import os

# One process per core: libraries that start threads of their own would only get in each other's way.
os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")

import time
from typing import Annotated

import numpy as np
import typer
from rich.console import Console

from slam_backend.errors import bad_argument, check_int
from slam_backend.filter import FastSlam
from slam_backend.metrics import map_rmse
from slam_backend.smoothing.options import SmoothingOptions
from slam_backend.warming import warm_up
from training.accuracy_trials import REJUVENATE_EVERY
from training.stereo_runs import STEP, RunSpec, StereoRun, simulate_run

app = typer.Typer(no_args_is_help=True)
console = Console(highlight=False, soft_wrap=True)


@app.command()
def single(
    keys: Annotated[list[int] | None, typer.Option(help="Most key poses, once or more.")] = None,
    poses: Annotated[int, typer.Option(help="Of the run.")] = 400,
    landmarks: Annotated[int, typer.Option(help="In the office.")] = 300,
    particles: Annotated[int, typer.Option(help="M.")] = 100,
    repeats: Annotated[int, typer.Option(help="Of the same rejuvenation.")] = 30,
    seed: Annotated[int, typer.Option(help="Of the run and of the filters.")] = 100,
) -> None:
    """Time the last rejuvenation of a run, 25 steps after the one before."""
    check_int("repeats", repeats, 1, "Time it at least once.")
    warm_up()
    run = simulate_run(RunSpec(length=STEP * poses, landmarks=landmarks), seed)
    for most in keys or [SmoothingOptions().max_keys]:
        options = SmoothingOptions(max_keys=most)
        slam = run.build_filter(particles, "fastslam2", seed, rejuvenate_every=REJUVENATE_EVERY, smoothing=options)
        for reading in list(run.readings())[: run.num_steps // REJUVENATE_EVERY * REJUVENATE_EVERY - 1]:
            slam.step(**reading)
        state, times = slam.get_state(), []
        for _ in range(repeats):
            slam.set_state(state)
            begin = time.process_time()
            report = slam.rejuvenate()
            times.append(1e3 * (time.process_time() - begin))
            if report.reason:
                raise bad_argument("seed", "a run that can be smoothed", report.reason, "Take another.")
        console.print(
            f"{most:4d} keys, {slam.map_size} landmarks: least {min(times):.1f}, median {np.median(times):.1f} ms"
        )


@app.command("long")
def long_run(
    steps: Annotated[int, typer.Option(help="Of the run.")] = 10_000,
    landmarks: Annotated[int, typer.Option(help="In the office.")] = 2000,
    every: Annotated[int, typer.Option(help="Steps between rejuvenations.")] = 50,
    effort: Annotated[float, typer.Option(help="See SmoothingOptions.")] = SmoothingOptions().effort,
    keys: Annotated[int, typer.Option(help="Most key poses.")] = SmoothingOptions().max_keys,
    slice_steps: Annotated[int | None, typer.Option(help="New steps taken in at once; left away: all.")] = None,
    seed: Annotated[int, typer.Option(help="Of the run and of the filters.")] = 100,
) -> None:
    """Time a run with rejuvenation and without, interleaved, and say how far off poses and maps are."""
    smoothing = SmoothingOptions(effort=effort, max_keys=keys, slice_steps=slice_steps)
    warm_up()
    run = simulate_run(RunSpec(length=STEP * steps, landmarks=landmarks), seed)
    filters = [
        run.build_filter(100, "fastslam2", seed, rejuvenate_every=chosen, smoothing=smoothing)
        for chosen in (None, every)
    ]
    spent, drawn, squares = np.zeros(2), [], np.zeros(2)
    for step, reading in enumerate(run.readings()):
        for i, slam in enumerate(filters):
            begin = time.process_time()
            report = slam.step(**reading).rejuvenation
            spent[i] += (now := time.process_time()) - begin
            squares[i] += ((slam.pose().mean - run.true_paths[0, step])[:2] ** 2).sum()
            if report is not None:
                drawn.append(now - begin)
    console.print(
        f"{run.num_steps} steps, {filters[0].map_size} landmarks: {spent[0]:.1f} s without, {spent[1]:.1f} s with "
        f"rejuvenation, {spent[1] / spent[0]:.2f} times as much; {len(drawn)} rejuvenations of "
        f"{1e3 * np.median(drawn):.0f} ms, at most {1e3 * max(drawn):.0f} ms; the smoother holds "
        f"{smoother_bytes(filters[1]) / 1e6:.1f} MB, the log {filters[1].log().nbytes / 1e6:.1f} MB"
    )
    for name, slam, square in zip(("without", "with"), filters, squares, strict=True):
        pose = np.sqrt(square / run.num_steps)
        console.print(f"{name:8s} pose {pose:.3f} m off (RMS of all steps), map {map_off(run, slam):.3f} m")


def map_off(run: StereoRun, slam: FastSlam) -> float:
    """Return the RMS error [m] of a filter's landmarks, told by their places."""
    return map_rmse(slam.map().means, run.landmarks).rmse


def smoother_bytes(slam: FastSlam) -> int:
    """Return the bytes of the arrays that a filter's smoother keeps between steps."""
    graph = slam.get_state()["rejuvenation"]["graph"]
    return 0 if graph is None else sum(array.nbytes for array in graph.values())


if __name__ == "__main__":
    app()
