"""Logs of one robot or a team as steps of filters: what readers return and `training.replay.core` replays."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from agents.plugins import find_plugin, one_line
from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import FloatArray, argument_error, check_array, check_kind, did_you_mean
from slam_backend.fastslam.options import MAX_ROBOTS, FilterOptions
from slam_backend.models.measurements import Measurements
from slam_backend.team.reports import TeamReport
from slam_backend.trajectory import Trajectory

if TYPE_CHECKING:
    from training.replay.core import Replay
    from training.replay.metrics import PathScore

Step = tuple[FloatArray, Measurements | None]


@short_repr
@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RobotLog:
    """Readings of one robot in T steps, and its true path.

    Attributes:
        odometry: (T, 3) float64 [m, m, rad]. Motion since the previous step, in the previous robot frame; the first is
            not used. None: `measurements` yields pairs of motion and measurements, computed during the replay.
        measurements: T entries; None for a step without measurements. All descriptors have one length, and are equal
            where landmarks look alike.
        identities: T entries; (n,) int, the true landmark of each measurement: a row of `Log.landmarks`. None: unknown.
        truth: True poses over time; or (g, 3) float64 [s, m, m], times and true positions without headings, as of a
            GPS. None: unknown.
        reckoned: (T, 3) float64 [m, m, rad]. Dead reckoning, start frame. None: that of `odometry`.
        number: Number of the robot in output.
    """

    odometry: FloatArray | None
    measurements: Iterable[Any]
    identities: Sequence[Any] | None = None
    truth: Trajectory | FloatArray | None = None
    reckoned: FloatArray | None = None
    number: int = 1

    def steps(self) -> Iterator[Step]:
        """Yield the motion since the previous step and the measurements of each step."""
        yield from self.measurements if self.odometry is None else zip(self.odometry, self.measurements, strict=True)


class Source:
    """Peculiarities of the logs of a source; by default there are none."""

    def describe(self, frame: Measurements, predicted_pose: Callable[[], FloatArray]) -> Measurements:
        """Return the measurements as the filter gets them; the predicted pose (3,) is in the start frame."""
        return frame

    def observe(self, report: TeamReport) -> None:
        """Look at the report of a step."""

    def complete(self, metrics: dict[str, Any], result: "Replay", score: "PathScore | None") -> list[str]:
        """Add to the metrics, in place, given the score of the first robot's path; return lines to print."""
        return []

    def draw(self, folder: Path, result: "Replay") -> None:
        """Draw further pictures into the run folder."""


@short_repr
@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Log:
    """Log of robots in one world, as steps at common times.

    Attributes:
        times: (T,) float64 [s], strictly increasing.
        robots: Readings of each robot.
        landmarks: (N, 2) float64 [m], world frame. True positions. None: unknown.
        options: Options of the filters, see `FilterOptions`.
        team: Options of `TeamSlam` if the robots form a team whose starts are unknown. None: a log of one robot.
        alone: Whether the robots of a team never communicate.
        identified: Whether filters are given the true identities.
        mount: (3,) float64 [m, m, rad], robot frame. Place of the sensor whose true poses are known.
        seed: Seed of the filters. None: that of the command.
        title: Title of the figure of one robot.
        notes: Lines to print, about what is implausible in the log.
        source: Peculiarities of the source.

    Raises:
        ValueError: If an array or list has a wrong length or shape or a number that is not finite, the log is empty, or
            there is no such option.
    """

    times: FloatArray
    robots: Sequence[RobotLog]
    landmarks: FloatArray | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    team: Mapping[str, Any] | None = None
    alone: bool = False
    identified: bool = True
    mount: Sequence[float] = (0.0, 0.0, 0.0)
    seed: np.random.SeedSequence | None = None
    title: str = "replay"
    notes: tuple[str, ...] = ()
    source: Source = field(default_factory=Source)

    def __post_init__(self) -> None:
        times = check_array("times", self.times, (None,), "Give the time of each step in seconds.")
        if len(times) < 2:
            raise argument_error("times", "two steps or more", f"a log of {len(times)}", "Give a longer log.")
        if len(back := np.flatnonzero(np.diff(times) <= 0.0)):
            got = f"{times[back[0] + 1]} s after {times[back[0]]} s"
            raise argument_error("times", "strictly increasing times", got, "Sort the steps by time.")
        robots = tuple(self.robots)
        if not 1 <= len(robots) <= MAX_ROBOTS:
            hint = "Give a RobotLog for each robot."
            raise argument_error("robots", f"1 to {MAX_ROBOTS} robots", f"a list of {len(robots)}", hint)
        if self.landmarks is not None:
            hint = "Give the position x, y of each landmark in metres."
            object.__setattr__(self, "landmarks", check_array("landmarks", self.landmarks, (None, 2), hint))
        robots = tuple(self._checked(check_kind("robots", each, RobotLog), len(times)) for each in robots)
        known = [each.name for each in fields(FilterOptions)]
        for name in self.options:
            if name not in known:
                hint = f"{did_you_mean(name, known)}Filters have the options {', '.join(known)}."
                raise argument_error("options", "names of options", name, hint)
        if len(robots) > 1 and self.team is None:
            object.__setattr__(self, "team", {})
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "robots", robots)

    def _checked(self, robot: RobotLog, steps: int) -> RobotLog:
        """Return the readings of a robot if they are complete; what is computed during the replay is trusted."""
        for name, values in (("odometry", robot.odometry), ("reckoned", robot.reckoned)):
            if values is not None:
                check_array(name, values, (steps, 3), "Give a motion or pose (x, y, theta) in m, m, rad for each step.")
        if isinstance(robot.truth, np.ndarray):
            check_array("truth", robot.truth, (None, 3), "Give rows of time, x, y.")
        elif robot.truth is not None:
            check_kind("truth", robot.truth, Trajectory, "Build one: Trajectory(times, poses).")
        if robot.odometry is None:
            return robot
        frames = _of_steps("measurements", robot.measurements, steps)
        for step, frame in enumerate(frames):
            if not isinstance(frame, Measurements | None):
                hint = "Build one: Measurements(points, descriptors)."
                raise argument_error(f"measurements[{step}]", "Measurements or None", frame, hint)
        if robot.identities is None:
            return robot
        hint, identities = "Give the landmark of each measurement, a row of `landmarks`.", []
        for step, named in enumerate(_of_steps("identities", robot.identities, steps)):
            shape = (0 if frames[step] is None else len(frames[step]),)
            rows = check_array(f"identities[{step}]", [] if named is None else named, shape, hint, dtype=np.int64)
            if len(rows) and (rows.min() < 0 or (self.landmarks is not None and rows.max() >= len(self.landmarks))):
                raise argument_error(f"identities[{step}]", "rows of landmarks", named, hint)
            identities.append(rows)
        return replace(robot, identities=identities)

    @property
    def has_identities(self) -> bool:
        """Whether the true landmarks of all measurements are known."""
        return all(robot.identities is not None for robot in self.robots)

    @property
    def num_landmarks(self) -> int:
        """Number of true landmarks, as far as it is known."""
        if self.landmarks is not None:
            return len(self.landmarks)
        named = (row for robot in self.robots for row in robot.identities or () if len(row))
        return 1 + max((int(row.max()) for row in named), default=-1)


def _of_steps(name: str, values: Any, steps: int) -> Sequence[Any]:
    """Return a list with an entry for each step, or raise."""
    if not isinstance(values, Sequence) or len(values) != steps:
        got = f"a list of {len(values)}" if isinstance(values, Sequence) else values
        raise argument_error(
            name, f"a list of {steps} entries, one for each step", got, "Give None where nothing was seen."
        )
    return values


def read_with(name: str, path: str | Path) -> Log:
    """Return the log that a reader of the user, `MODULE:NAME`, makes of a path.

    Raises:
        ValueError: If there is no such function, it raises, or it returns no log; one line with a cure.
    """
    reader = find_plugin(name, "reader")
    with one_line(name, "reader"):
        log = reader(Path(path))
    return check_kind("reader", log, Log, f"Let {name} return a training.replay.log.Log.")
