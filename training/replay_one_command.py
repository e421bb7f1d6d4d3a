"""The commands `vslam replay victoria` and `vslam replay kitti`: one robot's log, one filter."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from training.command_options import (
    Config,
    Duration,
    Estimator,
    Json,
    Out,
    Particles,
    RejuvenateEvery,
    Seed,
    finish,
    gather,
)
from training.compiling import prepare
from training.replay_images_command import replay_folder_of_images
from training.replay_paths import default_path

if TYPE_CHECKING:  # what computes is imported when the command runs, so that --help answers at once
    from slam_backend.trajectory import Trajectory
    from training.replay_one import OneReplay
    from training.run_folder import RunFolder

Result = TypeVar("Result")

VICTORIA = Path("victoria_park")
KITTI = Path("kitti_landmarks")


def replay_victoria(
    path: Annotated[
        Path | None, typer.Option(help="Folder of the log.", show_default=f"{VICTORIA} in $VSLAM_DATA")
    ] = None,
    duration: Duration = None,
    particles: Particles = None,
    estimator: Estimator = None,
    rejuvenate_every: RejuvenateEvery = None,
    seed: Seed = None,
    out: Out = None,
    json: Json = None,
    config: Config = None,
) -> None:
    """A car among the trees of a park: trees without names, matched by where they stand, GPS as the truth."""
    from slam_backend.readers.victoria import load_victoria
    from training.figures_replay_one import draw_one
    from training.replay_victoria import VictoriaConfig, replay, score, summarise
    from training.run_folder import RunFolder, plain

    command = "replay victoria"
    given = {"path": path, "duration": duration, "particles": particles, "estimator": estimator}
    given |= {"rejuvenate_every": rejuvenate_every, "seed": seed}
    values = gather(command, given, config, json, out)
    if "path" not in values:
        values["path"] = default_path(VICTORIA, "the Victoria Park log")
    chosen = VictoriaConfig.from_mapping(values)
    log = load_victoria(chosen.path, chosen.duration)
    folder = RunFolder.create(out, command, chosen.to_mapping(), chosen.seed)
    prepare()
    console = Console()
    result = with_progress(console, lambda on_step: replay(log, chosen, on_step))
    scored = score(result, log)
    metrics = plain(summarise(result, scored))
    print_table(console, metrics, result)
    gps = metrics["gps"]
    console.print(
        f"At {gps['fixes']} GPS fixes: median {gps['median_m']:.2f} m, 95 % within {gps['percentile_95_m']:.2f} m, "
        f"worst {gps['worst_m']:.1f} m. Trees seen ten times or more: {metrics['landmarks_seen_ten_times']}.",
        highlight=False,
    )
    draw_one(
        folder.path / "replay.png",
        "Victoria Park",
        result,
        (scored.path, scored.reckoned),
        (scored.estimate, scored.odometry),
        scored.fixes,
        "GPS",
    )
    write_paths(folder, result)
    finish(console, folder, folder.write_metrics(metrics), json)


def replay_kitti(
    path: Annotated[
        Path | None,
        typer.Option(
            help="Archive of features, folder with one, or folder of images.", show_default=f"{KITTI} in $VSLAM_DATA"
        ),
    ] = None,
    truth: Annotated[
        Path | None, typer.Option(help="File of the true poses.", show_default="that beside the data")
    ] = None,
    duration: Duration = None,
    particles: Particles = None,
    estimator: Estimator = None,
    rejuvenate_every: RejuvenateEvery = None,
    seed: Seed = None,
    out: Out = None,
    json: Json = None,
    config: Config = None,
) -> None:
    """A car in a town: stereo images, or stereo features whose tracks are the landmarks; motion taken to be planar."""
    from slam_backend.readers.kitti import load_kitti
    from slam_backend.readers.kitti_images import holds_images
    from training.figures_replay_one import draw_one
    from training.replay_kitti import KittiConfig, replay, score, summarise
    from training.run_folder import RunFolder, plain

    command = "replay kitti"
    given = {"path": path, "truth": truth, "duration": duration, "particles": particles, "estimator": estimator}
    given |= {"rejuvenate_every": rejuvenate_every, "seed": seed}
    values = gather(command, given, config, json, out)
    if "path" not in values:
        values["path"] = default_path(KITTI, "KITTI features")
    if holds_images(values["path"]):
        replay_folder_of_images(values, out, json)
        return
    chosen = KittiConfig.from_mapping(values)
    log = load_kitti(chosen.path, chosen.truth, chosen.duration)
    folder = RunFolder.create(out, command, chosen.to_mapping(), chosen.seed)
    prepare()
    console = Console()
    result = with_progress(console, lambda on_step: replay(log, chosen, on_step))
    scored = score(result, log)
    metrics = plain(summarise(result, scored))
    print_table(console, metrics, result)
    if scored is not None and scored.loop is not None:
        seconds = [float(result.times[step] - result.times[0]) for step in scored.loop]
        console.print(
            f"The place of {seconds[0]:.0f} s was seen again at {seconds[1]:.0f} s; the motion between is off by "
            f"{scored.loop_error:.2f} m. Tracks that ended never come back, so nothing closes this loop.",
            highlight=False,
        )
    paths = (scored.path[:, :2], scored.reckoned[:, :2]) if scored else (result.path[:, :2], result.reckoned[:, :2])
    draw_one(
        folder.path / "replay.png",
        "KITTI, tracked stereo features in the plane",
        result,
        paths,
        (scored.estimate, scored.odometry) if scored else None,
        scored.truth[:, :2] if scored else None,
    )
    write_paths(folder, result, log.truth)
    finish(console, folder, folder.write_metrics(metrics), json)


def with_progress(console: Console, work: Callable[[Callable[[float], None]], Result]) -> Result:
    """Run a replay under a progress bar."""
    columns = (
        TextColumn("replay"), BarColumn(), TextColumn("{task.percentage:>3.0f} %"), TimeElapsedColumn(),
        TimeRemainingColumn(),
    )  # fmt: skip
    with Progress(*columns, console=console) as progress:
        task = progress.add_task("replay", total=1.0)
        return work(lambda done: progress.update(task, completed=done))


def print_table(console: Console, metrics: dict[str, Any], result: "OneReplay") -> None:
    """Print how far path and dead reckoning are off, what became of the measurements, and the speed."""
    table = Table(title="RMS distance to the truth [m]")
    for name in ("", "after the best rigid fit", "from the start, no fit"):
        table.add_column(name, justify="right")
    row = metrics["robots"][0]
    for name, key in (("estimate", "ate"), ("odometry", "dead_reckoning_ate")):
        figures = (row[f"{key}_aligned_m"], row[f"{key}_start_m"])
        table.add_row(name, *("-" if value is None else f"{value:.2f}" for value in figures))
    console.print(table)
    made = metrics["measurements"]
    console.print(
        f"{metrics['landmarks']} landmarks; of the measurements {made['matched']} matched, {made['created']} began "
        f"landmarks, {made['rejected']} were refused. {row['path_m']:.0f} m in {metrics['duration_s']:.0f} s; "
        f"the filter took {result.seconds:.1f} s: {result.speed:.0f} times real time.",
        highlight=False,
    )


def write_paths(folder: "RunFolder", result: "OneReplay", truth: "Trajectory | None" = None) -> None:
    """Write the paths, and how long the filter took, which no two runs share."""
    from slam_backend.trajectory import Trajectory
    from training.run_folder import to_json

    folder.write_trajectory("estimate", Trajectory(result.times, result.path))
    folder.write_trajectory("dead_reckoning", Trajectory(result.times, result.reckoned))
    if truth is not None:
        folder.write_trajectory("truth", truth)
    folder.write_text("timing.json", to_json({"seconds": result.seconds, "times_real_time": result.speed}))
