"""Log of one robot's run as flat, read-only arrays, the input of a smoother."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.read_only import as_read_only
from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.state import (
    BOOL,
    FLOAT64,
    INT8,
    INT64,
    MAX_DISTANCE,
    MAX_LANDMARKS,
    Array,
    Maybe,
    Sizes,
    State,
)

STATIONARY: Final = 0  # kinds of motion
ODOMETRY: Final = 1
EXACT: Final = 2
REJECTED: Final = -1


class LogStep(NamedTuple):
    """One step of a log; its arrays are read-only views.

    Attributes:
        step: Index of the step in the run.
        kind: STATIONARY, ODOMETRY or EXACT.
        motion: (3,) [m, m, rad]. ODOMETRY: motion since the last step, previous robot frame; EXACT: the pose, own start
            frame; STATIONARY: zeros.
        points: (n, 3) [m], robot axes, relative to the camera centre.
        covariances: (n, 6) [m^2] of the points, robot axes, upper triangles by rows; None: the camera model.
        ids: (n,) landmarks, -1 = rejected.
    """

    step: int
    kind: int
    motion: FloatArray
    points: FloatArray
    covariances: FloatArray | None
    ids: IntArray


COLUMNS = ("steps", "kinds", "motions", "given", "starts", "points", "ids", "covariances")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class LogArrays:
    """Log of T steps with n measurements in all, as read-only arrays.

    Attributes:
        steps: (T,) int64. Index of each step in the run, ascending; steps without events may be missing.
        kinds: (T,) int8. STATIONARY, ODOMETRY or EXACT.
        motions: (T, 3) float64 [m, m, rad], by kind as in `LogStep`.
        given: (T,) bool. Whether the measurements of a step came with covariances; else the camera model applies.
        starts: (T + 1,) int64. Measurements of row t are starts[t] to starts[t + 1].
        points: (n, 3) float64 [m], robot axes, relative to the camera centre.
        ids: (n,) int64. Landmarks by the most probable particle of that step, -1 = rejected.
        covariances: (n, 6) float64 [m^2], robot axes, upper triangles by rows; NaN where not given. None: all NaN.
    """

    STATE = State(
        steps=Array(INT64, "T", ascending=True),
        kinds=Array(INT8, "T", STATIONARY, EXACT),
        motions=Array(FLOAT64, "T 3", -MAX_DISTANCE, MAX_DISTANCE),
        given=Array(BOOL, "T"),
        starts=Array(INT64, "T+1"),
        points=Array(FLOAT64, "n 3", -MAX_DISTANCE, MAX_DISTANCE),
        ids=Array(INT64, "n", REJECTED, MAX_LANDMARKS),
        covariances=Maybe(Array(FLOAT64, "n 6", nan=True)),
    )
    steps: IntArray
    kinds: NDArray[np.int8]
    motions: FloatArray
    given: BoolArray
    starts: IntArray
    points: FloatArray
    ids: IntArray
    covariances: FloatArray | None

    def __post_init__(self) -> None:
        for name in COLUMNS:
            array = getattr(self, name)
            if array is not None:
                object.__setattr__(self, name, as_read_only(array))

    @staticmethod
    def check_state(parts: Mapping[str, Any], sizes: Sizes) -> None:
        """Refuse a state whose measurements are not those of its steps."""
        starts, covariances = parts["starts"], parts["covariances"]
        if starts[0] != 0 or starts[-1] != sizes["n"] or (starts[1:] < starts[:-1]).any():
            raise ValueError("measurements of no step")
        given = np.repeat(parts["given"], np.diff(starts))
        if parts["given"].any() and (covariances is None or np.isnan(covariances[given]).any()):
            raise ValueError("no given covariances")

    def __len__(self) -> int:
        return len(self.steps)

    def __deepcopy__(self, memo: dict[int, Any]) -> "LogArrays":
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        return _from_columns, (self._columns(),)  # plain pickling loses the read-only flags

    @property
    def nbytes(self) -> int:
        """Size of the arrays in bytes."""
        return sum(array.nbytes for array in self._columns().values() if array is not None)

    def _columns(self) -> dict[str, Any]:
        """Return all arrays by name."""
        return {name: getattr(self, name) for name in COLUMNS}

    def row(self, t: int) -> LogStep:
        """Return row t, 0 <= t < T."""
        at = slice(int(self.starts[t]), int(self.starts[t + 1]))
        return LogStep(
            int(self.steps[t]),
            int(self.kinds[t]),
            self.motions[t],
            self.points[at],
            self.covariances[at] if self.covariances is not None and self.given[t] else None,
            self.ids[at],
        )

    def since(self, step: int) -> "LogArrays":
        """Return the rows from index `step` of the run on; all arrays but `starts` are views."""
        t = int(np.searchsorted(self.steps, step))
        first = int(self.starts[t])
        return LogArrays(
            steps=self.steps[t:],
            kinds=self.kinds[t:],
            motions=self.motions[t:],
            given=self.given[t:],
            starts=self.starts[t:] - first,
            points=self.points[first:],
            ids=self.ids[first:],
            covariances=None if self.covariances is None else self.covariances[first:],
        )

    def renamed(self, old_ids: IntArray, new_ids: IntArray, keep_others: bool) -> "LogArrays":
        """Return the log with landmark id `old_ids[i]` replaced by `new_ids[i]`; all arrays but `ids` are shared.

        Args:
            old_ids: (k,) int64, strictly ascending.
            new_ids: (k,) int64.
            keep_others: Whether landmarks that are not in `old_ids` keep their ids; else they are rejected.
        """
        ids = self.ids.copy() if keep_others else np.full_like(self.ids, REJECTED)
        if len(old_ids):
            at = np.minimum(np.searchsorted(old_ids, self.ids), len(old_ids) - 1)
            known = old_ids[at] == self.ids
            ids[known] = new_ids[at[known]]
        return replace(self, ids=ids)


def _from_columns(columns: dict[str, Any]) -> LogArrays:
    """Restore a log from its arrays after unpickling."""
    return LogArrays(**columns)


def join(parts: Sequence[LogArrays]) -> LogArrays:
    """Concatenate one or more parts in the given order; covariances are NaN for parts without any."""
    if len(parts) == 1:
        return parts[0]
    ends = np.cumsum([len(part.ids) for part in parts])
    starts = [parts[0].starts] + [part.starts[1:] + end for part, end in zip(parts[1:], ends[:-1], strict=True)]
    columns = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in ("steps", "kinds", "motions", "given", "points", "ids")
    }
    covariances = None
    if any(part.covariances is not None for part in parts):
        covariances = np.concatenate(
            [np.full((len(part.ids), 6), np.nan) if part.covariances is None else part.covariances for part in parts]
        )
    return LogArrays(starts=np.concatenate(starts), covariances=covariances, **columns)
