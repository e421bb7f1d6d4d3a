"""Grids of robots that lose each other and return hold what those hold that were never apart."""

import numpy as np
import pytest
from builders.environments import ANGLES, MAX_RANGE, MEETING, building, cast, small_env, turning

from slam_backend.fastslam.relative_poses import TeamPoses
from slam_backend.fastslam.reports import Associations
from slam_backend.geometry import between, compose, inverse
from slam_backend.models.camera import StereoCamera
from slam_backend.state import restore, take
from slam_backend.team.reports import LandmarkIdMap, MergeUndone, TeamReport
from vslam_env.belief.belief import RobotHardware
from vslam_env.belief.shared_grids import MAX_ABSENCE, GridTransfer, GridUpdate, SharedGrids, plan_catch_up
from vslam_env.navigation import OCCUPIED, UNKNOWN

BODY = RobotHardware(radius=0.2, ray_angles=ANGLES, scan_range=MAX_RANGE)
STARTS = np.array([[7.3, 2.5, 1.5], [8.6, 1.8, 2.1], [6.2, 2.9, -2.0]])  # of three robots, in one room of the building
NEAR, FAR = [5.4, 0.4, -4.0], [9.6, 4.1, 4.0]  # corners of that room; headings as they come
ALL, NONE = ((0, 1, 2),) * 3, ((0,), (1,), (2,))
NOTHING, NO_MOTION = np.empty(0, np.int64), np.zeros(3)
Mates = tuple[tuple[int, ...], ...]


def stand(path: np.ndarray) -> TeamPoses:
    """Return where robots at true poses (3, 3) believe themselves and each other to be, who know it well."""
    team_poses = TeamPoses(3)
    for own in range(3):
        team_poses.poses[own] = between(STARTS[own], path)
        team_poses.starts[own] = inverse(STARTS[own])  # the map frame is that of the building
    team_poses.own[:] = team_poses.poses[np.arange(3), np.arange(3)]
    return team_poses


class Drive:
    """Three robots in a building, whose grids follow them.

    Args:
        seed: Seed of the drives.
    """

    def __init__(self, seed: int) -> None:
        self.grids, self.tick = SharedGrids(3, BODY, StereoCamera()), 0
        self._rng, self._path = np.random.default_rng(seed), STARTS.copy()

    def on(self, mates: Mates, *entries: LandmarkIdMap | MergeUndone, off: np.ndarray = NO_MOTION) -> None:
        """Drive on for a tick, with these in contact, after what became of maps; 0 and 1 see each other `off`."""
        way = self._rng.uniform([-0.05, -0.05, -0.2], [0.15, 0.05, 0.2], (3, 3))
        self._path = np.clip(compose(self._path, way), NEAR, FAR)
        scans = np.array([cast(building(), pose) for pose in self._path])
        team_poses, merges = stand(self._path), tuple(entry for entry in entries if isinstance(entry, LandmarkIdMap))
        team_poses.poses[0, 1], team_poses.poses[1, 0] = (
            compose(off, team_poses.poses[0, 1]),
            compose(off, team_poses.poses[1, 0]),
        )
        told = Associations.from_arrays([NOTHING], [NOTHING])
        report = TeamReport(self.tick, told, mates, (), merges, (0, 0, 0), entries, self.tick + 1)
        self.grids.step(self.tick, report, mates, team_poses, scans, np.zeros(3, np.bool_))
        self.tick += 1

    def cells(self) -> np.ndarray:
        """Return all verdicts (3, 300, 300)."""
        return np.array([self.grids[robot].cells for robot in range(3)])


def parted(rng: np.random.Generator) -> Mates:
    """Return who is in contact with whom where any link may fail."""
    patterns: list[Mates] = [ALL, NONE, ((0, 1), (0, 1), (2,)), ((0, 2), (1,), (0, 2)), ((0,), (1, 2), (1, 2))]
    return patterns[int(rng.integers(len(patterns)))]


@pytest.mark.parametrize("seed", range(100, 104))
def test_returning_robots_have_the_grids_of_unbroken_contact(seed: int) -> None:
    """But for the order of what was painted: each scan went into each grid once, by whichever way it came."""
    rng, lossy, steady = np.random.default_rng(seed), Drive(seed), Drive(seed)
    for drive, patterns in ((steady, [ALL] * 150), (lossy, [ALL] + [parted(rng) for _ in range(148)] + [ALL])):
        for mates in patterns:
            drive.on(mates)
    ours, theirs = lossy.cells(), steady.cells()
    assert ((ours == UNKNOWN) == (theirs == UNKNOWN)).all()
    assert (ours != theirs).sum() < 0.01 * (theirs != UNKNOWN).sum()
    ours, theirs = (drive.grids.looks.counts.astype(int) for drive in (lossy, steady))
    assert theirs.sum() > 1000
    assert np.abs(ours - theirs).sum() < 0.02 * theirs.sum()


def test_meeting_again_without_new_scans_changes_nothing() -> None:
    """However often, in whatever frames."""
    drive = Drive(100)
    for _ in range(20):
        drive.on(ALL)
    before, looks = drive.cells(), drive.grids.looks.counts.copy()
    team_poses = stand(STARTS)
    for tick in range(drive.tick, drive.tick + 50):
        drive.grids.share_on_contact(tick, NONE, team_poses.starts)
        drive.grids.share_on_contact(tick, ALL, team_poses.starts)
    assert (drive.cells() == before).all()
    assert (drive.grids.looks.counts == looks).all()


def test_the_history_of_scans_is_bounded() -> None:
    """What is kept of the time apart is bounded; after it they absorb each other's grids."""
    drive = Drive(100)
    drive.on(ALL)
    for _ in range(MAX_ABSENCE + 5):
        drive.on(((0, 1), (0, 1), (2,)))
        assert len(drive.grids._updates) <= MAX_ABSENCE + 1
    assert not drive.grids._updates
    alone = drive.cells()
    drive.on(ALL)
    known = drive.cells() != UNKNOWN
    assert (known.sum(axis=(1, 2)) > (alone != UNKNOWN).sum(axis=(1, 2)))[2]


def test_restored_grids_continue_with_missed_scans() -> None:
    """A state taken while robots are out of contact leads to the same cells."""
    rng, drive = np.random.default_rng(100), Drive(100)
    for mates in [ALL] * 3 + [parted(rng) for _ in range(20)]:
        drive.on(mates)
    other = SharedGrids(3, BODY, StereoCamera())
    restore(other, take(drive.grids))
    team_poses, nothing = stand(STARTS), np.full((3, len(ANGLES)), MAX_RANGE)
    report = TeamReport(
        drive.tick, Associations.from_arrays([NOTHING], [NOTHING]), ALL, (), (), (0, 0, 0), (), drive.tick + 1
    )
    for grids in (drive.grids, other):
        grids.step(drive.tick, report, ALL, team_poses, nothing, np.zeros(3, np.bool_))
    for robot in range(3):
        assert (drive.grids[robot].cells == other[robot].cells).all()
    assert (drive.grids.looks.counts == other.looks.counts).all()


def test_scans_are_sent_once() -> None:
    """Of two that hold the same, one sends it; what is known is noted, not sent; others hand on what they received."""
    shared = np.array([[1, 1, 0], [1, 1, 0], [0, 0, 1]])
    update = GridUpdate(7, shared, np.zeros((3, 3, 3)), np.ones((3, 2)), np.zeros(3, np.bool_))
    motion = np.array([1.0, 2.0, 0.5])
    tellings = [
        GridTransfer(0, 2, motion, 0, False),
        GridTransfer(1, 2, motion, 0, False),
        GridTransfer(2, 0, -motion, 0, True),
    ]
    (after,), (missed,) = plan_catch_up([update], tellings)
    assert missed.shared.tolist() == [[0, 0, 0], [0, 0, 0], [1, 1, 0]]
    assert after.shared.tolist() == [[1, 1, 1], [1, 1, 0], [1, 1, 1]]
    np.testing.assert_array_equal(missed.poses[2, :2], [motion, motion])
    (later,), (missed,) = plan_catch_up([after], [GridTransfer(0, 1, motion, 0, False)])
    assert later.shared.all()
    assert missed.shared.tolist() == [[0, 0, 0], [0, 0, 1], [0, 0, 0]]
    assert update.shared is shared
    assert shared.sum() == 5
    assert plan_catch_up([], tellings) == ([], [])


MERGED = LandmarkIdMap((0, 2), (1,), np.empty((0, 2), np.int64), (0, 1, 3))
UNDONE = MergeUndone(MERGED.maps)
PAIR, WITHOUT = ((0, 2), (1,), (0, 2)), ((0, 1), (0, 1), (2,))


def test_scans_of_an_undone_merge_do_not_reach_absent_robots() -> None:
    """A robot that was away during merge and undo receives the scans of its own group only."""
    drives = Drive(100), Drive(100)
    for drive, was_merged in zip(drives, (True, False), strict=True):
        for mates in [PAIR] * 5 + [NONE] * 5:
            drive.on(mates)
        for i in range(15):
            merges = [MERGED] if was_merged and i == 0 else []
            drive.on(WITHOUT if was_merged else NONE, *merges, off=np.array([3.0, -2.0, 1.0]))
        for mates, *undos in [(NONE, UNDONE), (NONE,), (PAIR,), (PAIR,)]:
            drive.on(mates, *(undos if was_merged else ()))
    assert (drives[0].cells() == drives[1].cells()).all()


def test_scans_shared_within_a_side_survive_an_undo() -> None:
    """Scans from before the merge that robots of a side exchanged are applied again after the undo."""
    drives = Drive(101), Drive(101)
    for drive, was_merged in zip(drives, (True, False), strict=True):
        for mates in [PAIR] * 5 + [NONE] * 20:
            drive.on(mates)
        for i in range(6):
            merges = [MERGED] if was_merged and i == 0 else []
            apart = i < 3
            drive.on((WITHOUT if apart else ALL) if was_merged else (NONE if apart else PAIR), *merges)
        for i in range(5):
            drive.on(PAIR, *([UNDONE] if was_merged and i == 0 else []))
    ours, theirs = (drive.cells() for drive in drives)
    assert ((ours == UNKNOWN) == (theirs == UNKNOWN)).all()
    assert (ours != theirs).sum() < 0.01 * (theirs != UNKNOWN).sum()
    ours, theirs = (drive.grids.looks.counts.astype(int) for drive in drives)
    assert theirs.sum() > 1000
    assert np.abs(ours - theirs).sum() < 0.02 * theirs.sum()


def test_a_scan_history_owns_its_arrays() -> None:
    """Updates that were added to own their arrays: views would keep the whole history of each meeting alive."""
    rng, drive = np.random.default_rng(100), Drive(100)
    for mates in [ALL] * 2 + [((0,), (1,), (2,)), ((0, 1), (0, 1), (2,))] * 20 + [parted(rng) for _ in range(20)]:
        drive.on(mates)
    assert drive.grids._updates
    for own in drive.grids._updates:
        for array in (own.shared, own.poses):
            assert isinstance(array.base, bytes)
            assert len(array.base) == array.nbytes


def test_radios_that_lose_half_leave_walls_as_thin_as_they_are() -> None:
    """In an environment: as many cells are occupied, to a fifth, as where nothing is lost."""
    occupied = []
    for loss in (0.0, 0.5):
        env = small_env(comm_loss=loss, oracle_merge=True, max_cycles=200)
        env.reset(seed=100, options={"start_poses": MEETING})
        while env.agents:
            env.step(turning(env.agents))
        assert env.belief("robot_0").group == (0, 1)
        occupied.append(sum(int((env.belief(agent).grid.cells == OCCUPIED).sum()) for agent in env.possible_agents))
    assert occupied[1] < 1.2 * occupied[0]
