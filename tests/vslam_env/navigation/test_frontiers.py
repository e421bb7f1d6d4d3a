"""Frontiers, and the candidates that they make."""

import numpy as np
import pytest
from builders.environments import ANGLES, building, clearance, drive, in_start_frame, scan
from builders.kernels import python_entry
from scipy.optimize import linear_sum_assignment

from slam_backend.core.validation import FloatArray
from slam_backend.geometry import inverse, transform_points
from slam_backend.state import restore, take
from vslam_env.navigation import (
    CELL,
    FREE,
    GRID_SIZE,
    OCCUPIED,
    UNKNOWN,
    CandidateSlots,
    OccupancyGrid,
    cell_of,
    find_frontiers,
    follow_path,
    plan_path,
)
from vslam_env.navigation._planning_kernels.costmap import OUTSIDE, PAD
from vslam_env.navigation._planning_kernels.frontiers import _unseen_edges
from vslam_env.navigation.candidate_slots import NUM_SLOTS, SAME_GOAL, pair_up
from vslam_env.navigation.grid_storage import known_bounds

_unseen_edges = python_entry(_unseen_edges)


def room(doors: tuple[float, ...] = (), width: float = 1.2) -> np.ndarray:
    """Return cells of a room, x from -6 to 6, y from -2 to 3, walled but for doors at the given x of its upper wall."""
    cells = np.full((GRID_SIZE, GRID_SIZE), UNKNOWN, np.uint8)
    (r1, c1), (r2, c2) = cell_of((-5.9, -1.9)), cell_of((5.9, 2.9))
    cells[r1 - 1 : r2 + 2, c1 - 1 : c2 + 2] = OCCUPIED
    cells[r1 : r2 + 1, c1 : c2 + 1] = FREE
    for x in doors:
        first = cell_of((x - width / 2 + 0.1, 3.1))[1]
        cells[r2 + 1, first : first + round(width / CELL)] = FREE
    return cells


def test_a_door_is_the_frontier_of_a_closed_room() -> None:
    """The goal lies in the door or just before it, and looks outwards; its length is that of the way."""
    found = find_frontiers(room((2.0,)), (-3.1, -0.9))
    assert len(found.goals) == 1
    assert np.abs(found.goals[0] - [2.0, 3.0]).max() < 0.3
    assert found.headings[0] == pytest.approx(np.pi / 2, abs=0.3)
    assert found.sizes[0] == pytest.approx(1.2, abs=0.45)
    assert found.lengths[0] == pytest.approx(np.hypot(5.1, 3.9), rel=0.1)


def test_a_closed_room_and_an_empty_grid_have_no_frontier() -> None:
    """Where nothing unknown can be reached, there is nothing to explore."""
    assert len(find_frontiers(room(), (0.0, 0.0)).goals) == 0
    assert len(find_frontiers(np.zeros((GRID_SIZE, GRID_SIZE), np.uint8), (0.0, 0.0)).goals) == 0
    assert len(find_frontiers(np.full((GRID_SIZE, GRID_SIZE), FREE, np.uint8), (3.0, 0.0)).goals) == 0


def test_frontiers_come_nearest_first() -> None:
    """Of several doors, the one with the shortest way comes first."""
    found = find_frontiers(room((-4.0, 0.2, 4.4)), (3.1, -0.9))
    assert np.abs(found.goals[:, 0] - [4.4, 0.2, -4.0]).max() < 0.3
    assert (np.diff(found.lengths) > 0.5).all()


def test_long_frontiers_are_cut() -> None:
    """An opening of 11 m gives three frontiers of nearly equal size, with goals far apart."""
    found = find_frontiers(room((0.0,), width=11.0), (0.1, 0.1))
    assert len(found.goals) == 3
    assert found.sizes.max() <= 4.0
    assert found.sizes.sum() == pytest.approx(11.0, abs=0.5)
    assert np.diff(np.sort(found.goals[:, 0])).min() > 3.0


def test_specks_and_what_is_out_of_reach_are_no_frontiers() -> None:
    """Two unseen cells in the floor are ignored, three are not; and so is floor behind a wall."""
    cells = room()
    row, col = cell_of((1.1, 0.1))
    cells[row, col : col + 2] = UNKNOWN
    far_row, far_col = cell_of((10.0, 10.0))
    cells[far_row : far_row + 9, far_col : far_col + 9] = FREE
    assert len(find_frontiers(cells, (-3.0, 0.0)).goals) == 0
    cells[row, col + 2] = UNKNOWN
    assert len(find_frontiers(cells, (-3.0, 0.0)).goals) == 1
    assert len(find_frontiers(cells, (-3.0, 0.0), ignored=[(-2.0, 0.1), (1.9, 0.1)]).goals) == 0
    assert len(find_frontiers(cells, (-3.0, 0.0), ignored=[(-2.0, 0.1), (2.4, 0.1)]).goals) == 1


def test_a_gap_too_narrow_for_the_robot_is_no_frontier() -> None:
    """A hole of 0.4 m in a wall cannot be driven through, so its other side is not to be explored."""
    assert len(find_frontiers(room((1.0,), width=0.4), (0.0, 0.0)).goals) == 0


@pytest.mark.slow
def test_a_candidate_keeps_its_slot_while_it_lives() -> None:
    """When one of three candidates dies, the others stay in their slots, and the next new one takes the free one."""
    slots = CandidateSlots()
    slots.update(room((-4.0, 0.2, 4.4)), (3.1, -0.9, 0.0))
    assert slots.valid.tolist() == [True] * 3 + [False] * 13
    assert slots.goals[:3, 0] == pytest.approx([4.4, 0.2, -4.0], abs=0.3)
    slots.update(room((-4.0, 4.4)), (-3.0, 0.2, 0.0))
    assert slots.valid.tolist() == [True, False, True] + [False] * 13
    assert slots.goals[[0, 2], 0] == pytest.approx([4.4, -4.0], abs=0.3)
    assert np.isnan(slots.goals[1]).all()
    slots.update(room((-4.3, -1.9, 1.1, 4.4)), (-3.0, 0.2, 0.0))
    assert slots.goals[:4, 0] == pytest.approx([4.4, -1.9, -4.3, 1.1], abs=0.3)
    slots.update(room(), (-3.0, 0.2, 0.0))
    assert not slots.valid.any()


def test_sixteen_slots_take_the_nearest_of_more_candidates() -> None:
    """With more frontiers than slots, the sixteen nearest ones are offered."""
    cells = room()
    for x in np.arange(-5.0, 5.1, 0.9):
        for y in (-1.1, 0.3, 1.7):
            row, col = cell_of((x, y))
            cells[row : row + 2, col : col + 2] = UNKNOWN
    found = find_frontiers(cells, (-3.0, 1.0))
    assert len(found.goals) > 20
    slots = CandidateSlots()
    slots.update(cells, (-3.0, 1.0, 0.0))
    assert slots.valid.all()
    assert (slots.goals == found.goals[:16]).all()


def test_a_frontier_that_stays_after_a_look_is_dropped() -> None:
    """A frontier that stays when the robot looks at it from its goal dies after four updates, and does not return."""
    cells = room((-4.0, 4.4))
    slots = CandidateSlots()
    slots.update(cells, (0.0, 0.0, 0.0))
    pose = np.array([*slots.goals[0], slots.headings[0]])
    for _ in range(3):
        slots.update(cells, pose)
        assert slots.valid[:2].all()
    for _ in range(9):
        slots.update(cells, pose)
        assert slots.valid.tolist() == [False, True] + [False] * 14
    assert slots.goals[1, 0] == pytest.approx(4.4, abs=0.3)


def test_visits_without_a_look_take_longer() -> None:
    """With its back to a frontier, or with a teammate there, a robot waits sixteen updates before it gives up."""
    cells = room((-4.0, 4.4))
    slots = CandidateSlots()
    slots.update(cells, (0.0, 0.0, 0.0))
    pose = np.array([*slots.goals[0], slots.headings[0] + np.pi])
    teammates = slots.goals[1:2]
    for _ in range(15):
        slots.update(cells, pose, teammates)
        assert slots.valid.sum() == 2
    slots.update(cells, pose, teammates)
    assert not slots.valid.any()


def test_passing_robots_drop_no_frontier() -> None:
    """Updates away from the goals do not count as visits."""
    cells = room((-4.0, 4.4))
    slots = CandidateSlots()
    for k in range(40):
        slots.update(cells, (3.0 * np.sin(k), -0.5, float(k)))
    assert slots.valid.sum() == 2


def test_restored_slots_continue_bit_for_bit() -> None:
    """After a restoration, the same updates lead to the same candidates, visits included."""
    cells = room((-4.0, 4.4))
    slots, again = CandidateSlots(), CandidateSlots()
    slots.update(cells, (0.0, 0.0, 0.0))
    pose = np.array([*slots.goals[0], slots.headings[0]])
    for _ in range(3):
        slots.update(cells, pose)
    restore(again, take(slots))
    for each in (slots, again):
        each.update(cells, pose)
    assert slots.valid.sum() == 1
    assert take(slots) == take(again)


def explore(seed: int, start: FloatArray, max_ticks: int = 2000) -> tuple[OccupancyGrid, CandidateSlots, FloatArray]:
    """Drive an ideal robot to the nearest candidate until none is left; return grid, slots and true path (n, 3)."""
    rng = np.random.default_rng(seed)
    walls = building()
    grid, slots = OccupancyGrid(), CandidateSlots()
    pose, path, heading = start, None, 0.0
    track = [pose]
    for tick in range(max_ticks):
        est_pose = in_start_frame(start, pose)
        grid.update_from_scan(est_pose, scan(walls, pose, rng), ANGLES)
        grid.clear_disc(est_pose)
        if tick % 10 == 0:
            slots.update(grid.cells, est_pose)
            if not slots.valid.any():
                break
            nearest = int(np.nanargmin(slots.lengths))
            path, heading = plan_path(grid.cells, est_pose[:2], slots.goals[nearest]), float(slots.headings[nearest])
            assert path is not None
        v, omega = follow_path(est_pose, path, final_heading=heading)
        pose = drive(pose, v, omega)
        track.append(pose)
    return grid, slots, np.array(track)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "start"), [(0, (2.0, 2.0, 0.3)), (1, (8.0, 5.5, -2.0)), (2, (16.2, 0.7, 1.0)), (3, (7.3, 9.9, 2.5))]
)
def test_the_nearest_frontier_explores_a_building_and_ends(seed: int, start: tuple[float, float, float]) -> None:
    """With 1 % noise, at least 98 % of the reachable floor is seen free in 150 s, then no candidate is left.

    On the way the robot keeps its radius from all walls. The seeds are fixed.
    """
    walls, start_pose = building(), np.array(start)
    grid, slots, track = explore(seed, start_pose)
    assert not slots.valid.any()
    assert len(track) <= 1500
    assert clearance(walls, track[:, :2]).min() > 0.2
    points = np.stack(np.meshgrid(np.arange(0.05, 17, 0.1), np.arange(0.05, 11, 0.1)), axis=-1).reshape(-1, 2)
    reachable = points[clearance(walls, points) > 0.2]
    rows, cols = cell_of(transform_points(inverse(start_pose), reachable)).T
    assert (grid.cells[rows, cols] == FREE).mean() > 0.98


@pytest.mark.parametrize("corner", [(0, 0), (GRID_SIZE - 12, 40), (100, GRID_SIZE - 15)])
def test_frontiers_are_made_of_unknown_cells_beside_free_ones(corner: tuple[int, int]) -> None:
    """Also at the border of the grid."""
    rng = np.random.default_rng(3)
    cells = np.full((GRID_SIZE, GRID_SIZE), UNKNOWN, np.uint8)
    row, col = corner
    cells[row : row + 12, col : col + 15] = rng.integers(0, 3, (12, 15))
    padded = np.pad(cells, 1, constant_values=OUTSIDE) == FREE
    beside = padded[:-2, 1:-1] | padded[2:, 1:-1] | padded[1:-1, :-2] | padded[1:-1, 2:]
    bounds = known_bounds(cells)
    around = np.pad(cells, PAD, constant_values=OUTSIDE)
    box = np.ascontiguousarray(around[bounds[0] : bounds[2] + 2 * PAD, bounds[1] : bounds[3] + 2 * PAD])
    edges = _unseen_edges(box, bounds[0] - PAD, bounds[1] - PAD, GRID_SIZE)
    found = np.argwhere(edges) + bounds[:2] - PAD
    assert found.tolist() == np.argwhere((cells == UNKNOWN) & beside).tolist()


def test_pairs_are_the_nearest_ones_and_where_nothing_else_is_near_those_of_the_optimal_assignment() -> None:
    """Whatever lies how close together: no goal and place that are left, or paired less closely, are within reach."""
    rng = np.random.default_rng(11)
    num_clear = 0
    for _ in range(400):
        goals, places = rng.uniform(0.0, 12.0, (NUM_SLOTS, 5)), rng.uniform(0.0, 12.0, (rng.integers(0, 20), 5))
        again = rng.random(len(places)) < 0.3
        places[again, :2] = goals[rng.integers(0, NUM_SLOTS, again.sum()), :2] + rng.normal(0.0, 0.3, (again.sum(), 2))
        goals[rng.random(NUM_SLOTS) < 0.5] = np.nan
        found = pair_up(goals, places)
        apart = np.linalg.norm(goals[:, None, :2] - places[None, :, :2], axis=2)
        near = np.where(apart < SAME_GOAL, apart, SAME_GOAL)  # NaN is no less
        slots = np.flatnonzero(found >= 0)
        of_goals, of_places = np.full(len(goals), SAME_GOAL), np.full(len(places), SAME_GOAL)
        of_goals[slots] = of_places[found[slots]] = near[slots, found[slots]]
        assert len(set(found[slots].tolist())) == len(slots)
        assert (np.minimum(of_goals[:, None], of_places) <= near).all()
        if all((near < SAME_GOAL).sum(axis=axis).max(initial=0) <= 1 for axis in (0, 1)):
            rows, columns = linear_sum_assignment(near)
            kept = near[rows, columns] < SAME_GOAL
            np.testing.assert_array_equal(
                np.column_stack([slots, found[slots]]), np.column_stack([rows, columns])[kept]
            )
            num_clear += 1
    assert 40 < num_clear < 360


LARGE = 1200  # cells along a side of a grown grid


def corridor(doors: list[float]) -> np.ndarray:
    """Return cells (S, S) of a corridor, x from -5 to 95, y from 0 to 3, with doors of 1.2 m at the given x."""
    cells = np.full((LARGE, LARGE), UNKNOWN, np.uint8)
    (r1, c1), (r2, c2) = cell_of((-4.9, 0.1), LARGE), cell_of((94.9, 2.9), LARGE)
    cells[r1 - 1 : r2 + 2, c1 - 1 : c2 + 2] = OCCUPIED
    cells[r1 : r2 + 1, c1 : c2 + 1] = FREE
    for x in doors:
        first = cell_of((x - 0.5, 3.1), LARGE)[1]
        cells[r2 + 1, first : first + 6] = FREE
    return cells


def test_a_path_makes_a_detour_of_any_length() -> None:
    """A path that leaves the surroundings of start and goal is found where there is no other, and only then."""
    cells = corridor([2.0, 90.0])
    (row, first), (end, last) = cell_of((1.6, 3.1), LARGE), cell_of((90.4, 9.9), LARGE)
    cells[row : end + 1, first : last + 1] = OCCUPIED
    inner, between = slice(first + 1, last), cell_of((90.0, 3.1), LARGE)
    cells[row + 10 : end, inner] = FREE  # a second corridor above, joined at its far end
    cells[row : row + 10, between[1] - 4 : between[1] + 2] = FREE
    path = plan_path(cells, (3.0, 1.5), (3.0, 8.0))
    assert path is not None
    assert path[:, 0].max() > 88.0
    cells[row : row + 10, first + 1 : first + 9] = FREE
    nearer = plan_path(cells, (3.0, 1.5), (3.0, 8.0))
    assert nearer is not None
    assert nearer[:, 0].max() < 10.0
