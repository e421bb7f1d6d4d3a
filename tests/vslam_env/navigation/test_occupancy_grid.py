"""Occupancy grids, updated scan by scan or for a whole team at once."""

import numpy as np
import pytest
from builders.environments import ANGLES, MAX_RANGE, scan
from builders.plain_scan_update import PLAIN_SIZE, plain_scan_update
from hypothesis import given
from hypothesis import strategies as st

from slam_backend.geometry import transform_points
from slam_backend.state import restore, take
from vslam_env.navigation import (
    CELL,
    FREE,
    GRID_SIZE,
    OCCUPIED,
    UNKNOWN,
    OccupancyGrid,
    TeamGrids,
    cell_of,
    centre_of,
    distance_map,
    find_frontiers,
    plan_path,
    ray_directions,
)
from vslam_env.navigation._grid_kernels import LARGEST_SIZE
from vslam_env.navigation.grid_storage import GRID_SIZES

ALL_CENTRES = centre_of(np.stack(np.meshgrid(np.arange(GRID_SIZE), np.arange(GRID_SIZE), indexing="ij"), axis=-1))


def wall_ranges(distance: float) -> np.ndarray:
    """Return the ranges to a wall across the robot's way."""
    return np.minimum(distance / np.cos(ANGLES), MAX_RANGE)


def cells_at(grid: OccupancyGrid, points: np.ndarray) -> np.ndarray:
    """Return the verdicts at points (n, 2)."""
    rows, cols = cell_of(points, len(grid.cells)).T
    return grid.cells[rows, cols]


def evidence_of(grid: OccupancyGrid, size: int) -> np.ndarray:
    """Return the evidence (size, size) of a grid."""
    (row, col), evidence = grid.known
    shift, whole = (size - GRID_SIZE) // 2, np.zeros((size, size), np.int8)
    whole[row + shift : row + shift + len(evidence), col + shift : col + shift + evidence.shape[1]] = evidence
    return whole


@given(st.integers(0, GRID_SIZE - 1), st.integers(0, GRID_SIZE - 1))
def test_a_cell_holds_its_own_centre(row: int, col: int) -> None:
    """The centre of a cell lies in that cell, and x goes with columns."""
    centre = centre_of([row, col])
    assert cell_of(centre).tolist() == [row, col]
    assert cell_of(centre + np.array([CELL, 0.0])).tolist() == [row, col + 1]


@given(
    st.tuples(st.floats(-15, 15), st.floats(-15, 15), st.floats(-7, 7)),
)
def test_an_open_view_leaves_no_speckles(pose: tuple[float, float, float]) -> None:
    """All cells in view of a scan that hits nothing are free, and no other cell is touched."""
    grid = OccupancyGrid()
    grid.update_from_scan(pose, np.full(32, MAX_RANGE), ANGLES)
    offset = ALL_CENTRES - np.array(pose[:2])
    bearing = (np.arctan2(offset[..., 1], offset[..., 0]) - pose[2] + np.pi) % (2 * np.pi) - np.pi
    distance = np.hypot(offset[..., 0], offset[..., 1])
    in_view = (np.abs(bearing) < ANGLES[-1] - 1e-6) & (distance < MAX_RANGE - 1e-6)
    beyond = (np.abs(bearing) > ANGLES[-1] + 1e-6) | (distance > MAX_RANGE + 1e-6)
    away = distance > 1e-6  # the cell whose centre is the robot's has no bearing
    assert (grid.cells[in_view & away] == FREE).all()
    assert (grid.cells[beyond & away] == UNKNOWN).all()


@pytest.mark.parametrize("distance", [0.9, 2.3, 3.05, 5.5, 6.97])
def test_a_wall_is_marked_without_holes(distance: float) -> None:
    """Before a wall all is free, on it occupied, behind it unknown."""
    grid = OccupancyGrid()
    grid.update_from_scan((0.0, 0.0, 0.0), wall_ranges(distance), ANGLES)
    across = np.linspace(-0.4, 0.4, 41) * distance
    before = np.stack([np.full(41, distance - 0.3), across * 0.8], axis=-1)
    behind = np.stack([np.full(41, distance + 0.4), across], axis=-1)
    assert (cells_at(grid, before) == FREE).all()
    assert (cells_at(grid, behind) == UNKNOWN).all()
    near = [cells_at(grid, np.stack([np.full(41, distance + d), across], axis=-1)) for d in (-0.1, 0.0, 0.1)]
    assert (np.stack(near) == OCCUPIED).any(axis=0).all()


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "fan"), [
    (1, ANGLES), pytest.param(2, np.linspace(-1.5, 1.5, 40), marks=pytest.mark.nightly), (3, np.array([-0.3, 0.4])),
])  # fmt: skip
def test_a_scan_update_agrees_with_the_plain_definition(seed: int, fan: np.ndarray) -> None:
    """Scans of walls, gaps and nothing, wherever the robot stands and looks, change the evidence as the plain form."""
    rng = np.random.default_rng(seed)
    grid, plain = OccupancyGrid(), np.zeros((PLAIN_SIZE, PLAIN_SIZE), np.int8)
    for k in range(40):
        pose = np.append(
            rng.uniform(-45.0, 45.0, 2) if k % 4 == 3 else rng.uniform(-2.0, 2.0, 2), rng.uniform(-7.0, 7.0)
        )
        ranges = rng.uniform(0.5, 7.0) / np.cos(fan - rng.uniform(-0.2, 0.2)) + rng.normal(0.0, 0.02, len(fan))
        ranges = np.abs(
            np.where(rng.random(len(fan)) < rng.choice([0.0, 0.2]), rng.uniform(0.0, 9.0, len(fan)), ranges)
        )
        ranges[rng.random(len(fan)) < rng.choice([0.0, 0.5])] = MAX_RANGE
        grid.update_from_scan(pose, ranges, fan)
        plain = plain_scan_update(plain, pose, ranges, fan, MAX_RANGE)
        assert (evidence_of(grid, PLAIN_SIZE) == plain).all()
        verdicts = np.where(plain == 0, UNKNOWN, np.where(plain > 0, OCCUPIED, FREE))
        inset = (PLAIN_SIZE - len(grid.cells)) // 2
        assert (grid.cells == verdicts[inset : PLAIN_SIZE - inset, inset : PLAIN_SIZE - inset]).all()
    assert len(grid.cells) == PLAIN_SIZE


def test_a_grid_keeps_the_bounds_of_what_it_knows() -> None:
    """However it is painted, joined and restored, they are the least and largest row and column of it."""
    rng = np.random.default_rng(5)
    team, other = TeamGrids(1), OccupancyGrid()
    (grid,), (bounds,) = team.grids, team.bounds
    assert bounds.tolist() == [0, 0, 0, 0]
    other.update_from_scan((3.0, -2.0, 1.0), wall_ranges(4.0), ANGLES)
    for k in range(30):
        before = take(grid)
        pose = np.append(rng.uniform(-31.0, 31.0, 2) if k % 3 == 0 else rng.uniform(-3.0, 3.0, 2), rng.uniform(-3, 3))
        grid.update_from_scan(pose, rng.uniform(0.3, 9.0, 32), ANGLES)
        grid.clear_disc(pose)
        grid.bump(pose)
        if k % 5 == 0:
            grid.merge(other, pose)
        if k % 7 == 0:
            restore(grid, before)
        rows, columns = np.nonzero(grid.cells)
        if len(rows) > 0:
            assert bounds.tolist() == [rows.min(), columns.min(), rows.max() + 1, columns.max() + 1]
    assert len(rows) > 0


def test_a_doorway_between_two_rays_is_not_walled_up() -> None:
    """Two hits beside an opening that a robot fits through leave it open."""
    grid = OccupancyGrid()
    ranges = wall_ranges(3.0)
    ranges[12:20] = MAX_RANGE  # 0.8 m wide
    grid.update_from_scan((0.0, 0.0, 0.0), ranges, ANGLES)
    inside = np.stack([np.full(9, 3.0), np.linspace(-0.2, 0.2, 9)], axis=-1)
    assert (cells_at(grid, inside) == FREE).all()


def test_grazing_rays_do_not_eat_thin_walls() -> None:
    """A wall of no thickness stays closed while a robot drives along it, 0.35 m away, with noisy ranges.

    Chance of a false alarm: none, the seed is fixed.
    """
    rng = np.random.default_rng(3)
    walls = np.array([[-20.0, 0.35, 20.0, 0.35], [-20.0, -1.4, 20.0, -1.4]])
    grid = OccupancyGrid()
    for x in np.arange(-5.0, 5.0, 0.05):
        pose = np.array([x, 0.0, 0.0])
        grid.update_from_scan(pose, scan(walls, pose, rng), ANGLES)
        grid.clear_disc(pose)
    along = np.linspace(-2.3, 6.0, 400)  # farther on, single rays hit too far apart to tell
    for y in (0.35, -1.4):
        across = [cells_at(grid, np.stack([along, np.full(400, y + d)], axis=-1)) for d in (-0.1, 0.0, 0.1)]
        assert (np.stack(across) == OCCUPIED).any(axis=0).all()
    assert (cells_at(grid, np.stack([along, np.zeros(400)], axis=-1)) == FREE).all()


def test_one_outlier_does_not_block_a_path() -> None:
    """A hit where ten scans passed changes nothing; a wall that stays is believed."""
    grid = OccupancyGrid()
    for _ in range(10):
        grid.update_from_scan((0.0, 0.0, 0.0), wall_ranges(6.0), ANGLES)
    grid.update_from_scan((0.0, 0.0, 0.0), wall_ranges(3.1), ANGLES)
    assert cells_at(grid, np.array([[3.1, 0.05]])) == [FREE]
    for _ in range(3):
        grid.update_from_scan((0.0, 0.0, 0.0), wall_ranges(3.1), ANGLES)
    assert cells_at(grid, np.array([[3.1, 0.05]])) == [OCCUPIED]


def test_moved_obstacles_are_cleared() -> None:
    """A robot that stood in view for long leaves no wall behind once rays pass again for two seconds."""
    grid = OccupancyGrid()
    for distance, ticks in ((3.1, 100), (6.0, 20)):
        for _ in range(ticks):
            grid.update_from_scan((0.0, 0.0, 0.0), wall_ranges(distance), ANGLES)
    assert (cells_at(grid, np.stack([np.linspace(0.3, 5.5, 50), np.zeros(50)], axis=-1)) == FREE).all()


def test_the_robots_place_is_free_but_the_wall_it_touches_stays() -> None:
    """A disc frees unknown cells and what lies wholly inside it, not the wall at its rim."""
    grid = OccupancyGrid()
    grid.update_from_scan((0.05, 0.1, 0.0), wall_ranges(0.95), ANGLES)
    assert cells_at(grid, np.array([[1.0, 0.1]])) == [OCCUPIED]
    grid.clear_disc((0.75, 0.1, 0.0), radius=0.3)
    assert cells_at(grid, np.array([[0.75, 0.1], [0.75, -0.1]])).tolist() == [FREE, FREE]
    assert cells_at(grid, np.array([[1.0, 0.1]])) == [OCCUPIED]
    grid.clear_disc((1.0, 0.1, 0.0), radius=0.3)
    assert cells_at(grid, np.array([[1.0, 0.1]])) == [FREE]


def test_a_bump_marks_what_is_ahead() -> None:
    """After a bump the cell ahead is occupied, until rays pass through it for a second."""
    grid = OccupancyGrid()
    pose = (1.0, -2.0, np.pi / 2)
    grid.clear_disc(pose)
    grid.bump(pose)
    assert cells_at(grid, np.array([[1.01, -1.7]])) == [OCCUPIED]
    for _ in range(10):
        grid.update_from_scan((1.0, -2.5, np.pi / 2), wall_ranges(4.0), ANGLES)
    assert cells_at(grid, np.array([[1.01, -1.7]])) == [FREE]


@pytest.mark.parametrize("pose", [(401.0, 3.0, np.pi), (399.9, -399.9, 0.3), (1e300, -1e300, 0.0), (0.0, 400.1, -1.5)])
def test_what_lies_outside_the_largest_grid_is_ignored(pose: tuple[float, float, float]) -> None:
    """Near and beyond the edge, all ways of painting work and touch only the cells that exist."""
    grid, other = OccupancyGrid(), OccupancyGrid()
    other.clear_disc((0.0, 0.0, 0.0), radius=2.0)
    grid.update_from_scan(pose, wall_ranges(3.0), ANGLES)
    grid.clear_disc(pose)
    grid.bump(pose)
    grid.merge(other, pose)
    assert grid.cells.shape == (LARGEST_SIZE, LARGEST_SIZE)


def test_a_grid_grows_with_what_was_seen_and_stays_the_same() -> None:
    """Content, frontiers, paths and merges of a grid that grew are those of one that was large from the beginning."""
    rng = np.random.default_rng(7)
    small, large, other = OccupancyGrid(), OccupancyGrid(), OccupancyGrid()
    large.clear_disc((250.0, 0.0, 0.0))
    assert len(large.cells) == GRID_SIZES[-1]
    restore(large, take(small))
    other.update_from_scan((25.0, 4.0, 0.0), wall_ranges(5.0), ANGLES)
    sizes = set()
    for x in np.arange(0.0, 130.0, 2.0):
        pose, ranges = np.array([x, -0.3 * x, rng.uniform(-3.0, 3.0)]), rng.uniform(3.0, 9.0, 32)
        for grid in (small, large):
            grid.update_from_scan(pose, ranges, ANGLES)
            grid.clear_disc(pose, 1.0)
            grid.bump(pose)
            if x % 40 == 0:
                grid.merge(other, pose)
        state, expected = small.known, large.known
        assert state.corner == expected.corner
        assert (state.values == expected.values).all()
        sizes.add(len(small.cells))
    assert sizes == set(GRID_SIZES[:4])
    for x in np.arange(0.0, 130.0, 0.5):  # a way through what the scans drew
        for grid in (small, large):
            grid.clear_disc((x, -0.3 * x, 0.0), 1.0)
    here, there = pose[:2], np.zeros(2)
    for make in (find_frontiers, distance_map):
        found, wanted = make(small, here), make(large, here)
        for name in ("goals", "headings", "sizes", "lengths") if make is find_frontiers else ("box", "cost", "parent"):
            assert (getattr(found, name) == getattr(wanted, name)).all()
    assert len(find_frontiers(small, here).goals) > 10
    assert (plan_path(small, here, there) == plan_path(large, here, there)).all()
    assert (plan_path(small, here, there) == plan_path(small.cells, here, there)).all()
    points = rng.uniform(-140.0, 140.0, (500, 2))
    assert (cells_at(small, points) == cells_at(large, points)).all()


def test_views_and_states_follow_a_grid_that_grows() -> None:
    """A view that was taken before a grid grew shows what it holds now, and an old state is restored exactly."""
    team = TeamGrids(2)
    grid, view = team.grids[0], team.grids[0].read_only_view()
    grid.update_from_scan((0.0, 0.0, 0.0), wall_ranges(3.0), ANGLES)
    before, known = take(grid), cells_at(grid, ALL_CENTRES.reshape(-1, 2))
    grid.update_from_scan((60.0, 0.0, 0.0), wall_ranges(3.0), ANGLES)
    assert (view.cells == grid.cells).all()
    assert cells_at(view, np.array([[60.5, 0.1]])) == [FREE]
    assert len(team.cells[1]) == len(view.cells) > GRID_SIZE
    assert not team.cells[1].any()
    restore(grid, before)
    assert (cells_at(view, ALL_CENTRES.reshape(-1, 2)) == known).all()
    assert np.count_nonzero(view.cells) == np.count_nonzero(known)
    assert len(grid.known.values) < 60


@given(st.tuples(st.floats(-8, 8), st.floats(-8, 8), st.floats(-4, 4)))
def test_absorbed_walls_stand_where_they_are_and_stay_closed(self_from_other: tuple[float, float, float]) -> None:
    """What another robot saw appears at its place in the own frame, its walls without holes."""
    grid, other = OccupancyGrid(), OccupancyGrid()
    for _ in range(4):
        other.update_from_scan((0.0, 0.0, 0.0), wall_ranges(4.1), ANGLES)
    grid.merge(other, self_from_other)
    wall = np.stack([np.full(300, 4.1), np.linspace(-1.7, 1.7, 300)], axis=-1)
    found = []
    for d in (-0.1, 0.0, 0.1):
        found.append(cells_at(grid, transform_points(self_from_other, wall + np.array([d, 0.0]))))
    assert (np.stack(found) == OCCUPIED).any(axis=0).all()
    floor = np.stack([np.linspace(0.5, 3.6, 50), np.zeros(50)], axis=-1)
    assert (cells_at(grid, transform_points(self_from_other, floor)) == FREE).all()


def test_absorbing_without_a_move_copies_and_keeps_the_other() -> None:
    """An empty grid that absorbs another one in the same frame knows the same floor, and the other stays as it was."""
    grid, other = OccupancyGrid(), OccupancyGrid()
    other.update_from_scan((1.0, 2.0, 0.4), wall_ranges(4.1), ANGLES)
    before = other.cells.copy()
    grid.merge(other, (0.0, 0.0, 0.0))
    assert (grid.cells == before).all()
    assert (other.cells == before).all()


def test_copies_are_independent_and_views_follow() -> None:
    """A copy keeps its content when the grid changes; a frozen view follows it and refuses changes."""
    grid = OccupancyGrid()
    copy, view = grid.copy(), grid.read_only_view()
    grid.clear_disc((0.1, 0.1, 0.0))
    assert not copy.cells.any()
    assert (view.cells == grid.cells).all()
    for write in (
        lambda: view.update_from_scan((0, 0, 0), wall_ranges(2.0), ANGLES),
        lambda: view.clear_disc((0, 0, 0)),
        lambda: view.bump((0, 0, 0)),
        lambda: view.merge(grid, (0, 0, 0)),
        lambda: restore(view, take(grid)),
    ):
        with pytest.raises(RuntimeError, match=r"read-only view. Make a copy\(\)"):
            write()
    with pytest.raises(ValueError, match="read-only"):
        view.cells[0, 0] = FREE


RADIUS = 0.2
HARDWARE = ray_directions(ANGLES), MAX_RANGE, RADIUS


def test_a_combined_update_equals_its_parts() -> None:
    """Each grid holds the result of scan, disc and bump in ascending order of robots."""
    rng = np.random.default_rng(4)
    team, apart = TeamGrids(3), [TeamGrids(1) for _ in range(3)]
    parts = [single.grids[0] for single in apart]
    for _ in range(30):
        shared = rng.integers(0, 2, (3, 3))
        poses = rng.uniform(-1.0, 1.0, (3, 3, 3)) * [9.0, 9.0, 3.0]
        scans, bumps = rng.uniform(0.3, 9.0, (3, 32)), rng.random(3) < 0.4
        team.update(shared, poses, scans, bumps, *HARDWARE)
        for owner, robot in np.argwhere(shared):
            pose = poses[owner, robot]
            parts[owner].update_from_scan(pose, scans[robot], ANGLES)
            parts[owner].clear_disc(pose, RADIUS)
            if bumps[robot]:
                parts[owner].bump(pose, RADIUS)
        for robot, (whole, part) in enumerate(zip(team.grids, parts, strict=True)):
            assert (evidence_of(whole, GRID_SIZE) == evidence_of(part, GRID_SIZE)).all()
            assert (whole.cells == part.cells).all()
            assert (team.cells[robot] == part.cells).all()


def test_places_are_entered_as_if_seen_often() -> None:
    """Cells of places are free or occupied, occupied where both are, the grid grows, and one scan changes none."""
    grid = OccupancyGrid()
    grid.enter([[1.0, 1.0], [2.0, 1.0], [-45.0, 3.0]], [[2.05, 1.05], [0.0, 55.0]])
    size = len(grid.cells)
    assert size > GRID_SIZE
    states = {(1.0, 1.0): FREE, (-45.0, 3.0): FREE, (2.0, 1.0): OCCUPIED, (0.0, 55.0): OCCUPIED, (5.0, 5.0): UNKNOWN}
    for place, state in states.items():
        assert grid.cells[tuple(cell_of(place, size))] == state
    top, left, bottom, right = grid.bounds
    assert (grid.cells != UNKNOWN).sum() == (grid.cells[top:bottom, left:right] != UNKNOWN).sum() == 4
    grid.update_from_scan([1.0, 1.0, 0.0], np.full(len(ANGLES), MAX_RANGE), ANGLES, MAX_RANGE)
    assert grid.cells[tuple(cell_of([2.0, 1.0], size))] == OCCUPIED
    with pytest.raises(RuntimeError, match="read-only"):
        grid.read_only_view().enter([], [])
