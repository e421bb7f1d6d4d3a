"""`SharedGrids`: the robots' seen grids, what they tell each other of the floor, and how a wrong merge is wiped out."""

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from slam_backend.errors import BoolArray, FloatArray, IntArray
from slam_backend.geometry import compose, inverse
from slam_backend.reports import MapDropped, MergeUndone, Renaming, TeamReport
from slam_backend.standpoints import Standpoints
from vslam_env.navigation import SeenGrid, TeamGrids, ray_directions
from vslam_env.robot_belief import Body


class Strokes(NamedTuple):
    """What the readings of one tick wrote into the grids, as `TeamGrids.paint_readings` takes it.

    Attributes:
        tick: Of the readings.
        shared: (K, K) int64. 1 where i's grid took what robot j read.
        poses: (K, K, 3) [m, m, rad]. Where robot j was believed to be in i's start frame.
        scans: (K, R) [m].
        bumps: (K,) bool. Who bumped into something.
    """

    tick: int
    shared: IntArray
    poses: FloatArray
    scans: FloatArray
    bumps: BoolArray

    def within(self, side: Sequence[int]) -> "Strokes":
        """Return those of some robots' readings that went into these robots' grids."""
        own = np.isin(np.arange(len(self.shared)), side)
        return self._replace(shared=self.shared * own * own[:, None])


class Kept(NamedTuple):
    """Grids as they were just before a merge.

    Attributes:
        tick: Of the merge; what was painted later is not in them.
        sides: The robots of either group.
        maps: Numbers of a's map, of b's and of the joint one.
        grids: State of each robot's grid.
    """

    tick: int
    sides: tuple[tuple[int, ...], tuple[int, ...]]
    maps: tuple[int, int, int]
    grids: dict[int, dict[str, Any]]


class SharedGrids:
    """The seen grids of a team, each in its robot's own start frame.

    Robots that go by one filter paint what each of them scans into all of their grids. Those that come together, by a
    merge or on return, absorb each other's grids; evidence is bounded, so that what both had already only gets firmer.
    While a merge can be undone the grids from before it are kept, with what was painted since; an undo restores them
    and paints again what the robots of each side scanned.

    Args:
        num_robots: K.
        body: The robots' hardware.

    Attributes:
        team: All grids, in the order of robots.
    """

    def __init__(self, num_robots: int, body: Body) -> None:
        self.team = TeamGrids(num_robots)
        self._grids = self.team.grids
        self._hardware = ray_directions(body.ray_angles), float(body.scan_range), float(body.radius)
        self._settle([(robot,) for robot in range(num_robots)])
        self._kept: list[Kept] = []
        self._strokes: deque[Strokes] = deque()

    def __getitem__(self, robot: int) -> SeenGrid:
        return self._grids[robot]

    def keep(self, tick: int, renaming: Renaming) -> None:
        """Keep the grids of both sides of a merge, before they absorb each other's.

        Args:
            tick: Whose readings are painted next.
            renaming: Of the merge.
        """
        sides = renaming.robots_a, renaming.robots_b
        grids = {robot: self._grids[robot].get_state() for robot in sides[0] + sides[1]}
        self._kept.append(Kept(tick, sides, renaming.maps, grids))

    def step(
        self,
        tick: int,
        report: TeamReport,
        mates: Sequence[tuple[int, ...]],
        points: Standpoints,
        scans: FloatArray,
        bumps: BoolArray,
    ) -> None:
        """Go along with what became of the maps in a tick, and paint what each robot scans where it belongs.

        That is into the grids of all robots that go by its filter.

        Args:
            tick: Of the readings.
            report: Of the tick.
            mates: As `meet` takes them.
            points: Where the robots stand now.
            scans: (K, R) float64 [m]. Of this tick.
            bumps: (K,) bool. Who bumped into something.

        Raises:
            ValueError: If a range is out of its limits.
        """
        if report.entries or self._strokes:
            self._follow(tick, report)
        if mates != self._mates:
            self.meet(mates, points.starts)
        self.team.paint_readings(self._shared, points.poses, scans, bumps, *self._hardware)
        if self._kept:
            self._strokes.append(Strokes(tick, self._shared, points.poses.copy(), scans.copy(), bumps.copy()))

    def _follow(self, tick: int, report: TeamReport) -> None:
        """Keep grids for an undo, undo, and forget what can no longer be undone."""
        for entry in report.entries:
            if isinstance(entry, Renaming) and entry in report.renamings:
                self.keep(tick, entry)
            elif isinstance(entry, MergeUndone):
                self._undo(entry)
            elif isinstance(entry, MapDropped):
                self._kept = [kept for kept in self._kept if entry.number not in kept.maps[:2]]
        oldest = self._kept[0].tick if self._kept else tick  # both stand in order of time
        while self._strokes and self._strokes[0].tick < oldest:
            self._strokes.popleft()

    def _undo(self, undone: MergeUndone) -> None:
        """Restore the grids from before a merge and paint again what the robots of each side have scanned since."""
        kept = next((kept for kept in self._kept if kept.maps == undone.maps), None)
        if kept is None:
            return  # it was made and undone within a tick
        self._kept.remove(kept)
        for side in kept.sides:
            for robot in side:
                self._grids[robot].set_state(kept.grids[robot])
            for strokes in self._strokes:
                if strokes.tick >= kept.tick:
                    self.team.paint_readings(*strokes.within(side)[1:], *self._hardware)
        side_of = {robot: side for side in kept.sides for robot in side}
        self._settle(
            [
                tuple(mate for mate in mates if mate in side_of.get(robot, mates))
                for robot, mates in enumerate(self._mates)
            ]
        )

    def meet(self, mates: Sequence[tuple[int, ...]], starts: FloatArray) -> None:
        """Let robots that have come together absorb what the others have seen.

        Args:
            mates: Per robot those that go by the same filter now, itself included.
            starts: (K, 3) [m, m, rad]. The motion from the map frame to each robot's start frame.
        """
        for now in sorted(set(mates)):
            before = sorted({tuple(mate for mate in self._mates[robot] if mate in now) for robot in now})
            if len(before) > 1:
                # Robots that were together have seen the same already, so that one of each part stands for all of it.
                grids = [self._grids[part[0]].copy() for part in before]
                for part in before:
                    for other, grid in zip(before, grids, strict=True):
                        if other is not part:
                            for robot in part:
                                own_from_other = compose(starts[robot], inverse(starts[other[0]]))
                                self._grids[robot].absorb(grid, own_from_other)
        self._settle(mates)

    def _settle(self, mates: Sequence[tuple[int, ...]]) -> None:
        """Take note of who goes by the same filter as whom."""
        self._mates = tuple(mates)
        self._shared = np.array([[robot in group for robot in range(len(mates))] for group in mates], np.int64)

    def get_state(self) -> dict[str, Any]:
        """Return all that decides how the grids go on; what is never written to is shared."""
        return {
            "grids": [grid.get_state() for grid in self._grids],
            "mates": self._mates,
            "kept": tuple(self._kept),
            "strokes": tuple(self._strokes),
        }

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Go on as the grids that gave `state`, in place: views of them follow."""
        for grid, seen in zip(self._grids, state["grids"], strict=True):
            grid.set_state(seen)
        self._settle(state["mates"])
        self._kept, self._strokes = list(state["kept"]), deque(state["strokes"])
