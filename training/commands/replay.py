"""The command `vslam replay mrclam`: options, live progress, a table, and the run folder."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from training.commands._options import Config, Duration, Estimator, Json, Out, RejuvenateEvery, Seed, numbers
from training.commands._progress import share_shown
from training.commands._run_folder import begin, choose, finish
from training.episodes.attempt_tables import print_refusals
from training.episodes.consistency_table import print_consistency
from training.experiments.tables import console_table, number
from training.replay.rejuvenation_counts import sentence_of

if TYPE_CHECKING:  # what computes is imported when the command runs, so that --help answers at once
    from slam_backend.readers.mrclam import MrclamLog
    from training.experiments.run_folder import RunFolder
    from training.replay.mrclam import Replay, ReplayConfig

COMMAND = "replay mrclam"
DATASET = Path("mrclam") / "MRCLAM_Dataset7"
LOG = (DATASET, "a folder of the MR.CLAM log, with Barcodes.dat, Landmark_Groundtruth.dat and Robot*.dat")


def replay_mrclam(
    path: Annotated[
        Path | None, typer.Option(help="Folder of the log.", show_default=f"{DATASET} in $VSLAM_DATA")
    ] = None,
    robots: Annotated[str | None, typer.Option(help="Numbers with commas, e.g. 1,2,5.", show_default="all")] = None,
    truth: Annotated[
        Path | None, typer.Option(help="File of the true poses of the one robot named.", show_default="the folder's")
    ] = None,
    duration: Duration = None,
    identities: Annotated[
        str | None, typer.Option(help="given: barcodes are read. hidden: positions alone.", show_default="given")
    ] = None,
    alone: Annotated[
        bool | None, typer.Option("--alone/--team", help="Each robot by itself, or maps merge.", show_default="team")
    ] = None,
    particles: Annotated[
        int | None, typer.Option(help="Particles per filter.", show_default="100 for each robot of a team")
    ] = None,
    estimator: Estimator = None,
    rejuvenate_every: RejuvenateEvery = None,
    seed: Seed = None,
    out: Out = None,
    json: Json = None,
    config: Config = None,
) -> None:
    """Five real robots with unknown starts: a filter each, maps aligned and merged, one team in the end.

    The odometry noise was calibrated on data sets 7 and 4 of MR.CLAM.
    """
    from slam_backend.readers.mrclam import load_mrclam
    from training.episodes.maps import group_name, write_maps
    from training.experiments.run_folder import plain, to_json
    from training.replay.figures import draw_joint_map, draw_replay
    from training.replay.metrics import score_path, summarise
    from training.replay.mrclam import ReplayConfig, replay

    given = {
        "path": path,
        "robots": numbers("robots", robots),
        "truth": truth,
        "duration": duration,
        "identities": identities,
        "alone": alone,
        "particles": particles,
        "estimator": estimator,
        "rejuvenate_every": rejuvenate_every,
        "seed": seed,
    }
    chosen = choose(ReplayConfig, COMMAND, given, config=config, json=json, out=out, log=LOG)
    log = load_mrclam(chosen.path, chosen.robots, chosen.duration, chosen.truth)
    console, folder = begin(COMMAND, chosen, out)
    for note in log.notes:
        console.print(note, soft_wrap=True, highlight=False)
    result = _replay_live(console, log, chosen, replay)
    paths = [score_path(result, robot, own.truth) for robot, own in enumerate(log.robots)]
    scores = plain(summarise(result, log, paths))
    _print_tables(console, scores, {own.robot for own in log.robots if own.truth is not None})
    print_consistency(console, scores["consistency"])
    if told := sentence_of(scores["rejuvenations"]):
        console.print(told, highlight=False)
    speed = float(result.times[-1] - result.times[0]) / result.seconds
    console.print(f"The filters took {result.seconds:.1f} s: {speed:.0f} times real time.", highlight=False)
    _write_paths(folder, log, result)
    maps = {group_name([log.robots[r].robot for r in group]): result.maps[group[0]] for group in result.groups}
    console.print(write_maps(folder, maps), soft_wrap=True, highlight=False)
    folder.write_text("timing.json", to_json({"seconds": result.seconds, "times_real_time": speed}))
    draw_replay(folder.path / "replay.png", log, result, paths)
    for group in result.groups:
        if len(group) > 1:
            names = group_name([log.robots[robot].robot for robot in group])
            draw_joint_map(folder.path / f"joint_map_{names}.png", log, result, paths, group)
    finish(console, folder, folder.write_metrics(scores), json)


def _replay_live(console: Console, log: "MrclamLog", config: "ReplayConfig", replay: Any) -> "Replay":
    """Run the replay under a progress bar, and tell of each merge as it comes."""
    names = [own.robot for own in log.robots]
    team = f"{len(names)} robots"
    with share_shown(console, team, "{task.fields[groups]} groups", groups=len(names)) as update:

        def on_step(done: float, report: Any) -> None:
            update(done, groups=len(report.groups))
            for event in report.events:
                if event.kind == "merge":
                    sides = [", ".join(str(names[r]) for r in side) for side in (event.robots_a, event.robots_b)]
                    seconds = report.step * config.dt
                    console.print(f"{seconds:6.1f} s  maps of {sides[0]} and {sides[1]} merged")

        result: Replay = replay(log, config, on_step)
    return result


def _write_paths(folder: "RunFolder", log: "MrclamLog", result: "Replay") -> None:
    """Write per robot its estimated and reckoned path, own start frame, and its true one, world frame."""
    from slam_backend.trajectory import Trajectory

    for robot, own in enumerate(log.robots):
        for kind, poses in (("estimate", result.paths[robot]), ("dead_reckoning", result.reckoned[robot])):
            folder.write_trajectory(f"robot{own.robot}_{kind}", Trajectory(result.times, poses))
        if own.truth is not None:
            folder.write_trajectory(f"robot{own.robot}_truth", own.truth)


def _print_tables(console: Console, metrics: dict[str, Any], with_poses: set[int]) -> None:
    """Print scores of paths, maps and merges, as far as they are known.

    Args:
        console: Where to.
        metrics: Content of `metrics.json`.
        with_poses: Numbers of the robots whose log has true poses.
    """
    aligned, start = "after the best rigid fit", "from the true start, no fit"
    paths = {
        f"path (m),\n{aligned}": "ate_aligned_m", "odometry,\nfitted too": "dead_reckoning_ate_aligned_m",
        f"path (m),\n{start}": "ate_start_m", "odometry,\nno fit": "dead_reckoning_ate_start_m",
    }  # fmt: skip
    maps = {
        f"RMSE (m),\n{aligned}": "map_rmse_m", "recall": "map_recall", "precision": "map_precision",
        f"map error E (m),\nerrors cut at 1 m,\n{start}": "map_error",
    }  # fmt: skip
    for title, columns in (("Paths", paths), ("Maps", maps)):
        rows = [row for row in metrics["robots"] if any(row[key] is not None for key in columns.values())]
        shown = {name: key for name, key in columns.items() if any(row[key] is not None for row in rows)}
        if rows:
            cells = [[str(row["robot"]), *(number(row[key]) for key in shown.values())] for row in rows]
            console.print(console_table(title, ("robot", *shown), cells))
        unknown = [row["robot"] for row in metrics["robots"] if row not in rows]
        missed = [robot for robot in unknown if title == "Paths" and robot in with_poses]
        for robots, why in (
            ([robot for robot in unknown if robot not in missed], "no ground truth in this folder"),
            (missed, "fewer than two true poses during this replay"),
        ):
            if robots:
                console.print(f"{title} of robots {', '.join(map(str, robots))}: {why}.", highlight=False)
    errors = {"off by (m)": "error_m", "off by (°)": "error_deg"}
    errors = {name: key for name, key in errors.items() if any(row[key] is not None for row in metrics["merges"])}
    merges = []
    for row in metrics["merges"]:
        sides = [", ".join(map(str, row[side])) for side in ("robots_a", "robots_b")]
        off = [number(row[key]) for key in errors.values()]
        merges.append([f"{row['time_s']:.1f}", *sides, str(row["landmarks"]), *off])
    headings = ("time (s)", "group", "with", "shared landmarks", *errors)
    console.print(console_table("Merges", headings, merges) if merges else "No merge.")
    print_refusals(console, metrics["refusals"])
    console.print("Groups at the end: " + "; ".join(", ".join(map(str, group)) for group in metrics["groups"]))
