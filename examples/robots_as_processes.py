"""Robots as processes of the operating system that tell each other their maps over sockets of this machine.

    python examples/robots_as_processes.py                             # five robots in an office
    python examples/robots_as_processes.py --kill 2 --at 30            # one is killed, and comes back from its file
    python examples/robots_as_processes.py --mrclam FOLDER --speed 20  # the five robots of an MR.CLAM log

Each process reads the readings of one robot, `--speed` times as fast as they were made. The page
docs/how-to/robots.md says what else a robot needs.
"""

import multiprocessing
import socket
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from slam_backend import LandmarkMap, Measurements, TeamSlam, Trajectory
from slam_backend.core.validation import FloatArray
from slam_backend.distributed import RobotSlam
from slam_backend.fastslam.options import FilterOptions
from slam_backend.geometry import transform_points
from slam_backend.metrics import align_se2
from slam_backend.team.merge_scheduler import AttemptOptions
from training.episodes.config import RunConfig
from training.episodes.runner import run_episode
from training.replay.readers import read_mrclam
from vslam_env.config import TICK

NEAR = 0.5  # largest distance of a landmark that counts as a true one [m]
SAVE_EVERY = 50  # steps between two saves
LINGER = 3.0  # time that robots listen to each other at the end [s]
Steps = list[tuple[FloatArray | None, Measurements | None]]


class Recorded(NamedTuple):
    """Readings of a team, step by step, and what is known of the world."""

    steps: Sequence[Steps]  # Readings of each robot
    seconds: float  # Duration of a step [s]
    options: Mapping[str, Any]  # Options of filters
    alignment: Any  # Options of alignments
    landmarks: FloatArray  # (N, 2) true landmarks
    starts: FloatArray  # (K, 3) true start poses
    attempts: AttemptOptions  # Schedule of `TeamSlam`


def record_episode(robots: int, world: str, seconds: float, seed: int) -> Recorded:
    """Return the readings of an episode with the planner `next_best_view`."""
    config = RunConfig(robots=robots, world=world, max_seconds=seconds, policy="next_best_view", seed=seed)
    env, ticks = config.make_env(), list[Any]()
    env.recorder = ticks.append
    run_episode(env, config.make_policies(env), seed)
    belief, landmarks = env.config.belief, env.episode.world.landmarks
    assert landmarks is not None
    return Recorded(
        [[(tick[k].odometry, tick[k].measurements) for tick in ticks] for k in range(robots)], TICK,
        {field.name: getattr(belief.filter, field.name) for field in fields(FilterOptions)}, belief.alignment,
        landmarks.positions[:, :2], env.episode.true_path[0].copy(), AttemptOptions(),
    )  # fmt: skip


def record_mrclam(folder: Path) -> Recorded:
    """Return the readings of an MR.CLAM log."""
    log = read_mrclam(folder)
    steps = [[(moved if k else None, frame) for k, (moved, frame) in enumerate(robot.steps())] for robot in log.robots]
    assert log.team is not None
    assert log.landmarks is not None
    starts = [robot.truth.at(log.times[:1])[0] for robot in log.robots if isinstance(robot.truth, Trajectory)]
    return Recorded(
        steps, float(log.times[1] - log.times[0]), log.options, log.team["alignment"], log.landmarks, np.array(starts),
        log.team["attempts"],
    )  # fmt: skip


def run_robot(
    name: str, ports: Mapping[str, int], steps: Steps, pace: float, options: Any, folder: Path, ready: Any
) -> None:
    """Run one robot until its readings end: the process of a robot."""
    transport = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    transport.bind(("127.0.0.1", ports[name]))
    transport.setblocking(False)
    others = [("127.0.0.1", port) for other, port in ports.items() if other != name]
    file = folder / f"{name}.state"
    robot = RobotSlam.load(file) if file.exists() else RobotSlam(name, life=time.time_ns(), **options)

    def exchange() -> None:
        for message in robot.outbox():
            for address in others:
                transport.sendto(message, address)
        while True:
            try:
                refusal = robot.receive(transport.recv(65_536))
            except BlockingIOError:
                return
            if refusal is not None:
                print(f"{name}: {refusal}", flush=True)

    (folder / f"{name}.ready").touch()
    ready.wait()
    begin = time.monotonic() - pace * robot.filter.next_step
    for odometry, frame in steps[robot.filter.next_step :]:
        robot.step(odometry, frame)
        exchange()
        if robot.filter.next_step % SAVE_EVERY == 0:
            robot.save(file)
        time.sleep(max(0.0, begin + pace * robot.filter.next_step - time.monotonic()))
    end = time.monotonic() + LINGER
    while time.monotonic() < end:
        robot.share()
        exchange()
        robot.attempt()
        time.sleep(0.1)
    robot.map(min_count=2).save(folder / f"{name}.npz")
    (folder / f"{name}.group").write_text(" ".join(robot.group), encoding="utf-8")


def free_ports(count: int) -> list[int]:
    """Return ports of this machine that are free."""
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)]
    for each in sockets:
        each.bind(("127.0.0.1", 0))
    ports = [each.getsockname()[1] for each in sockets]
    for each in sockets:
        each.close()
    return ports


def score(landmarks: LandmarkMap, start: FloatArray, truth: FloatArray) -> str:
    """Return the number of landmarks of a map in a start frame, and its error after the best rigid fit."""
    guess = landmarks.means[:, :2]
    moved = transform_points(start, guess)
    for _ in range(3):
        rows, columns = linear_sum_assignment(np.minimum(cdist(moved, truth), 2.0 * NEAR))
        near = np.linalg.norm(moved[rows] - truth[columns], axis=1) < 2.0 * NEAR
        moved = transform_points(align_se2(truth[columns[near]], guess[rows[near]]), guess)
    apart = np.linalg.norm(moved[rows] - truth[columns], axis=1)
    apart = apart[apart < NEAR]
    error = np.sqrt(np.mean(np.square(apart)))
    return f"{len(guess)} landmarks, {len(apart)} at true ones, RMS error {error:.3f} m"


def team_maps(recorded: Recorded) -> list[tuple[tuple[int, ...], LandmarkMap]]:
    """Return group and map of each robot of a `TeamSlam` that reads the same, each in the start frame of the robot."""
    team = TeamSlam(len(recorded.steps), recorded.alignment, attempts=recorded.attempts, **recorded.options)
    for tick in zip(*recorded.steps, strict=True):
        team.step([odometry for odometry, _ in tick], [frame for _, frame in tick])
    team.rejuvenate()
    group_of = {robot: group for group in team.groups for robot in group}
    return [(group_of[k], team.map(k, min_count=2).moved(team.start_from_group(k))) for k in range(len(recorded.steps))]


def main(
    robots: Annotated[int, typer.Option(help="Number of robots.", min=1, max=8)] = 5,
    world: Annotated[str, typer.Option(help="World family.")] = "office",
    seconds: Annotated[float, typer.Option(help="Simulated time [s].", min=1.0)] = 120.0,
    seed: Annotated[int, typer.Option(help="Seed of the episode.")] = 0,
    speed: Annotated[float, typer.Option(help="Simulated seconds per second.", min=0.1)] = 4.0,
    kill: Annotated[int | None, typer.Option(help="Number of a robot whose process is killed.", min=0)] = None,
    at: Annotated[float, typer.Option(help="Simulated time at which it is killed [s].", min=0.0)] = 30.0,
    revive: Annotated[bool, typer.Option(help="Whether it comes back from its file.")] = True,
    mrclam: Annotated[Path | None, typer.Option(help="Folder of an MR.CLAM log, in place of an episode.")] = None,
) -> None:
    """Run robots as processes, and show their final maps beside those of `TeamSlam` on the same readings."""
    print("Recording ...", flush=True)
    recorded = record_episode(robots, world, seconds, seed) if mrclam is None else record_mrclam(mrclam)
    names = [f"robot-{k}" for k in range(len(recorded.steps))]
    if kill is not None and kill >= len(names):
        raise typer.BadParameter(f"expected a number below {len(names)}, got {kill}", param_hint="--kill")
    context = multiprocessing.get_context("spawn")
    options = {**recorded.options, "alignment": recorded.alignment}
    with tempfile.TemporaryDirectory() as scratch:
        folder, ports = Path(scratch), dict(zip(names, free_ports(len(names)), strict=True))
        ready = context.Event()

        def start(k: int) -> Any:
            work = (names[k], ports, recorded.steps[k], recorded.seconds / speed, options, folder, ready)
            process = context.Process(target=run_robot, args=work, daemon=True)
            process.start()
            return process

        processes = [start(k) for k in range(len(names))]
        print(f"{len(names)} processes, {speed:g} times as fast as the robots drove.", flush=True)
        while len(list(folder.glob("*.ready"))) < len(names):
            time.sleep(0.1)
        ready.set()
        if kill is not None:
            time.sleep(at / speed)
            processes[kill].kill()
            processes[kill].join()
            print(f"Killed {names[kill]} at {at:g} s.", flush=True)
            if revive:
                processes[kill] = start(kill)
        for process in processes:
            process.join()
        joint = team_maps(recorded)
        for k, name in enumerate(names):
            if not (folder / f"{name}.npz").is_file():
                print(f"{name}: no map.")
                continue
            group = (folder / f"{name}.group").read_text(encoding="utf-8")
            own = score(LandmarkMap.load(folder / f"{name}.npz"), recorded.starts[k], recorded.landmarks)
            print(f"{name}, with {group}: {own}.")
            print(f"  TeamSlam, with {joint[k][0]}: {score(joint[k][1], recorded.starts[k], recorded.landmarks)}.")


if __name__ == "__main__":
    typer.run(main)
