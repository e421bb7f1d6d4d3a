"""Commands `vslam replay ...`: the backend on logs of real robots, one core for the logs of all readers."""

import copy
from collections.abc import Callable, Mapping
from inspect import signature
from typing import TYPE_CHECKING, Any, cast

import typer
from rich.console import Console
from typer.core import TyperGroup

from training.commands.helpers.options import options
from training.commands.helpers.progress import share_progress
from training.commands.helpers.run_folder import Call
from training.commands.study import write_tables
from training.episodes.tables import print_consistency, print_tables, write_maps
from training.experiments.output.console import print_warning
from training.replay.config import (
    KITTI,
    MRCLAM,
    PAIRS,
    VICTORIA,
    BagConfig,
    GraphConfig,
    ImagesConfig,
    KittiConfig,
    LogConfig,
    MrclamConfig,
    ReplayConfig,
    VictoriaConfig,
)

if TYPE_CHECKING:  # numerical modules are imported when the command runs, so that --help is fast
    from training.replay.core import Replay
    from training.replay.log import Log

OWN = "MODULE:FUNCTION"
MRCLAM_LOG = (MRCLAM, "a folder of the MR.CLAM log, with Barcodes.dat, Landmark_Groundtruth.dat and Robot*.dat")
VICTORIA_LOG = (
    VICTORIA, "a folder of the Victoria Park log, with aa3_dr.mat, VictoriaParkSinSincronizar.mat and aa3_gpsx.mat",
)  # fmt: skip
KITTI_LOG = (KITTI, "an archive (.npz) of KITTI features, a folder with one, or a folder of images (image_0, ...)")
STEREO_LOG = (
    PAIRS,
    "a folder with two stereo pairs (left_img_0.png, right_img_0.png, left_img_1.png, ...) and their calibration",
)
PAIR_RANGE = 12.0  # maximum distance of points of two pairs [m]
DRIVE_ALONE = ("times", "duration", "particles")  # options for drives only, not for two pairs


class Readers(TyperGroup):
    """The commands, each with a reader; any other name with a colon is a reader of the user."""

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return a command; None if there is none of this name."""
        if ":" not in cmd_name:
            return super().get_command(ctx, cmd_name)
        command: Any = copy.copy(super().get_command(ctx, OWN))
        command.name = cmd_name
        return command


replay = typer.Typer(cls=Readers, help="Run the backend on logs of real robots.", no_args_is_help=True)


@replay.command("mrclam")
@options(MrclamConfig, "replay mrclam", log=MRCLAM_LOG)
def replay_mrclam(call: Call[MrclamConfig]) -> None:
    """Replay five real robots with unknown starts: separate filters, whose maps are aligned and merged into one team.

    The odometry noise was calibrated on data sets 7 and 4 of MR.CLAM.
    """
    from training.replay.readers import read_mrclam

    _replay(call, call.config, read_mrclam)


@replay.command("victoria")
@options(VictoriaConfig, "replay victoria", log=VICTORIA_LOG)
def replay_victoria(call: Call[VictoriaConfig]) -> None:
    """Replay a car among the trees of a park: unlabelled trees, matched by position, with GPS as ground truth."""
    from training.replay.readers import read_victoria

    _replay(call, call.config, read_victoria)


@replay.command("kitti")
@options(KittiConfig, "replay kitti", log=KITTI_LOG)
def replay_kitti(call: Call[KittiConfig]) -> None:
    """Replay a car in a town: stereo images, or tracked stereo features as landmarks, assuming planar motion."""
    from slam_backend.readers.kitti_images import is_image_folder
    from training.replay.readers import read_kitti

    if is_image_folder(call.values["path"]):
        _replay_images(call, call.values)
    else:
        _replay(call, call.config, read_kitti)


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
        _replay_images(call, values | names)
        return
    for name in DRIVE_ALONE:
        if name in call.given:
            hint = "Omit it: two pairs are aligned in space."
            raise argument_error(name, "a drive of three pairs or more", "a folder with two pairs", hint)
    _align_pairs(call, ImagesConfig.from_mapping({"max_range": PAIR_RANGE} | values | names))


@replay.command("bag")
@options(BagConfig, "replay bag")
def replay_bag(call: Call[BagConfig]) -> None:
    """Replay a bag of ROS 1 or ROS 2 (extra ros): odometry, and landmarks with identities or descriptors.

    Without --odometry and --landmarks its topics are listed. Several comma-separated topics are several robots, a team
    with unknown starts.
    """
    from slam_backend.core.validation import argument_error
    from training.replay.readers import read_bag

    config = call.config
    missing = [name for name in ("odometry", "landmarks") if getattr(config, name) is None]
    if missing:
        _list_topics(call.console, config)
    if len(missing) == 1:
        hint = f"Choose a topic above that can be {missing[0]}."
        raise argument_error(missing[0], f"the topic of the {missing[0]}", f"no --{missing[0]}", hint)
    if not missing:
        _replay(call, config, read_bag)


def _list_topics(console: Console, config: BagConfig) -> None:
    """Print the topics of a bag."""
    from rich.table import Table

    from slam_backend.readers.bags import bag_topics

    table = Table("topic", "type", "messages", "can be", box=None)
    for column in table.columns[:2]:
        column.no_wrap = True
    for topic, kind, count, use in bag_topics(config.path, config.tag_frames):
        table.add_row(topic, kind or "several", str(count), use or "-")
    console.print(table)


@replay.command("graph")
@options(GraphConfig, "replay graph")
def replay_graph(call: Call[GraphConfig]) -> None:
    """Replay a pose graph of g2o or PyFactorGraph with landmarks: its odometry and sightings, identities given."""
    from training.replay.graphs import read_graph_log

    _replay(call, call.config, read_graph_log)


@replay.command(OWN)
@options(LogConfig, f"replay {OWN}")
def replay_own(call: Call[LogConfig], context: typer.Context) -> None:
    """Replay a log by a reader of yours: a function of a path that returns a training.replay.log.Log."""
    from training.replay.log import read_with

    call.command = f"replay {context.info_name}"
    _replay(call, call.config, lambda path: read_with(str(context.info_name), path))


def _replay_images(call: Call[Any], values: Mapping[str, Any]) -> None:
    """Replay a folder of stereo images."""
    from training.replay.stereo_images import read_images

    _replay(call, ImagesConfig.from_mapping(values), read_images)


def _replay(call: Call[Any], config: ReplayConfig, reader: "Callable[..., Log]") -> None:
    """Replay a log, print the errors, and write the run folder.

    Args:
        reader: Function that gets those values of the configuration that are names of its parameters.
    """
    from slam_backend.trajectory import Trajectory
    from training.experiments.run_folder import plain, to_json
    from training.replay.core import make_filters
    from training.replay.figures import draw_replay
    from training.replay.metrics import score_path, summarise
    from training.replay.recordings import record_replay

    log = reader(**{name: getattr(config, name) for name in signature(reader).parameters})
    console, folder = call.begin(lambda: make_filters(log, config), config=config)
    for note in log.notes:
        console.print(note, soft_wrap=True)
    result = _replay_live(console, log, config)
    scores = [score_path(result, log, robot) for robot in range(len(log.robots))]
    metrics = summarise(result, log, scores)
    lines = log.source.complete(metrics, result, scores[0])
    shown = plain(metrics)
    call.write(shown)
    for cause in shown["set_up"]:  # first, as all else may follow from it
        print_warning(f"robot {cause['robot']}, {cause['cause']}: {cause['text']}", console)
    print_tables(console, shown)
    print_consistency(console, shown["consistency"])
    names = {group: "-".join(str(log.robots[robot].number) for robot in group) for group in result.groups}
    lines += [*_summary(shown), f"Filter time: {result.seconds:.1f} s, {result.speed:.0f} times real time."]
    for line in [*lines, write_maps(folder, {name: result.maps[group[0]] for group, name in names.items()})]:
        console.print(line, soft_wrap=True)
    for robot, path, reckoned in zip(log.robots, result.paths, result.reckoned, strict=True):
        prefix = "" if log.team is None else f"robot{robot.number}_"
        folder.write_trajectory(f"{prefix}estimate", Trajectory(result.times, path))
        folder.write_trajectory(f"{prefix}dead_reckoning", Trajectory(result.times, reckoned))
        if isinstance(robot.truth, Trajectory):
            folder.write_trajectory(f"{prefix}truth", robot.truth)
    folder.write_text("timing.json", to_json({"seconds": result.seconds, "times_real_time": result.speed}))
    draw_replay(folder.path / "replay.png", log, result, scores)
    for group in result.groups:
        if len(group) > 1:
            draw_replay(folder.path / f"joint_map_{names[group]}.png", log, result, scores, [group])
    log.source.draw(folder.path, result)
    record_replay(log, result, scores).save(folder.path)
    call.finish()


def _replay_live(console: Console, log: "Log", config: ReplayConfig) -> "Replay":
    """Run the replay under a progress bar, and print each merge when it happens."""
    from training.replay.core import replay_log

    names = [robot.number for robot in log.robots]
    bar = ("replay",) if log.team is None else (f"{len(names)} robots", "{task.fields[groups]} groups")
    with share_progress(console, *bar, groups=len(names)) as update:

        def on_step(done: float, report: Any) -> None:
            update(done, groups=len(report.groups))
            for event in report.events:
                if event.kind == "merge":
                    sides = [", ".join(str(names[r]) for r in side) for side in (event.robots_a, event.robots_b)]
                    seconds = log.times[report.step] - log.times[0]
                    console.print(f"{seconds:6.1f} s  maps of {sides[0]} and {sides[1]} merged")

        return replay_log(log, config, on_step)


def _summary(metrics: Mapping[str, Any]) -> list[str]:
    """Return lines about the end of a single path, the use of the measurements and the rejuvenations."""
    row, made, lines = metrics["robots"][0], metrics["measurements"], []
    if len(metrics["robots"]) == 1 and row["end_error_m"] is not None:
        if row["mean_drift"] is not None:  # the true path is long enough
            lines.append(
                "Drift (KITTI metric: mean error over segments of 100, 200, ... 800 m): "
                f"{100.0 * row['mean_drift']:.2f} % (odometry {100.0 * row['dead_reckoning_mean_drift']:.2f} %)."
            )
        other, length = row["dead_reckoning_end_error_m"], row["true_path_m"]
        lines.append(
            f"Final error after {length:.1f} m, from the start, no fit: {row['end_error_m']:.2f} m, "
            f"{row['end_error_percent']:.2f} % of the path (odometry {other:.2f} m, {100.0 * other / length:.2f} %)."
        )
    if made:
        lines.append(
            f"{metrics['landmarks']} landmarks; {made['matched']} measurements matched, {made['created']} created "
            f"landmarks, {made['rejected']} rejected. {row['path_m']:.0f} m in {metrics['duration_s']:.0f} s."
        )
    return [*lines, *rejuvenation_lines(metrics["rejuvenations"])]


def rejuvenation_lines(counts: Mapping[str, Any]) -> list[str]:
    """Return a line with the number of rejuvenations and the reasons for refusals; none if nothing was attempted."""
    refused = "; ".join(f"{reason} ({count})" for reason, count in counts["refused"].items())
    made = f"Rejuvenated {counts['drawn']} times" + (f". Refused: {refused}." if refused else ".")
    return [made] if counts["drawn"] or refused else []


def _align_pairs(call: Call[ImagesConfig], chosen: ImagesConfig) -> None:
    """Align two pairs with each descriptor, print the result, and write the run folder."""
    from slam_backend.frontend import DESCRIPTORS
    from training.replay.image_figures import draw_matches
    from training.replay.stereo_pairs import TABLE, align_pairs, load_pairs, row_of

    log = load_pairs(chosen.path, chosen.files)
    console, folder = call.begin(config=chosen)
    order = [chosen.descriptor, *(name for name in DESCRIPTORS if name != chosen.descriptor)]
    results = {name: align_pairs(log, cast(Any, name), chosen.max_range, chosen.seed) for name in order}
    main = results[chosen.descriptor]
    write_tables(call, [TABLE], [row_of(name, result) for name, result in results.items()])
    known = f"The places are {main.true_m:.2f} m and {main.true_deg:.1f} degrees apart."
    console.print("Errors: no ground truth in this folder." if log.poses is None else known)
    if main.motion is not None:
        draw_matches(folder.path / "matches.png", main.images, main.frames, main.motion)
    console.print(write_maps(folder, {str(place): own for place, own in enumerate(main.maps)}), soft_wrap=True)
    call.finish()
