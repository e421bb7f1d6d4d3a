"""Command `vslam drive`: drive one robot by keyboard while the others follow a policy."""

from pathlib import Path
from typing import Annotated

import typer

from training.experiments.output.compilation import prepare
from training.experiments.output.console import make_console

EPISODE_S = 600.0  # [s]


def drive_by_hand(
    world: Annotated[
        str | None, typer.Option(help="World family or path; see vslam worlds list.", show_default="office")
    ] = None,
    world_split: Annotated[
        str | None, typer.Option(help="Split of the worlds: train, validation or test.", show_default="any")
    ] = None,
    robots: Annotated[int, typer.Option(help="Number of robots, 1 to 8.")] = 3,
    policy: Annotated[str, typer.Option(help="Policy of the other robots, or none.")] = "frontier",
    seed: Annotated[int, typer.Option(help="Seed of the episode.")] = 0,
    preset: Annotated[
        str, typer.Option(help="Noise preset: easy, standard or hard; large: standard noise in 120 x 120 m.")
    ] = "standard",
    max_cycles: Annotated[
        int | None, typer.Option(help="Length of the episode in ticks of 0.1 s.", show_default="600 s")
    ] = None,
    max_seconds: Annotated[
        float | None, typer.Option(help="Length of the episode \\[s], instead of max_cycles.", show_default="600")
    ] = None,
    record: Annotated[Path | None, typer.Option(help="Record a video to this .mp4 file.", show_default=False)] = None,
) -> None:
    """Drive a robot with the arrow keys or WASD; Tab selects the next robot, Escape or Q quits."""
    from contextlib import ExitStack

    from agents import make_policy
    from agents.policy import keys_for
    from slam_backend.core.validation import argument_error
    from training.episodes.teleoperation import KEYS, drive
    from training.episodes.video import VideoWriter
    from training.experiments.machine.interrupt import interrupt_flag
    from training.experiments.output.tables import E_SCALE
    from vslam_env import vslam_v1
    from vslam_env.rendering.window import Window, display_unavailable_reason

    if max_cycles is None and max_seconds is None:
        max_seconds = EPISODE_S
    env = vslam_v1.parallel_env(
        world=world,
        world_split=world_split,
        num_robots=robots,
        action_type="continuous",
        preset=preset,
        max_cycles=max_cycles,
        max_seconds=max_seconds,
        observation_keys="driver" if policy == "none" else keys_for(make_policy(policy, "continuous"), "continuous"),
    )
    policies = {} if policy == "none" else {a: make_policy(policy, "continuous") for a in env.possible_agents}
    env.reset(seed=seed)  # detects a world that cannot be built first
    reason = display_unavailable_reason()
    if reason:
        raise argument_error("drive", "a display for a window", reason.split(".")[0], reason.split(". ", 1)[1] + ".")
    prepare()
    console = make_console()
    console.print(KEYS)
    window = Window("vslam drive")
    with ExitStack() as stack:
        interrupted = stack.enter_context(interrupt_flag())
        film = None if record is None else stack.enter_context(VideoWriter(record, (960, 720), 10))
        infos = drive(env, window, policies, seed, film.add if film is not None else lambda frame: None, interrupted)
    window.close()
    console.print(E_SCALE)
    for agent, info in infos.items():
        console.print(
            f"{agent}: E {info['map_error']:.3f} m, recall {info['map_recall']:.0%}, "
            f"pose error {info['pose_error']:.2f} m, group {info['group']}"
        )
    if record is not None:
        console.print(f"Video: {record}", soft_wrap=True)
