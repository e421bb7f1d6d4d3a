"""How much the robots tell each other: new and changed landmarks since the last contact, descriptors once."""

import copy
from collections.abc import Mapping
from typing import Any

import numpy as np

from slam_backend.errors import IntArray
from slam_backend.landmark_map import LandmarkMap
from slam_backend.reports import StepReport

LANDMARK_BYTES = 8 + 9 * 8  # id, mean and covariance
POSE_BYTES = 3 * 8


class ExchangeLedger:
    """Counts the bytes that each robot sends.

    Args:
        num_robots: K.
    """

    def __init__(self, num_robots: int) -> None:
        self.bytes_sent: IntArray = np.zeros(num_robots, dtype=np.int64)
        self._known: dict[tuple[int, int], dict[int, int]] = {}  # (from, to) -> landmark id -> its count when last sent

    def record_step(self, robots: tuple[int, ...], report: StepReport, descriptor_size: int) -> None:
        """Count what the robots of a joint filter broadcast in one step: pose, landmarks updated and created."""
        if len(robots) < 2:
            return
        for index, robot in enumerate(robots):
            touched = int(np.count_nonzero(report.associations[index] >= 0))
            created = int(np.count_nonzero(report.created[index] >= 0))
            self.bytes_sent[robot] += POSE_BYTES + touched * LANDMARK_BYTES + created * 4 * descriptor_size

    def record_maps(self, robot_a: int, robot_b: int, map_a: LandmarkMap, map_b: LandmarkMap) -> None:
        """Count the maps that two groups' first robots exchange to align them."""
        for sender, receiver, landmarks in ((robot_a, robot_b, map_a), (robot_b, robot_a, map_b)):
            known = self._known.setdefault((sender, receiver), {})
            counts = dict(zip(landmarks.ids.tolist(), landmarks.counts.tolist(), strict=True))
            new = sum(1 for name in counts if name not in known)
            changed = sum(1 for name, count in counts.items() if known.get(name, count) != count)
            self.bytes_sent[sender] += (new + changed) * LANDMARK_BYTES + new * 4 * landmarks.descriptors.shape[1]
            known.update(counts)

    def get_state(self) -> dict[str, Any]:
        """Return a copy of the counts."""
        return {"bytes_sent": self.bytes_sent.copy(), "known": copy.deepcopy(self._known)}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Take over counts that `get_state` returned."""
        self.bytes_sent = state["bytes_sent"].copy()
        self._known = copy.deepcopy(state["known"])
