"""Command `vslam run`: an exploration episode with live progress, tables, and the run folder."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

from training.commands.helpers.options import options
from training.commands.helpers.run_folder import Call
from training.episodes.config import RunConfig
from training.experiments.output.console import text_column

if TYPE_CHECKING:  # numerical modules are imported when the command runs, so that --help is fast
    from training.episodes.runner import EpisodeRecord, MergeRecord, Progress

VIDEO_SIZE = (960, 720)
REFRESH_STEPS = 5
IMAGE_WIDTH = 480  # width of a robot's camera images, beside the map [px]


@options(RunConfig, "run")
def run(
    call: Call[RunConfig],
    video: Annotated[bool, typer.Option(help="Whether to record a video.")] = True,
    live: Annotated[
        bool, typer.Option("--live", help="Show the episode in a browser on this machine while it runs.")
    ] = False,
    speed: Annotated[
        float, typer.Option(help="Simulated seconds per second with --live; 0: as fast as it runs.", min=0.0)
    ] = 10.0,
    port: Annotated[int, typer.Option(help="Port of 127.0.0.1 for --live; 0: any free one.", min=0, max=65535)] = 8765,
    rerun: Annotated[
        Path | None,
        typer.Option(help="Also write the episode to this .rrd file for rerun (extra rerun).", show_default=False),
    ] = None,
    mcap: Annotated[
        Path | None,
        typer.Option(
            help="Also write the episode to this .mcap file of ROS 2, for Foxglove or rerun (extra ros).",
            show_default=False,
        ),
    ] = None,
    show: Annotated[
        bool, typer.Option("--open", help="Open the browser: with --live at once, else at the end.")
    ] = False,
) -> None:
    """Let robots with unknown starts explore a building, map it, and merge their maps."""
    import webbrowser

    from slam_backend.trajectory import Trajectory
    from training.episodes.figures import draw_errors, draw_maps
    from training.episodes.metrics import score_episode
    from training.episodes.tables import print_consistency, print_tables, write_maps
    from training.experiments.machine.interrupt import interrupt_flag
    from training.experiments.run_folder import plain
    from training.report.content import live_content
    from training.report.live import LiveView
    from training.report.mcap_file import check_mcap, write_mcap
    from training.report.page import REPORT_FILE
    from training.report.recording import EpisodeRecorder
    from training.report.rerun_file import check_rerun, write_rerun

    if rerun is not None:
        check_rerun(rerun)
    if mcap is not None:
        check_mcap(mcap)
    chosen = call.config
    env = chosen.make_env()
    policies = chosen.make_policies(env)
    # Detect a world that cannot be built before the folder is created.
    with ExitStack() as stack:
        view = stack.enter_context(LiveView(port, speed)) if live else None
        console, folder = call.begin(lambda: _first_steps(env, policies, chosen))
        folder.write_text("environment.toml", env.config.replace(world=folder.config["world"]).to_toml())
        recorder = EpisodeRecorder(env, chosen.num_steps, chosen.step_s, policies.goals)
        interrupted = stack.enter_context(interrupt_flag())
        on_steps = [recorder.on_step]
        if view is not None:
            view.shows(lambda: live_content(folder.path, "run", recorder.so_far()), interrupted)
            console.print(f"Live: {view.address}, where the episode begins once the page is open.", soft_wrap=True)
            on_steps.append(view.on_step)
            if show:
                webbrowser.open(view.address)
        record = _run_with_progress(
            console, env, policies, chosen, folder.path / "video.mp4" if video else None, on_steps, interrupted
        )
        recording = recorder.finish(record)
        if view is not None:
            view.finish()
    scores = plain(score_episode(record))
    print_tables(console, scores)
    print_consistency(console, scores["consistency"])
    call.write(scores)
    for robot in range(len(record.infos)):  # estimated paths are in start frames, true paths in the world frame
        for kind, paths in (
            ("estimate", record.estimated), ("dead_reckoning", record.reckoned), ("truth", record.true_poses)
        ):  # fmt: skip
            folder.write_trajectory(f"robot{robot}_{kind}", Trajectory(record.times, paths[robot]))
    agents = env.possible_agents
    maps = {"-".join(map(str, group)): record.maps[group[0]] for group in record.groups}
    grids = {"-".join(map(str, group)): env.belief(agents[group[0]]).grid for group in record.groups}
    console.print(write_maps(folder, maps, grids), soft_wrap=True)
    draw_maps(record, folder.path / "map.png")
    draw_errors(record, folder.path / "error.png")
    recording.save(folder.path)
    if rerun is not None:
        console.print(f"For rerun: {write_rerun(recording, rerun)}", soft_wrap=True)
    if mcap is not None:
        console.print(f"For ROS 2: {write_mcap(recording, mcap)}", soft_wrap=True)
    call.finish()
    if show and not live:
        webbrowser.open((folder.path / REPORT_FILE).resolve().as_uri())


def _first_steps(env: Any, policies: Any, config: RunConfig) -> None:
    """Run the first two steps of the episode, which use all kernels except those of merging."""
    from training.episodes.runner import run_episode

    steps = iter(range(2))
    run_episode(
        env, policies, config.seed, should_stop=lambda: next(steps, None) is None, options=config.reset_options()
    )


def _run_with_progress(
    console: Console, env: Any, policies: Any, config: RunConfig, video: Path | None,
    on_steps: "Sequence[Callable[[Progress], None]]", interrupted: Callable[[], bool],
) -> "EpisodeRecord":  # fmt: skip
    """Run the episode with live metrics, with a video if there is a path for it, until it ends or is interrupted."""
    from training.episodes.runner import run_episode
    from training.episodes.video import VideoWriter, choose_pace, with_camera_images, with_video_time_merges
    from vslam_env.rendering import draw_frame

    pace = choose_pace(config.num_steps, config.step_s)
    eyes = config.sensor == "stereo"
    size = (VIDEO_SIZE[0] + (IMAGE_WIDTH if eyes else 0), VIDEO_SIZE[1])
    with ExitStack() as stack:
        show = stack.enter_context(live_progress(console, config.num_steps, env.possible_agents))
        writer = None if video is None else stack.enter_context(VideoWriter(video, size, pace.fps))

        def on_step(progress: "Progress") -> None:
            show(progress)
            for each in on_steps:
                each(progress)
            if writer is not None and progress.step % pace.stride == 0:
                picture = draw_frame(with_video_time_merges(env.scene(), env.events, pace.speedup), VIDEO_SIZE)
                writer.add(with_camera_images(picture, env.episode.frames[0], IMAGE_WIDTH) if eyes else picture)

        record = run_episode(env, policies, config.seed, on_step, interrupted, config.reset_options())
    if not record.complete:
        console.print(f"Stopped at {record.times[-1]:.1f} s; the results cover the run until then.")
    return record


@contextmanager
def live_progress(console: Console, num_steps: int, agents: Sequence[str]) -> Iterator[Callable[["Progress"], None]]:
    """Show a bar with the metrics of a running episode, and a line for each merge; yield the callback for a step."""
    columns = (
        text_column("{task.fields[time]:6.1f} s"), BarColumn(20), text_column("E {task.fields[errors]} m"),
        text_column("coverage {task.fields[coverage]:2.0f} %"), text_column("{task.fields[maps]}"),
        TimeRemainingColumn(),
    )  # fmt: skip
    with Bar(*columns, console=console) as bar:
        task = bar.add_task("run", total=num_steps, time=0.0, errors="-", coverage=0.0, maps=_count_maps(len(agents)))

        def show(progress: "Progress") -> None:
            for merge in progress.new_merges:
                console.print(describe(merge))
            if progress.step % REFRESH_STEPS == 0:
                infos = [progress.infos[agent] for agent in agents]
                bar.update(
                    task, completed=progress.step, time=progress.time,
                    errors=errors_in_short([info["map_error"] for info in infos]),
                    coverage=100.0 * infos[0]["coverage"], maps=_count_maps(len({info["group"] for info in infos})),
                )  # fmt: skip

        yield show


def _count_maps(number: int) -> str:
    return "1 map" if number == 1 else f"{number} maps"


def errors_in_short(errors: Sequence[float]) -> str:
    """Return the map errors [m] of up to three robots, or mean and range of more.

    >>> errors_in_short([0.5, 0.25]), errors_in_short([0.5, 0.25, 0.25, 0.0])
    ('0.50 0.25', '0.25 (0.00 to 0.50)')
    """
    if len(errors) <= 3:
        return " ".join(f"{error:.2f}" for error in errors)
    return f"{sum(errors) / len(errors):.2f} ({min(errors):.2f} to {max(errors):.2f})"


def describe(merge: "MergeRecord") -> str:
    """Describe a merge in one line."""
    sides = [", ".join(map(str, side)) for side in (merge.robots_a, merge.robots_b)]
    off = f"error {merge.error_m:.2f} m, {merge.error_deg:.1f} deg"
    return f"{merge.time:6.1f} s  maps of {sides[0]} and {sides[1]} merged on {merge.landmarks} landmarks, {off}"
