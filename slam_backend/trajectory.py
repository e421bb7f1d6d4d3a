"""Trajectories: interpolation, dead reckoning and the TUM file format."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from slam_backend.core.files import write_file
from slam_backend.core.short_repr import short_repr
from slam_backend.core.text_files import data_lines, line_error, parse_numbers, read_text
from slam_backend.core.validation import FloatArray, argument_error, check_array
from slam_backend.geometry import wrap_angle

LONGEST_HOLD = 0.25  # [s] for which an end of a trajectory applies beyond it
DECIMAL = 1e-4  # last digit of quaternions that are written with four decimals
LEAST_NORM, MOST_NORM = 1.0 - 1e-3, 1.0 + 1e-3  # of quaternions with three decimals and more


@short_repr
@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """The poses of one robot over time, in one frame. The arrays are read-only copies of the arguments.

    Attributes:
        times: (T,) float64 [s], strictly increasing, T >= 1.
        poses: (T, 3) float64 [m, m, rad].

    Raises:
        ValueError: If a shape is wrong, a number is not finite, or times do not increase strictly.

    >>> Trajectory([0.0, 2.0], [[0.0, 0.0, 0.0], [4.0, 0.0, 1.0]]).at(0.5).tolist()
    [1.0, 0.0, 0.25]
    """

    times: FloatArray
    poses: FloatArray

    def __post_init__(self) -> None:
        times = check_array("times", self.times, (None,), "Give one time per pose.")
        poses = check_array("poses", self.poses, (len(times), 3), "Give one pose (x, y, theta) per time.")
        if not len(times):
            raise argument_error("times", "at least one time", "an array of none", "Record a pose first.")
        backwards = np.flatnonzero(np.diff(times) <= 0.0)
        if len(backwards):
            later = int(backwards[0]) + 1
            raise argument_error(
                "times",
                "strictly increasing times",
                f"a time {times[later]} after {times[later - 1]} at index {later}",
                "Sort the poses by time and drop repeated ones.",
            )
        for name, array in (("times", times), ("poses", poses)):
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    def __len__(self) -> int:
        return len(self.times)

    def at(self, times: ArrayLike) -> FloatArray:
        """Return interpolated poses: positions along straight lines, headings along the shorter arc.

        The first and the last pose also apply to times outside by up to one usual interval between poses, at most
        `LONGEST_HOLD`.

        Args:
            times: (...) float64 [s].

        Returns:
            (..., 3) poses [m, m, rad].

        Raises:
            ValueError: If a time lies further outside the recorded range.
        """
        try:
            wanted = np.asarray(times, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise argument_error("times", "numbers", times, "Give times in seconds.") from error
        reach = min(float(np.median(np.diff(self.times))), LONGEST_HOLD) if len(self) > 1 else 0.0
        outside = ~((wanted >= self.times[0] - reach) & (wanted <= self.times[-1] + reach))
        if outside.any():
            raise argument_error(
                "times",
                f"times from {self.times[0]:.6f} s to {self.times[-1]:.6f} s",
                float(wanted[outside][0]),
                "Cut the times to the recorded range.",
            )
        wanted = np.clip(wanted, self.times[0], self.times[-1])
        right = np.clip(np.searchsorted(self.times, wanted, side="left"), min(1, len(self) - 1), len(self) - 1)
        left = np.maximum(right - 1, 0)
        span = np.where(right > left, self.times[right] - self.times[left], 1.0)
        share = np.where(right > left, (wanted - self.times[left]) / span, 0.0)[..., None]
        change = self.poses[right] - self.poses[left]
        change[..., 2] = wrap_angle(change[..., 2])
        poses = self.poses[left] + share * change
        poses[..., 2] = wrap_angle(poses[..., 2])
        return np.asarray(poses)

    def save_tum(self, path: str | Path) -> None:
        """Write `to_tum()` to a file.

        Raises:
            ValueError: If the file cannot be written; an existing file is then unchanged.
        """
        write_file(path, self.to_tum())

    def to_tum(self) -> str:
        """Return lines `time tx ty tz qx qy qz qw`, with numbers in the shortest form that reads back bit for bit."""
        rows = ["# timestamp tx ty tz qx qy qz qw"]
        half = 0.5 * self.poses[:, 2]
        for time, (x, y, _), qz, qw in zip(self.times, self.poses, np.sin(half), np.cos(half), strict=True):
            rows.append(" ".join(repr(float(v)) for v in (time, x, y, 0.0, 0.0, 0.0, qz, qw)))
        return "\n".join(rows) + "\n"

    @classmethod
    def load_tum(cls, path: str | Path) -> Self:
        """Read a planar path; comments after `#` and empty lines are skipped.

        Quaternions may be rounded to four decimals, and tilts that this could explain count as none.

        Raises:
            ValueError: If the file is missing or has no poses, a line is malformed, a rotation is not about the
                vertical, or times do not increase; the message names file and line.
        """
        rows: list[tuple[float, float, float, float]] = []
        for number, line in data_lines(read_text(path, kind="a TUM trajectory file")):
            values = parse_numbers(line.split())
            if values is None or len(values) != 8 or not np.isfinite(values).all():
                raise line_error("path", "8 finite numbers time tx ty tz qx qy qz qw", line, path, number)
            time, x, y, _, qx, qy, qz, qw = values
            if not LEAST_NORM <= math.hypot(qx, qy, qz, qw) <= MOST_NORM:
                raise line_error("path", "a unit quaternion qx qy qz qw", line, path, number)
            if max(abs(qx), abs(qy)) > DECIMAL:
                raise line_error("path", "a rotation about the vertical (qx = qy = 0)", line, path, number)
            if rows and time <= rows[-1][0]:
                raise line_error("path", f"a time after {rows[-1][0]}", line, path, number)
            rows.append((time, x, y, float(wrap_angle(2.0 * np.arctan2(qz, qw)))))
        if not rows:
            raise argument_error("path", "a TUM trajectory file with poses", "no pose", f"Check {str(path)!r}.")
        table = np.array(rows)
        return cls(table[:, 0], table[:, 1:])


def dead_reckoning(start_pose: ArrayLike, odometry: ArrayLike) -> FloatArray:
    """Chain odometry readings from a start pose.

    Args:
        start_pose: (3,) float64 [m, m, rad].
        odometry: (T, 3) float64 [m, m, rad]. Motions since the previous reading, in the robot's previous frame.

    Returns:
        (T + 1, 3) poses in the frame of `start_pose`, which is the first row.

    Raises:
        ValueError: If a shape is wrong or a number is not finite.

    >>> dead_reckoning([0.0, 0.0, np.pi / 2], [[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]).round(6)[:, 1].tolist()
    [0.0, 1.0, 3.0]
    """
    start = check_array("start_pose", start_pose, (3,), "Give a pose (x, y, theta).")
    motion = check_array("odometry", odometry, (None, 3), "Give one row (dx, dy, dtheta) per step.")
    headings = start[2] + np.concatenate([[0.0], np.cumsum(motion[:, 2])])
    c, s = np.cos(headings[:-1]), np.sin(headings[:-1])
    steps = np.stack([c * motion[:, 0] - s * motion[:, 1], s * motion[:, 0] + c * motion[:, 1]], axis=-1)
    positions = start[:2] + np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    return np.column_stack([positions, wrap_angle(headings)])
