import itertools
import math

import numpy as np
import pytest
from builders.kernels import python_entry
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from slam_backend.geometry import compose
from vslam_env.navigation import (
    FREE,
    GRID_SIZE,
    OCCUPIED,
    UNKNOWN,
    cell_of,
    centre_of,
    distance_map,
    follow_path,
    plan_path,
)
from vslam_env.navigation._planning_kernels.costmap import CLOSE, NEAR, OPEN, OUTSIDE, PAD, inflate_costs
from vslam_env.navigation._planning_kernels.dijkstra import UNREACHED, wavefront
from vslam_env.navigation.grid_storage import known_bounds

wavefront, inflate_costs = map(python_entry, (wavefront, inflate_costs))


def floor(low: tuple[float, float], high: tuple[float, float], walls: list[tuple[float, ...]]) -> np.ndarray:
    """Return cells with free floor between two corners, a wall around it, and inner walls (x1, y1, x2, y2)."""
    cells = np.full((GRID_SIZE, GRID_SIZE), UNKNOWN, np.uint8)
    (r1, c1), (r2, c2) = cell_of(low), cell_of(high)
    cells[r1 - 1 : r2 + 2, c1 - 1 : c2 + 2] = OCCUPIED
    cells[r1 : r2 + 1, c1 : c2 + 1] = FREE
    for x1, y1, x2, y2 in walls:
        (r1, c1), (r2, c2) = cell_of((x1, y1)), cell_of((x2, y2))
        cells[r1 : r2 + 1, c1 : c2 + 1] = OCCUPIED
    return cells


def samples(path: np.ndarray) -> np.ndarray:
    """Return points every few centimetres along a path."""
    return np.concatenate([np.linspace(a, b, 50) for a, b in itertools.pairwise(path)])


def gap_to_walls(cells: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the distances [m] from points (n, 2) to the nearest occupied cell's square."""
    corners = centre_of(np.argwhere(cells == OCCUPIED))
    beside = np.maximum(np.abs(points[:, None] - corners) - 0.1, 0.0)
    return np.hypot(beside[..., 0], beside[..., 1]).min(axis=1)


TWO_ROOMS = floor((-3.0, -2.0), (5.0, 3.1), [(1.0, -2.0, 1.0, 0.3), (1.0, 1.5, 1.0, 3.1)])  # door from 0.4 to 1.4


@given(arrays(np.uint8, (9, 13), elements=st.sampled_from([0, 0, OPEN, OPEN, NEAR, CLOSE])), st.data())
def test_the_wavefront_agrees_with_scipys_dijkstra(inner: np.ndarray, data: st.DataObject) -> None:
    """Costs equal those of scipy on the same graph, and following the parents adds up to them."""
    inner[data.draw(st.integers(0, 8)), data.draw(st.integers(0, 12))] = OPEN
    weights = np.pad(inner, 1)
    width = weights.shape[1]
    start = tuple(int(i) for i in np.argwhere(weights)[data.draw(st.integers(0, int((weights > 0).sum()) - 1))])
    cost, parent = wavefront(weights, *start, -1)

    edges = {}
    for r, c in np.argwhere(weights):
        for i, j in ((0, 1), (1, 0), (1, 1), (1, -1)):
            if weights[r + i, c + j]:
                step = 7 if i and j else 5
                total = int(weights[r, c]) + int(weights[r + i, c + j])
                edges[r * width + c, (r + i) * width + c + j] = step * total
    rows, cols = np.array(list(edges)).reshape(-1, 2).T
    graph = coo_array((list(edges.values()), (rows, cols)), shape=(weights.size, weights.size)).tocsr()
    expected = dijkstra(graph, directed=False, indices=start[0] * width + start[1])

    assert (cost.ravel() == np.where(np.isinf(expected), UNREACHED, expected)).all()
    for cell in np.flatnonzero(parent.ravel() >= 0):
        before = int(parent.ravel()[cell])
        step = edges.get((before, cell)) or edges[cell, before]
        assert cost.ravel()[cell] == cost.ravel()[before] + step


@given(arrays(np.uint8, (11, 17), elements=st.sampled_from([FREE] * 7 + [UNKNOWN, OCCUPIED])), st.floats(0.6, 3.2))
def test_weights_follow_the_distance_from_walls(box: np.ndarray, reach: float) -> None:
    """A cell is closed within reach of a wall, expensive within one more cell, less so within two or at the unknown."""
    distance = distance_transform_edt(box != OCCUPIED) if (box == OCCUPIED).any() else np.full(box.shape, np.inf)
    weights = inflate_costs(box, reach)[1:-1, 1:-1]
    inner = (slice(1, -1), slice(1, -1))
    unknown = box == UNKNOWN
    edge = unknown[2:, 1:-1] | unknown[:-2, 1:-1] | unknown[1:-1, 2:] | unknown[1:-1, :-2]
    distance, is_free = distance[inner], box[inner] == FREE
    expected = np.select(
        [~is_free | (distance < reach), distance < reach + 1, (distance < reach + 2) | edge],
        [0, CLOSE, NEAR],
        default=OPEN,
    )
    assert (weights == expected).all()


@given(st.lists(st.tuples(st.floats(-2.9, 4.9), st.floats(-1.9, 2.9)), max_size=25), st.floats(-1.5, 2.5))
def test_no_path_touches_a_wall(posts: list[tuple[float, float]], goal_y: float) -> None:
    """Whatever stands in the way, the disc of the robot stays clear of walls all along, or there is no path."""
    cells = TWO_ROOMS.copy()
    for row, col in cell_of(np.array(posts).reshape(-1, 2)):
        cells[row, col] = OCCUPIED
    start, goal = np.array([-2.0, -1.0]), np.array([4.1, goal_y])
    ways = distance_map(cells, start)
    path = plan_path(cells, start, goal)
    if ways.weights[ways.cell_of(start)] == 0:
        return  # a post stands on the robot: the way out may pass it
    if path is None:
        row, col = ways.cell_of(goal)
        assert (ways.cost[row, col] == UNREACHED) or ways.weights[row, col] == 0
        return
    assert (path[0] == start).all()
    assert np.hypot(*(path[-1] - goal)) < 0.6
    assert gap_to_walls(cells, samples(path)).min() > 0.2 - 1e-9


@given(
    st.lists(st.tuples(st.floats(-2.9, 4.9), st.floats(-1.9, 2.9)), max_size=25),
    st.tuples(st.floats(-4.0, 6.0), st.floats(-3.0, 4.0)),
)
def test_a_search_that_ends_at_the_goal_finds_the_path_of_the_whole_search(
    posts: list[tuple[float, float]], goal: tuple[float, float]
) -> None:
    """The path to a goal is the one in the map of all distances, whether the goal is free, in a wall or outside."""
    cells = TWO_ROOMS.copy()
    for row, col in cell_of(np.array(posts).reshape(-1, 2)):
        cells[row, col] = OCCUPIED
    start = (-2.0, -1.0)
    path, expected = plan_path(cells, start, goal), distance_map(cells, start).path_to(goal)
    assert (path is None) == (expected is None)
    if path is not None and expected is not None:
        np.testing.assert_array_equal(path, expected)


def test_a_robot_among_walls_that_drift_drew_finds_open_floor() -> None:
    """Where walls were drawn over a robot for 2 m around it, its ways begin at the nearest floor beyond the unknown."""
    cells = floor((-6.0, -5.0), (7.0, 8.1), [])
    centres = centre_of(np.argwhere(cells == FREE))
    for row, col in np.argwhere(cells == FREE)[np.hypot(*centres.T) < 2.0]:
        cells[row, col] = UNKNOWN
    path = plan_path(cells, (0.0, 0.0), (5.0, 5.0))
    assert path is not None
    assert 2.0 < np.hypot(*path[1]) < 2.6


@pytest.mark.parametrize("width", [0.3, 0.7, 1.1, 2.6])
def test_a_robot_on_an_island_of_floor_starts_beyond_it(width: float) -> None:
    """Where what is unknown leaves less than 25 open cells around a robot, its ways begin at the floor beyond."""
    cells = floor((-6.0, -5.0), (7.0, 8.1), [])
    centres = centre_of(np.argwhere(cells == FREE))
    for (row, col), (x, y) in zip(np.argwhere(cells == FREE), centres, strict=True):
        if max(abs(x), abs(y)) < 0.5 * width + 0.8 and max(abs(x), abs(y)) > 0.5 * width:
            cells[row, col] = UNKNOWN
    path = plan_path(cells, (0.0, 0.0), (5.0, 5.0))
    assert (path is None) == (width > 1.0)
    if path is not None:
        assert np.hypot(*path[1]) > 0.5 * width


def test_a_path_in_an_open_room_is_one_straight_line() -> None:
    """Without walls near, start and goal are joined directly."""
    cells = floor((-6.0, -5.0), (7.0, 8.1), [])
    path = plan_path(cells, (-3.03, -2.07), (4.4, 5.9))
    assert path is not None
    assert path.tolist() == [[-3.03, -2.07], [4.4, 5.9]]


def test_a_path_leads_through_the_middle_of_a_door() -> None:
    """A door of 1.1 m between rooms is passed, at least 0.35 m from its posts."""
    path = plan_path(TWO_ROOMS, (-1.0, -1.2), (3.0, 2.2))
    assert path is not None
    points = samples(path)
    in_door = np.abs(points[:, 0] - 1.1) < 0.15
    assert in_door.any()
    assert gap_to_walls(TWO_ROOMS, points[in_door]).min() > 0.3
    assert gap_to_walls(TWO_ROOMS, points).min() > 0.25


def test_a_path_keeps_away_from_walls_where_there_is_room() -> None:
    """Around the end of a wall in a wide room, the path keeps 0.4 m away from it."""
    cells = floor((-5.0, -4.0), (6.0, 4.1), [(0.0, -4.0, 0.0, 1.0)])
    path = plan_path(cells, (-2.1, -1.0), (2.3, -1.3))
    assert path is not None
    assert gap_to_walls(cells, samples(path)).min() > 0.4


@pytest.mark.parametrize(
    ("start", "goal"),
    [
        ((0.1, 0.1), (3.1, 0.1)),  # behind a wall
        ((0.1, 0.1), (-6.0, 0.0)),  # on unknown floor
        ((0.1, 0.1), (-1e300, 0.0)),  # far outside the grid
        ((3.1, 0.1), (0.1, 0.1)),  # the robot is where nothing is known
        ((-45.0, 0.0), (0.1, 0.1)),
        ((0.0, 1e300), (0.1, 0.1)),
    ],
)
def test_where_no_way_is_known_there_is_no_path(start: tuple[float, float], goal: tuple[float, float]) -> None:
    """None is returned, without delay, for all that cannot be reached."""
    cells = floor((-1.0, -1.2), (2.0, 1.3), [])
    cells[cell_of((3.1, 0.1))[0], cell_of((3.1, 0.1))[1]] = FREE if goal[0] == 3.1 else UNKNOWN
    assert plan_path(cells, start, goal) is None


@pytest.mark.parametrize("start", [(0.95, -1.0), (1.35, -1.0), (-2.95, 2.95), (0.85, 0.25)])
def test_a_robot_in_a_walls_margin_gets_out_on_its_own_side(start: tuple[float, float]) -> None:
    """A path that begins too near a wall leads away from it, never through it."""
    goal = (-1.5, 1.0) if start[0] < 1.1 else (4.0, 1.0)
    path = plan_path(TWO_ROOMS, start, goal)
    assert path is not None
    assert path[0].tolist() == list(start)
    assert path[-1].tolist() == list(goal)
    assert len(path) >= 3
    assert gap_to_walls(TWO_ROOMS, samples(path)).min() >= min(0.2, gap_to_walls(TWO_ROOMS, path[:1])[0]) - 1e-9


def test_a_goal_in_a_walls_margin_is_served_from_nearby() -> None:
    """The path ends on open floor near a goal that a robot cannot stand on."""
    path = plan_path(TWO_ROOMS, (-1.5, 0.1), (0.9, -1.0))
    assert path is not None
    assert 0.0 < np.hypot(*(path[-1] - [0.9, -1.0])) < 0.6
    assert gap_to_walls(TWO_ROOMS, path[-1:])[0] > 0.2


def test_a_path_goes_through_the_edge_of_the_grid_safely() -> None:
    """Floor that is known up to the edge of the 60 x 60 m is travelled like other floor."""
    cells = np.full((GRID_SIZE, GRID_SIZE), FREE, np.uint8)
    path = plan_path(cells, (-29.95, -29.95), (29.95, 29.95))
    assert path is not None
    assert path.tolist() == [[-29.95, -29.95], [29.95, 29.95]]


def test_following_a_planned_path_arrives_without_touching_walls() -> None:
    """An ideal robot that follows the path through the door ends at the goal, looking where it should."""
    goal = np.array([3.0, 2.2])
    pose = np.array([-1.0, -1.2, -2.5])
    path = plan_path(TWO_ROOMS, pose[:2], goal)
    track = [pose]
    for _ in range(300):
        v, omega = follow_path(pose, path, final_heading=-1.0)
        if v == 0.0 and omega == 0.0:
            break
        pose = compose(pose, [v * 0.1, 0.0, omega * 0.1])
        track.append(pose)
    assert len(track) < 150
    assert np.hypot(*(pose[:2] - goal)) < 0.1
    assert abs(pose[2] + 1.0) < 0.06
    assert gap_to_walls(TWO_ROOMS, np.array(track)[:, :2]).min() > 0.2


@given(
    st.tuples(st.floats(-9, 9), st.floats(-9, 9), st.floats(-20, 20)),
    st.lists(st.tuples(st.floats(-9, 9), st.floats(-9, 9)), min_size=1, max_size=6),
    st.floats(0.1, 1.0),
    st.floats(0.2, 1.5),
    st.floats(-1.0, 1.0),
)
def test_commands_stay_within_their_limits(
    pose: tuple[float, float, float], path: list[tuple[float, float]], max_speed: float, max_turn: float, aside: float
) -> None:
    """0 <= v <= max_speed and |omega| <= max_turn for all poses and paths, degenerate ones included."""
    v, omega = follow_path(pose, path, max_speed, max_turn, aside=aside)
    assert 0.0 <= v <= max_speed
    assert abs(omega) <= max_turn


def test_a_robot_that_looks_aside_stays_near_its_path() -> None:
    """With alternating sides its heading swings by more than half of the angle; it keeps to the path and arrives."""
    pose, track = np.zeros(3), []
    path = [[0.0, 0.0], [6.0, 0.0], [6.0, 6.0]]
    for tick in range(200):
        v, omega = follow_path(pose, path, final_heading=0.0, aside=0.6 if tick % 16 < 8 else -0.6)
        pose = compose(pose, [v * 0.1, 0.0, omega * 0.1])
        track.append(pose)
    gaps = np.minimum(np.abs(np.array(track)[:, 1]), np.abs(np.array(track)[:, 0] - 6.0))
    assert gaps.max() < 0.3
    straight = np.array([pose[2] for pose in track if 1.0 < pose[0] < 5.0])
    assert straight.max() > 0.3
    assert straight.min() < -0.3
    assert np.hypot(*(pose[:2] - path[-1])) < 0.1
    assert abs(pose[2]) < 0.06
    assert np.hypot(*np.diff(np.array(track)[:, :2], axis=0).T).sum() < 1.1 * 12.0


def test_a_robot_turns_in_place_towards_a_path_behind_it() -> None:
    """With the path straight behind, it turns at full rate without driving; with the path ahead, it drives straight."""
    path = [[0.0, 0.0], [-3.0, 0.0]]
    v, omega = follow_path((0.0, 0.0, 0.1), path)
    assert (v, omega) == (0.0, 1.5)
    assert follow_path((0.0, 0.0, math.pi), path) == pytest.approx((1.0, 0.0))


def test_a_robot_at_the_end_stays() -> None:
    """At the last point it stops, and turns only if a heading was asked for."""
    path = [[0.0, 0.0], [2.0, 1.0]]
    assert follow_path((2.02, 1.03, 0.4), path) == (0.0, 0.0)
    assert follow_path((2.02, 1.03, 0.4), path, final_heading=0.4 + 2 * math.pi) == (0.0, 0.0)
    v, omega = follow_path((2.02, 1.03, 0.4), path, final_heading=0.2)
    assert (v, omega) == (0.0, pytest.approx(-0.6))


@pytest.mark.parametrize("places", [[], [(0, 0)], [(299, 299)], [(3, 250), (200, 7)], [(0, 120), (299, 120)]])
def test_the_known_box_holds_all_known_cells_and_no_more(places: list[tuple[int, int]]) -> None:
    """Its bounds are the least and largest row and column of what is known, and it is padded with what lies outside."""
    cells = np.full((GRID_SIZE, GRID_SIZE), UNKNOWN, np.uint8)
    for row, col in places:
        cells[row, col] = OCCUPIED
    bounds = known_bounds(cells)
    rows, cols = np.nonzero(cells)
    assert bounds.tolist() == ([rows.min(), cols.min(), rows.max() + 1, cols.max() + 1] if places else [0, 0, 0, 0])
    padded = np.pad(cells, PAD, constant_values=OUTSIDE)
    ways = distance_map(cells, (0.0, 0.0))
    assert ways.corner == (bounds[0] - PAD, bounds[1] - PAD)
    np.testing.assert_array_equal(ways.box, padded[bounds[0] : bounds[2] + 2 * PAD, bounds[1] : bounds[3] + 2 * PAD])
