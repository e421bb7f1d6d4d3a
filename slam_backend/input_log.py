"""What the robots read in the last steps, kept as long as some filter may have to take it in later."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from slam_backend.errors import FloatArray, IntArray
from slam_backend.measurements import Measurements


class RobotInput(NamedTuple):
    """What `FastSlam.step` takes of one robot in one step; it is not written to."""

    odometry: FloatArray | None
    frame: Measurements | None
    identities: IntArray | None
    pose: FloatArray | None


NOTHING = RobotInput(None, None, None, None)


def are_silent(inputs: Sequence[RobotInput]) -> bool:
    """Tell whether there is nothing to take in.

    An empty frame is something: it says that nothing was there to see.
    """
    for odometry, frame, _, pose in inputs:
        if odometry is not None or frame is not None or pose is not None:
            return False
    return True


class InputLog:
    """The readings of all robots, step by step."""

    def __init__(self) -> None:
        self._steps: dict[int, tuple[RobotInput, ...]] = {}

    def __len__(self) -> int:
        """Return how many steps are kept."""
        return len(self._steps)

    def record(self, step: int, inputs: Sequence[RobotInput]) -> None:
        """Keep what all robots read in a step, later than all before."""
        self._steps[step] = tuple(inputs)

    def read(self, step: int, robot: int) -> RobotInput:
        """Return what a robot read in a step that is kept."""
        return self._steps[step][robot]

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
