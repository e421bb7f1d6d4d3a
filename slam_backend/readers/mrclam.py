"""Reader of the UTIAS multi-robot logs (MR.CLAM)."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slam_backend.core.files import checked_path
from slam_backend.core.short_repr import short_repr
from slam_backend.core.text_files import data_lines, existing_file, line_error, parse_numbers, read_text
from slam_backend.core.validation import BoolArray, FloatArray, IntArray, argument_error, check_float
from slam_backend.readers.conversions import HOLD, integrate_commands
from slam_backend.readers.plausibility import MOST_BEARING, check_rate, repetition_note, unit_notes
from slam_backend.readers.range_bearing import RobotReadings, even_times, frames_at, motions
from slam_backend.readers.tables import MOST_JITTER, sorted_note, steps_back, time_order
from slam_backend.trajectory import Trajectory

ROBOTS = (1, 2, 3, 4, 5)  # subject numbers of the robots
STEP = 0.25  # [s] between steps by default


@short_repr
@dataclass(frozen=True, slots=True, eq=False)
class MrclamRobot:
    """Readings of one robot, and its true path. The arrays are read-only.

    Attributes:
        robot: Number of the robot in the log, 1 to 5.
        commands: (n, 3) float64 [s, m/s, rad/s]. Time, forward and angular velocity as commanded, in order of time.
        sightings: (m, 4) float64 [s, -, m, rad]. Time, subject, range, bearing (positive to the left) of landmarks, in
            order of time. Sightings of robots and of unknown barcodes are dropped.
        truth: True poses in the world frame; None if unknown.
    """

    robot: int
    commands: FloatArray
    sightings: FloatArray
    truth: Trajectory | None


@short_repr
@dataclass(frozen=True, slots=True, eq=False)
class MrclamLog:
    """A log of several robots among landmarks with barcodes. The arrays are read-only.

    Attributes:
        robots: One entry per requested robot, in that order.
        subjects: (N,) int64. Subject numbers of the landmarks with a barcode, ascending.
        positions: (N, 2) float64 [m]. True positions of the landmarks, world frame; None if unknown.
        notes: Lines about files that were sorted by time, and about what is implausible.
    """

    robots: tuple[MrclamRobot, ...]
    subjects: IntArray
    positions: FloatArray | None
    notes: tuple[str, ...] = ()


def load_mrclam(
    path: str | Path,
    robots: Sequence[int] | None = None,
    duration: float | None = None,
    truth: str | Path | None = None,
) -> MrclamLog:
    """Read a folder such as `MRCLAM_Dataset7`.

    Rows up to `MOST_JITTER` back in time are sorted, with a remark in the notes of the log. At equal times the last
    command and the first true pose of the file apply; sightings keep the order of the file.

    Args:
        path: Folder with `Barcodes.dat` and, for each robot i, `Robot<i>_Odometry.dat` and `Robot<i>_Measurement.dat`;
            optional: `Landmark_Groundtruth.dat` and `Robot<i>_Groundtruth.dat`.
        robots: Numbers of the robots to read, 1 to 5, without repetition. None: all robots with odometry.
        duration: Length of the log from the earliest command [s]. None: the whole log.
        truth: File of true poses if a single robot is read: rows of time, x, y and heading, separated by blanks or
            commas, with an optional header line. None: the file in the folder, if any.

    Returns:
        The log. True poses are not cut to `duration`.

    Raises:
        ValueError: If the folder or a file is missing, a line is malformed (the message names file and line), a time
            lies more than `MOST_JITTER` back, commands are usually more than `HOLD` apart, all sightings
            are earlier than a robot's odometry, a robot is unknown, `Landmark_Groundtruth.dat` lacks a landmark, or
            `truth` is given for several robots.
    """
    folder = checked_path(path)
    if not folder.is_dir():
        raise argument_error("path", "a folder of the MR.CLAM log", "no such folder", f"Check {str(path)!r}.")
    numbers = _check_robots(folder, robots)
    barcodes, _ = _read_table(folder / "Barcodes.dat", ("subject", "barcode"))
    subject_of = {int(barcode): int(subject) for subject, barcode in barcodes}
    subjects = np.array(sorted(set(subject_of.values()) - set(ROBOTS)), dtype=np.int64)
    positions = _read_positions(folder / "Landmark_Groundtruth.dat", subjects)
    if truth is not None and len(numbers) != 1:
        hint = "Name the robot whose poses these are with robots."
        raise argument_error("truth", "a file of one robot's poses", f"a log of robots {numbers}", hint)
    truths = {} if truth is None else {numbers[0]: existing_file(truth, "truth", "a file of true poses")}
    sorted_files: list[str] = []
    logs = [_read_robot(folder, robot, subject_of, truths.get(robot), sorted_files) for robot in numbers]
    notes = sorted_note(sorted_files) + tuple(f"Robot {log.robot}: {note}" for log in logs for note in _notes(log))
    if duration is not None:
        seconds = check_float("duration", duration, "Give seconds, or None for the whole log.", above=0.0)
        start = min(log.commands[0, 0] for log in logs)
        logs = [_cut(log, start + seconds) for log in logs]
    arrays = [subjects, *(a for log in logs for a in (log.commands, log.sightings))]
    for array in arrays if positions is None else [*arrays, positions]:
        array.setflags(write=False)
    return MrclamLog(tuple(logs), subjects, positions, notes)


def _notes(log: MrclamRobot) -> Iterator[str]:
    """Yield a line for each kind of reading that does not overlap a robot's odometry in time, or is implausible."""
    first, last = log.commands[0, 0], log.commands[-1, 0]
    stamps = {"sightings": log.sightings[:, 0], "true poses": np.empty(0) if log.truth is None else log.truth.times}
    for name, times in stamps.items():
        if len(times) and (times[0] > last or times[-1] < first):
            yield (
                f"no overlap of its {name} ({times[0]:.1f} to {times[-1]:.1f} s) with its odometry "
                f"({first:.1f} to {last:.1f} s): check that their times are of one clock."
            )
    yield from repetition_note(log.sightings[:, 0], log.sightings[:, 1].astype(np.int64))
    yield from unit_notes(log.commands, log.sightings[:, [0, 2, 3]], HOLD, STEP)


def _read_positions(file: Path, subjects: IntArray) -> FloatArray | None:
    """Return the true positions (N, 2) [m] of landmarks (N,), or None if the file does not exist."""
    if not file.exists():
        return None
    rows, _ = _read_table(file, ("subject", "x", "y", "sigma_x", "sigma_y"))
    place_of = {int(row[0]): row[1:3] for row in rows}
    unplaced = [int(subject) for subject in subjects if int(subject) not in place_of]
    if unplaced:
        got = f"no position of subject {unplaced[0]}"
        raise argument_error("path", "a position of each landmark", got, f"Add it to {file}.")
    return np.array([place_of[int(subject)] for subject in subjects]).reshape(-1, 2)


def _check_robots(folder: Path, robots: Sequence[int] | None) -> tuple[int, ...]:
    """Return the numbers of the robots to read, or raise."""
    if robots is None:
        present = tuple(robot for robot in ROBOTS if (folder / f"Robot{robot}_Odometry.dat").is_file())
        if not present:
            hint = f"Check {str(folder / 'Robot1_Odometry.dat')!r}."
            raise argument_error("path", "a folder of the MR.CLAM log", "no odometry of any robot", hint)
        return present
    numbers = tuple(robots)
    unknown = [robot for robot in numbers if robot not in ROBOTS]
    if not numbers or unknown or len(set(numbers)) < len(numbers):
        raise argument_error("robots", "different numbers from 1 to 5", numbers, "Name each robot once, e.g. 1,2,3.")
    return numbers


def _read_robot(
    folder: Path, robot: int, subject_of: dict[int, int], truth_file: Path | None, sorted_files: list[str]
) -> MrclamRobot:
    """Read the files of one robot, without sightings of robots, and append the remarks about sorting."""
    commands, words = _read_table(folder / f"Robot{robot}_Odometry.dat", ("time", "velocity", "angular_velocity"))
    sorted_files.append(words)
    check_rate("path", commands[:, 0], HOLD, f"Give times in seconds in {folder / f'Robot{robot}_Odometry.dat'}.")
    columns = ("time", "barcode", "range", "bearing")
    rows, words = _read_table(folder / f"Robot{robot}_Measurement.dat", columns, empty=True)
    sorted_files.append(words)
    if len(rows) and rows[-1, 0] < commands[0, 0] - MOST_JITTER:
        expected = f"sightings of robot {robot} since its first odometry at {commands[0, 0]:.3f} s"
        got = f"a log of sightings from {rows[0, 0]:.3f} to {rows[-1, 0]:.3f} s"
        hint = f"Check that the times in {folder / f'Robot{robot}_Measurement.dat'} are of the same clock."
        raise argument_error("path", expected, got, hint)
    seen = np.array([subject_of.get(int(barcode), 0) for barcode in rows[:, 1]], dtype=np.float64)
    sightings = np.column_stack([rows[:, 0], seen, rows[:, 2:]])[seen > max(ROBOTS)]
    default = folder / f"Robot{robot}_Groundtruth.dat"
    truth = None
    if truth_file is not None or default.is_file():
        poses, words = _read_table(default if truth_file is None else truth_file, ("time", "x", "y", "theta"))
        sorted_files.append(words)
        kept = np.diff(poses[:, 0], prepend=-np.inf) > 0.0  # drops repeated time stamps
        truth = Trajectory(poses[kept, 0], poses[kept, 1:])
    return MrclamRobot(robot, commands, sightings, truth)


def _cut(log: MrclamRobot, end: float) -> MrclamRobot:
    """Drop the readings after `end` [s]; a robot that starts later keeps its first command."""
    kept = log.commands[log.commands[:, 0] <= end]
    return MrclamRobot(
        log.robot, kept if len(kept) else log.commands[:1], log.sightings[log.sightings[:, 0] <= end], log.truth
    )


def _read_table(file: Path, columns: tuple[str, ...], empty: bool = False) -> tuple[FloatArray, str]:
    """Return the rows (n, columns) of a file of numbers separated by blanks or commas, and the remark of `time_order`.

    Comments after `#`, empty lines and a header line are skipped. Rows with a time are in order of time.

    Raises:
        ValueError: If the file is missing or, unless `empty`, has no rows; if a line does not have one finite number
            per column; if subjects or barcodes are not whole, ranges not positive, or times go back by more than
            `MOST_JITTER`.
    """
    expected = f"{len(columns)} numbers ({' '.join(columns)})"
    lines = list(data_lines(read_text(file, kind="a file of the MR.CLAM log")))
    if lines and _names(lines[0][1]):
        del lines[0]
    rows: list[list[float]] = []
    for number, line in lines:
        row = parse_numbers(line.split(",") if "," in line else line.split())
        if row is None or len(row) != len(columns):
            raise line_error("path", expected, line, file, number)
        rows.append(row)
    if not rows and not empty:
        raise argument_error("path", f"rows ({' '.join(columns)})", "no rows", f"{file} is empty: get it again.")
    table = np.array(rows, dtype=np.float64).reshape(-1, len(columns))
    for rule, broken in _faults(table, columns):
        if broken.any():
            number, line = lines[int(np.argmax(broken))]
            raise line_error("path", f"{expected} with {rule}", line, file, number)
    if columns[0] != "time":
        return table, ""
    order, words = time_order(file.name, table[:, 0])
    return table[order], words


def _faults(table: FloatArray, columns: tuple[str, ...]) -> Iterator[tuple[str, BoolArray]]:
    """Yield each rule for rows (n, columns), with the mask (n,) of rows that violate it."""
    yield "finite numbers", np.asarray(~np.isfinite(table).all(axis=1))
    for name, column in zip(columns, table.T, strict=True):
        if name in ("subject", "barcode"):
            yield f"a whole {name}", column != np.round(column)
        elif name == "range":
            yield "a range > 0", column <= 0.0
        elif name == "bearing":
            yield "a bearing within +-2 pi", np.abs(column) > MOST_BEARING
        elif name == "time":
            yield f"a time at most {MOST_JITTER:g} s before that of a line above", steps_back(column) > MOST_JITTER


def _names(body: str) -> bool:
    """Return whether a line is a header: words separated by commas, none of them a number."""
    return "," in body and all(parse_numbers([word]) is None for word in body.split(","))


@short_repr
@dataclass(frozen=True, slots=True, kw_only=True)
class SightingNoise:
    """Assumed errors of one sighting; the defaults are twice the errors observed in this data set.

    Compared with the truth of six robots (five of data set 7, one of 4), the standard deviation of ranges is 0.03 to
    0.17 m from 1 to 3 m and 0.07 to 0.21 m from 4 to 6 m, that of bearings 0.006 to 0.018 rad, depending on the robot.
    The errors are correlated in time: those of ranges by about 0.85 between frames, 0.65 over 1 s and 0.4 over 4 s,
    those of bearings half as much. A filter assumes independent sightings, hence the factor of two.

    Attributes:
        range_floor: Standard deviation of a range near zero [m].
        range_share: Additional standard deviation per metre of range, added in quadrature [m/m].
        bearing: Standard deviation of a bearing [rad].
        height: Standard deviation of the landmarks' height relative to the camera, assumed zero [m].
    """

    range_floor: float = 0.1
    range_share: float = 0.07
    bearing: float = 0.025
    height: float = 0.05

    def __post_init__(self) -> None:
        for name in ("range_floor", "bearing", "height"):
            check_float(f"sensor.{name}", getattr(self, name), "Give a standard deviation.", above=0.0)
        check_float("sensor.range_share", self.range_share, "Give a share of the range.", at_least=0.0)

    def variances(self, ranges: FloatArray) -> FloatArray:
        """Return the variances (n, 3) [m^2, rad^2, m^2] of range, bearing and height at ranges (n,) [m]."""
        along = self.range_floor**2 + (self.range_share * ranges) ** 2
        return np.stack([along, *(np.full(len(ranges), v**2) for v in (self.bearing, self.height))], axis=-1)


@short_repr
@dataclass(frozen=True, slots=True, kw_only=True)
class Drive:
    """Response of a robot to its commands; by default it follows them exactly.

    Attributes:
        delay: Time from a command to the motion [s].
        speed: Ratio of driven to commanded velocity [-].
        turn: Ratio of driven to commanded angular velocity [-].
    """

    delay: float = 0.0
    speed: float = 1.0
    turn: float = 1.0

    def __post_init__(self) -> None:
        check_float("drive.delay", self.delay, "Give seconds.", at_least=0.0)
        for name in ("speed", "turn"):
            check_float(f"drive.{name}", getattr(self, name), "Give a factor near 1.", above=0.0)

    def driven(self, commands: FloatArray) -> FloatArray:
        """Return the driven velocities (n, 3) [s, m/s, rad/s] of commands (n, 3) in the same units."""
        return np.asarray(commands * [1.0, self.speed, self.turn] + [self.delay, 0.0, 0.0])


@short_repr
@dataclass(frozen=True, slots=True, eq=False)
class RobotSteps(RobotReadings):
    """Readings of one robot; descriptors are one-hot, in the order of `MrclamLog.subjects`.

    Attributes:
        reckoned: (T, 3) float64 [m, m, rad]. Dead reckoning of the commands, own start frame.
    """

    reckoned: FloatArray


@short_repr
@dataclass(frozen=True, slots=True, eq=False)
class MrclamSteps:
    """Log as steps at common times.

    Attributes:
        times: (T,) float64 [s]. Evenly spaced times.
        robots: Steps of each robot, in the order of the log.
    """

    times: FloatArray
    robots: tuple[RobotSteps, ...]


def to_filter_steps(
    log: MrclamLog, dt: float = STEP, noise: SightingNoise | None = None, drive: Drive | None = None
) -> MrclamSteps:
    """Resample a log at common times, from its earliest command to its last reading.

    A sighting is assigned to the nearest step and moved there by the odometry in between, so that rounding of its time
    causes no error. Only the first of several sightings of one landmark in one step is used: their errors are strongly
    correlated. The default step is slightly longer than the 0.23 s between two frames of these cameras.

    Args:
        log: Log from `load_mrclam`.
        dt: Time between steps [s].
        noise: Assumed errors of each sighting. None: `SightingNoise()`.
        drive: Response of the robots to their commands. None: `Drive()`.

    Raises:
        ValueError: If `dt` is not positive, or gives more than a million steps.
    """
    noise = SightingNoise() if noise is None else noise
    stamps = [robot.commands[:, 0] for robot in log.robots] + [robot.sightings[:, 0] for robot in log.robots]
    start = min(float(robot.commands[0, 0]) for robot in log.robots)
    times = even_times(start, max(float(column[-1]) for column in stamps if len(column)), dt)
    drive = Drive() if drive is None else drive
    return MrclamSteps(times, tuple(_robot_steps(robot, times, log.subjects, noise, drive) for robot in log.robots))


def _robot_steps(
    log: MrclamRobot, times: FloatArray, subjects: IntArray, noise: SightingNoise, drive: Drive
) -> RobotSteps:
    """Return the steps of one robot at these times (T,) [s]."""
    velocities = drive.driven(log.commands)

    def pose_at(wanted: FloatArray) -> FloatArray:
        return integrate_commands(velocities, wanted)

    reckoned = integrate_commands(log.commands, times)
    reckoned.setflags(write=False)
    column = np.searchsorted(subjects, log.sightings[:, 1].astype(np.int64))
    descriptors = np.eye(len(subjects), dtype=np.float32)[column]
    seen, variances = log.sightings[:, [0, 2, 3]], noise.variances(log.sightings[:, 2])
    frames = frames_at(times, pose_at, seen, variances, descriptors, column)
    return RobotSteps(motions(pose_at(times)), frames, reckoned)
