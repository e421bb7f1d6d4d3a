"""The command `vslam run`: robots explore a building, live progress, tables, and the run folder."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from training.commands._options import Config, EnvRejuvenateEvery, Json, Noise, Out, Particles, Seed, Sensor
from training.commands._run_folder import begin, choose, finish
from training.episodes.consistency_table import print_consistency

if TYPE_CHECKING:  # what computes is imported when the command runs, so that --help answers at once
    from training.episodes.config import RunConfig
    from training.episodes.runner import EpisodeRecord
    from training.experiments.run_folder import RunFolder

COMMAND = "run"
VIDEO_SIZE = (960, 720)
EYE_WIDTH = 480  # of what one robot sees, beside the map [px]


def run(
    world: Annotated[
        str | None, typer.Option(help="A family or a path; see vslam worlds list.", show_default="office")
    ] = None,
    robots: Annotated[int | None, typer.Option(help="How many, 1 to 8.", show_default="3")] = None,
    policy: Annotated[
        str | None,
        typer.Option(
            help="frontier, random_goals, random_walk, a trained model's path, or MODULE:NAME of your own.",
            show_default="frontier",
        ),
    ] = None,
    seed: Seed = None,
    action_type: Annotated[
        str | None,
        typer.Option(help="continuous, discrete or goal.", show_default="continuous, if the policy knows it"),
    ] = None,
    max_cycles: Annotated[int | None, typer.Option(help="Steps of the episode.", show_default="180 s worth")] = None,
    particles: Particles = None,
    rejuvenate_every: EnvRejuvenateEvery = None,
    preset: Noise = None,
    sensor: Sensor = None,
    out: Out = None,
    json: Json = None,
    video: Annotated[bool, typer.Option(help="Whether to film the run.")] = True,
    config: Config = None,
) -> None:
    """Robots that do not know where they start explore a building, map it, and join their maps."""
    from agents.registry import action_types
    from training.episodes.config import RunConfig
    from training.episodes.figures import draw_errors, draw_maps
    from training.episodes.maps import group_name, write_maps
    from training.episodes.metrics import score_episode
    from training.episodes.tables import print_tables
    from training.experiments.run_folder import plain

    if action_type is None and policy is not None and "continuous" not in (known := action_types(policy)):
        action_type = known[0]
    given = {
        "world": world,
        "robots": robots,
        "policy": policy,
        "seed": seed,
        "action_type": action_type,
        "max_cycles": max_cycles,
        "particles": particles,
        "rejuvenate_every": rejuvenate_every,
        "preset": preset,
        "sensor": sensor,
    }
    chosen = choose(RunConfig, COMMAND, given, config=config, json=json, out=out)
    env = chosen.make_env()
    policies = chosen.make_policies(env)
    # A bad world shows before there is a folder.
    console, folder = begin(COMMAND, chosen, out, lambda: _first_steps(env, policies, chosen.seed))
    folder.write_text("environment.toml", env.config.replace(world=folder.config["world"]).to_toml())
    record = _run_live(console, env, policies, chosen, folder.path / "video.mp4" if video else None)
    scores = plain(score_episode(record))
    print_tables(console, scores)
    print_consistency(console, scores["consistency"])
    metrics = folder.write_metrics(scores)
    _write_paths(folder, record)
    maps = {group_name(group): record.maps[group[0]] for group in record.groups}
    console.print(write_maps(folder, maps), soft_wrap=True, highlight=False)
    draw_maps(record, folder.path / "map.png")
    draw_errors(record, folder.path / "error.png")
    finish(console, folder, metrics, json)


def _first_steps(env: Any, policies: Any, seed: int) -> None:
    """Run the first two steps of the episode, which need all kernels but those of a merge."""
    from training.episodes.runner import run_episode

    steps = iter(range(2))
    run_episode(env, policies, seed, should_stop=lambda: next(steps, None) is None)


def _run_live(console: Console, env: Any, policies: Any, config: "RunConfig", video: Path | None) -> "EpisodeRecord":
    """Run the episode with live figures, filming it if there is a path for the video; Ctrl-C ends it early."""
    from contextlib import ExitStack

    from training.episodes.camera_overlay import beside_the_map
    from training.episodes.live import LiveProgress
    from training.episodes.runner import Progress, run_episode
    from training.episodes.video import VideoWriter, choose_pace, with_slow_flashes
    from training.experiments.interrupt import interrupt_flag
    from vslam_env.rendering import draw_frame

    pace = choose_pace(config.num_steps, config.step_s)
    eyes = config.sensor == "stereo"
    size = (VIDEO_SIZE[0] + (EYE_WIDTH if eyes else 0), VIDEO_SIZE[1])
    with ExitStack() as stack:
        interrupted = stack.enter_context(interrupt_flag())
        live = stack.enter_context(LiveProgress(console, config.num_steps, env.possible_agents))
        writer = None if video is None else stack.enter_context(VideoWriter(video, size, pace.fps))

        def on_step(progress: Progress) -> None:
            live.show(progress)
            if writer is not None and progress.step % pace.stride == 0:
                picture = draw_frame(with_slow_flashes(env.scene(), env.events, pace.speedup), VIDEO_SIZE)
                writer.add(beside_the_map(picture, env.episode.frames[0], EYE_WIDTH) if eyes else picture)

        record = run_episode(env, policies, config.seed, on_step, interrupted)
    if not record.complete:
        console.print(f"Stopped at {record.times[-1]:.1f} s; what follows is about the run until then.")
    return record


def _write_paths(folder: "RunFolder", record: "EpisodeRecord") -> None:
    """Write per robot its estimated and reckoned path, own start frame, and its true one, world frame."""
    from slam_backend.trajectory import Trajectory

    for robot in range(len(record.infos)):
        for kind, paths in (
            ("estimate", record.estimated), ("dead_reckoning", record.reckoned), ("truth", record.true_poses)
        ):  # fmt: skip
            folder.write_trajectory(f"robot{robot}_{kind}", Trajectory(record.times, paths[robot]))
