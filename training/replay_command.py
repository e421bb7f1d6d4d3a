"""The command `vslam replay mrclam`: options, live progress, a table, and the run folder."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from training.compiling import prepare

if TYPE_CHECKING:  # what computes is imported when the command runs, so that --help answers at once
    from slam_backend.readers.mrclam import MrclamLog
    from training.replay_mrclam import Replay, ReplayConfig
    from training.run_folder import RunFolder

COMMAND = "replay mrclam"
DATASET = Path("mrclam") / "MRCLAM_Dataset7"


def replay_mrclam(
    path: Annotated[
        Path | None, typer.Option(help="Folder of the log.", show_default=f"{DATASET} in $VSLAM_DATA")
    ] = None,
    robots: Annotated[
        str | None, typer.Option(help="Numbers with commas, e.g. 1,2,5.", show_default="all")
    ] = None,
    duration: Annotated[
        float | None, typer.Option(help="Seconds to replay.", show_default="all")
    ] = None,
    particles: Annotated[
        int | None, typer.Option(help="Particles per filter.", show_default="100")
    ] = None,
    estimator: Annotated[
        str | None, typer.Option(help="fastslam2 or fastslam1.", show_default="fastslam2")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Of all random draws.", show_default="0")] = None,
    out: Annotated[
        Path | None, typer.Option(help="New run folder.", show_default="the next runs/replay-mrclam-*")
    ] = None,
    json: Annotated[Path | None, typer.Option(help="Write the metrics to this file too.", show_default=False)] = None,
    config: Annotated[
        Path | None,
        typer.Option(help="config.toml of an earlier run to repeat; other options override it.", show_default=False),
    ] = None,
) -> None:
    """Five real robots with unknown starts: a filter each, maps aligned and merged, one team in the end."""
    from slam_backend.readers.mrclam import load_mrclam
    from training.figures_replay import draw_replay
    from training.replay_mrclam import ReplayConfig, replay
    from training.replay_scores import score_path, summarise
    from training.run_folder import RunFolder, check_writable, plain, read_config, to_json, write_whole

    if json is not None and json.parent != out:  # the run's own folder does not exist yet
        check_writable(json, "json")
    values: dict[str, Any] = {}
    if config is not None:
        values, values["seed"] = read_config(config, COMMAND)
    given = {
        "path": None if path is None else str(path.resolve()),  # so that the config repeats from any folder
        "robots": None if robots is None else parse_numbers(robots),
        "duration": duration,
        "particles": particles,
        "estimator": estimator,
        "seed": seed,
    }
    values |= {name: value for name, value in given.items() if value is not None}
    chosen = ReplayConfig.from_mapping({"path": str(default_path()), **values} if "path" not in values else values)
    log = load_mrclam(chosen.path, chosen.robots, chosen.duration)
    folder = RunFolder.create(out, COMMAND, chosen.to_mapping(), chosen.seed)
    prepare()
    console = Console()
    result = _replay_live(console, log, chosen, replay)
    paths = [score_path(result, robot, own.truth) for robot, own in enumerate(log.robots)]
    scores = plain(summarise(result, log, paths))
    _print_tables(console, scores)
    metrics = folder.write_metrics(scores)
    _write_paths(folder, log, result)
    draw_replay(folder.path / "replay.png", log, result, paths)
    if json is not None:
        write_whole(json, to_json(metrics), "json")
    console.print(f"Run folder: {folder.path}", soft_wrap=True, highlight=False)


def parse_numbers(text: str) -> tuple[int, ...]:
    """Return the numbers of a text such as `1,2,5`.

    Raises:
        ValueError: If it is none.
    """
    from slam_backend.errors import bad_argument

    words = text.split(",")
    if not all(word.strip().isdecimal() for word in words):
        raise bad_argument("robots", "numbers with commas between", repr(text), "Write them like 1,2,5.")
    return tuple(int(word) for word in words)


def default_path() -> Path:
    """Return the folder of the log below the one that the variable VSLAM_DATA names.

    Raises:
        ValueError: If the variable is not set.
    """
    from slam_backend.errors import bad_argument

    data = os.environ.get("VSLAM_DATA")
    if not data:
        raise bad_argument("path", "a folder of the MR.CLAM log", "no --path", "Name it, or set VSLAM_DATA.")
    return Path(data).resolve() / DATASET


def _replay_live(console: Console, log: "MrclamLog", config: "ReplayConfig", replay: Any) -> "Replay":
    """Run the replay under a progress bar, and tell of each merge as it comes."""
    numbers = [own.robot for own in log.robots]
    columns = (
        TextColumn("[progress.description]{task.description}"), BarColumn(), TextColumn("{task.percentage:>3.0f} %"),
        TextColumn("{task.fields[groups]} groups"), TimeElapsedColumn(), TimeRemainingColumn(),
    )  # fmt: skip
    with Progress(*columns, console=console) as progress:
        task = progress.add_task(f"{len(numbers)} robots", total=1.0, groups=len(numbers))

        def on_step(done: float, report: Any) -> None:
            progress.update(task, completed=done, groups=len(report.groups))
            for event in report.events:
                if event.kind == "merge":
                    sides = [", ".join(str(numbers[r]) for r in side) for side in (event.robots_a, event.robots_b)]
                    seconds = report.step * config.dt
                    progress.console.print(f"{seconds:6.1f} s  maps of {sides[0]} and {sides[1]} merged")

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


def _print_tables(console: Console, metrics: dict[str, Any]) -> None:
    """Print scores of paths, maps and merges."""
    aligned, start = "after the best rigid fit", "from the true start, no fit"
    paths = {
        f"path (m),\n{aligned}": "ate_aligned_m", "odometry,\nfitted too": "dead_reckoning_ate_aligned_m",
        f"path (m),\n{start}": "ate_start_m", "odometry,\nno fit": "dead_reckoning_ate_start_m",
    }  # fmt: skip
    maps = {
        f"RMSE (m),\n{aligned}": "map_rmse_m", "recall": "map_recall", "precision": "map_precision",
        f"map error (m),\n{start}": "map_error",
    }  # fmt: skip
    for title, columns in (("Paths", paths), ("Maps", maps)):
        table = Table(title=title)
        for name in ("robot", *columns):
            table.add_column(name, justify="right")
        for row in metrics["robots"]:
            table.add_row(str(row["robot"]), *(_number(row[key]) for key in columns.values()))
        console.print(table)
    merges = Table(title="Merges")
    for name in ("time (s)", "group", "with", "shared landmarks", "off by (m)", "off by (°)"):
        merges.add_column(name, justify="right")
    for row in metrics["merges"]:
        sides = [", ".join(map(str, row[side])) for side in ("robots_a", "robots_b")]
        merges.add_row(
            f"{row['time_s']:.1f}", *sides, str(row["landmarks"]), _number(row["error_m"]), _number(row["error_deg"])
        )
    console.print(merges if metrics["merges"] else "No merge.")
    console.print("Groups at the end: " + "; ".join(", ".join(map(str, group)) for group in metrics["groups"]))


def _number(value: float | None) -> str:
    """Show a number with two digits, and what is not known as a dash."""
    return "-" if value is None else f"{value:.2f}"
