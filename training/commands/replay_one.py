"""The commands `vslam replay victoria` and `vslam replay kitti`: one robot's log, one filter."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from training.commands._options import Config, Duration, Estimator, Json, Out, Particles, RejuvenateEvery, Seed
from training.commands._progress import share_shown
from training.commands._run_folder import begin, choose, finish, gather
from training.commands.replay_images import replay_folder_of_images
from training.episodes.consistency_table import print_consistency
from training.experiments.tables import console_table, number
from training.replay.rejuvenation_counts import sentence_of

if TYPE_CHECKING:  # what computes is imported when the command runs, so that --help answers at once
    from slam_backend.core.validation import FloatArray
    from slam_backend.trajectory import Trajectory
    from training.experiments.run_folder import RunFolder
    from training.replay.single_robot import OneReplay, PositionScore

NO_TRUTH = "Errors: no ground truth in this folder."
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
    from slam_backend.readers.victoria import CONTROLS_FILE, GPS_FILE, TREES_FILE, load_victoria
    from training.replay.victoria import VictoriaConfig, replay, score, summarise

    command = "replay victoria"
    given = {"path": path, "duration": duration, "particles": particles, "estimator": estimator}
    given |= {"rejuvenate_every": rejuvenate_every, "seed": seed}
    files = f"{CONTROLS_FILE}, {TREES_FILE} and {GPS_FILE}"
    place = (VICTORIA, f"a folder of the Victoria Park log, with {files}")
    chosen = choose(VictoriaConfig, command, given, config=config, json=json, out=out, log=place)
    log = load_victoria(chosen.path, chosen.duration)
    console, folder = begin(command, chosen, out)
    with share_shown(console, "replay") as on_step:
        result = replay(log, chosen, on_step)
    scored = score(result, log)
    metrics = summarise(result, scored)
    told = [f"Trees seen ten times or more: {metrics['landmarks_seen_ten_times']}.", *log.notes]
    if scored is not None:
        gps = metrics["gps"]
        told.insert(
            0,
            f"At {gps['fixes']} GPS fixes: median {gps['median_m']:.2f} m, 95 % within {gps['percentile_95_m']:.2f} m, "
            f"worst {gps['worst_m']:.1f} m.",
        )
    finish_one(
        console, folder, json, result, {**metrics, "notes": log.notes}, told, "Victoria Park",
        paths=(scored.path, scored.reckoned) if scored else (result.path, result.reckoned),
        scores=(scored.estimate, scored.odometry) if scored else None,
        known=scored.fixes if scored else None,
        known_as="GPS",
        unknown=NO_TRUTH if log.gps is None else _outside(log.gps[:, 0], result.times),
    )  # fmt: skip


def _outside(fixes: "FloatArray", times: "FloatArray") -> str:
    """Return the line that says that fewer than two fixes at times (g,) [s] fall into a replay at times (T,) [s]."""
    return (
        f"Errors: fewer than two GPS fixes ({fixes[0]:.1f} to {fixes[-1]:.1f} s) during this replay ({times[0]:.1f} to "
        f"{times[-1]:.1f} s)."
    )


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
    from training.replay.kitti import KittiConfig, replay, score, summarise
    from training.replay.single_robot import path_length

    command = "replay kitti"
    given = {"path": path, "truth": truth, "duration": duration, "particles": particles, "estimator": estimator}
    given |= {"rejuvenate_every": rejuvenate_every, "seed": seed}
    place = (KITTI, "an archive (.npz) of KITTI features, a folder with one, or one of images (image_0, ...)")
    values = gather(command, given, config=config, json=json, out=out, log=place)
    if holds_images(values["path"]):
        replay_folder_of_images(values, out, json)
        return
    chosen = KittiConfig.from_mapping(values)
    log = load_kitti(chosen.path, chosen.truth, chosen.duration)
    console, folder = begin(command, chosen, out)
    with share_shown(console, "replay") as on_step:
        result = replay(log, chosen, on_step)
    scored = score(result, log)
    told = []
    if scored is not None:
        told += [drift_told(scored.drifts), end_told(scored.ends, path_length(scored.truth), "odometry")]
    if scored is not None and scored.loop is not None:
        seconds = [float(result.times[step] - result.times[0]) for step in scored.loop]
        told.append(
            f"The place of {seconds[0]:.0f} s was seen again at {seconds[1]:.0f} s; the motion between is off by "
            f"{scored.loop_error:.2f} m. Tracks that ended never come back, so nothing closes this loop."
        )
    finish_one(
        console, folder, json, result, summarise(result, scored), told, "KITTI, tracked stereo features in the plane",
        paths=(scored.path, scored.reckoned) if scored else (result.path, result.reckoned),
        scores=(scored.estimate, scored.odometry) if scored else None,
        known=scored.truth if scored else None,
        truth=log.truth,
    )  # fmt: skip


def finish_one(
    console: Console,
    folder: "RunFolder",
    json: Path | None,
    result: "OneReplay",
    metrics: Mapping[str, Any],
    told: Sequence[str],
    title: str,
    *,
    paths: "tuple[FloatArray, FloatArray]",
    scores: "tuple[PositionScore, PositionScore] | None",
    known: "FloatArray | None",
    known_as: str = "true path",
    truth: "Trajectory | None" = None,
    unknown: str = NO_TRUTH,
) -> None:
    """Show and keep what came of one robot's log.

    Args:
        console: Where to print.
        folder: Of the run.
        json: The option of that name.
        result: Of the replay.
        metrics: As `metrics_of` gives them.
        told: Lines below the table.
        title: Of the picture.
        paths: Of the estimate and of dead reckoning (T, 2 or 3) [m], start frame, as they are scored.
        scores: Of both; None without truth.
        known: Positions (n, 2 or 3) [m], world frame; None likewise.
        known_as: What the picture calls them.
        truth: The true path, to be kept beside the others.
        unknown: Line in place of the table where there are no scores.
    """
    from training.episodes.maps import write_maps
    from training.experiments.run_folder import plain
    from training.replay.single_robot_figure import draw_one

    shown = plain(metrics)
    print_table(console, shown, result, unknown)
    print_consistency(console, shown["consistency"])
    told = [*told, sentence_of(metrics["rejuvenations"]), write_maps(folder, {"1": result.landmarks})]
    for line in filter(None, told):
        console.print(line, soft_wrap=True, highlight=False)
    flat = tuple(path[:, :2] for path in paths)
    draw_one(
        folder.path / "replay.png", title, result, (flat[0], flat[1]), scores,
        None if known is None else known[:, :2], known_as,
    )  # fmt: skip
    write_paths(folder, result, truth)
    finish(console, folder, folder.write_metrics(shown), json)


def drift_told(drifts: tuple[float, float]) -> str:
    """Return a line about KITTI's drift of the estimate and of odometry; "" where the true path is too short."""
    if not all(map(math.isfinite, drifts)):
        return ""
    return (
        f"Drift (KITTI's: mean error of the motion over 100, 200, ... 800 m): {100.0 * drifts[0]:.2f} % "
        f"(odometry {100.0 * drifts[1]:.2f} %)."
    )


def end_told(ends: tuple[float, float], length: float, other: str) -> str:
    """Return a line about errors at the end [m] of the estimate and of the `other`, after a true path [m]."""
    shares = [100.0 * error / length for error in ends]
    return (
        f"End of {length:.1f} m, from the start, no fit: off by {ends[0]:.2f} m, {shares[0]:.2f} % of the path "
        f"({other} {ends[1]:.2f} m, {shares[1]:.2f} %)."
    )


def print_table(console: Console, metrics: dict[str, Any], result: "OneReplay", unknown: str = NO_TRUTH) -> None:
    """Print how far path and dead reckoning are off or that it is `unknown`, what became of the measurements, speed."""
    row = metrics["robots"][0]
    if row["ate_aligned_m"] is None:
        console.print(unknown, soft_wrap=True, highlight=False)
    else:
        headings = ("", "after the best rigid fit", "from the start, no fit")
        names = {"estimate": "ate", "odometry": "dead_reckoning_ate"}
        rows = [[name, *(number(row[f"{key}_{end}_m"]) for end in ("aligned", "start"))] for name, key in names.items()]
        console.print(console_table("RMS distance to the truth [m]", headings, rows))
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
    from training.experiments.run_folder import to_json

    folder.write_trajectory("estimate", Trajectory(result.times, result.path))
    folder.write_trajectory("dead_reckoning", Trajectory(result.times, result.reckoned))
    if truth is not None:
        folder.write_trajectory("truth", truth)
    folder.write_text("timing.json", to_json({"seconds": result.seconds, "times_real_time": result.speed}))
