"""Steps of a filter that are not in the logs of its robots yet."""

from collections.abc import Sequence

import numpy as np

from slam_backend.core.validation import IntArray
from slam_backend.fastslam._kernels import NUM_MEASURED, NUM_NOTED
from slam_backend.fastslam._kernels.run_log import initial_poses_of
from slam_backend.fastslam.rejuvenation import RejuvenationScheduler
from slam_backend.fastslam.run_log import RobotLog
from slam_backend.fastslam.step_input import RobotRows, StepInput

LONGEST = 32  # largest number of pending steps
ROOM = 16 * LONGEST  # initial capacity for measurements


class PendingSteps:
    """Buffer of steps that are not in the logs yet; kernels write into its arrays.

    Args:
        num_robots: Number of robots of the filter, K.

    Attributes:
        steps: Numbers of the T buffered steps.
        noted: (`LONGEST`, K, 10) float64. Entry of each step and robot, the first T are in use; see `_kernels.layout`.
        measured: (>= n, 10) float64. Measurements of all steps, robot by robot.
        num_measured: n.
    """

    __slots__ = ("measured", "noted", "num_measured", "steps")

    def __init__(self, num_robots: int) -> None:
        self.steps: list[int] = []
        self.noted = np.empty((LONGEST, num_robots, NUM_NOTED))
        self.measured = np.empty((ROOM, NUM_MEASURED))
        self.num_measured = 0

    def reserve(self, used: int) -> None:
        """Provide capacity for `used` more measurements."""
        needed = self.num_measured + used
        if needed > len(self.measured):
            wider = np.empty((2 * needed, NUM_MEASURED))
            wider[: self.num_measured] = self.measured[: self.num_measured]
            self.measured = wider

    def clear(self) -> None:
        """Drop all steps."""
        self.steps.clear()
        self.num_measured = 0

    def flush(self, logs: Sequence[RobotLog], smoother: RejuvenationScheduler | None) -> None:
        """Move the steps into the logs of K robots, and the estimated poses to the smoother, if there is one.

        A step without motion and measurement of a robot gets no row in its log.
        """
        steps = np.array(self.steps)
        noted, measured = self.noted[: len(steps)], self.measured[: self.num_measured]
        for robot, log in enumerate(logs):
            log.extend(robot, steps, noted, measured)
            if smoother is not None:
                smoother.add_initial_poses(robot, *initial_poses_of(robot, steps, noted))
        self.clear()


def record_rejected(
    smoother: RejuvenationScheduler, step: int, inputs: StepInput, robots: RobotRows, associations: IntArray
) -> None:
    """Pass the rejected measurements of a step to the smoother, without those that have identities."""
    associated, _ = associations
    for robot, row in robots.active:
        given = inputs.inputs[row]
        if not given.has_names:
            rows = slice(given.begin, given.end)
            smoother.add_rejected(robot, step, associated[rows], inputs.descriptors[rows])
