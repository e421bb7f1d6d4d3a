"""What the last steps of a filter came to, as it waits to be written into the robots' logs, many steps at a time."""

from collections.abc import Sequence

import numpy as np

from slam_backend._kernels.layout import ASSOCIATED, NUM_MEASURED, NUM_NOTED
from slam_backend._log_kernels import write_guesses
from slam_backend._rejuvenation_step import RejuvenationStep
from slam_backend.errors import IntArray
from slam_backend.input_log import Seats, StepInput
from slam_backend.run_log import RobotLog

LONGEST = 32  # steps that wait
ROOM = 16 * LONGEST  # for measurements at first


class Journal:
    """Steps that wait; kernels write into its arrays.

    Args:
        num_robots: K, of the filter.

    Attributes:
        steps: Numbers of the steps, T.
        noted: (`LONGEST`, K, 10) float64. Of each step, of which T are written, and robot; see `_kernels.layout`.
        measured: (>= n, 10) float64. What was measured in all of them, one robot's after the other's.
        num_measured: n.
    """

    __slots__ = ("measured", "noted", "num_measured", "steps")

    def __init__(self, num_robots: int) -> None:
        self.steps: list[int] = []
        self.noted = np.empty((LONGEST, num_robots, NUM_NOTED))
        self.measured = np.empty((ROOM, NUM_MEASURED))
        self.num_measured = 0

    def make_room(self, used: int) -> None:
        """Provide room for so many more measurements."""
        needed = self.num_measured + used
        if needed > len(self.measured):
            wider = np.empty((2 * needed, NUM_MEASURED))
            wider[: self.num_measured] = self.measured[: self.num_measured]
            self.measured = wider

    def clear(self) -> None:
        """Let no step wait any more."""
        self.steps.clear()
        self.num_measured = 0

    def write_down(self, logs: Sequence[RobotLog], smoother: RejuvenationStep | None) -> None:
        """Enter what waits into the logs of K robots, and tell the smoother of the filter, if it has one.

        A step in which a robot did nothing and was given no measurement gets no row.
        """
        steps = np.array(self.steps)
        noted, measured = self.noted[: len(steps)], self.measured[: self.num_measured]
        for robot, log in enumerate(logs):
            log.extend(robot, steps, noted, measured)
            if smoother is not None:
                heard, poses = np.empty_like(steps), np.empty((len(steps), 3))
                count, is_placed = write_guesses(robot, steps, noted, heard, poses)
                smoother.note(robot, heard[:count], poses[:count], is_placed)
        self.clear()


def tell_refused(smoother: RejuvenationStep, step: int, inputs: StepInput, seats: Seats, told: IntArray) -> None:
    """Tell the smoother what of a step's measurements, those with names left out, was neither matched nor new."""
    for robot, row in seats.heard:
        _, begin, end, _, named, _ = inputs.turns[row]
        if not named:
            smoother.note_refused(robot, step, told[ASSOCIATED, begin:end], inputs.descriptors[begin:end])
