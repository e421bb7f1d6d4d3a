"""How much the robots tell each other: new and changed landmarks since the last contact, descriptors once.

Counted are numbers of 8 bytes, and of 4 in descriptors, as these are sent:

- Robots that go by one filter: each broadcasts, once, at every step its pose (24), each landmark that it measured (id,
  mean, covariance: 80) and the descriptors of those that it created. A robot that nobody hears sends nothing.
- Two groups that try to align their maps: the first robot of each sends the landmarks that are new to the other side
  or were measured again since it sent them last (80 each), with the descriptors of the new ones. When their maps
  were straightened and are aligned once more, it sends all landmarks again (80 each).
- A robot that returns to its filter: for each buffered step its odometry (24) and its measurements (24 each, 48 more
  with a covariance, and their descriptors). When all is taken in, the first robot of those that kept the filter sends
  the landmarks that are new or were measured again since they lost contact (80 each), with descriptors of those new
  ones that the returning robots have not created themselves; after a merge or an undo in between it sends all of them.
"""

import copy
from collections.abc import Mapping, Sequence
from typing import Any

from slam_backend._kernels import MOVED, PLACED
from slam_backend.branches import ReplayedStep
from slam_backend.landmark_map import LandmarkMap
from slam_backend.reports import StepReport

LANDMARK_BYTES = 8 + 9 * 8  # id, mean and covariance
POSE_BYTES = 3 * 8
POINT_BYTES = 3 * 8
COVARIANCE_BYTES = 6 * 8


class ExchangeLedger:
    """Counts the bytes that each robot sends.

    Args:
        num_robots: K.

    Attributes:
        sent: Bytes that each robot has sent.
    """

    def __init__(self, num_robots: int) -> None:
        self.sent = [0] * num_robots
        self._known: dict[tuple[int, int], dict[int, int]] = {}  # (from, to) -> landmark id -> its count when last sent

    def record_step(self, report: StepReport, descriptor_size: int) -> None:
        """Count what the robots of a joint filter broadcast in one step: pose, landmarks updated and created.

        Args:
            report: Of the step; those of its robots that were heard hear each other.
            descriptor_size: d.
        """
        findings = report.findings
        for robot in report.rows:
            if robot >= 0:
                touched = len(findings.names_associated(robot)) if report.num_rejected else findings.num_given(robot)
                created = len(findings.names_created(robot)) if report.num_created else 0
                self.sent[robot] += POSE_BYTES + touched * LANDMARK_BYTES + created * 4 * descriptor_size

    def record_replay(self, replayed: Sequence[ReplayedStep]) -> None:
        """Count the buffered readings that returning robots send."""
        for done in replayed:
            each = POINT_BYTES + 4 * done.inputs.descriptors.shape[1]
            for robot in done.robots:
                act, _, _, covered, _, count = done.inputs.turns[robot]
                if act in (MOVED, PLACED):
                    self.sent[robot] += POSE_BYTES
                self.sent[robot] += max(count, 0) * (each + covered * COVARIANCE_BYTES)

    def record_return(
        self, sender: int, known: Mapping[int, int], counts: Mapping[int, int], descriptor_size: int
    ) -> None:
        """Count what returning robots are told of the map that they come back to.

        Args:
            sender: Who tells them.
            known: Per landmark whose descriptor they know: how often it had been measured when they were last told.
            counts: Per landmark of the map: how often it has been measured now.
            descriptor_size: d.
        """
        changed = sum(1 for name, count in counts.items() if known.get(name) != count)
        new = sum(1 for name in counts if name not in known)
        self.sent[sender] += changed * LANDMARK_BYTES + new * 4 * descriptor_size

    def record_maps(self, robot_a: int, robot_b: int, map_a: LandmarkMap, map_b: LandmarkMap) -> None:
        """Count the maps that two groups' first robots exchange to align them."""
        for sender, receiver, landmarks in ((robot_a, robot_b, map_a), (robot_b, robot_a, map_b)):
            known = self._known.setdefault((sender, receiver), {})
            counts = dict(zip(landmarks.ids.tolist(), landmarks.counts.tolist(), strict=True))
            new = sum(1 for name in counts if name not in known)
            changed = sum(1 for name, count in counts.items() if known.get(name, count) != count)
            self.sent[sender] += (new + changed) * LANDMARK_BYTES + new * 4 * landmarks.descriptors.shape[1]
            known.update(counts)

    def record_straightened(self, robot_a: int, robot_b: int, map_a: LandmarkMap, map_b: LandmarkMap) -> None:
        """Count the maps once more, after both were straightened: all landmarks have moved, none looks otherwise."""
        for sender, landmarks in ((robot_a, map_a), (robot_b, map_b)):
            self.sent[sender] += len(landmarks) * LANDMARK_BYTES

    def get_state(self) -> dict[str, Any]:
        """Return a copy of the counts."""
        return {"bytes_sent": tuple(self.sent), "known": copy.deepcopy(self._known)}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Take over counts that `get_state` returned."""
        self.sent = list(state["bytes_sent"])
        self._known = copy.deepcopy(state["known"])
