"""Compact log of one robot's odometry and measurements, the input of the smoother."""

from bisect import bisect_left
from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from slam_backend.core.validation import FloatArray, IntArray, argument_error, check_array, check_choice, check_int
from slam_backend.fastslam._kernels.records import LogColumns
from slam_backend.fastslam._kernels.run_log import turn_of, write_rows
from slam_backend.smoother.log_arrays import (
    EXACT,
    ODOMETRY,
    REJECTED,
    STATIONARY,
    LogArrays,
    LogStep,
    join,
)
from slam_backend.state import Each, Record, Sizes, State, accepted, restore, take

ROWS = 256  # steps of a chunk
MEASUREMENTS = 2048  # measurements of a chunk, unless one frame alone has more
NO_MOTION = np.zeros(3)
NO_POINTS = np.empty((0, 3))
NO_IDS = np.empty(0, dtype=np.int64)


class RobotLog:
    """Append-only log of one robot: odometry or exact poses, measured points, and their data association.

    Steps lie in chunks. A finished chunk never changes: snapshots and copies share it, so that they cost O(number of
    chunks) and a copy of the last, unfinished one, however long the run. A step takes 42 bytes, a measurement 32;
    covariances (48) are stored only in chunks that have some.

    Example:
        >>> log = RobotLog()
        >>> log.append(0, points=np.array([[2.0, 0.0, 0.1]]), ids=np.array([7]))       # the first frame
        >>> log.append(1, odometry=np.array([0.1, 0.0, 0.02]))                         # motion only
        >>> len(log), log.num_measurements, log.arrays().starts.tolist()
        (2, 1, [0, 1, 1])
    """

    STATE = State(chunks=Each(Record(LogArrays), kind=list), unfinished=Record(LogArrays))
    __slots__ = ("_chunks", "_covariances", "_given", "_ids", "_kinds", "_last", "_motions",
                 "_num_measurements", "_num_rows", "_points", "_starts", "_steps")  # fmt: skip

    def __init__(self) -> None:
        self._chunks: list[LogArrays] = []
        self._last = -1
        self._open(MEASUREMENTS)

    def _open(self, capacity: int) -> None:
        """Start an empty chunk for up to `capacity` measurements."""
        self._num_rows = self._num_measurements = 0
        self._steps = np.empty(ROWS, dtype=np.int64)
        self._kinds = np.empty(ROWS, dtype=np.int8)
        self._motions = np.empty((ROWS, 3))
        self._given = np.empty(ROWS, dtype=np.bool_)
        self._starts = np.zeros(ROWS + 1, dtype=np.int64)
        self._points = np.empty((capacity, 3))
        self._ids = np.empty(capacity, dtype=np.int64)
        self._covariances: FloatArray | None = None

    # ------------------------------------------------------------------ writing

    def append(
        self,
        step: int,
        odometry: FloatArray | None = None,
        pose: FloatArray | None = None,
        points: FloatArray = NO_POINTS,
        ids: IntArray = NO_IDS,
        covariances: FloatArray | None = None,
    ) -> None:
        """Add a step. Order and shapes are checked; the numbers have been checked by the filter.

        Args:
            step: Index of the step in the run, larger than that of the previous one.
            odometry: (3,) [m, m, rad], motion since the last step, previous robot frame. None: the robot stood still.
            pose: (3,) [m, m, rad], own start frame. Exact pose, if known; odometry is then ignored, as in the filter.
            points: (n, 3) [m], robot axes, relative to the camera centre. All measured points, rejected ones included:
                the smoother may find their landmarks.
            ids: (n,) landmarks by the most probable particle, -1 = rejected.
            covariances: (n, 6) [m^2], robot axes, upper triangles by rows (xx, xy, xz, yy, yz, zz). None: the camera
                model.

        Raises:
            ValueError: If steps go back or shapes disagree; the log is then unchanged.
        """
        n = len(ids)
        motion = odometry if pose is None else pose
        if (
            step <= self._last
            or points.shape != (n, 3)
            or (motion is not None and motion.shape != (3,))
            or (covariances is not None and covariances.shape != (n, 6))
        ):
            raise self._refusal(step, odometry, pose, points, ids, covariances)
        start, t = self._num_measurements, self._num_rows
        if t == ROWS or (start and start + n > MEASUREMENTS):
            self._chunks.append(self._copy_of_open())
            self._open(max(MEASUREMENTS, n))
            start = t = 0
        elif n > len(self._ids):  # one huge frame after steps without measurements
            self._points, self._ids = np.empty((n, 3)), np.empty(n, dtype=np.int64)
        end = start + n
        self._steps[t] = step
        self._kinds[t] = STATIONARY if motion is None else ODOMETRY if pose is None else EXACT
        self._motions[t] = NO_MOTION if motion is None else motion
        self._given[t] = covariances is not None
        self._starts[t + 1] = end
        if n:
            self._points[start:end] = points
            self._ids[start:end] = ids
            if covariances is not None or self._covariances is not None:
                self._reserve_covariances()[start:end] = np.nan if covariances is None else covariances
        self._num_rows, self._num_measurements, self._last = t + 1, end, step

    def extend(self, robot: int, steps: IntArray, noted: FloatArray, measured: FloatArray) -> None:
        """Add the steps in which one of K robots has an entry, as `append` does one by one.

        Args:
            robot: Index of the robot.
            steps: (T,) indices of the steps in the run.
            noted, measured: (T, K, 10), (n, 10) journal of all steps, see `PendingSteps`.

        Raises:
            ValueError: If steps go back; the log then holds the steps before.
        """
        k = 0
        while k < len(steps):
            if self._covariances is None and steps[k] > self._last:
                most = min(MEASUREMENTS, len(self._ids))
                columns = LogColumns(
                    self._steps, self._kinds, self._motions, self._given, self._starts, self._points, self._ids
                )
                k, self._num_rows, self._num_measurements = write_rows(
                    robot, k, steps, noted, measured, most, self._num_rows, self._num_measurements, columns
                )
                if self._num_rows:
                    self._last = int(self._steps[self._num_rows - 1])
            if k < len(steps):  # what cannot stand there yet
                if (turn := turn_of(robot, k, noted, measured)) is not None:
                    self.append(int(steps[k]), **turn)
                k += 1

    def _refusal(self, step: int, odometry: Any, pose: Any, points: Any, ids: Any, covariances: Any) -> ValueError:
        """Return the error for a bad step; the details are found only here, as `append` is in the filter's loop."""
        if step <= self._last:
            return argument_error("step", f"an int > {self._last}", step, "Log steps in order, each once.")
        n = len(ids)
        per_id, motion = "Give one row per id.", "Give (x, y, theta)."
        wanted = {
            "points": (points, (n, 3), per_id),
            "covariances": (covariances, (n, 6), per_id),
            "pose": (pose, (3,), motion),
            "odometry": (odometry, (3,), motion),
        }
        name = next(key for key, (value, shape, _) in wanted.items() if value is not None and value.shape != shape)
        value, shape, hint = wanted[name]
        return argument_error(name, f"an array of shape {shape}", f"shape {value.shape}", hint)

    def _reserve_covariances(self) -> FloatArray:
        """Return the open chunk's covariances, NaN where none were given."""
        if self._covariances is None:
            self._covariances = np.full((len(self._ids), 6), np.nan)
        return self._covariances

    def _copy_of_open(self, first: int = 0) -> LogArrays:
        """Return a copy of the open chunk from a row on, trimmed to its content."""
        t, start = self._num_rows, int(self._starts[first])
        measured = slice(start, self._num_measurements)
        return LogArrays(
            steps=self._steps[first:t].copy(),
            kinds=self._kinds[first:t].copy(),
            motions=self._motions[first:t].copy(),
            given=self._given[first:t].copy(),
            starts=self._starts[first : t + 1] - start,
            points=self._points[measured].copy(),
            ids=self._ids[measured].copy(),
            covariances=None if self._covariances is None else self._covariances[measured].copy(),
        )

    # ------------------------------------------------------------------ reading

    def __len__(self) -> int:
        """Return the number of steps logged."""
        return sum(map(len, self._chunks)) + self._num_rows

    @property
    def last_step(self) -> int:
        """Index of the last step logged, -1 if there is none."""
        return self._last

    @property
    def num_measurements(self) -> int:
        """Measurements logged, rejected ones included."""
        return sum(len(chunk.ids) for chunk in self._chunks) + self._num_measurements

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays, unused space of the open chunk included; shared chunks count in full."""
        arrays = (self._steps, self._kinds, self._motions, self._given, self._starts, self._points, self._ids,
                  self._covariances)  # fmt: skip
        open_bytes = sum(array.nbytes for array in arrays if array is not None)
        return open_bytes + sum(chunk.nbytes for chunk in self._chunks)

    def arrays(self, since: int = 0) -> LogArrays:
        """Return all steps with an index of at least `since` as flat arrays; cost O(result + one chunk)."""
        check_int("since", since, 0, "Use 0 for the whole run.")
        first = len(self._chunks)
        while first > 0 and self._chunks[first - 1].steps[-1] >= since:
            first -= 1
        if first == len(self._chunks):
            return self._copy_of_open(bisect_left(self._steps, since, 0, self._num_rows))
        return join([*self._chunks[first:], self._copy_of_open()]).since(since)

    @property
    def has_exact_poses(self) -> bool:
        """Whether any step has an exact pose."""
        return any(
            (kinds == EXACT).any() for kinds in (*(c.kinds for c in self._chunks), self._kinds[: self._num_rows])
        )

    def num_since(self, since: int) -> int:
        """Return the number of steps with an index of at least `since`; cost O(number of their chunks)."""
        count = self._num_rows - bisect_left(self._steps, since, 0, self._num_rows)
        for chunk in reversed(self._chunks):
            if chunk.steps[-1] < since:
                break
            count += len(chunk) - bisect_left(chunk.steps, since)
        return count

    def __iter__(self) -> Iterator[LogStep]:
        """Iterate over the steps in order, in a snapshot taken when the loop begins."""
        for chunk in [*self._chunks, self._copy_of_open()]:
            yield from map(chunk.row, range(len(chunk)))

    # ------------------------------------------------------------------ copies

    def copy(self) -> "RobotLog":
        """Return an independent log; finished chunks are shared."""
        return _restored(take(self))

    __copy__ = copy

    def __deepcopy__(self, memo: dict[int, Any]) -> "RobotLog":
        return self.copy()

    def __reduce__(self) -> tuple[Any, ...]:
        return _restored, (take(self),)

    def renamed(
        self, old_ids: ArrayLike, new_ids: ArrayLike, others: Literal["reject", "keep"] = "reject"
    ) -> "RobotLog":
        """Return a copy with renamed landmarks, as after a merge of maps.

        Args:
            old_ids: (k,) int64 >= 0, distinct. Names in this log.
            new_ids: (k,) int64 >= -1. New names of the same landmarks; -1 rejects their measurements.
            others: Treatment of names that are not in `old_ids`. "reject": -1, as the name of a landmark deleted before
                a merge may denote another landmark in the joint map. "keep": unchanged.

        Returns:
            The copy; its finished chunks share all arrays but the ids with this log.

        Raises:
            ValueError: If lengths disagree, an old name is repeated, or a name is too low.
        """
        old: IntArray = check_array("old_ids", old_ids, (None,), "Give landmark ids.", dtype=np.int64)
        new: IntArray = check_array("new_ids", new_ids, old.shape, "Give one per old id.", dtype=np.int64)
        for name, values, least in (("old_ids", old, 0), ("new_ids", new, REJECTED)):
            if len(values) and values.min() < least:
                raise argument_error(name, f"ids >= {least}", int(values.min()), "Give landmark ids.")
        unique, order = np.unique(old, return_index=True)
        if len(unique) < len(old):
            raise argument_error("old_ids", "distinct ids", old.tolist(), "Give one new name per landmark.")
        keep = check_choice("others", others, ("reject", "keep")) == "keep"
        log = RobotLog()
        log._chunks = [chunk.renamed(unique, new[order], keep) for chunk in self._chunks]
        log.unfinished = self.unfinished.renamed(unique, new[order], keep)
        log.rebuild()
        return log

    # ------------------------------------------------------------------ snapshots

    @property
    def unfinished(self) -> LogArrays:
        """Steps of the open chunk. A copy."""
        return self._copy_of_open()

    @unfinished.setter
    def unfinished(self, last: LogArrays) -> None:
        t, n = len(last), len(last.ids)
        self._open(max(MEASUREMENTS, n))
        self._num_rows, self._num_measurements = t, n
        self._steps[:t], self._kinds[:t], self._motions[:t], self._given[:t] = (
            last.steps, last.kinds, last.motions, last.given
        )  # fmt: skip
        self._starts[: t + 1], self._points[:n], self._ids[:n] = last.starts, last.points, last.ids
        if last.covariances is not None:
            self._reserve_covariances()[:n] = last.covariances

    def rebuild(self) -> None:
        """Find the last step."""
        t = self._num_rows
        self._last = int(self._steps[t - 1] if t else self._chunks[-1].steps[-1] if self._chunks else -1)

    @staticmethod
    def check_state(parts: Mapping[str, Any], sizes: Sizes) -> None:
        """Refuse chunks that are empty, too long or out of order."""
        chunks, unfinished = parts["chunks"], parts["unfinished"]
        if not all(map(len, chunks)) or len(unfinished) > ROWS:
            raise ValueError(f"an empty chunk or more than {ROWS} steps after the chunks")
        filled = [chunk.steps for chunk in (*chunks, unfinished) if len(chunk)]
        if any(later[0] <= earlier[-1] for earlier, later in pairwise(filled)):
            raise ValueError("a step out of order")


def last_step(log: Mapping[str, Any]) -> int:
    """Return the last step of the state of a log, -1 if there is none."""
    newest = next((part for part in (log["unfinished"], *reversed(log["chunks"])) if len(part)), None)
    return -1 if newest is None else int(newest.steps[-1])


def _restored(state: Mapping[str, Any]) -> RobotLog:
    """Return a log with the given state."""
    log = RobotLog()
    restore(log, accepted(RobotLog, "state", state))
    return log
