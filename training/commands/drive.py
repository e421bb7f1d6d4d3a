"""The command `vslam drive`: explore by hand, in a window, beside robots that explore by themselves."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from training.experiments.compilation import prepare


def drive_by_hand(
    world: Annotated[str, typer.Option(help="A family or a path; see vslam worlds list.")] = "office",
    robots: Annotated[int, typer.Option(help="How many, 1 to 8.")] = 3,
    policy: Annotated[str, typer.Option(help="Of the robots that nobody drives, or none.")] = "frontier",
    seed: Annotated[int, typer.Option(help="Of the episode.")] = 0,
    preset: Annotated[str, typer.Option(help="easy, standard or hard noise.")] = "standard",
    max_cycles: Annotated[int, typer.Option(help="Ticks of 0.1 s until the end.")] = 6000,
    record: Annotated[Path | None, typer.Option(help="Film it into this .mp4 file.", show_default=False)] = None,
) -> None:
    """Drive a robot with the keys: arrows or WASD; Tab takes the next robot, Escape or Q ends."""
    from contextlib import ExitStack

    from agents import make_policy
    from slam_backend.core.validation import argument_error
    from training.episodes.teleoperation import KEYS, drive
    from training.episodes.video import VideoWriter
    from training.experiments.interrupt import interrupt_flag
    from vslam_env import vslam_v0
    from vslam_env.rendering.window import Window, display_unavailable_reason

    env = vslam_v0.parallel_env(world=world, num_robots=robots, preset=preset, max_cycles=max_cycles)
    policies = {} if policy == "none" else {a: make_policy(policy, "continuous") for a in env.possible_agents}
    env.reset(seed=seed)  # a world that cannot be built shows first
    reason = display_unavailable_reason()
    if reason:
        raise argument_error("drive", "a screen for a window", reason.split(".")[0], reason.split(". ", 1)[1] + ".")
    prepare()
    console = Console(highlight=False)
    console.print(KEYS)
    window = Window("vslam drive")
    with ExitStack() as stack:
        interrupted = stack.enter_context(interrupt_flag())
        film = None if record is None else stack.enter_context(VideoWriter(record, (960, 720), 10))
        infos = drive(env, window, policies, seed, film.add if film is not None else lambda frame: None, interrupted)
    window.close()
    for agent, info in infos.items():
        console.print(
            f"{agent}: map error {info['map_error']:.3f} m, recall {info['map_recall']:.0%}, "
            f"pose error {info['pose_error']:.2f} m, group {info['group']}"
        )
    if record is not None:
        console.print(f"Video: {record}", soft_wrap=True)
