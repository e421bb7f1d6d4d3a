"""The replay of a MR.CLAM log: robots, each with its own filter from its own unknown start, become one team."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Literal, Self

import numpy as np

from slam_backend.alignment import AlignmentOptions
from slam_backend.attempts import AttemptOptions
from slam_backend.errors import FloatArray, bad_argument, check_choice, check_float, check_int
from slam_backend.geometry import compose
from slam_backend.landmark_map import LandmarkMap
from slam_backend.motion import OdometryModel
from slam_backend.readers.mrclam import MrclamLog
from slam_backend.readers.mrclam_steps import SightingNoise, steps
from slam_backend.reports import MergeEvent, TeamReport
from slam_backend.team import TeamSlam
from slam_backend.trajectory import dead_reckoning

ESTIMATORS = ("fastslam2", "fastslam1")

# The odometry is the command, which these robots follow within 10 % of the distance and 25 % of the turn over a second.
# What they miss persists over many steps, while a filter draws anew at each: hence more than that.
MOTION = OdometryModel(
    sigma_along=0.4,
    sigma_across=0.1,
    sigma_heading=0.3,
    sigma_turn=0.6,
    floor_position=0.002,
    floor_heading=0.004,
)
# A barcode cannot be taken for another, so position need not tell landmarks apart: the gate only stops nonsense. A
# robot that has seen nothing for a minute may be metres off when it sees a landmark again, and only by accepting that
# sighting does it find back. Nor does a barcode ever start a second landmark.
POSITION_GATE = 1e4
DEAD_ZONE = 1e6
# Young maps of these robots are bent by tenths of a metre: landmarks need not fit closely, but nearly all have to. On
# two logs and four seeds, merges on 12 of the 15 landmarks were up to 24 degrees off, on 14 never more than 4.
POSITION_FLOOR = 0.3
LANDMARKS_NOT_SHARED = 1
MAX_SIGMA_HEADING = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplayConfig:
    """All that decides a replay.

    Attributes:
        path: Folder of the log.
        robots: Numbers of the robots, or None for all.
        duration: Seconds to replay [s], or None for all.
        particles: Per filter.
        estimator: Proposal of the filters.
        dt: Time between steps [s].
        seed: Of all random draws.
        motion: Assumed noise of the odometry, the same for all robots.
        sensor: Assumed noise of the sightings, the same for all robots.
    """

    path: str
    robots: tuple[int, ...] | None = None
    duration: float | None = None
    particles: int = 100
    estimator: Literal["fastslam2", "fastslam1"] = "fastslam2"
    dt: float = 0.25
    seed: int = 0
    motion: OdometryModel = MOTION
    sensor: SightingNoise = field(default_factory=SightingNoise)

    def __post_init__(self) -> None:
        check_int("particles", self.particles, 1, "Use at least one particle; 100 is a good start.")
        check_int("seed", self.seed, 0, "Use 0 or a positive number.")
        check_choice("estimator", self.estimator, ESTIMATORS)
        check_float("dt", self.dt, "Give seconds between steps.", above=0.0)
        if self.duration is not None:
            check_float("duration", self.duration, "Give seconds, or leave it away.", above=0.0)

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> Self:
        """Build a config from plain values, as `to_mapping` gives them; unknown names are refused."""
        chosen = dict(values)
        _refuse_unknown("config", chosen, cls)
        for name, kind in (("motion", OdometryModel), ("sensor", SightingNoise)):
            if name in chosen:
                _refuse_unknown(name, chosen[name], kind)
                chosen[name] = kind(**chosen[name])
        if chosen.get("robots") is not None:
            chosen["robots"] = tuple(chosen["robots"])
        return cls(**chosen)

    def to_mapping(self) -> dict[str, Any]:
        """Return the plain values that repeat this replay, the seed apart."""
        return {name: value for name, value in asdict(self).items() if name != "seed"}


@dataclass(frozen=True, slots=True, eq=False)
class Merge:
    """One merge, with the maps as they were just before it.

    Attributes:
        time: Seconds since the first step [s].
        event: The merge; its robots count from 0.
        map_a: Of the group whose frame stays.
        map_b: Of the other group.
    """

    time: float
    event: MergeEvent
    map_a: LandmarkMap
    map_b: LandmarkMap


@dataclass(frozen=True, slots=True, eq=False)
class Replay:
    """What the team estimated. K robots, T steps.

    Attributes:
        times: (T,) float64 [s]. Of the log's clock.
        paths: (K, T, 3) float64 [m, m, rad]. Estimated at each step from what was known then, own start frames.
        reckoned: (K, T, 3) float64 [m, m, rad]. Dead reckoning, own start frames.
        maps: Of each robot's group at the end, moved to the robot's own start frame.
        start_from_group: (K, 3) float64 [m, m, rad]. From its group's map frame to each robot's start frame.
        groups: Robots, counted from 0, that share a map at the end.
        merges: In order.
        attempts: How often two maps were compared.
    """

    times: FloatArray
    paths: FloatArray
    reckoned: FloatArray
    maps: tuple[LandmarkMap, ...]
    start_from_group: FloatArray
    groups: tuple[tuple[int, ...], ...]
    merges: tuple[Merge, ...]
    attempts: int


def replay(
    log: MrclamLog, config: ReplayConfig, on_step: Callable[[float, TeamReport], None] = lambda progress, report: None
) -> Replay:
    """Let a team of filters live through a log.

    Args:
        log: Of the robots that the config names.
        config: Assumptions and sizes.
        on_step: Called after each step with the share of the log that is done, in (0, 1], and the team's report.

    Returns:
        Paths as they were known at each step, maps and merges as they came.
    """
    readings = steps(log, config.dt, config.sensor)
    robots, num_steps = range(len(log.robots)), len(readings.times)
    team = TeamSlam(
        len(log.robots),
        alignment=AlignmentOptions(
            position_floor=POSITION_FLOOR,
            min_inliers=max(3, len(log.subjects) - LANDMARKS_NOT_SHARED),
            max_sigma_heading=MAX_SIGMA_HEADING,
        ),
        attempts=AttemptOptions(new_candidates=1),
        seed=config.seed,
        num_particles=config.particles,
        motion=config.motion,
        proposal=config.estimator,
        position_gate=POSITION_GATE,
        dead_zone=DEAD_ZONE,
    )
    paths = np.zeros((len(robots), num_steps, 3))
    merges: list[Merge] = []
    attempts = 0
    maps = [team.map(robot) for robot in robots]
    for step in range(num_steps):
        report = team.step(
            [own.odometry[step] if step else None for own in readings.robots],
            [own.measurements[step] for own in readings.robots],
        )
        for event in report.events:
            attempts += event.kind == "attempt"
            if event.kind == "merge":
                time = float(readings.times[step] - readings.times[0])
                merges.append(Merge(time, event, maps[event.robots_a[0]], maps[event.robots_b[0]]))
        maps = [team.map(robot) for robot in robots]
        for robot in robots:
            paths[robot, step] = compose(team.start_from_group(robot), team.pose(robot).mean)
        on_step((step + 1) / num_steps, report)
    frames = np.array([team.start_from_group(robot) for robot in robots])
    return Replay(
        times=readings.times,
        paths=paths,
        reckoned=np.array([dead_reckoning(np.zeros(3), own.odometry[1:]) for own in readings.robots]),
        maps=tuple(own.moved(frame) for own, frame in zip(maps, frames, strict=True)),
        start_from_group=frames,
        groups=team.groups,
        merges=tuple(merges),
        attempts=attempts,
    )


def _refuse_unknown(name: str, values: Any, kind: type[Any]) -> None:
    """Raise if `values` is no mapping, or names something that the dataclass `kind` lacks."""
    names = [known.name for known in fields(kind)]
    if not isinstance(values, Mapping):
        raise bad_argument(name, f"a table of {', '.join(names)}", values, "Write it as a table.")
    unknown = [key for key in values if key not in names]
    if unknown:
        raise bad_argument(name, f"names among {', '.join(names)}", unknown[0], "Correct the name.")
