"""Occupancy grids of a team: exchange between robots and restoration after a rollback."""

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice, permutations
from typing import Any, NamedTuple

import numpy as np

from slam_backend.core.read_only import as_constant, as_read_only, with_constants, with_read_only
from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.fastslam.relative_poses import TeamPoses
from slam_backend.geometry import compose, inverse
from slam_backend.models.camera import StereoCamera
from slam_backend.team.reports import LandmarkIdMap, MapReleased, MergeUndone, TeamReport
from vslam_env.belief.belief import RobotHardware
from vslam_env.navigation import OccupancyGrid, TeamGrids, TeamLooks, ray_directions
from vslam_env.navigation.looks import looks_reach


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


class GridSnapshot(NamedTuple):
    """Grids just before a merge.

    Attributes:
        tick: Tick of the merge; later readings are not in the grids.
        sides: Robots of either group.
        maps: Numbers of map a, map b and the joint map.
        grids: State of each robot's grid.
        looks: State of each robot's looks.
        updates: Buffered updates at that time.
    """

    tick: int
    sides: tuple[tuple[int, ...], tuple[int, ...]]
    maps: tuple[int, int, int]
    grids: dict[int, dict[str, Any]]
    looks: dict[int, dict[str, Any]]
    updates: tuple[GridUpdate, ...]


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

    def __init__(self, num_robots: int, body: RobotHardware, camera: StereoCamera) -> None:
        self.team = TeamGrids(num_robots)
        reach = min(float(body.scan_range), camera.max_range)
        self.looks = TeamLooks(num_robots, body.ray_angles, camera.half_fov, reach)
        self._grids = self.team.grids
        self._hardware = ray_directions(body.ray_angles), float(body.scan_range), float(body.radius)
        self._parted = np.full((num_robots, num_robots), NEVER_MET)  # tick since which two robots share no scans
        self._settle(0, [(robot,) for robot in range(num_robots)])
        self._kept: list[GridSnapshot] = []
        self._strokes: deque[GridUpdate] = deque()

    @property
    def shared(self) -> IntArray:
        """(K, K) int64. 1 where two robots are on the same filter, so that they share their scans."""
        return self._shared

    def __getitem__(self, robot: int) -> OccupancyGrid:
        return self._grids[robot]

    def save_for_undo(self, tick: int, id_map: LandmarkIdMap) -> None:
        """Keep the grids of both sides before a merge.

        Args:
            tick: Tick of the next readings.
            id_map: Landmark ids of the merge.
        """
        sides = id_map.robots_a, id_map.robots_b
        robots = sides[0] + sides[1]
        grids = with_read_only({robot: self._grids[robot].get_state() for robot in robots})
        looks = with_read_only({robot: self.looks.get_state(robot) for robot in robots})
        self._kept.append(GridSnapshot(tick, sides, id_map.maps, grids, looks, tuple(self._strokes)))

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
        if report.map_changes or self._strokes:
            self._apply_report(tick, report)
        if mates != self._mates:
            self.share_on_contact(tick, mates, team_poses.starts)
        self.team.update(self._shared, team_poses.poses, scans, bumps, *self._hardware)
        self.looks.update(self._shared, team_poses.poses, scans, self.team.size)
        if self._kept or self._oldest_parting is not None:
            poses, scans, bumps = as_constant(team_poses.poses), as_constant(scans), as_constant(bumps)
            self._strokes.append(GridUpdate(tick, self._shared_then, poses, scans, bumps))

    def _apply_report(self, tick: int, report: TeamReport) -> None:
        """Save grids before merges, restore them at rollbacks, and drop data of merges that became final."""
        for entry in report.map_changes:
            if isinstance(entry, LandmarkIdMap) and entry in report.id_maps:
                self.save_for_undo(tick, entry)
            elif isinstance(entry, MergeUndone):
                self._undo(tick, entry)
            elif isinstance(entry, MapReleased):
                self._kept = [snapshot for snapshot in self._kept if entry.number not in snapshot.maps[:2]]
        if self._oldest_parting is not None and self._oldest_parting < tick - MAX_ABSENCE:
            self._update_absences(tick)
        oldest = tick
        if self._kept:  # in ascending order; updates missing then may have been transferred since
            oldest = self._kept[0].updates[0].tick if self._kept[0].updates else self._kept[0].tick
        if self._oldest_parting is not None:
            oldest = min(oldest, self._oldest_parting)
        while self._strokes and self._strokes[0].tick < oldest:
            self._strokes.popleft()

    def _undo(self, tick: int, undone: MergeUndone) -> None:
        """Restore the grids before a merge and repaint the later updates of each side."""
        snapshot = next((snapshot for snapshot in self._kept if snapshot.maps == undone.maps), None)
        if snapshot is None:
            return  # merged and rolled back within a tick
        self._kept.remove(snapshot)
        for robot in snapshot.sides[0] + snapshot.sides[1]:
            self._grids[robot].set_state(snapshot.grids[robot])
            self.looks.set_state(robot, snapshot.looks[robot])
        self._strokes, replayed = map(deque, split_history(self._strokes, snapshot.updates, snapshot.sides))
        for update in replayed:
            self._replay(update)
        side_a, side_b = snapshot.sides
        self._parted[np.ix_(side_a, side_b)] = self._parted[np.ix_(side_b, side_a)] = NEVER_MET
        side_of = {robot: side for side in snapshot.sides for robot in side}
        mates = [
            tuple(mate for mate in group if mate in side_of.get(robot, group))
            for robot, group in enumerate(self._mates)
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
            grids = {robot: (self._grids[robot].copy(), self.looks.counts[robot].copy()) for robot in sources}
            for transfer in transfers:
                if transfer.is_whole:
                    grid, looks = grids[transfer.source]
                    self._grids[transfer.target].merge(grid, transfer.motion)
                    self.looks.reserve(self.team.size)
                    self.looks.merge(transfer.target, looks, transfer.motion)
            first = max(0, len(self._strokes) - max(tick - transfer.since for transfer in transfers))
            after, missing = plan_catch_up(list(islice(self._strokes, first, None)), transfers)
            for row, update in enumerate(after, first):
                self._strokes[row] = update
            for update in missing:
                self._replay(update)
        self._settle(tick, mates)

    def _plan_transfers(self, now: tuple[int, ...], starts: FloatArray) -> Iterator[GridTransfer]:
        """Yield the transfers among robots that now share a filter; whole grids between robots that never met."""
        before = sorted({tuple(mate for mate in self._mates[robot] if mate in now) for robot in now})
        for part, other in permutations(before, 2):
            # Robots that were connected already have the same content, so one robot represents each part.
            since = int(self._parted[np.ix_(part, other)].min())
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
        self._mates = tuple(mates)
        together = np.array([[robot in group for robot in range(len(mates))] for group in mates])
        self._shared = together.astype(np.int64)
        self._shared_then = as_constant(self._shared)  # read-only, as in grid updates
        self._parted[(self._parted == CONNECTED) & ~together] = tick
        self._parted[together] = CONNECTED
        self._update_absences(tick)

    def _update_absences(self, tick: int) -> None:
        """Find the first tick whose updates separated robots may need; treat long absences as never met."""
        self._parted[(self._parted >= 0) & (self._parted < tick - MAX_ABSENCE)] = NEVER_MET
        since = self._parted[self._parted >= 0]
        self._oldest_parting = int(since.min()) if len(since) else None

    @property
    def grid_updates(self) -> dict[int, GridUpdate]:
        """All buffered updates by `id`; read-only."""
        histories = (self._strokes, *(snapshot.updates for snapshot in self._kept))
        return {id(update): update for history in histories for update in history}

    def get_state(self) -> dict[str, Any]:
        """Return the complete state of the grids; shared arrays are read-only."""
        return {
            "grids": [grid.get_state() for grid in self._grids],
            "looks": [self.looks.get_state(robot) for robot in range(len(self._grids))],
            "mates": self._mates,
            "parted": self._parted.copy(),
            "kept": tuple(self._kept),
            "strokes": tuple(self._strokes),
        }

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Restore a state of `get_state` in place; views of the grids remain valid."""
        for grid, grid_state in zip(self._grids, state["grids"], strict=True):
            grid.set_state(grid_state)
        self.team.reserve(max(map(looks_reach, state["looks"])))
        self.looks.reserve(self.team.size)
        for robot, looks in enumerate(state["looks"]):
            self.looks.set_state(robot, looks)
        self._parted[:] = state["parted"]
        self._settle(0, state["mates"])
        self._kept, self._strokes = with_constants(list(state["kept"])), deque(with_constants(state["strokes"]))
