"""Communication of a team: who can reach whom, and how many bytes were sent."""

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from slam_backend.core.validation import BoolArray, IntArray, argument_error, check_array
from slam_backend.fastslam._kernels import EXACT_POSE, MOVED
from slam_backend.fastslam.reports import StepReport
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.team.branches import ReplayedStep


def check_contacts(contacts: ArrayLike, num_robots: int) -> BoolArray:
    """Return contacts as a checked array.

    Args:
        contacts: (K, K) bool, symmetric; the diagonal means nothing.
        num_robots: K.

    Raises:
        ValueError: If they are no symmetric array of bools.
    """
    cure = "Say for each pair of robots whether it can exchange data."
    touch = check_array("contacts", contacts, (num_robots, num_robots), cure, dtype=None, finite=False)
    if touch.dtype != np.bool_ or not np.array_equal(touch, touch.T):
        got = f"an array of {touch.dtype}" if touch.dtype != np.bool_ else "a matrix that is not symmetric"
        raise argument_error("contacts", "a symmetric array of bools", got, cure)
    return np.asarray(touch)


def contact_components(contacts: BoolArray | None, num_robots: int) -> IntArray:
    """Number the networks: robots pass on what they hear, so that those who reach each other by steps are in contact.

    Args:
        contacts: (K, K) bool, symmetric; the diagonal means nothing. None = all.
        num_robots: K.

    Returns:
        (K,) int64. Robots with the same number can exchange data.

    >>> chain = np.array([[0, 1, 0, 0], [1, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 0]], dtype=bool)
    >>> contact_components(chain, 4).tolist()
    [0, 0, 0, 1]
    """
    if contacts is None or contacts.all():
        return np.zeros(num_robots, dtype=np.int64)
    from scipy.sparse.csgraph import connected_components  # slow to import, and not always needed

    return np.asarray(connected_components(contacts, directed=False)[1], dtype=np.int64)


LANDMARK_BYTES = 8 + 9 * 8  # id, mean and covariance
POSE_BYTES = 3 * 8
POINT_BYTES = 3 * 8
COVARIANCE_BYTES = 6 * 8


class TrafficCounter:
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
        findings = report.all_associations
        for robot in report.rows:
            if robot >= 0:
                touched = (
                    len(findings.associated_ids(robot)) if report.num_rejected else findings.num_measurements(robot)
                )
                created = len(findings.created_ids(robot)) if report.num_created else 0
                self.sent[robot] += POSE_BYTES + touched * LANDMARK_BYTES + created * 4 * descriptor_size

    def record_replay(self, replayed: Sequence[ReplayedStep]) -> None:
        """Count the buffered readings that returning robots send."""
        for done in replayed:
            each = POINT_BYTES + 4 * done.inputs.descriptors.shape[1]
            for robot in done.robots:
                act, _, _, covered, _, count = done.inputs.inputs[robot]
                if act in (MOVED, EXACT_POSE):
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

    def record_smoothed(self, robot_a: int, robot_b: int, map_a: LandmarkMap, map_b: LandmarkMap) -> None:
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
