"""Occupancy grids of a team: exchange between robots and restoration after a rollback."""

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice, permutations
from typing import Any, NamedTuple

import numpy as np

from slam_backend.core.read_only import as_constant, as_read_only
from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.fastslam.relative_poses import TeamPoses
from slam_backend.geometry import compose, inverse
from slam_backend.models.camera import StereoCamera
from slam_backend.state import (
    BOOL,
    FLOAT64,
    INT64,
    MAX_DISTANCE,
    Array,
    Child,
    Each,
    Int,
    Record,
    Row,
    Sizes,
    State,
    with_state,
)
from slam_backend.team.reports import LandmarkIdMap, MapReleased, MergeUndone, TeamReport
from vslam_env.belief.belief import RobotHardware
from vslam_env.navigation import OccupancyGrid, TeamGrids, TeamLooks, ray_directions
from vslam_env.navigation.grid_storage import GridPart, LooksPart


@with_state(
    tick=Int(),
    shared=Array(INT64, "K K", 0, 1, constant=True),
    poses=Array(FLOAT64, "K K 3", -MAX_DISTANCE, MAX_DISTANCE, nan=True, constant=True),
    scans=Array(FLOAT64, "K RAYS", 0.0, constant=True),
    bumps=Array(BOOL, "K", constant=True),
)
class GridUpdate(NamedTuple):
    """Arguments of `TeamGrids.update` for one tick, with read-only arrays.

    Attributes:
        tick: Tick of the readings.
        shared: (K, K) int64. 1 where the readings of robot j are in the grid of robot i, painted then or later.
        poses: (K, K, 3) [m, m, rad]. Estimated pose of robot j in the start frame of robot i.
        scans: (K, R) [m]. Scans of the robots.
        bumps: (K,) bool. True for robots that bumped into an obstacle.
    """

    tick: int
    shared: IntArray
    poses: FloatArray
    scans: FloatArray
    bumps: BoolArray

    @staticmethod
    def check_state(parts: Mapping[str, Any], sizes: Sizes) -> None:
        """Raise unless all robots that share scans have poses."""
        if np.isnan(parts["poses"][parts["shared"] == 1]).any():
            raise ValueError("robots that share scans without a pose")


class GridTransfer(NamedTuple):
    """Transfer of the content of one robot's grid to another's.

    Attributes:
        source, target: Indices of the two robots.
        motion: (3,) [m, m, rad]. Start pose of the source in the start frame of the target.
        since: First tick whose readings the target may lack.
        is_whole: Whether the whole grid is merged into the target, including updates no longer buffered.
    """

    source: int
    target: int
    motion: FloatArray
    since: int
    is_whole: bool


def plan_catch_up(
    history: Sequence[GridUpdate], transfers: Iterable[GridTransfer]
) -> tuple[list[GridUpdate], list[GridUpdate]]:
    """Return the history after simultaneous transfers, and the missing updates to paint.

    Args:
        history: Updates in ascending order of ticks.
        transfers: Simultaneous transfers; what a robot receives now is not passed on.

    Returns:
        The new history, and the missing updates of each tick with any.
    """
    if not history:
        return [], []
    before = np.array([update.shared for update in history])
    shared, missing, poses = before.copy(), np.zeros_like(before), np.array([update.poses for update in history])
    for source, target, motion, _, is_whole in transfers:
        ticks, readers = np.nonzero(before[:, source] > shared[:, target])
        shared[ticks, target, readers] = 1
        missing[ticks, target, readers] = not is_whole
        poses[ticks, target, readers] = compose(motion, poses[ticks, source, readers])
    rows = (shared != before).any(axis=(1, 2))
    after = [
        update._replace(shared=as_constant(shared[row]), poses=as_constant(poses[row])) if rows[row] else update
        for row, update in enumerate(history)
    ]
    incomplete = np.flatnonzero(missing.any(axis=(1, 2)))
    return after, [after[row]._replace(shared=missing[row]) for row in incomplete.tolist()]


def split_history(
    history: Iterable[GridUpdate], before: Iterable[GridUpdate], sides: Sequence[Sequence[int]]
) -> tuple[list[GridUpdate], list[GridUpdate]]:
    """Return the history without transfers between two sides, and the updates to paint into their restored grids.

    Args:
        history: Updates including transfers between the sides.
        before: History before the merge, whose updates the restored grids contain.
        sides: Robots of either side; the grids of other robots are unchanged.
    """
    robots, earlier = [robot for side in sides for robot in side], {update.tick: update.shared for update in before}
    after, replayed = [], []
    for update in history:
        own = np.zeros_like(update.shared)
        for side in sides:
            own[np.ix_(side, side)] = update.shared[np.ix_(side, side)]
        painted = earlier.get(update.tick, np.zeros_like(own))
        shared = update.shared.copy()
        shared[robots] = painted[robots] | own[robots]
        after.append(update._replace(shared=as_read_only(shared)))
        if (missing := own & ~painted).any():
            replayed.append(update._replace(shared=missing))
    return after, replayed


CONNECTED, NEVER_MET = -1, -2  # stand for the tick at which two robots lost contact; NEVER_MET is the least
MAX_ABSENCE = 1000  # [ticks] after a longer absence whole grids are merged: replaying takes 10 us a tick


@with_state(
    tick=Int(),
    sides=Row(Each(Int(high="K")), Each(Int(high="K"))),
    maps=Row(Int(), Int(), Int()),
    grids=Each(Record(GridPart)),
    looks=Each(Record(LooksPart)),
    updates=Each(Record(GridUpdate)),
)
class GridSnapshot(NamedTuple):
    """Grids just before a merge.

    Attributes:
        tick: Tick of the merge; later readings are not in the grids.
        sides: Robots of either group.
        maps: Numbers of map a, map b and the joint map.
        grids: Grids of the robots of both sides, in turn.
        looks: Looks of these robots.
        updates: Buffered updates at that time.
    """

    tick: int
    sides: tuple[tuple[int, ...], tuple[int, ...]]
    maps: tuple[int, int, int]
    grids: tuple[GridPart, ...]
    looks: tuple[LooksPart, ...]
    updates: tuple[GridUpdate, ...]

    @property
    def robots(self) -> tuple[int, ...]:
        """Robots of both sides."""
        return self.sides[0] + self.sides[1]

    @staticmethod
    def check_state(parts: Mapping[str, Any], sizes: Sizes) -> None:
        """Raise unless each robot belongs to one side and has a grid and looks."""
        robots = parts["sides"][0] + parts["sides"][1]
        if not len(set(robots)) == len(robots) == len(parts["grids"]) == len(parts["looks"]):
            raise ValueError(f"not a grid and looks of each of the robots {robots}")


class SharedGrids:
    """Occupancy grids and looks of a team, each in the start frame of its robot.

    The scans of robots that share a filter are painted into all their grids. At their first merge robots merge their
    whole grids. Robots that regain contact paint only the updates that their grids lack, because merging whole grids
    again would count common scans twice and thicken walls. While a merge can be rolled back, the grids before it and
    the later updates are kept; a rollback restores these grids and repaints the updates of each side.

    Args:
        num_robots: Number of robots K.
        body: Hardware of the robots.
        camera: Camera that measures the landmarks.

    Attributes:
        team: Grids of all robots.
        looks: Looks of all robots at walls; they follow the grids.
    """

    STATE = State(
        team=Child(TeamGrids),
        looks=Child(TeamLooks),
        same_filter=Each(Each(Int(high="K")), "K"),
        separated_since=Array(INT64, "K K", NEVER_MET),
        snapshots=Each(Record(GridSnapshot), kind=list),
        updates=Each(Record(GridUpdate), kind=deque),
    )

    def __init__(self, num_robots: int, body: RobotHardware, camera: StereoCamera) -> None:
        self.team = TeamGrids(num_robots)
        reach = min(float(body.scan_range), camera.max_range)
        self.looks = TeamLooks(num_robots, body.ray_angles, camera.half_fov, reach)
        self._hardware = ray_directions(body.ray_angles), float(body.scan_range), float(body.radius)
        self._separated_since = np.full(
            (num_robots, num_robots), NEVER_MET
        )  # tick since which two robots share no scans
        self._settle(0, [(robot,) for robot in range(num_robots)])
        self._snapshots: list[GridSnapshot] = []
        self._updates: deque[GridUpdate] = deque()

    @property
    def shared(self) -> IntArray:
        """(K, K) int64. 1 where two robots are on the same filter, so that they share their scans."""
        return self._shared

    def __getitem__(self, robot: int) -> OccupancyGrid:
        return self.team.grids[robot]

    def save_for_undo(self, tick: int, id_map: LandmarkIdMap) -> None:
        """Keep the grids of both sides before a merge.

        Args:
            tick: Tick of the next readings.
            id_map: Landmark ids of the merge.
        """
        sides = id_map.robots_a, id_map.robots_b
        robots = sides[0] + sides[1]
        grids, looks = tuple(self.team.grids[robot].known for robot in robots), tuple(map(self.looks.part, robots))
        self._snapshots.append(GridSnapshot(tick, sides, id_map.maps, grids, looks, tuple(self._updates)))

    def step(
        self,
        tick: int,
        report: TeamReport,
        mates: Sequence[tuple[int, ...]],
        team_poses: TeamPoses,
        scans: FloatArray,
        bumps: BoolArray,
    ) -> None:
        """Apply merges and rollbacks of a tick, and paint each robot's scan into the grids of all robots on its filter.

        Args:
            tick: Tick of the readings.
            report: Report of the filters on this tick.
            mates: Robots on the same filter, see `share_on_contact`.
            team_poses: Current pose estimates.
            scans: (K, R) float64 [m]. Scans of this tick.
            bumps: (K,) bool. True for robots that bumped into an obstacle.

        Raises:
            ValueError: If a pose is not finite, or a range is negative or NaN.
        """
        if report.map_changes or self._updates:
            self._apply_report(tick, report)
        if mates != self._same_filter:
            self.share_on_contact(tick, mates, team_poses.starts)
        self.team.update(self._shared, team_poses.poses, scans, bumps, *self._hardware)
        self.looks.update(self._shared, team_poses.poses, scans, self.team.size)
        if self._snapshots or self._oldest_parting is not None:
            poses, scans, bumps = as_constant(team_poses.poses), as_constant(scans), as_constant(bumps)
            self._updates.append(GridUpdate(tick, self._shared_then, poses, scans, bumps))

    def _apply_report(self, tick: int, report: TeamReport) -> None:
        """Save grids before merges, restore them at rollbacks, and drop data of merges that became final."""
        for entry in report.map_changes:
            if isinstance(entry, LandmarkIdMap) and entry in report.id_maps:
                self.save_for_undo(tick, entry)
            elif isinstance(entry, MergeUndone):
                self._undo(tick, entry)
            elif isinstance(entry, MapReleased):
                self._snapshots = [snapshot for snapshot in self._snapshots if entry.number not in snapshot.maps[:2]]
        if self._oldest_parting is not None and self._oldest_parting < tick - MAX_ABSENCE:
            self._update_absences(tick)
        oldest = tick
        if self._snapshots:  # in ascending order; updates missing then may have been transferred since
            oldest = self._snapshots[0].updates[0].tick if self._snapshots[0].updates else self._snapshots[0].tick
        if self._oldest_parting is not None:
            oldest = min(oldest, self._oldest_parting)
        while self._updates and self._updates[0].tick < oldest:
            self._updates.popleft()

    def _undo(self, tick: int, undone: MergeUndone) -> None:
        """Restore the grids before a merge and repaint the later updates of each side."""
        snapshot = next((snapshot for snapshot in self._snapshots if snapshot.maps == undone.maps), None)
        if snapshot is None:
            return  # merged and rolled back within a tick
        self._snapshots.remove(snapshot)
        for robot, grid, looks in zip(snapshot.robots, snapshot.grids, snapshot.looks, strict=True):
            self.team.grids[robot].known = grid
            self.looks.restore_part(robot, looks)
        self._updates, replayed = map(deque, split_history(self._updates, snapshot.updates, snapshot.sides))
        for update in replayed:
            self._replay(update)
        side_a, side_b = snapshot.sides
        self._separated_since[np.ix_(side_a, side_b)] = self._separated_since[np.ix_(side_b, side_a)] = NEVER_MET
        side_of = {robot: side for side in snapshot.sides for robot in side}
        mates = [
            tuple(mate for mate in group if mate in side_of.get(robot, group))
            for robot, group in enumerate(self._same_filter)
        ]
        self._settle(tick, mates)

    def share_on_contact(self, tick: int, mates: Sequence[tuple[int, ...]], starts: FloatArray) -> None:
        """Exchange grid content between robots that now share a filter.

        Args:
            tick: Tick of the next readings.
            mates: Robots on the same filter as each robot, itself included.
            starts: (K, 3) [m, m, rad]. Motion from the map frame to each robot's start frame.
        """
        transfers = [transfer for now in sorted(set(mates)) for transfer in self._plan_transfers(now, starts)]
        if transfers:
            sources = {each.source for each in transfers if each.is_whole}
            grids = {robot: (self.team.grids[robot].copy(), self.looks.counts[robot].copy()) for robot in sources}
            for transfer in transfers:
                if transfer.is_whole:
                    grid, looks = grids[transfer.source]
                    self.team.grids[transfer.target].merge(grid, transfer.motion)
                    self.looks.reserve(self.team.size)
                    self.looks.merge(transfer.target, looks, transfer.motion)
            first = max(0, len(self._updates) - max(tick - transfer.since for transfer in transfers))
            after, missing = plan_catch_up(list(islice(self._updates, first, None)), transfers)
            for row, update in enumerate(after, first):
                self._updates[row] = update
            for update in missing:
                self._replay(update)
        self._settle(tick, mates)

    def _plan_transfers(self, now: tuple[int, ...], starts: FloatArray) -> Iterator[GridTransfer]:
        """Yield the transfers among robots that now share a filter; whole grids between robots that never met."""
        before = sorted({tuple(mate for mate in self._same_filter[robot] if mate in now) for robot in now})
        for part, other in permutations(before, 2):
            # Robots that were connected already have the same content, so one robot represents each part.
            since = int(self._separated_since[np.ix_(part, other)].min())
            for robot in part:
                motion = compose(starts[robot], inverse(starts[other[0]]))
                yield GridTransfer(other[0], robot, motion, since, since == NEVER_MET)

    def _replay(self, update: GridUpdate) -> None:
        """Paint the readings of an earlier tick."""
        _, shared, poses, scans, bumps = update
        # Copies: kernels are compiled for writable arrays, except for read-only bumps.
        copies = shared.copy(), poses.copy(), scans.copy()
        self.team.update(*copies, bumps, *self._hardware)
        self.looks.update(*copies, self.team.size)

    def _settle(self, tick: int, mates: Sequence[tuple[int, ...]]) -> None:
        """Record which robots share a filter from a tick on."""
        self._same_filter = tuple(mates)
        together = np.array([[robot in group for robot in range(len(mates))] for group in mates])
        self._shared = together.astype(np.int64)
        self._shared_then = as_constant(self._shared)  # read-only, as in grid updates
        self._separated_since[(self._separated_since == CONNECTED) & ~together] = tick
        self._separated_since[together] = CONNECTED
        self._update_absences(tick)

    def _update_absences(self, tick: int) -> None:
        """Find the first tick whose updates separated robots may need; treat long absences as never met."""
        self._separated_since[(self._separated_since >= 0) & (self._separated_since < tick - MAX_ABSENCE)] = NEVER_MET
        since = self._separated_since[self._separated_since >= 0]
        self._oldest_parting = int(since.min()) if len(since) else None

    def rebuild(self) -> None:
        """Give grids and looks the same size, and restore what follows from the robots that share filters."""
        self.team.reserve(self.looks.counts.shape[1] // 2)
        self.looks.reserve(self.team.size)
        self._settle(0, self._same_filter)

    @staticmethod
    def check_state(parts: Mapping[str, Any], sizes: Sizes) -> None:
        """Raise unless robots that share a filter are the same for all of them."""
        groups = parts["same_filter"]
        if any(
            robot not in group or any(groups[mate] != group for mate in group) for robot, group in enumerate(groups)
        ):
            raise ValueError(f"robots that do not share filters with each other: {groups}")
