"""`SharedGrids`: the robots' seen grids, what they tell each other of the floor, and how a wrong merge is wiped out."""

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice, permutations
from typing import Any, NamedTuple

import numpy as np

from slam_backend.core.read_only import as_constant, as_read_only, with_constants, with_read_only
from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.fastslam.relative_poses import TeamPoses
from slam_backend.fastslam.reports import LandmarkIdMap, MapReleased, MergeUndone, TeamReport
from slam_backend.geometry import compose, inverse
from vslam_env.belief.belief import RobotHardware
from vslam_env.navigation import SeenGrid, TeamGrids, ray_directions


class GridUpdate(NamedTuple):
    """What the readings of one tick wrote into the grids, as `TeamGrids.update` takes it. Arrays are read-only.

    Attributes:
        tick: Of the readings.
        shared: (K, K) int64. 1 where i's grid took what robot j read, then or when they came together again.
        poses: (K, K, 3) [m, m, rad]. Where robot j was believed to be in i's start frame.
        scans: (K, R) [m].
        bumps: (K,) bool. Who bumped into something.
    """

    tick: int
    shared: IntArray
    poses: FloatArray
    scans: FloatArray
    bumps: BoolArray


class GridTransfer(NamedTuple):
    """That one robot's grid takes what another's has.

    Attributes:
        source, target: These robots.
        motion: (3,) [m, m, rad]. The giver's start pose in the taker's start frame.
        since: The taker may miss what was read from this tick on.
        is_whole: Whether the taker absorbs the whole of it, strokes that are forgotten included.
    """

    source: int
    target: int
    motion: FloatArray
    since: int
    is_whole: bool


def plan_catch_up(
    history: Sequence[GridUpdate], tellings: Iterable[GridTransfer]
) -> tuple[list[GridUpdate], list[GridUpdate]]:
    """Return a history in which robots have told each other what they had before, and what is to be painted for that.

    Args:
        history: Of some ticks.
        tellings: Who tells whom, all at once: nobody hands on what is told now.

    Returns:
        The history, and for each tick of which grids miss something the strokes that they miss.
    """
    if not history:
        return [], []
    before = np.array([strokes.shared for strokes in history])
    shared, missed, poses = before.copy(), np.zeros_like(before), np.array([strokes.poses for strokes in history])
    for giver, taker, motion, _, is_whole in tellings:
        ticks, readers = np.nonzero(before[:, giver] > shared[:, taker])
        shared[ticks, taker, readers] = 1
        missed[ticks, taker, readers] = not is_whole
        poses[ticks, taker, readers] = compose(motion, poses[ticks, giver, readers])
    rows = (shared != before).any(axis=(1, 2))
    after = [
        strokes._replace(shared=as_constant(shared[row]), poses=as_constant(poses[row])) if rows[row] else strokes
        for row, strokes in enumerate(history)
    ]
    late = np.flatnonzero(missed.any(axis=(1, 2)))
    return after, [after[row]._replace(shared=missed[row]) for row in late.tolist()]


def split_history(
    history: Iterable[GridUpdate], before: Iterable[GridUpdate], sides: Sequence[Sequence[int]]
) -> tuple[list[GridUpdate], list[GridUpdate]]:
    """Return a history in which two sides were never together, and what is to be painted into their grids of before.

    Args:
        history: With all that either side took from the other.
        before: The history when they came together; what stands there is in the grids.
        sides: The robots of either; others keep what they have.
    """
    robots, then = [robot for side in sides for robot in side], {strokes.tick: strokes.shared for strokes in before}
    after, again = [], []
    for strokes in history:
        own = np.zeros_like(strokes.shared)
        for side in sides:
            own[np.ix_(side, side)] = strokes.shared[np.ix_(side, side)]
        held = then.get(strokes.tick, np.zeros_like(own))
        shared = strokes.shared.copy()
        shared[robots] = held[robots] | own[robots]
        after.append(strokes._replace(shared=as_read_only(shared)))
        if (missing := own & ~held).any():
            again.append(strokes._replace(shared=missing))
    return after, again


CONNECTED, NEVER_MET = -1, -2  # in place of the tick in which two robots lost each other; strangers come first
MAX_ABSENCE = 1000  # [ticks] whoever is away for longer comes back as a stranger: to paint takes 10 us a tick


class GridSnapshot(NamedTuple):
    """Grids as they were just before a merge.

    Attributes:
        tick: Of the merge; what was painted later is not in them.
        sides: The robots of either group.
        maps: Numbers of a's map, of b's and of the joint one.
        grids: State of each robot's grid.
        updates: What was known then of the ticks before, of which somebody may miss something.
    """

    tick: int
    sides: tuple[tuple[int, ...], tuple[int, ...]]
    maps: tuple[int, int, int]
    grids: dict[int, dict[str, Any]]
    updates: tuple[GridUpdate, ...]


class SharedGrids:
    """The seen grids of a team, each in its robot's own start frame.

    Robots that go by one filter paint what each of them scans into all of their grids. Those that come together for
    the first time, by a merge, absorb each other's grids. Those that lost each other and return paint what their grids
    miss of what was scanned meanwhile, so that no scan is painted twice, but for what strangers hold in common: to
    absorb whole grids each time would add all walls anew, a little thicker, to what came from the same scans. While a
    merge can be undone the grids from before it are kept, with what was painted since; an undo restores them and paints
    again what the robots of each side scanned or told each other.

    Args:
        num_robots: K.
        body: The robots' hardware.

    Attributes:
        team: All grids, in the order of robots.
    """

    def __init__(self, num_robots: int, body: RobotHardware) -> None:
        self.team = TeamGrids(num_robots)
        self._grids = self.team.grids
        self._hardware = ray_directions(body.ray_angles), float(body.scan_range), float(body.radius)
        self._parted = np.full((num_robots, num_robots), NEVER_MET)  # since which tick two do not share what they scan
        self._settle(0, [(robot,) for robot in range(num_robots)])
        self._kept: list[GridSnapshot] = []
        self._strokes: deque[GridUpdate] = deque()

    def __getitem__(self, robot: int) -> SeenGrid:
        return self._grids[robot]

    def save_for_undo(self, tick: int, renaming: LandmarkIdMap) -> None:
        """Keep the grids of both sides of a merge, before they absorb each other's.

        Args:
            tick: Whose readings are painted next.
            renaming: Of the merge.
        """
        sides = renaming.robots_a, renaming.robots_b
        grids = with_read_only({robot: self._grids[robot].get_state() for robot in sides[0] + sides[1]})
        self._kept.append(GridSnapshot(tick, sides, renaming.maps, grids, tuple(self._strokes)))

    def step(
        self,
        tick: int,
        report: TeamReport,
        mates: Sequence[tuple[int, ...]],
        points: TeamPoses,
        scans: FloatArray,
        bumps: BoolArray,
    ) -> None:
        """Go along with what became of the maps in a tick, and paint what each robot scans where it belongs.

        That is into the grids of all robots that go by its filter.

        Args:
            tick: Of the readings.
            report: Of the tick.
            mates: As `share_on_contact` takes them.
            points: Where the robots stand now.
            scans: (K, R) float64 [m]. Of this tick.
            bumps: (K,) bool. Who bumped into something.

        Raises:
            ValueError: If a range is out of its limits.
        """
        if report.map_changes or self._strokes:
            self._apply_report(tick, report)
        if mates != self._mates:
            self.share_on_contact(tick, mates, points.starts)
        self.team.update(self._shared, points.poses, scans, bumps, *self._hardware)
        if self._kept or self._oldest_parting is not None:
            self._strokes.append(with_constants(GridUpdate(tick, self._shared_then, points.poses, scans, bumps)))

    def _apply_report(self, tick: int, report: TeamReport) -> None:
        """Keep grids for an undo, undo, and forget what can no longer be undone."""
        for entry in report.map_changes:
            if isinstance(entry, LandmarkIdMap) and entry in report.id_maps:
                self.save_for_undo(tick, entry)
            elif isinstance(entry, MergeUndone):
                self._undo(tick, entry)
            elif isinstance(entry, MapReleased):
                self._kept = [kept for kept in self._kept if entry.number not in kept.maps[:2]]
        if self._oldest_parting is not None and self._oldest_parting < tick - MAX_ABSENCE:
            self._update_absences(tick)
        oldest = tick
        if self._kept:  # in order of time; what somebody missed then may be told since
            oldest = self._kept[0].updates[0].tick if self._kept[0].updates else self._kept[0].tick
        if self._oldest_parting is not None:
            oldest = min(oldest, self._oldest_parting)
        while self._strokes and self._strokes[0].tick < oldest:
            self._strokes.popleft()

    def _undo(self, tick: int, undone: MergeUndone) -> None:
        """Restore the grids from before a merge and paint again what the robots of each side have scanned since."""
        kept = next((kept for kept in self._kept if kept.maps == undone.maps), None)
        if kept is None:
            return  # it was made and undone within a tick
        self._kept.remove(kept)
        for robot in kept.sides[0] + kept.sides[1]:
            self._grids[robot].set_state(kept.grids[robot])
        self._strokes, again = map(deque, split_history(self._strokes, kept.updates, kept.sides))
        for strokes in again:
            self._replay(strokes)
        one, two = kept.sides
        self._parted[np.ix_(one, two)] = self._parted[np.ix_(two, one)] = NEVER_MET
        side_of = {robot: side for side in kept.sides for robot in side}
        mates = [
            tuple(mate for mate in group if mate in side_of.get(robot, group))
            for robot, group in enumerate(self._mates)
        ]
        self._settle(tick, mates)

    def share_on_contact(self, tick: int, mates: Sequence[tuple[int, ...]], starts: FloatArray) -> None:
        """Let robots that have come together absorb, or paint, what the others have seen.

        Args:
            tick: Whose readings are painted next.
            mates: Per robot those that go by the same filter now, itself included.
            starts: (K, 3) [m, m, rad]. The motion from the map frame to each robot's start frame.
        """
        tellings = [telling for now in sorted(set(mates)) for telling in self._plan_transfers(now, starts)]
        if tellings:
            grids = {telling.source: self._grids[telling.source].copy() for telling in tellings if telling.is_whole}
            for telling in tellings:
                if telling.is_whole:
                    self._grids[telling.target].merge(grids[telling.source], telling.motion)
            first = max(0, len(self._strokes) - max(tick - telling.since for telling in tellings))
            after, missed = plan_catch_up(list(islice(self._strokes, first, None)), tellings)
            for row, strokes in enumerate(after, first):
                self._strokes[row] = strokes
            for strokes in missed:
                self._replay(strokes)
        self._settle(tick, mates)

    def _plan_transfers(self, now: tuple[int, ...], starts: FloatArray) -> Iterator[GridTransfer]:
        """Yield who of those who are together now is told by whom; of strangers one is told all that the other has."""
        before = sorted({tuple(mate for mate in self._mates[robot] if mate in now) for robot in now})
        for part, other in permutations(before, 2):
            # Robots that were together have seen the same already, so that one of each part stands for all of it.
            since = int(self._parted[np.ix_(part, other)].min())
            for robot in part:
                motion = compose(starts[robot], inverse(starts[other[0]]))
                yield GridTransfer(other[0], robot, motion, since, since == NEVER_MET)

    def _replay(self, strokes: GridUpdate) -> None:
        """Paint what was read in an earlier tick."""
        _, shared, poses, scans, bumps = strokes
        # Copies: kernels are compiled for arrays as the world gives them, of which bumps alone are read-only.
        self.team.update(shared.copy(), poses.copy(), scans.copy(), bumps, *self._hardware)

    def _settle(self, tick: int, mates: Sequence[tuple[int, ...]]) -> None:
        """Take note of who goes by the same filter as whom from a tick on."""
        self._mates = tuple(mates)
        together = np.array([[robot in group for robot in range(len(mates))] for group in mates])
        self._shared = together.astype(np.int64)
        self._shared_then = as_constant(self._shared)  # as strokes hold it
        self._parted[(self._parted == CONNECTED) & ~together] = tick
        self._parted[together] = CONNECTED
        self._update_absences(tick)

    def _update_absences(self, tick: int) -> None:
        """Note since when strokes are needed because robots lost each other; forget who has been away for long."""
        self._parted[(self._parted >= 0) & (self._parted < tick - MAX_ABSENCE)] = NEVER_MET
        since = self._parted[self._parted >= 0]
        self._oldest_parting = int(since.min()) if len(since) else None

    @property
    def grid_updates(self) -> dict[int, GridUpdate]:
        """All strokes that are kept, by `id`; to be looked at."""
        return {id(one): one for history in (self._strokes, *(k.updates for k in self._kept)) for one in history}

    def get_state(self) -> dict[str, Any]:
        """Return all that decides how the grids go on; what is shared is read-only."""
        return {
            "grids": [grid.get_state() for grid in self._grids],
            "mates": self._mates,
            "parted": self._parted.copy(),
            "kept": tuple(self._kept),
            "strokes": tuple(self._strokes),
        }

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Go on as the grids that gave `state`, in place: views of them follow."""
        for grid, seen in zip(self._grids, state["grids"], strict=True):
            grid.set_state(seen)
        self._parted[:] = state["parted"]
        self._settle(0, state["mates"])
        self._kept, self._strokes = with_constants(list(state["kept"])), deque(with_constants(state["strokes"]))
