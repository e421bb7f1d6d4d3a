"""What the robots read in the last steps, kept as long as some filter may have to take it in later."""

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from slam_backend._kernels import IDLE
from slam_backend.errors import BoolArray, Float32Array, FloatArray, IntArray

# Of one robot: what it did, where its used measurements begin and end among all n, whether these come with covariances,
# and with names; and how many it was given, used or not, -1 where it has no frame. `_kernels.layout` names the numbers.
Turn = Sequence[int]
UNHEARD = (IDLE, 0, 0, 0, 0, -1)


class StepInput(NamedTuple):
    """What N robots read in one step, checked, as filters take it; it is not written to.

    Attributes:
        turns: Of each robot.
        table: (N, 6) int64. The same.
        moves: (N, 3) [m, m, rad] odometry of those that moved, poses in their own start frames of those that were told
            theirs.
        masks: By robot which of its measurements are used (n_i,) bool; only of robots that the caller gave some named
            -1, which are not.
        sightings: (n, 9) [m, m^2] all robots' measurements, one robot's after the other's, in robot axes: points (3)
            relative to the camera centre, and their covariances (6), upper triangles by rows, where they have any.
        descriptors: (n, d), its own: kernels are compiled for arrays that can be written.
        names: (n,) the caller's names, or (0,) where no robot has any.
        silent: Robots of which there is nothing to take in. An empty frame is something: it says that nothing was there
            to see.
    """

    turns: Sequence[Turn]
    table: IntArray
    moves: FloatArray
    masks: Mapping[int, BoolArray]
    sightings: FloatArray
    descriptors: Float32Array
    names: IntArray
    silent: frozenset[int]


class Seats(NamedTuple):
    """Where the readings of a filter's K robots stand in a `StepInput`.

    Attributes:
        rows: Of each robot there; -1: it is not heard, and stands still, unseeing.
        heard: Of each that is: which of the K robots it is, and its row.
        array: (K,) int64. `rows`, as kernels take them; not written to.
    """

    rows: tuple[int, ...]
    heard: tuple[tuple[int, int], ...]
    array: IntArray


@lru_cache(maxsize=256)
def seats_of(rows: tuple[int, ...]) -> Seats:
    """Return the seats in these rows."""
    heard = tuple((robot, row) for robot, row in enumerate(rows) if row >= 0)
    return Seats(rows, heard, np.array(rows, np.int64))


class InputLog:
    """The readings of all robots, step by step."""

    def __init__(self) -> None:
        self._steps: dict[int, StepInput] = {}

    def __len__(self) -> int:
        """Return how many steps are kept."""
        return len(self._steps)

    @property
    def kept(self) -> Mapping[int, StepInput]:
        """The steps that are kept, by their numbers; to be looked at."""
        return self._steps

    def record(self, step: int, inputs: StepInput) -> None:
        """Keep what all robots read in a step, later than all before."""
        self._steps[step] = inputs

    def read(self, step: int) -> StepInput:
        """Return what all robots read in a step that is kept."""
        return self._steps[step]

    def forget_before(self, step: int) -> None:
        """Forget the steps before this one."""
        while self._steps and (oldest := next(iter(self._steps))) < step:  # they stand in order of time
            del self._steps[oldest]

    def get_state(self) -> dict[str, Any]:
        """Return what is kept; inputs are never written to, and are shared."""
        return {"steps": dict(self._steps)}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Go on with what `get_state` returned."""
        self._steps = dict(state["steps"])
