"""Faults of robots and logs: whether filters notice that a robot is lost, and what is said of a wrong set-up.

python -m studies.filters.faults --seeds 20
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.blas import single_threaded_blas
from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.diagnosis import diagnose
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.options import FilterOptions
from slam_backend.geometry import compose, inverse, wrap_angle
from slam_backend.models.measurements import Measurements
from studies.bounds.episodes import record_episode
from studies.filters.circle_world import MOTION, MOVE, Mistake, circle_log
from training.bench.exploration.players import parted
from training.commands.study import run_program
from training.experiments.config import ExperimentConfig, first_seed, option
from training.experiments.study import Column, ResultTable, Row, Study
from training.replay.config import MRCLAM, find_log
from training.replay.metrics import true_poses
from training.replay.readers import read_mrclam
from vslam_env import preset_config, vslam_v1

World = Literal["circle", "office", "maze", "loops", "hall", "rooms", "mrclam"]
Event = Literal["jump", "carried", "none"]
MISTAKES, EVENTS = get_args(Mistake), get_args(Event)
JUMP = np.array([3.0, 2.0, 1.0])  # [m, m, rad] by which one odometry reading is wrong
CUT = {"circle": 30, "mrclam": 400}  # steps of a drive that are left out
CUT_OF_FAMILIES = 150
KNOWN = 5  # landmarks seen again after which a robot could know
IN_TIME = 50  # steps within which it should

# ---------------------------------------------------------------------- trials


class Config(ExperimentConfig):
    """Robots whose odometry jumps once, that are carried, and others; logs with each mistake."""

    worlds: tuple[World, ...] = option(
        ("circle", "office", "mrclam"), "Worlds: circle (of the SLAM tutorial), families, mrclam (data set 7)."
    )
    events: tuple[Event, ...] = option(EVENTS, "Events: jump (one wrong odometry reading), carried, none.")
    mistakes: tuple[Mistake, ...] = option(MISTAKES, "Mistakes in the set-up of logs in the circle world.")
    seeds: int = option(20, "Number of trials in each world.", ge=1, hint="Use at least one.")
    seed: int = first_seed()
    preset: Literal["standard", "hard"] = option("standard", "Noise preset in families.")


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One robot, or one log."""

    world: World
    event: Event | None  # One wrong reading of the odometry, a part of the drive without readings, or neither
    mistake: Mistake | None  # Name of the mistake in a log that is diagnosed, as `diagnose` gives it
    matches: Literal["identities", "descriptors"]  # Means to match landmarks
    seed: int  # Seed of the noise, the filter, and the time


def trials(config: Config) -> list[Trial]:
    """Return all trials."""
    seeds = range(config.seed, config.seed + config.seeds)
    return [
        Trial(world=world, event=event, mistake=None, matches="descriptors", seed=seed)
        for world in config.worlds
        for seed in seeds
        for event in config.events
    ] + [
        Trial(world="circle", event=None, mistake=mistake, matches=matches, seed=seed)
        for mistake in config.mistakes
        for matches in ("identities", "descriptors")
        for seed in seeds
    ]


class Drive(NamedTuple):
    """Readings of a robot in T steps, with the true landmark of each measurement, and its true path."""

    odometry: FloatArray  # (T, 3) float64 [m, m, rad]
    frames: Sequence[Measurements | None]
    true_ids: Sequence[IntArray]  # Negative: of no landmark
    true_path: FloatArray  # (T, 3) float64 [m, m, rad]; NaN where it is unknown
    options: dict[str, Any]  # Options of the filter

    def without(self, begin: int, end: int) -> "Drive":
        """Return the drive without some steps, as if the robot had been carried."""
        return Drive(
            np.delete(self.odometry, slice(begin, end), axis=0), [*self.frames[:begin], *self.frames[end:]],
            [*self.true_ids[:begin], *self.true_ids[end:]], np.delete(self.true_path, slice(begin, end), axis=0),
            self.options,
        )  # fmt: skip


@lru_cache(maxsize=2)
def drive(world: World, seed: int, preset: Literal["standard", "hard"]) -> Drive:
    """Return a drive in a world; of data set 7 robots and parts differ between seeds."""
    if world == "circle":
        log = circle_log("none", seed)
        path = np.zeros((len(log.odometry), 3))
        for step in range(1, len(path)):
            path[step] = compose(path[step - 1], MOVE)
        return Drive(log.odometry, log.measurements, log.identities, path, {"motion": MOTION})
    if world != "mrclam":
        player = parted("frontier@continuous")
        config = preset_config(preset).replace(
            world=world, num_robots=1, max_seconds=120.0, action_type=player.action_type
        )
        env = vslam_v1.parallel_env(config=config, observation_keys=player.observation_keys)
        episode = record_episode(env, player.make(env, 600.0), seed)
        env.close()
        chosen = config.belief.filter
        return Drive(
            np.vstack([np.zeros(3), episode.odometry[0]]), [own[0].measurements for own in episode.readings],
            [ids[0] for ids in episode.true_ids], episode.true_paths[0],
            {field.name: getattr(chosen, field.name) for field in fields(FilterOptions)},
        )  # fmt: skip
    place = find_log(None, MRCLAM, "the folder of MR.CLAM data set 7")
    read = read_mrclam(place, robots=(1 + seed % 5,), alone=True)
    robot = read.robots[0]
    assert robot.odometry is not None
    assert robot.identities is not None
    frames = [
        None if frame is None else Measurements(frame.points, _badges(names), frame.covariances)
        for frame, names in zip(robot.measurements, robot.identities, strict=True)
    ]
    truth = true_poses(robot.truth, read.times)
    ids = [np.asarray([] if names is None else names, np.int64) for names in robot.identities]
    return Drive(robot.odometry, frames, ids, truth, {"motion": read.options["motion"]})  # gates for descriptors


def _badges(names: IntArray) -> NDArray[np.float32]:
    """Return descriptors (n, 32) of MR.CLAM's landmarks that tell them apart, as their barcodes do."""
    return np.asarray(np.eye(32, dtype=np.float32)[np.asarray(names, np.int64) % 32])


def play(config: Config, trial: Trial) -> dict[str, Any]:
    """Run the filter on a drive, or diagnose a log; see `run_filter` and `diagnosis`."""
    return run_filter(config, trial) if trial.mistake is None else diagnosis(trial)


def diagnosis(trial: Trial) -> dict[str, Any]:
    """Return what is `said` of a log, and whether that is `right`: the mistake alone."""
    assert trial.mistake is not None
    log = circle_log(trial.mistake, trial.seed)
    names = log.identities if trial.matches == "identities" else None
    said = [cause.name for cause in diagnose(log.odometry, log.measurements, names, motion=MOTION)]
    return {"said": ", ".join(said) or "none", "right": said == ([] if trial.mistake == "none" else [trial.mistake])}


@single_threaded_blas
def run_filter(config: Config, trial: Trial) -> dict[str, Any]:
    """Run the filter on a drive.

    Returns:
        `warned`: whether a warning says that the robot is or was lost; `others`: number of warnings before that
        or without; `found`: number of relocalisations, `worse`: of those that made the error of the pose larger.
        `delay`: steps from the first sight of five known landmarks until the warning, and `in_time`: whether it is at
        most `IN_TIME`; None if five are never seen again. `before_m`, `lost_m`, `end_m`: position error before, the
        largest afterwards, and at the end. `copies`: landmarks of the map for each true one.
    """
    own = drive(trial.world, trial.seed, config.preset)
    count, rng = len(own.odometry), np.random.default_rng((trial.seed, 1))
    at = int(count * rng.uniform(0.4, 0.6))
    if trial.event == "carried":
        own = own.without(at, at + CUT.get(trial.world, CUT_OF_FAMILIES))
    odometry = own.odometry.copy()
    if trial.event == "jump":
        odometry[at] = compose(odometry[at], JUMP)
    slam = FastSlam(seed=trial.seed, **own.options)
    path, moved = np.zeros_like(odometry), []
    for step in range(len(odometry)):
        report = slam.step([odometry[step]], [own.frames[step]])
        path[step] = slam.pose().mean
        seen = None if report.rejuvenation is None else report.rejuvenation.relocalisation
        if seen is not None and seen.outcome != "suspected":
            moved.append(step)
    warnings = [one.step for one in slam.consistency.warnings if one.sign == "lost"]
    known = {int(name) for names in own.true_ids[:at] for name in names if name >= 0}
    could = next(_known_again(own.true_ids, at, known), None) if trial.event != "none" else None
    late = next((step for step in warnings if step >= at), None) if trial.event != "none" else None
    off = path - _in_start_frame(own.true_path)
    errors, apart = np.hypot(*off[:, :2].T), np.abs(wrap_angle(off[:, 2]))
    return {
        "warned": late is not None, "could": could is not None,
        "others": len([step for step in warnings if step < at or trial.event == "none"]),
        "worse": sum(bool(errors[n] + apart[n] > errors[n - 1] + apart[n - 1]) for n in moved),
        "found": len(moved), "delay": None if could is None or late is None else late - could,
        "in_time": None if could is None else late is not None and late - could <= IN_TIME,
        "before_m": float(np.nanmax(errors[: at - 1][-50:])), "lost_m": float(np.nanmax(errors[at:])),
        "end_m": float(errors[~np.isnan(errors)][-1]),
        "copies": slam.map_size / max(len({int(n) for names in own.true_ids for n in names if n >= 0}), 1),
    }  # fmt: skip


def _known_again(true_ids: Sequence[IntArray], at: int, known: set[int]) -> Iterator[int]:
    """Yield the steps from `at` on by which enough known landmarks were seen again."""
    seen: set[int] = set()
    for step in range(at, len(true_ids)):
        seen |= known & {int(name) for name in true_ids[step]}
        if len(seen) >= KNOWN:
            yield step


def _in_start_frame(path: FloatArray) -> FloatArray:
    known = np.flatnonzero(~np.isnan(path[:, 0]))
    return compose(inverse(path[known[0]]), path)


# ---------------------------------------------------------------------- results


def _said(rows: Sequence[Row]) -> str:
    """Return what is said, with numbers."""
    return ", ".join(f"{name} {count}" for name, count in Counter(row["said"] for row in rows).most_common())


STUDY = Study(
    name="faults",
    about="""Let robots lose their pose, and see how soon filters notice; make mistakes, and see what is said of them.

    Either one odometry reading is wrong by 3 m, 2 m and 1 rad, or the readings of a part of the drive are left out;
    robots with neither show false alarms. Logs with each usual mistake in their set-up, and without, are diagnosed.
    """,
    config=Config,
    trial=Trial,
    trials=trials,
    play=play,
    quick={"worlds": ("circle",), "seeds": 2},
    tables=(
        ResultTable(
            name="lost", title="Robots that are lost, and others", by=("world", "event"),
            where=lambda row: row["mistake"] is None,
            columns=(
                Column("warned", "warned [%]", digits=0, factor=100.0), Column("others", "others", "sum", digits=0),
                Column("found", "found", "sum", digits=0), Column("worse", "worse", "sum", digits=0),
                Column("could", "could [%]", digits=0, factor=100.0),
                Column("in_time", "soon [%]", digits=0, factor=100.0),
                Column("delay", "delay [steps]", "median", digits=0), Column("before_m", "before [m]", digits=2),
                Column("lost_m", "worst [m]", digits=2), Column("end_m", "end [m]", "median", digits=2),
                Column("copies", digits=2),
            ),
        ),
        ResultTable(
            name="mistakes", title="What is said of logs with one mistake each", by=("mistake", "matches"),
            where=lambda row: row["mistake"] is not None,
            columns=(Column("right", "right [%]", digits=0, factor=100.0), Column("said", "said", _said)),
        ),
    ),
)  # fmt: skip

if __name__ == "__main__":
    run_program(STUDY)
