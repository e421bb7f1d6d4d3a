"""Communication within a team: connected components and a traffic count."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from slam_backend.core.validation import BoolArray, IntArray, argument_error, check_array
from slam_backend.fastslam._kernels import EXACT_POSE, MOVED
from slam_backend.fastslam.reports import StepReport
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.state import Dict, Each, Int, Row, State
from slam_backend.team.branches import ReplayedStep
from slam_backend.team.merge_scheduler import LANDMARK, ROBOT


def check_contacts(contacts: ArrayLike, num_robots: int) -> BoolArray:
    """Return contacts as a checked array.

    Args:
        contacts: (K, K) bool, symmetric; the diagonal is ignored.
        num_robots: K.

    Raises:
        ValueError: If they are not a symmetric array of bools.
    """
    hint = "Say for each pair of robots whether it can exchange data."
    touch = check_array("contacts", contacts, (num_robots, num_robots), hint, dtype=None, finite=False)
    if touch.dtype != np.bool_ or not np.array_equal(touch, touch.T):
        got = f"an array of {touch.dtype}" if touch.dtype != np.bool_ else "a matrix that is not symmetric"
        raise argument_error("contacts", "a symmetric array of bools", got, hint)
    return np.asarray(touch)


def contact_components(contacts: BoolArray | None, num_robots: int) -> IntArray:
    """Number the connected components of the contact graph: robots relay messages.

    Args:
        contacts: (K, K) bool, symmetric; the diagonal is ignored. None = all.
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
    """Counter of the bytes that each robot sends.

    Args:
        num_robots: K.

    Attributes:
        sent: Bytes that each robot has sent.
    """

    STATE = State(sent=Each(Int(), "K", list), known=Dict(Row(ROBOT, ROBOT), Dict(LANDMARK, Int())))

    def __init__(self, num_robots: int) -> None:
        self.sent = [0] * num_robots
        self._known: dict[tuple[int, int], dict[int, int]] = {}  # (from, to) -> landmark id -> its count when last sent

    def record_step(self, report: StepReport, descriptor_size: int) -> None:
        """Count the broadcasts of a joint filter's robots in one step: pose, landmarks updated and created.

        Args:
            report: Report of the step; its robots with a row are in contact.
            descriptor_size: d.
        """
        associations = report.all_associations
        for robot in report.rows:
            if robot >= 0:
                updated = (
                    len(associations.associated_ids(robot))
                    if report.num_rejected
                    else associations.num_measurements(robot)
                )
                created = len(associations.created_ids(robot)) if report.num_created else 0
                self.sent[robot] += POSE_BYTES + updated * LANDMARK_BYTES + created * 4 * descriptor_size

    def record_replay(self, replayed: Sequence[ReplayedStep]) -> None:
        """Count the buffered inputs that returning robots send."""
        for done in replayed:
            each = POINT_BYTES + 4 * done.inputs.descriptors.shape[1]
            for robot in done.robots:
                given = done.inputs.inputs[robot]
                if given.kind in (MOVED, EXACT_POSE):
                    self.sent[robot] += POSE_BYTES
                self.sent[robot] += max(given.num_given, 0) * (each + given.has_covariances * COVARIANCE_BYTES)

    def record_return(
        self, sender: int, known: Mapping[int, int], counts: Mapping[int, int], descriptor_size: int
    ) -> None:
        """Count the map updates sent to returning robots.

        Args:
            sender: Robot that sends them.
            known: Number of measurements of each landmark when it was last sent to the returning robots, by id.
            counts: Present number of measurements of each landmark of the map, by id.
            descriptor_size: d.
        """
        changed = sum(1 for name, count in counts.items() if known.get(name) != count)
        new = sum(1 for name in counts if name not in known)
        self.sent[sender] += changed * LANDMARK_BYTES + new * 4 * descriptor_size

    def record_maps(self, robot_a: int, robot_b: int, map_a: LandmarkMap, map_b: LandmarkMap) -> None:
        """Count the maps that the first robots of two groups exchange for alignment."""
        for sender, receiver, landmarks in ((robot_a, robot_b, map_a), (robot_b, robot_a, map_b)):
            known = self._known.setdefault((sender, receiver), {})
            counts = dict(zip(landmarks.ids.tolist(), landmarks.counts.tolist(), strict=True))
            new = sum(1 for name in counts if name not in known)
            changed = sum(1 for name, count in counts.items() if known.get(name, count) != count)
            self.sent[sender] += (new + changed) * LANDMARK_BYTES + new * 4 * landmarks.descriptors.shape[1]
            known.update(counts)

    def record_smoothed(self, robot_a: int, robot_b: int, map_a: LandmarkMap, map_b: LandmarkMap) -> None:
        """Count the maps again after smoothing: all landmarks have moved, no descriptor has changed."""
        for sender, landmarks in ((robot_a, map_a), (robot_b, map_b)):
            self.sent[sender] += len(landmarks) * LANDMARK_BYTES
