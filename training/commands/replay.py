"""Commands `vslam replay ...`: the backend on logs of real robots."""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import typer
from rich.console import Console

from training.commands._options import options
from training.commands._progress import share_progress
from training.commands._run_folder import Call
from training.episodes.tables import figures, print_consistency, print_groups, print_refusals, write_maps
from training.experiments.tables import ATE_NOTE, E_SCALE, console_table, heading, number
from training.replay.config import (
    KITTI,
    MRCLAM,
    PAIRS,
    VICTORIA,
    ImagesConfig,
    KittiConfig,
    MrclamConfig,
    PairsConfig,
    VictoriaConfig,
)

if TYPE_CHECKING:  # numerical modules are imported when the command runs, so that --help is fast
    from slam_backend.core.validation import FloatArray
    from slam_backend.readers.mrclam import MrclamLog
    from slam_backend.trajectory import Trajectory
    from training.replay.kitti import DriveScore
    from training.replay.mrclam import Replay
    from training.replay.single_robot import OneReplay
    from training.replay.victoria import VictoriaScore

replay = typer.Typer(help="Run the backend on logs of real robots.", no_args_is_help=True)

NO_TRUTH = "Errors: no ground truth in this folder."
MRCLAM_LOG = (MRCLAM, "a folder of the MR.CLAM log, with Barcodes.dat, Landmark_Groundtruth.dat and Robot*.dat")
VICTORIA_LOG = (
    VICTORIA, "a folder of the Victoria Park log, with aa3_dr.mat, VictoriaParkSinSincronizar.mat and aa3_gpsx.mat",
)  # fmt: skip
KITTI_LOG = (KITTI, "an archive (.npz) of KITTI features, a folder with one, or a folder of images (image_0, ...)")
STEREO_LOG = (
    PAIRS,
    "a folder with two stereo pairs (left_img_0.png, right_img_0.png, left_img_1.png, ...) and their calibration",
)
DRIVE_ALONE = ("times", "duration", "particles")  # options for drives only, not for two pairs


@replay.command("mrclam")
@options(MrclamConfig, "replay mrclam", log=MRCLAM_LOG)
def replay_mrclam(call: Call[MrclamConfig]) -> None:
    """Replay five real robots with unknown starts: separate filters, whose maps are aligned and merged into one team.

    The odometry noise was calibrated on data sets 7 and 4 of MR.CLAM.
    """
    from slam_backend.readers.mrclam import load_mrclam
    from slam_backend.trajectory import Trajectory
    from training.experiments.run_folder import plain, to_json
    from training.replay.figures import draw_joint_map, draw_replay
    from training.replay.metrics import score_path, summarise
    from training.replay.recordings import record_team

    chosen = call.config
    log = load_mrclam(chosen.path, chosen.robots, chosen.duration, chosen.truth)
    console, folder = call.begin()
    for note in log.notes:
        console.print(note, soft_wrap=True)
    result = _replay_live(console, log, chosen)
    paths = [score_path(result, robot, robot_log.truth) for robot, robot_log in enumerate(log.robots)]
    scores = plain(summarise(result, log, paths))
    _print_tables(console, scores, {robot_log.robot for robot_log in log.robots if robot_log.truth is not None})
    print_consistency(console, scores["consistency"])
    for note in scores["notes"][len(log.notes) :]:
        console.print(note, soft_wrap=True)
    if counts := _rejuvenations(scores["rejuvenations"]):
        console.print(counts)
    speed = float(result.times[-1] - result.times[0]) / result.seconds
    console.print(f"Filter time: {result.seconds:.1f} s, {speed:.0f} times real time.")
    for robot, robot_log in enumerate(log.robots):
        for kind, poses in (("estimate", result.paths[robot]), ("dead_reckoning", result.reckoned[robot])):
            folder.write_trajectory(f"robot{robot_log.robot}_{kind}", Trajectory(result.times, poses))
        if robot_log.truth is not None:
            folder.write_trajectory(f"robot{robot_log.robot}_truth", robot_log.truth)
    names = {group: "-".join(str(log.robots[robot].robot) for robot in group) for group in result.groups}
    maps = {names[group]: result.maps[group[0]] for group in result.groups}
    console.print(write_maps(folder, maps), soft_wrap=True)
    folder.write_text("timing.json", to_json({"seconds": result.seconds, "times_real_time": speed}))
    draw_replay(folder.path / "replay.png", log, result, paths)
    for group in result.groups:
        if len(group) > 1:
            draw_joint_map(folder.path / f"joint_map_{names[group]}.png", log, result, paths, group)
    record_team(log, result, paths).save(folder.path)
    call.write(scores)
    call.finish()


def _replay_live(console: Console, log: "MrclamLog", config: MrclamConfig) -> "Replay":
    """Run the replay under a progress bar, and print each merge when it happens."""
    from training.replay.mrclam import replay_team

    names = [robot_log.robot for robot_log in log.robots]
    with share_progress(console, f"{len(names)} robots", "{task.fields[groups]} groups", groups=len(names)) as update:

        def on_step(done: float, report: Any) -> None:
            update(done, groups=len(report.groups))
            for event in report.events:
                if event.kind == "merge":
                    sides = [", ".join(str(names[r]) for r in side) for side in (event.robots_a, event.robots_b)]
                    seconds = report.step * config.dt
                    console.print(f"{seconds:6.1f} s  maps of {sides[0]} and {sides[1]} merged")

        return replay_team(log, config, on_step)


def _print_tables(console: Console, metrics: dict[str, Any], with_poses: set[int]) -> None:
    """Print the available errors of paths, maps and merges."""
    paths = dict.fromkeys(
        ("ate_aligned_m", "dead_reckoning_ate_aligned_m", "ate_start_m", "dead_reckoning_ate_start_m"), 2
    )
    maps = {"map_rmse_aligned_m": 2, "map_recall": 0, "map_precision": 0, "map_error": 2}
    for title, columns, note in (("Paths", paths, ATE_NOTE), ("Maps", maps, E_SCALE)):
        rows = [row for row in metrics["robots"] if any(row[key] is not None for key in columns)]
        shown = {key: digits for key, digits in columns.items() if any(row[key] is not None for row in rows)}
        if rows:
            cells = [[str(row["robot"]), *figures(row, shown)] for row in rows]
            console.print(console_table(title, ("robot", *map(heading, shown)), cells))
            if title == "Paths" or "map_error" in shown:
                console.print(note)
        unknown = [row["robot"] for row in metrics["robots"] if row not in rows]
        missed = [robot for robot in unknown if title == "Paths" and robot in with_poses]
        for robots, why in (
            ([robot for robot in unknown if robot not in missed], "no ground truth in this folder"),
            (missed, "fewer than two true poses during this replay"),
        ):
            if robots:
                console.print(f"{title} of robots {', '.join(map(str, robots))}: {why}.")
    errors = {key: 2 for key in ("error_m", "error_deg") if any(row[key] is not None for row in metrics["merges"])}
    merges = []
    for row in metrics["merges"]:
        sides = [", ".join(map(str, row[side])) for side in ("robots_a", "robots_b")]
        merges.append([f"{row['time_s']:.1f}", *sides, str(row["landmarks"]), *figures(row, errors)])
    headings = list(map(heading, ("time_s", "robots_a", "robots_b", "landmarks", *errors)))
    console.print(console_table("Merges", headings, merges) if merges else "No merge.")
    print_refusals(console, metrics["refusals"])
    print_groups(console, metrics)


@replay.command("victoria")
@options(VictoriaConfig, "replay victoria", log=VICTORIA_LOG)
def replay_victoria(call: Call[VictoriaConfig]) -> None:
    """Replay a car among the trees of a park: unlabelled trees, matched by position, with GPS as ground truth."""
    from slam_backend.readers.victoria import load_victoria
    from training.replay.victoria import replay, score, summarise

    log = load_victoria(call.config.path, call.config.duration)
    console, _ = call.begin()
    with share_progress(console, "replay") as on_step:
        result = replay(log, call.config, on_step)
    scored = score(result, log)
    metrics = summarise(result, scored)
    notes = [f"Trees seen at least ten times: {metrics['landmarks_seen_ten_times']}.", *log.notes]
    unknown = NO_TRUTH
    if scored is not None:
        gps = metrics["gps"]
        notes.insert(
            0,
            f"At {gps['fixes']} GPS fixes: median {gps['median_m']:.2f} m, 95 % within {gps['percentile_95_m']:.2f} m, "
            f"worst {gps['worst_m']:.1f} m.",
        )
    elif log.gps is not None:
        fixes, times = log.gps[[0, -1], 0], result.times[[0, -1]]
        unknown = (
            f"Errors: fewer than two GPS fixes ({fixes[0]:.1f} to {fixes[1]:.1f} s) during this replay "
            f"({times[0]:.1f} to {times[1]:.1f} s)."
        )
    known = scored.fixes if scored else None
    metrics |= {"notes": log.notes}
    _finish_one(call, result, metrics, notes, "Victoria Park", scored, known, known_as="GPS", unknown=unknown)


@replay.command("kitti")
@options(KittiConfig, "replay kitti", log=KITTI_LOG)
def replay_kitti(call: Call[KittiConfig]) -> None:
    """Replay a car in a town: stereo images, or tracked stereo features as landmarks, assuming planar motion."""
    from slam_backend.readers.kitti import load_kitti
    from slam_backend.readers.kitti_images import is_image_folder
    from training.replay.kitti import replay, score, summarise

    if is_image_folder(call.values["path"]):
        _replay_images(call, ImagesConfig.from_mapping(call.values))
        return
    log = load_kitti(call.config.path, call.config.truth, call.config.duration)
    console, _ = call.begin()
    with share_progress(console, "replay") as on_step:
        result = replay(log, call.config, on_step)
    scored = score(result, log)
    notes = _drift_lines(scored, "odometry")
    if scored is not None and scored.loop is not None:
        seconds = [float(result.times[step] - result.times[0]) for step in scored.loop]
        notes.append(
            f"The robot returned at {seconds[1]:.0f} s to its place of {seconds[0]:.0f} s; relative error: "
            f"{scored.loop_error:.2f} m. Ended tracks are not matched again, so there is no loop closure."
        )
    title = "KITTI, tracked stereo features in the plane"
    known = scored.truth if scored else None
    _finish_one(call, result, summarise(result, scored), notes, title, scored, known, truth=log.truth)


@replay.command("stereo")
@options(ImagesConfig, "replay stereo", log=STEREO_LOG)
def replay_stereo(call: Call[ImagesConfig]) -> None:
    """Replay stereo images: two pairs give the motion between their places, three or more a drive in the plane.

    File names are relative to the folder, unless they are absolute paths.
    """
    from slam_backend.core.validation import argument_error
    from slam_backend.readers.stereo_files import StereoFiles, find_pairs

    values, usual = call.values, StereoFiles()
    names = {key: values.get(key, getattr(usual, key)) for key in ("left", "right", "calibration")}
    if len(find_pairs(values["path"], StereoFiles(**names))[0]) > 2:
        _replay_images(call, ImagesConfig.from_mapping(values | names))
        return
    for name in DRIVE_ALONE:
        if name in values:
            hint = "Omit it: two pairs are aligned in space."
            raise argument_error(name, "a drive of three pairs or more", "a folder with two pairs", hint)
    _align_pairs(call, PairsConfig.from_mapping(values))


def _align_pairs(call: Call[ImagesConfig], chosen: PairsConfig) -> None:
    """Align two pairs with each descriptor, print the result, and write the run folder."""
    import numpy as np

    from slam_backend.frontend import DESCRIPTORS
    from training.experiments.run_folder import plain
    from training.replay.image_figures import draw_matches
    from training.replay.stereo_pairs import align_pairs, load_pairs, summarise_pairs

    log = load_pairs(chosen.path, chosen.files)
    console, folder = call.begin(config=chosen)
    order = [chosen.descriptor, *(name for name in DESCRIPTORS if name != chosen.descriptor)]
    results = {name: align_pairs(log, chosen.replace(descriptor=name)) for name in order}
    metrics = plain(summarise_pairs(results))
    known = log.poses is not None
    headings = ("descriptor", "points", "matches", "inliers", *(("error (m)", "error (degrees)") if known else ()))
    rows = []
    for name, row in metrics["alignments"].items():
        kinds = (("error_m", 3), ("error_deg", 2)) if known else ()
        errors = ["none" if row[key] is None else f"{row[key]:.{n}f}" for key, n in kinds]
        points = " + ".join(str(count) for count in row["points"])
        rows.append([name, points, str(row["matches"]), str(row["inliers"]), *errors])
    console.print(console_table("Motion between the two places", headings, rows))
    if not known:
        console.print(NO_TRUTH)
    main = results[chosen.descriptor]
    if not np.isnan(main.true_m):
        console.print(f"The places are {main.true_m:.2f} m and {main.true_deg:.1f} degrees apart.")
    if main.motion is not None:
        ends = [frame.pixels[rows, :2] for frame, rows in zip(main.frames, main.motion.pairs.T, strict=True)]
        inliers = np.flatnonzero(main.motion.inliers)
        draw_matches(folder.path / "matches.png", *main.images, ends[0], ends[1], inliers)
    maps = {str(place): landmarks for place, landmarks in enumerate(main.maps)}
    console.print(write_maps(folder, maps), soft_wrap=True)
    call.write(metrics)
    call.finish()


def _replay_images(call: Call[Any], chosen: ImagesConfig) -> None:
    """Replay a folder of stereo images, print the errors, and write the run folder."""
    from training.replay.image_figures import draw_frame, expected_pixels
    from training.replay.stereo_images import load_images, replay_images, score_images, summarise_images

    log = load_images(chosen)
    console, folder = call.begin(config=chosen)
    with share_progress(console, "replay") as on_step:
        result = replay_images(log, chosen, on_step)
    one, scored = result.replay, score_images(result.replay, log)
    metrics = summarise_images(result, scored)
    notes = [
        f"Odometry: visual, from half of the {metrics['features_per_frame']:.0f} features per frame "
        f"({metrics['odometry_inliers_per_frame']:.0f} inliers); the filter uses the other half. Motion is assumed "
        f"planar. Front end and odometry took {1e3 * result.front_end_seconds / len(log.times):.0f} ms per frame.",
        *_drift_lines(scored, "visual odometry alone"),
    ]
    landmarks = one.landmarks
    counts = dict(zip(landmarks.ids.tolist(), landmarks.counts.tolist(), strict=True))
    often = landmarks.subset(landmarks.counts >= 3)
    means = often.means.copy()
    means[:, 2] = [result.heights[name] for name in often.ids.tolist()]
    expected = expected_pixels(means, one.path[-1], log.pair.focal_px, log.pair.centre_px, 30.0)
    image = log.images(len(log.times) - 1)[0]
    draw_frame(folder.path / "frame.png", image, result.last.pixels[::2], result.last_ids, counts, expected)
    known = scored.truth if scored else None
    _finish_one(call, one, metrics, notes, "stereo images in the plane", scored, known, truth=log.truth)


def _drift_lines(scored: "DriveScore | None", other: str) -> list[str]:
    """Return lines about the KITTI drift and the final errors of the estimate and of the `other` path."""
    if scored is None:
        return []
    notes, drifts, ends, length = [], scored.drifts, scored.ends, scored.length
    if all(map(math.isfinite, drifts)):  # the true path is long enough
        notes.append(
            f"Drift (KITTI metric: mean error over segments of 100, 200, ... 800 m): {100.0 * drifts[0]:.2f} % "
            f"(odometry {100.0 * drifts[1]:.2f} %)."
        )
    shares = [100.0 * error / length for error in ends]
    notes.append(
        f"Final error after {length:.1f} m, from the start, no fit: {ends[0]:.2f} m, {shares[0]:.2f} % of the path "
        f"({other} {ends[1]:.2f} m, {shares[1]:.2f} %)."
    )
    return notes


def _finish_one(
    call: Call[Any], result: "OneReplay", metrics: Mapping[str, Any], notes: Sequence[str], title: str,
    scored: "DriveScore | VictoriaScore | None", known: "FloatArray | None", *, known_as: str = "true path",
    truth: "Trajectory | None" = None, unknown: str = NO_TRUTH,
) -> None:  # fmt: skip
    """Print and store the replay of a log of one robot.

    Args:
        known: Known positions (n, 2 or 3) [m], world frame; None without truth.
        known_as: Label of the known positions in the picture.
        unknown: Text in place of the table if there are no errors.
    """
    from slam_backend.trajectory import Trajectory
    from training.experiments.run_folder import plain, to_json
    from training.replay.figures import draw_one
    from training.replay.recordings import record_one

    console, folder = call.console, call.folder
    shown = plain(metrics)
    _print_one(console, shown, result, unknown)
    print_consistency(console, shown["consistency"])
    lines = [*notes, _rejuvenations(metrics["rejuvenations"]), write_maps(folder, {"1": result.landmarks})]
    for line in filter(None, lines):
        console.print(line, soft_wrap=True)
    estimate, reckoned = scored.paths if scored else (result.path, result.reckoned)
    draw_one(
        folder.path / "replay.png", title, result, (estimate[:, :2], reckoned[:, :2]),
        scored.scores if scored else None, None if known is None else known[:, :2], known_as,
    )  # fmt: skip
    true_poses = getattr(scored, "truth", None)  # fixes of a GPS are no poses
    record_one(result, (estimate, reckoned), scored.scores if scored else None, true_poses).save(folder.path)
    folder.write_trajectory("estimate", Trajectory(result.times, result.path))
    folder.write_trajectory("dead_reckoning", Trajectory(result.times, result.reckoned))
    if truth is not None:
        folder.write_trajectory("truth", truth)
    folder.write_text("timing.json", to_json({"seconds": result.seconds, "times_real_time": result.speed}))
    call.write(shown)
    call.finish()


def _print_one(console: Console, metrics: dict[str, Any], result: "OneReplay", unknown: str) -> None:
    """Print errors of path and dead reckoning, or `unknown`, then the use of the measurements and the speed."""
    row = metrics["robots"][0]
    if row["ate_aligned_m"] is None:
        console.print(unknown, soft_wrap=True)
    else:
        headings = ("", "after the best rigid fit", "from the start, no fit")
        names = {"estimate": "ate", "odometry": "dead_reckoning_ate"}
        rows = [[name, *(number(row[f"{key}_{end}_m"]) for end in ("aligned", "start"))] for name, key in names.items()]
        console.print(console_table("RMS distance to the truth [m]", headings, rows))
    made = metrics["measurements"]
    console.print(
        f"{metrics['landmarks']} landmarks; {made['matched']} measurements matched, {made['created']} created "
        f"landmarks, {made['rejected']} rejected. {row['path_m']:.0f} m in {metrics['duration_s']:.0f} s; "
        f"filter time {result.seconds:.1f} s, {result.speed:.0f} times real time."
    )


def _rejuvenations(counts: Mapping[str, Any]) -> str:
    """Return a line with the number of rejuvenations and the reasons for refusals; "" if nothing was attempted."""
    refused = "; ".join(f"{reason} ({count})" for reason, count in counts["refused"].items())
    if not counts["drawn"] and not refused:
        return ""
    return f"Rejuvenated {counts['drawn']} times" + (f". Refused: {refused}." if refused else ".")
