"""What a team of filters knows: groups, poses, maps, diagnostics. `TeamSlam` adds what changes them."""

from typing import Literal

import numpy as np

from slam_backend._best_map import write_outline
from slam_backend._team_state import TeamState
from slam_backend.branches import Branch, restored_filter
from slam_backend.consistency import Consistency
from slam_backend.errors import FloatArray, IntArray, bad_argument, check_kind
from slam_backend.exchange import ExchangeLedger
from slam_backend.geometry import inverse
from slam_backend.groups import Group
from slam_backend.landmark_map import LandmarkMap, TeamOutlines
from slam_backend.refusals import PairAttempts, count_attempts, refusals_of
from slam_backend.reports import MergeEvent, PoseEstimate
from slam_backend.standpoints import Standpoints


class TeamKnowledge(TeamState):
    """All that can be asked of a team."""

    @property
    def num_robots(self) -> int:
        """K."""
        return self._num_robots

    @property
    def groups(self) -> tuple[tuple[int, ...], ...]:
        """The groups, each in ascending order of robots, by ascending first robot."""
        return self.lineup.groups

    @property
    def events(self) -> tuple[MergeEvent, ...]:
        """All attempts, merges and undos so far, in order."""
        return tuple(self._events)

    @property
    def pair_attempts(self) -> tuple[PairAttempts, ...]:
        """What came of the attempts of each pair of groups so far, and why the last one was refused."""
        return count_attempts(self._events)

    @property
    def bytes_sent(self) -> IntArray:
        """(K,) bytes that each robot has sent; `slam_backend.exchange` says what is counted. A copy."""
        return np.array(self.exchange.sent, np.int64)

    @property
    def exchange(self) -> ExchangeLedger:
        """Counts these bytes; to be looked at."""
        return self._records.exchange

    @property
    def maps(self) -> tuple[int, ...]:
        """Per robot the number of the map that it goes by; see `TeamReport`."""
        return self.lineup.maps

    @property
    def diagnostics(self) -> tuple[dict[str, float], ...]:
        """Per robot: ESS, NIS, landmarks held, and its accepted, new and rejected measurements of the last step.

        Of the whole life of its filter: `nis_mean`, `nis_share`, `ess_share` and `rejected_share` of `Consistency`,
        and `warnings`, how many there are; `consistency` has their texts.
        And of all steps so far the attempts of its groups to align maps, and how many were refused for each reason.
        """
        rows: list[dict[str, float]] = []
        for robot in range(self.num_robots):
            branch, index = self._find(robot)
            report = branch.report
            found = np.empty(0, np.int64) if report is None else report.associations[index]
            made = np.empty(0, np.int64) if report is None else report.created[index]
            new = int(np.count_nonzero((found >= 0) & (found == made)))
            told = branch.filter.consistency
            rows.append(
                {
                    "ess": self.ess(robot),
                    "nis": float("nan") if report is None else report.nis,
                    "landmarks": float(branch.filter.map_size),
                    "accepted": float(np.count_nonzero(found >= 0) - new),
                    "new": float(new),
                    "rejected": float(np.count_nonzero(found < 0)),
                    "nis_mean": told.nis_mean,
                    "nis_share": told.nis_share,
                    "ess_share": told.ess_share,
                    "rejected_share": told.rejected_share,
                    "warnings": float(len(told.warnings)),
                    **refusals_of(self._events, robot),
                }
            )
        return tuple(rows)

    def consistency(self, robot: int) -> Consistency:
        """Return whether the filter that a robot goes by errs as little as it claims; see `FastSlam.consistency`."""
        return self._find(robot)[0].filter.consistency

    def members(self, robot: int) -> tuple[int, ...]:
        """Return the robots whose places the robot's filter knows, itself included, in ascending order.

        They are its group, but for a robot that has been out of contact since before a merge or an undo: it knows of
        neither. The map frame is the start frame of the first of them.
        """
        return self._find(robot)[0].robots

    def mates(self, robot: int) -> tuple[int, ...]:
        """Return the robots that go by the same filter as this one now, itself included, in ascending order."""
        return self._find(robot)[0].live

    def keepers(self, robot: int) -> tuple[int, ...]:
        """Return the robots that go by the joint filter of a robot's group, in ascending order: it merges by them."""
        return self._group_of(robot).trunk.live

    def ess(self, robot: int) -> float:
        """Return the effective sample size of the robot's filter at its last step, in [1, M]."""
        branch = self._find(robot)[0]
        return float(branch.filter.num_particles) if branch.report is None else branch.report.ess

    def pose(self, robot: int, seen_by: int | None = None) -> PoseEstimate:
        """Return the robot's pose in the map frame.

        Args:
            robot: Whose.
            seen_by: In whose filter, one of whose `members` is the robot; None: its own. Of a robot out of contact
                others know where it was when contact was lost.

        Raises:
            ValueError: If a robot does not exist or that filter does not know it.
        """
        branch, index = self._find(robot)
        if seen_by is not None:
            branch = self._find(seen_by)[0]
            if robot not in branch.robots:
                raise bad_argument("robot", f"one of {branch.robots}", robot, "Ask about members of its filter.")
            index = branch.robots.index(robot)
        return branch.filter.pose(index)

    def particles(self, robot: int) -> tuple[FloatArray, FloatArray]:
        """Return the robot's poses (M, 3), map frame of its group, and their log-weights (M,). Copies."""
        branch, index = self._find(robot)
        return branch.filter.particles(index)

    def pose_from_start(self, robot: int) -> PoseEstimate:
        """Return the robot's pose in its own start frame; see `FastSlam.pose_from_start`."""
        branch, index = self._find(robot)
        return branch.filter.pose_from_start(index)

    def particles_from_start(self, robot: int) -> FloatArray:
        """Return the robot's poses (M, 3) in its own start frame; see `FastSlam.particles_from_start`."""
        branch, index = self._find(robot)
        return branch.filter.particles_from_start(index)

    def map(self, robot: int, estimate: Literal["best", "mixture"] = "best", min_count: int = 1) -> LandmarkMap:
        """Return the map that the robot goes by in its map frame; see `FastSlam.map`."""
        return self._find(robot)[0].filter.map(estimate, min_count)

    def merged_maps(self, merge: MergeEvent) -> tuple[LandmarkMap, LandmarkMap]:
        """Return the two maps that a merge joined as they were just before it, straight if they had been straightened.

        Each is in its own frame, under its own ids, and has the rows that the inliers of `merge.alignment` name.

        Raises:
            ValueError: If it is no merge that is still watched.
        """
        check_kind("merge", merge, MergeEvent, "Give one of the events of a step's report.")
        for group in self._groups:
            for watch in group.trunk.watches:
                if watch.alignment is merge.alignment:
                    map_a, map_b = (restored_filter(side.trunk["filter"]).map() for side in watch.sides)
                    return map_a, map_b
        expected, got = "a merge still watched", f"the {merge.kind} of step {merge.step}"
        raise bad_argument("merge", expected, got, "Ask in the step in which it is made.")

    def start_from_group(self, robot: int) -> FloatArray:
        """Return (3,) the motion from the map frame of the robot's filter to the robot's own start frame.

        It is that of the most probable particle, so that it fits `map(robot)`.
        """
        branch, index = self._find(robot)
        return inverse(branch.filter.start_pose(index))

    def outlines(self, min_count: int = 1, into: TeamOutlines | None = None) -> TeamOutlines:
        """Return the outlines of `map(robot, min_count=min_count)` of all robots, much faster.

        Args:
            min_count: Landmarks that were measured fewer times are left out.
            into: What this has returned before; it is written to, as long as it has room. None: fresh arrays.
        """
        outlines = TeamOutlines.unwritten(self._num_robots, 0) if into is None else into
        (rows, parts), last = outlines, 0
        for branch in self.lineup.branches:
            slam = branch.filter
            first, last = last, write_outline(slam._maps, slam._best, min_count, rows, last)
            for robot in branch.live:
                parts[robot, 0], parts[robot, 1] = first, last
        if last > len(rows.names):
            return self.outlines(min_count, TeamOutlines.unwritten(self._num_robots, 2 * last))
        return outlines

    def standpoints(self, into: Standpoints | None = None) -> Standpoints:
        """Return where all robots stand: `pose_from_start`, `start_from_group`, `pose` at once.

        Args:
            into: What this has returned before; it is written to. None: fresh arrays.
        """
        points = Standpoints(self._num_robots) if into is None else into
        for branch in self.lineup.branches:
            slam, report = branch.filter, branch.report
            ess = 1.0 if report is None else report.ess / slam.num_particles
            slam._stand(branch.robots, branch.live, ess, points)
        return points

    def _group_of(self, robot: int) -> Group:
        """Return the robot's group."""
        return self._place(robot)[0]

    def _find(self, robot: int) -> tuple[Branch, int]:
        """Return the branch that the robot goes by, and its place in it."""
        return self._place(robot)[1:]

    def _place(self, robot: int) -> tuple[Group, Branch, int]:
        """Return the robot's group, the branch that it goes by, and its place in that."""
        if type(robot) is int and 0 <= robot < self._num_robots:
            return self.lineup.places[robot]
        if isinstance(robot, (int, np.integer)) and not isinstance(robot, bool) and 0 <= robot < self._num_robots:
            return self.lineup.places[robot]
        raise bad_argument("robot", f"an index from 0 to {self.num_robots - 1}", robot, "Count robots from 0.")
