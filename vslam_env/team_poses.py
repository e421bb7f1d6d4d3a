"""`TeamPoses`: where the robots believe themselves and each other to be, each in its own start frame."""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from slam_backend._jit import jit
from slam_backend.errors import FloatArray, IntArray
from slam_backend.team_knowledge import Standpoint


class Others(NamedTuple):
    """The other robots that a robot knows of; one out of contact is where it was when contact was lost.

    Attributes:
        robots: (m,) int64, ascending.
        poses: (m, 3) float64 [m, m, rad], start frame of the robot that knows of them.
        sigmas: (m,) float64 [m]. One sigma of their positions, averaged over directions.
    """

    robots: IntArray
    poses: FloatArray
    sigmas: FloatArray


NOBODY = Others(np.empty(0, np.int64), np.empty((0, 3)), np.empty(0))


class TeamPoses:
    """The poses of all robots after a step or a merge; arrays are to be looked at.

    Args:
        points: Where each of the K robots stands.

    Attributes:
        points: The same.
        starts: (K, 3) float64 [m, m, rad]. The motion from its group's map frame to each robot's own start frame.
        own: (K, 3) float64 [m, m, rad], own start frames.
        covariances: (K, 3, 3) float64 [m, m, rad]. Of these.
        mates: Per robot those that go by the same filter, itself included, in ascending order.
        mate_poses: Per robot (n, 3) float64 [m, m, rad], its start frame. Of its mates, itself included.
        others: Per robot the other robots that it knows of.
    """

    __slots__ = ("covariances", "mate_poses", "mates", "others", "own", "points", "starts")

    def __init__(self, points: Sequence[Standpoint]) -> None:
        robots = len(points)
        self.points = points
        self.mates = [point.mates for point in points]
        self.starts, self.own, self.covariances = np.empty((robots, 3)), np.empty((robots, 3)), np.empty((robots, 3, 3))
        for robot, point in enumerate(points):
            self.starts[robot] = point.start_from_group
            self.own[robot], self.covariances[robot] = point.own_pose
        self.mate_poses = [self.own[robot : robot + 1] for robot in range(robots)]
        self.others = [NOBODY] * robots
        for robot, point in enumerate(points):
            if len(point.members) > 1 and robot == point.mates[0]:
                self._look_around(point)

    def _look_around(self, point: Standpoint) -> None:
        """Let the robots of one filter see its members from their own start frames."""
        members, viewers = point.members, point.mates
        names, others = _names(members, viewers)
        count, known = len(viewers), len(members)
        means, covariances = np.empty((known, 3)), np.empty((known, 3, 3))
        for k, estimate in enumerate(point.poses):
            means[k], covariances[k] = estimate
        poses, sigmas = np.empty((count, known, 3)), np.empty((count, known - 1))
        other_poses = np.empty((count, known - 1, 3))
        _see(self.starts, self.own, *names, means, covariances, poses, other_poses, sigmas)
        for i, robot in enumerate(viewers):
            self.mate_poses[robot] = poses[i] if count == known else poses[i, [members.index(mate) for mate in viewers]]
            self.others[robot] = Others(others[i], other_poses[i], sigmas[i])


@lru_cache(maxsize=256)
def _names(members: tuple[int, ...], viewers: tuple[int, ...]) -> tuple[tuple[IntArray, IntArray], list[IntArray]]:
    """Return viewers and members as arrays, and for each viewer the other members (n - 1,)."""
    others = [np.array([mate for mate in members if mate != viewer]) for viewer in viewers]
    return (np.array(viewers), np.array(members)), others


@jit
def position_sigmas(covariances: FloatArray) -> FloatArray:
    """Return one sigma (n,) of positions [m], averaged over directions, of pose covariances (n, 3, 3) [m, m, rad]."""
    sigmas = np.empty(len(covariances))
    for k in range(len(covariances)):
        sigmas[k] = math.sqrt(0.5 * (covariances[k, 0, 0] + covariances[k, 1, 1]))
    return sigmas


@jit
def _see(
    starts: FloatArray,
    own: FloatArray,
    viewers: IntArray,
    members: IntArray,
    means: FloatArray,
    covariances: FloatArray,
    poses: FloatArray,
    other_poses: FloatArray,
    other_sigmas: FloatArray,
) -> None:
    """Move the poses of a filter's robots to the start frame of each robot that goes by it.

    Args:
        starts: (K, 3), as in `TeamPoses`.
        own: (K, 3) likewise.
        viewers: (m,) int64. Robots that go by the filter.
        members: (n,) int64. Robots that it knows of, in ascending order.
        means: (n, 3) [m, m, rad], map frame. Their poses.
        covariances: (n, 3, 3) [m, m, rad], map frame.
        poses: (m, n, 3). Poses of the members in each viewer's start frame, its own as in `own`. Written to, as what
            follows.
        other_poses: (m, n - 1, 3). The same without the viewer.
        other_sigmas: (m, n - 1) [m]. One sigma of their positions.
    """
    sigmas = position_sigmas(covariances)
    for i in range(len(viewers)):
        viewer = viewers[i]
        x, y, theta = starts[viewer]
        c, s = math.cos(theta), math.sin(theta)
        other = 0
        for k in range(len(members)):
            if members[k] == viewer:
                poses[i, k] = own[viewer]
                continue
            pose = other_poses[i, other]
            pose[0] = x + c * means[k, 0] - s * means[k, 1]
            pose[1] = y + s * means[k, 0] + c * means[k, 1]
            pose[2] = (theta + means[k, 2] + math.pi) % (2.0 * math.pi) - math.pi
            poses[i, k] = pose
            other_sigmas[i, other] = sigmas[k]
            other += 1
