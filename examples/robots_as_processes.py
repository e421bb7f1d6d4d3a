"""Robots as processes of the operating system that tell each other their maps over sockets of this machine.

    python examples/robots_as_processes.py                             # five robots in an office
    python examples/robots_as_processes.py --kill 2 --at 30            # one is killed, and comes back from its file
    python examples/robots_as_processes.py --mrclam FOLDER --speed 20  # the five robots of an MR.CLAM log

Each process reads the readings of one robot, `--speed` times as fast as they were made. The page
docs/how-to/robots.md says what else a robot needs.
"""

import multiprocessing
import signal
import socket
import sys
import tempfile
import time
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import fields
from itertools import count
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
LINGER = 6.0  # time that robots listen to each other at the end [s]
MOST_LATE = 2.0  # [s]
AT_ONCE = 2  # messages that a robot sends after a step: sockets drop what is more than they can hold
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
    name: str, ports: Mapping[str, int], steps: Steps, pace: float, options: Any, file: Path, parent: Any
) -> None:
    """Run one robot until its readings end and `parent`, a pipe, says so or is gone: the process of a robot."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent
    transport = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    transport.bind(("127.0.0.1", ports[name]))
    transport.setblocking(False)
    others = [("127.0.0.1", port) for other, port in ports.items() if other != name]

    def say(text: str) -> None:
        print(f"{name}: {text}", flush=True)

    sent, saves, late, waiting = 0, True, 0.0, deque[bytes]()

    def exchange() -> None:
        nonlocal sent
        waiting.extend(robot.outbox())
        for _ in range(min(len(waiting), AT_ONCE)):
            message = waiting.popleft()
            sent += len(message)
            for address in others:
                transport.sendto(message, address)
        while True:
            try:
                refusal = robot.receive(transport.recv(65_536))
            except BlockingIOError:
                return
            if refusal is not None:
                say(refusal)

    def save() -> None:
        nonlocal saves
        before, saves = saves, True
        try:
            robot.save(file)
        except ValueError as error:  # such as a full disk: the earlier file stays
            saves = False
            if before:
                say(f"not saved, goes on: {error}")
        if saves and not before:
            say("saved again")

    if file.exists():
        robot = RobotSlam.load(file)
        say(f"back from its file, at step {robot.filter.next_step} of {len(steps)}")
        save()  # so that it is heard again, even if it is killed before the next time
    else:
        robot = RobotSlam(name, life=time.time_ns(), **options)
    parent.send("ready")
    parent.recv()
    first = robot.filter.next_step
    begin = time.monotonic() - pace * first
    for odometry, frame in steps[first:]:
        robot.step(odometry, frame)
        exchange()
        if robot.filter.next_step % SAVE_EVERY == 0:
            save()
        late = time.monotonic() - begin - pace * robot.filter.next_step
        time.sleep(max(0.0, -late))
    if late > MOST_LATE:
        say(f"{late:.0f} s late: this machine needs a smaller --speed")
    parent.send(sent / max(1, robot.filter.next_step - first))
    stands = count(1)
    while not parent.poll(0.02):
        exchange()
        k = next(stands)
        if k % 40 == 0:
            robot.share()
        if k % 4 == 0:
            robot.attempt()
    transport.close()
    with suppress(OSError):  # the parent is gone
        parent.send((robot.group, robot.map(min_count=2)))


def heard(pipe: Any) -> Any:
    """Return what a process says next; None if it has ended."""
    try:
        return pipe.recv()
    except (EOFError, OSError):
        return None


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
    """Return each group of a `TeamSlam` that reads the same, and its map, start frame of the first robot."""
    team = TeamSlam(len(recorded.steps), recorded.alignment, attempts=recorded.attempts, **recorded.options)
    for tick in zip(*recorded.steps, strict=True):
        team.step([odometry for odometry, _ in tick], [frame for _, frame in tick])
    team.rejuvenate()
    return [(group, team.map(group[0], min_count=2)) for group in team.groups]


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
    try:
        recorded = record_episode(robots, world, seconds, seed) if mrclam is None else record_mrclam(mrclam)
    except ValueError as error:
        sys.exit(f"error {error}")
    names = [f"robot-{k}" for k in range(len(recorded.steps))]
    if kill is not None and kill >= len(names):
        raise typer.BadParameter(f"expected a number below {len(names)}, got {kill}", param_hint="--kill")
    context = multiprocessing.get_context("spawn")
    options = {**recorded.options, "alignment": recorded.alignment}
    with tempfile.TemporaryDirectory() as folder:
        ports = dict(zip(names, free_ports(len(names)), strict=True))

        def start(k: int) -> tuple[Any, Any]:
            ours, theirs = context.Pipe()
            file, pace = Path(folder, f"{names[k]}.state"), recorded.seconds / speed
            work = names[k], ports, recorded.steps[k], pace, options, file, theirs
            process = context.Process(target=run_robot, args=work, daemon=True)
            process.start()
            theirs.close()
            return process, ours

        def tell(k: int, text: str) -> None:
            with suppress(OSError):  # its process has ended
                running[k][1].send(text)

        running = [start(k) for k in range(len(names))]
        for _, pipe in running:
            heard(pipe)
        print(f"{len(names)} processes, {speed:g} times as fast as the robots drove.", flush=True)
        for k in range(len(names)):
            tell(k, "begin")
        if kill is not None:
            time.sleep(at / speed)
            running[kill][0].kill()
            running[kill][0].join()
            print(f"{names[kill]}: killed at {at:g} s", flush=True)
            if revive:
                print(f"{names[kill]}: started again", flush=True)
                running[kill] = start(kill)
                heard(running[kill][1])
                tell(kill, "begin")
        sent = [heard(pipe) for _, pipe in running]
        time.sleep(LINGER)
        for k in range(len(names)):
            tell(k, "end")
        ends = [heard(pipe) for _, pipe in running]
    for k, (name, end) in enumerate(zip(names, ends, strict=True)):
        if end is None:
            print(f"{name}: its process has ended, no map.")
            continue
        group, landmarks = end
        others = " ".join(other for other in group if other != name)
        found = score(landmarks, recorded.starts[k], recorded.landmarks)
        rate = 1e-3 * sent[k] / recorded.seconds
        print(f"{name}, with {others or 'no other'}: {found}, {rate:.1f} kB/s sent.")
    for robots_of, landmarks in team_maps(recorded):
        text = " ".join(names[k] for k in robots_of)
        print(f"TeamSlam, {text}: {score(landmarks, recorded.starts[robots_of[0]], recorded.landmarks)}.")


if __name__ == "__main__":
    typer.run(main)
