"""Robots with filters of their own that exchange maps, beside `TeamSlam` on the same readings.

python -m studies.merging.robots --presets standard,hard --seeds 5
"""

from collections import deque
from dataclasses import asdict, dataclass, fields
from itertools import product
from typing import Annotated, Any

import numpy as np
from pydantic import Field
from scipy.optimize import linear_sum_assignment

from slam_backend.core.blas import single_threaded_blas
from slam_backend.core.validation import FloatArray
from slam_backend.distributed import RobotSlam
from slam_backend.fastslam.options import FilterOptions
from slam_backend.geometry import between
from slam_backend.maps.alignment_types import is_distinct
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.team.communication import contact_components
from studies.bounds.episodes import RecordedEpisode, new_team
from studies.filters import losses
from studies.filters.losses import checks, recorded
from training.commands.study import run_program
from training.experiments.config import option
from training.experiments.study import Column, ResultTable, Study
from vslam_env.config import TICK

CUTOFF, NEAR = 1.0, 0.5  # cutoff of the map error; largest error of a landmark that counts as found [m]
SHARE_EVERY = 50  # ticks between two maps
Share = Annotated[float, Field(ge=0.0, lt=1.0)]
Seconds = Annotated[float, Field(ge=0.0)]


class Config(losses.TeamConfig):
    """Episodes of teams, whose messages may be late or lost."""

    delays: tuple[Seconds, ...] = option((0.0,), "Times that messages take [s].", hint="Give seconds.")
    lost: tuple[Share, ...] = option((0.0,), "Shares of messages that are lost.", hint="Give shares below 1.")
    copies: int = option(1, "Number of times that each message is sent.", ge=1, le=SHARE_EVERY, hint="Use 1 to 50.")


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial(losses.Trial):
    """One episode with messages of one kind."""

    delay: float  # Time that messages take [s]
    lost: float  # Share of messages that are lost


def trials(config: Config) -> list[Trial]:
    """Return all trials."""
    return [
        Trial(**asdict(trial), delay=delay, lost=lost)
        for trial, delay, lost in product(losses.trials(config), config.delays, config.lost)
    ]


@single_threaded_blas
def play(config: Config, trial: Trial) -> dict[str, Any]:
    """Run an episode, and let separate robots and a team read the same.

    Returns:
        `map_error` of the maps that robots hold at the end, `team_map_error` of `TeamSlam`, `more`: their difference;
        `alone_map_error` of filters alone; `recall`, `team_recall`; `held`, `team_held`: robots in the group
        of a robot; `false_links`: links at the end that are off by half a metre or 5 degrees; `undone`; bytes a second
        of a robot: `maps_bytes`, `inputs_bytes` of all its readings, `team_bytes` as `TeamSlam` counts them.

    Raises:
        PolicyError: If the policy fails.
    """
    episode = recorded(config, trial)
    count, seconds = len(episode.true_paths), TICK * len(episode.readings)
    robots, sent = _robots(episode, trial, config.copies)
    team = new_team(episode, episode.config.belief.filter)
    for tick in episode.readings:
        contacts = None if tick[0].contacts is None else np.stack([own.contacts for own in tick])  # type: ignore[misc]
        team.step([own.odometry for own in tick], [own.measurements for own in tick], contacts)
    team.rejuvenate()
    starts = episode.true_paths[:, 0]
    own = [map_error(robot.map(2), starts[k], episode) for k, robot in enumerate(robots)]
    alone = [map_error(robot.filter.map(min_count=2), starts[k], episode) for k, robot in enumerate(robots)]
    first = {k: group[0] for group in team.groups for k in group}
    joint = [map_error(team.map(k, min_count=2), starts[first[k]], episode) for k in range(count)]
    links = [_is_false(robot, name, motion, starts) for robot in robots for name, motion in _links(robot)]
    read = sum(24 + (0 if each.measurements is None else 4 * (each.measurements.points.size
               + each.measurements.descriptors.size)) for tick in episode.readings for each in tick)  # fmt: skip
    return {
        "map_error": _mean(own, 0), "team_map_error": _mean(joint, 0), "more": _mean(own, 0) - _mean(joint, 0),
        "alone_map_error": _mean(alone, 0), "recall": _mean(own, 1), "team_recall": _mean(joint, 1),
        "held": float(np.mean([len(robot.group) for robot in robots])),
        "team_held": float(np.mean([len(group) for group in team.groups for _ in group])),
        "links": len(links), "false_links": sum(links),
        "undone": sum(event.kind == "undone" for robot in robots for event in robot.events),
        "maps_bytes": sent / count / seconds, "inputs_bytes": read / count / seconds,
        "team_bytes": float(team.bytes_sent.mean()) / seconds,
    }  # fmt: skip


def _mean(errors: list[tuple[float, float]], column: int) -> float:
    return float(np.mean([row[column] for row in errors]))


def _robots(episode: RecordedEpisode, trial: Trial, copies: int) -> tuple[list[RobotSlam], int]:
    """Return robots that read an episode and hear those in contact, and the bytes that they sent."""
    count, rng = len(episode.true_paths), np.random.default_rng(trial.seed)
    belief = episode.config.belief
    options = {field.name: getattr(belief.filter, field.name) for field in fields(FilterOptions)}
    robots = [
        RobotSlam(f"robot {k}", seed=k, share_every=SHARE_EVERY, copies=copies, alignment=belief.alignment, **options)
        for k in range(count)
    ]
    on_the_way: deque[tuple[float, int, bytes]] = deque()
    sent = 0
    for step, tick in enumerate(episode.readings):
        parts = (
            np.zeros(count) if tick[0].contacts is None
            else contact_components(np.stack([own.contacts for own in tick]), count)  # type: ignore[misc]
        )  # fmt: skip
        for robot, own in zip(robots, tick, strict=True):
            robot.step(own.odometry, own.measurements)
        for k, robot in enumerate(robots):
            for message in robot.outbox():
                sent += len(message)
                hearers = [j for j in range(count) if j != k and parts[j] == parts[k]]
                on_the_way += [(TICK * step + trial.delay, j, message) for j in hearers if rng.random() >= trial.lost]
        while on_the_way and on_the_way[0][0] <= TICK * step:
            _, j, message = on_the_way.popleft()
            assert robots[j].receive(message) is None
    for robot in robots:
        robot.filter.rejuvenate()  # as environments do in the last step
    return robots, sent


def map_error(landmarks: LandmarkMap, start: FloatArray, episode: RecordedEpisode) -> tuple[float, float]:
    """Return the map error E [m] and the recall of a map, whose landmarks stand for those that they are nearest to.

    Args:
        landmarks: Map, start frame of a robot.
        start: (3,) true start pose [m, m, rad] of that robot.
        episode: Episode with the true landmarks; those that cannot be observed are neither missed nor false.
    """
    counts = np.zeros(len(episode.landmarks), np.bool_)
    counts[episode.observable] = True
    means = landmarks.moved(start).means
    squared = np.minimum(((means[:, None] - episode.landmarks[None]) ** 2).sum(axis=-1), CUTOFF**2)
    rows, columns = linear_sum_assignment(squared)
    near = squared[rows, columns] <= NEAR**2
    found = near & counts[columns]
    wrong = len(means) - np.count_nonzero(near) + np.count_nonzero(counts) - np.count_nonzero(found)
    total = squared[rows, columns][found].sum() + 0.5 * CUTOFF**2 * wrong
    return float(np.sqrt(total / counts.sum())), float(found.sum() / counts.sum())


def _links(robot: RobotSlam) -> list[tuple[str, FloatArray]]:
    """Return the robots that a robot has placed in its frame, with their start poses there."""
    return [(name, motion) for name, motion in robot.starts().items() if name != robot.name]


def _is_false(robot: RobotSlam, name: str, motion: FloatArray, starts: FloatArray) -> bool:
    """Return whether a link is off by half a metre or 5 degrees."""
    one, other = (int(each.split()[1]) for each in (robot.name, name))
    return is_distinct(between(between(starts[one], starts[other]), motion))


STUDY = Study(
    name="robots",
    about="""Compare robots that exchange maps with a team that shares filters, on the same readings.

    Options that accept several values take them comma-separated; all combinations are run. Ctrl-C finishes the current
    episode and summarises the finished ones; the same command with --out FOLDER resumes the run.
    """,
    config=Config,
    trial=Trial,
    trials=trials,
    play=play,
    checks=checks,
    quick={"worlds": ("office",), "seeds": 2, "duration": 30.0, "particles": (30,), "presets": ("standard",)},
    tables=(
        ResultTable(
            name="robots", title="Maps that robots exchange, and maps of a team", by=("preset", "delay", "lost"),
            columns=(
                Column("map_error", "E [m]", digits=3), Column("team_map_error", "E of TeamSlam [m]", digits=3),
                Column("more", "more [cm]", digits=1, factor=100.0, interval=True),
                Column("alone_map_error", "E alone [m]", digits=3),
                Column("recall", "recall [%]", digits=1, factor=100.0),
                Column("team_recall", "recall of TeamSlam [%]", digits=1, factor=100.0),
                Column("held", "group", digits=2), Column("team_held", "group of TeamSlam", digits=2),
                Column("false_links", "false links", "sum", digits=0), Column("links", "links", "sum", digits=0),
                Column("undone", "undone", "sum", digits=0),
            ),
        ),
        ResultTable(
            name="bytes", title="Bytes that a robot sends [kB/s]", by=("preset",),
            columns=(
                Column("maps_bytes", "maps", digits=1, factor=1e-3),
                Column("inputs_bytes", "all readings", digits=1, factor=1e-3),
                Column("team_bytes", "TeamSlam", digits=1, factor=1e-3),
            ),
        ),
    ),
)  # fmt: skip

if __name__ == "__main__":
    run_program(STUDY)
