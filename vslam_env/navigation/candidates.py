"""Candidates of three kinds, in slots with stable numbers: frontiers, places to look from again, and rendezvous."""

import math
from collections.abc import Mapping
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.state import FLOAT64, INT64, Array, Child, Each, Int, Sizes, State
from vslam_env.navigation._grid_kernels import CELL
from vslam_env.navigation._planning_kernels import PAD
from vslam_env.navigation._view_kernels import (
    NUM_DESCRIBED,
    NUM_GAINS,
    describe_candidates,
    renew_candidates,
)
from vslam_env.navigation.candidate_slots import NUM_COLUMNS, NUM_SLOTS, CandidateSlots, check_rows, untold
from vslam_env.navigation.looks import TeamLooks
from vslam_env.navigation.team_grids import TeamGrids

__all__ = ["CANDIDATE_FEATURES", "NUM_CANDIDATES", "CandidateGains", "CandidateKind", "TeamCandidates"]

NUM_REVISITS, NUM_RENDEZVOUS = 12, 4
NUM_CANDIDATES = NUM_SLOTS + NUM_REVISITS + NUM_RENDEZVOUS
CANDIDATE_FEATURES = (
    "x",
    "y",
    "heading_cos",
    "heading_sin",
    "path_length",
    "size",
    "teammate_path_length",
    "own_goal",
    "teammate_goal",
    "unknown_area",
    "unseen_wall",
    "weak_landmarks",
    "uncertain_length",
    "nearest_candidate",
    "is_frontier",
    "is_revisit",
    "is_rendezvous",
)
"""Names of the columns of the candidates in observations."""

FIRST_KIND = NUM_DESCRIBED  # column of the first kind


class CandidateKind(IntEnum):
    """Kind of a candidate."""

    NONE = -1
    FRONTIER = 0
    REVISIT = 1
    RENDEZVOUS = 2


SLOT_KINDS: IntArray = np.repeat(
    [int(CandidateKind.FRONTIER), int(CandidateKind.REVISIT), int(CandidateKind.RENDEZVOUS)],
    [NUM_SLOTS, NUM_REVISITS, NUM_RENDEZVOUS],
).astype(np.int64)


@short_repr
class CandidateGains(NamedTuple):
    """What there is to gain at candidates, each (C,) float64; zeros in empty slots.

    Attributes:
        unknown_area: Unknown area in view from the goal [m^2], looking through what is unknown up to the next wall.
        unseen_wall: Length of walls in view that were looked at too little, by the share of looks that they lack [m].
        weak_landmarks: Number of landmarks in view with fewer than three measurements, at walls that lack looks.
        uncertain_length: Length of the path over floor without well-known landmarks nearby [m].
    """

    unknown_area: FloatArray
    unseen_wall: FloatArray
    weak_landmarks: FloatArray
    uncertain_length: FloatArray


LandmarkRows = tuple[FloatArray, IntArray, FloatArray]


class TeamCandidates:
    """Candidates of all robots of a team.

    Slots 0 to 15 hold frontiers (`CandidateSlots`), 16 to 27 places to look from again, 28 to 31 rendezvous. A
    candidate keeps its slot while it lives: a place to look from again, while something is left to gain there.

    An update costs what is near: it searches within `near` of the robot, and candidates farther away, with their
    lengths and gains, stay as they were. All known floor is searched at every n-th update, robots in turn, n the known
    area over `share`, rounded up, and as soon as no frontier is left.

    Args:
        num_robots: Number of robots K.
        camera: Half the field of view [rad], range [m], and radius of the robots [m].
        near: Distance from the robot along x and y that every update searches [m].
        share: Area that an update searches beyond what is near, in the mean [m^2].

    Attributes:
        frontiers: Frontier slots of each robot.
    """

    STATE = State(
        frontiers=Each(Child(CandidateSlots), "K", list),
        other_rows=Array(FLOAT64, f"K {NUM_CANDIDATES - NUM_SLOTS} {NUM_COLUMNS}", nan=True),
        gains=Array(FLOAT64, f"K {NUM_CANDIDATES} {NUM_GAINS}", 0.0),
        views=Array(FLOAT64, f"K {NUM_CANDIDATES} 3", nan=True),
        lengths=Array(FLOAT64, f"K {NUM_CANDIDATES} K", 0.0, math.inf),
        visits=Array(INT64, f"K {NUM_REVISITS}"),
        updates=Each(Int(), "K", list),
    )

    def __init__(
        self, num_robots: int, camera: tuple[float, float, float], near: float = 18.0, share: float = 1600.0
    ) -> None:
        self._near, self._share = near, share
        self._camera = np.array(camera)
        self._rows = np.full((num_robots, NUM_CANDIDATES, NUM_COLUMNS), np.nan)
        self._gains = np.zeros((num_robots, NUM_CANDIDATES, NUM_GAINS))
        self._views = np.full((num_robots, NUM_CANDIDATES, 3), np.nan)
        self._lengths = np.full((num_robots, NUM_CANDIDATES, num_robots), np.inf)
        self._visits = np.zeros((num_robots, NUM_REVISITS), np.int64)
        self._updates = [0] * num_robots
        self._other_rows = self._rows[:, NUM_SLOTS:]  # view: the first rows belong to `frontiers`
        self.frontiers = [CandidateSlots.over(rows[:NUM_SLOTS]) for rows in self._rows]

    def update(
        self, robot: int, grids: TeamGrids, looks: TeamLooks, poses: FloatArray, landmarks: LandmarkRows,
        places: FloatArray,
    ) -> None:  # fmt: skip
        """Update a robot's candidates without checks.

        Args:
            robot: Index of the robot.
            grids: Occupancy grids of the robots.
            looks: Looks of the robots; those of this one at walls that cannot be seen are changed.
            poses: (K, K, 3) float64 [m, m, rad]. Pose of robot j in the start frame of robot i; NaN: unknown.
            landmarks: All landmarks of the robot's map (n, 4), their counts (n, 2), see `MapSummaryRows`, and the
                motion (3,) from the map frame to the start frame.
            places: (4, 3) float64 [m, m, rad], start frame. Places for rendezvous; NaN: none.
        """
        cells, bounds = grids.grids[robot].cells, grids.bounds[robot]
        frontiers = self.frontiers[robot]
        self._updates[robot] += 1
        reach, any_before = self._reach(robot, bounds), frontiers.valid.any()
        ways = frontiers.renew(cells, bounds, poses[robot], robot, reach)
        if reach < math.inf and any_before and not frontiers.valid.any():
            ways = frontiers.renew(cells, bounds, poses[robot], robot)
        rows, (height, width) = self._rows[robot], ways[0].shape
        searched = [ways[4] + PAD, ways[5] + PAD, ways[4] + height - PAD, ways[5] + width - PAD]
        is_whole = searched == bounds.tolist()
        distant = np.zeros(len(rows), np.bool_) if is_whole else untold(ways, bounds, len(cells), rows)
        gains = self._gains[robot], self._views[robot]
        slots = rows, distant, self._visits[robot], *gains, self._lengths[robot], robot, self._updates[robot]
        seen = looks.counts[robot], looks.bounds[robot]
        renew_candidates(cells, bounds, seen, ways, landmarks, poses[robot], self._camera, places, slots)

    def _reach(self, robot: int, bounds: NDArray[np.int32]) -> float:
        """Return the distance [m] from a robot along x and y that the present update searches; inf: everywhere."""
        top, left, bottom, right = bounds.tolist()
        period = max(1, math.ceil((bottom - top) * (right - left) * CELL**2 / self._share))
        return math.inf if self._updates[robot] % period == robot % period else self._near

    def rows(self, robot: int) -> FloatArray:
        """Return the candidates (32, 5) of a robot, columns as in `FrontierColumns`; NaN in empty slots. A view."""
        return np.asarray(self._rows[robot])

    def gains(self, robot: int) -> CandidateGains:
        """Return the gains of a robot's candidates; views."""
        return CandidateGains(*self._gains[robot].T)

    def lengths(self, robot: int) -> FloatArray:
        """Return the lengths (32, K) [m] of all robots' paths to a robot's candidates; inf: unknown. A view."""
        return np.asarray(self._lengths[robot])

    def features(self, poses: FloatArray, goals: FloatArray) -> NDArray[np.float32]:
        """Return the features of all robots' candidates without checks.

        Args:
            poses: (K, K, 3) float64 [m, m, rad]. Pose of robot j in the start frame of robot i; NaN: unknown.
            goals: (K, K, 2) float64 [m]. Current goal of robot j in the start frame of robot i; NaN: unknown.

        Returns:
            (K, 32, 17) float32. New array, columns `CANDIDATE_FEATURES`.
        """
        features = np.empty((len(self._rows), NUM_CANDIDATES, len(CANDIDATE_FEATURES)), np.float32)
        describe_candidates(self._rows, self._gains, self._lengths, poses, goals, SLOT_KINDS, features)
        return features

    @staticmethod
    def check_state(parts: Mapping[str, Any], sizes: Sizes) -> None:
        """Raise unless kernels find all positions in the grid."""
        check_rows(parts["other_rows"])
