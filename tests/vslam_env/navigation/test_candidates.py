"""Candidates of three kinds: looks at walls, gains of views, places to look from again, paths, and the global grid."""

import math
from typing import Any

import numpy as np
import pytest
from builders.environments import MEETING, know, small_env, turning
from builders.kernels import python_entry

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.fastslam.relative_poses import TeamPoses
from slam_backend.geometry import compose, inverse
from slam_backend.state import restore, take
from vslam_env import CANDIDATE_FEATURES, NUM_CANDIDATES, CandidateKind, vslam_v0
from vslam_env.belief.rendezvous import OWN_START, RICHEST, Rendezvous
from vslam_env.navigation import (
    CELL,
    FREE,
    GRID_SIZE,
    OCCUPIED,
    UNKNOWN,
    TeamCandidates,
    TeamGrids,
    TeamLooks,
    cell_of,
    centre_of,
    distance_map,
    lengths_between,
    ray_directions,
)
from vslam_env.navigation._view_kernels import COARSE, write_global_grid
from vslam_env.navigation._view_kernels.looks import LOOKED, MOST_LOOKS, NEAREST
from vslam_env.navigation._view_kernels.revisits import BINS, FARTHEST, PATIENCE, SPACING, add_revisits
from vslam_env.navigation._view_kernels.view_gains import view_gains
from vslam_env.navigation.grid_storage import GRID_SIZES, LARGEST_SIZE, known_bounds, margin

gains_of, places_of = python_entry(view_gains), python_entry(add_revisits)
HALF_FOV, REACH = 0.46, 8.0
CAMERA = np.array([HALF_FOV, REACH, 0.2])
ANGLES = np.linspace(-HALF_FOV, HALF_FOV, 33)
ALONE = np.ones((1, 1), np.int64)
NO_LANDMARKS = np.empty((0, 4)), np.empty((0, 2), np.int64), np.zeros(3)
NO_PLACES = np.full((4, 3), np.nan)


def walled(x: float = 6.0, y: float = 4.0, inner: float | None = None) -> np.ndarray:
    """Return cells of a room from (-2, -y) to (x, y) with walls one cell thick, and a wall at some x inside."""
    cells = np.full((GRID_SIZE, GRID_SIZE), UNKNOWN, np.uint8)
    (r1, c1), (r2, c2) = cell_of((-1.9, -y + 0.1)), cell_of((x - 0.1, y - 0.1))
    cells[r1 - 1 : r2 + 2, c1 - 1 : c2 + 2] = OCCUPIED
    cells[r1 : r2 + 1, c1 : c2 + 1] = FREE
    if inner is not None:
        cells[r1 : r2 + 1, cell_of((inner, 0.0))[1]] = OCCUPIED
    return cells


def looks_after(pose: FloatArray, scan: FloatArray, ticks: int = 1, half_fov: float = HALF_FOV) -> np.ndarray:
    """Return the looks of a robot that stands still."""
    looks = TeamLooks(1, ANGLES, half_fov, REACH)
    for _ in range(ticks):
        looks.update(ALONE, np.array([[pose]]), scan[None], GRID_SIZE)
    return looks.counts[0]


def facing_wall(distance: float, tilt: float = 0.0) -> FloatArray:
    """Return the ranges to a straight wall whose normal is `tilt` off the robot's axis."""
    ranges = distance * math.cos(tilt) / np.maximum(np.cos(ANGLES - tilt), 1e-9)
    return np.minimum(ranges, REACH)


def test_looks_are_counted_before_the_wall_once_a_tick() -> None:
    """A wall 3.1 m ahead gets a look per cell and tick on the free cells before it, and no other cell gets any."""
    looks = looks_after(np.zeros(3), facing_wall(3.1), ticks=4)
    rows, cols = np.nonzero(looks)
    places = centre_of(np.column_stack([rows, cols]))
    assert (np.abs(places[:, 0] - 2.9) < 0.2).all()
    assert places[:, 1].min() == pytest.approx(-3.1 * math.tan(HALF_FOV), abs=0.3)
    assert looks.max() <= 8
    assert looks[tuple(cell_of((2.95, 0.1)))] >= 4
    many = looks_after(np.zeros(3), facing_wall(3.1), ticks=300)
    assert many.max() == MOST_LOOKS


@pytest.mark.parametrize(("tilt", "seen"), [(0.0, True), (0.5, True), (1.2, False)])
def test_grazed_and_distant_walls_are_not_looked_at(tilt: float, seen: bool) -> None:
    """Walls met at more than 60 degrees, or beyond the range, get no looks."""
    ranges = np.full(len(ANGLES), 3.0)
    middle = slice(14, 19)  # nearly one direction, so that all of these have the same incidence
    ranges[middle] = 3.0 * math.cos(tilt) / np.cos(ANGLES[middle] - tilt)
    others = np.ones(len(ANGLES), bool)
    others[middle] = False
    ranges[others] = REACH
    assert looks_after(np.zeros(3), ranges).any() == seen
    assert not looks_after(np.zeros(3), np.full(len(ANGLES), REACH)).any()


def test_rays_outside_the_field_of_view_do_not_look() -> None:
    """A camera with a narrower view than the range finder looks at less of the wall."""
    wide, narrow = (np.count_nonzero(looks_after(np.zeros(3), facing_wall(3.1), 1, fov)) for fov in (HALF_FOV, 0.2))
    assert 0 < narrow < 0.6 * wide


def test_looks_of_other_frames_are_moved_into_the_own_one() -> None:
    """Looks merged from another start frame lie where the robot would have counted them itself, to a cell."""
    other_start, pose = np.array([2.3, -1.1, 0.8]), np.array([0.5, 0.3, -0.4])
    looks, own = TeamLooks(1, ANGLES, HALF_FOV, REACH), TeamLooks(1, ANGLES, HALF_FOV, REACH)
    theirs = looks_after(pose, facing_wall(4.0), ticks=3)
    looks.merge(0, theirs, other_start)
    assert (looks.bounds[0] == known_bounds(looks.counts[0])).all()
    own.update(ALONE, compose(other_start, pose)[None, None], facing_wall(4.0)[None], GRID_SIZE)
    expected, found = np.argwhere(own.counts[0]), np.argwhere(looks.counts[0])
    gaps = np.abs(found[:, None] - expected[None]).max(axis=2).min(axis=1)
    assert gaps.max() <= 1
    assert looks.counts.sum() == theirs.sum()


def test_looks_grow_with_the_grid() -> None:
    """In a larger grid the same looks lie around the same middle, and earlier looks are restored into it."""
    looks = TeamLooks(1, ANGLES, HALF_FOV, REACH)
    args = ALONE, np.zeros((1, 1, 3)), facing_wall(3.1)[None]
    looks.update(*args, GRID_SIZE)
    before, state = looks.counts[0].copy(), looks.part(0)
    looks.update(*args, GRID_SIZES[1])
    inner = slice(margin(GRID_SIZES[1]), -margin(GRID_SIZES[1]))
    assert before.any()
    assert (looks.counts[0, inner, inner] == 2 * before).all()
    looks.restore_part(0, state)
    assert looks.counts.sum() == before.sum()
    assert (looks.counts[0, inner, inner] == before).all()
    again = looks.part(0)
    assert again.corner == state.corner
    assert (again.values == state.values).all()
    assert state.values.size < 60
    assert (looks.bounds[0] == known_bounds(looks.counts[0])).all()
    empty = TeamLooks(1, ANGLES, HALF_FOV, REACH)
    looks.restore_part(0, empty.part(0))
    assert not looks.counts.any()
    assert not looks.bounds.any()


def test_candidates_do_not_depend_on_the_size_of_the_grid() -> None:
    """Far from the start, the candidates, their gains and the global grid are those of the largest grid."""
    found = []
    for reserved in (0, LARGEST_SIZE // 2):
        rng, drive = np.random.default_rng(5), 24.0
        grids, looks = TeamGrids(1), TeamLooks(1, ANGLES, HALF_FOV, REACH)
        grids.reserve(reserved)
        candidates, sizes, seen = TeamCandidates(1, (HALF_FOV, REACH, 0.2)), set(), []
        for x in np.arange(0.0, drive, 1.0):
            for theta in rng.uniform(-3.0, 3.0, 6):
                pose = np.array([[[x, 0.4 * x, theta]]])
                scan = np.array([_range_in_room(pose[0, 0], angle) for angle in ANGLES])[None]
                grids.update(ALONE, pose, scan, np.zeros(1, bool), ray_directions(ANGLES), REACH, 0.2)
                looks.update(ALONE, pose, scan, grids.size)
            marks = rng.uniform([-3.0, -3.0, 0.0, 0.1], [x + 3.0, x, 0.0, 0.1], (20, 4)), rng.integers(1, 9, (20, 2))
            candidates.update(0, grids, looks, pose[0][None], (*marks, np.zeros(3)), NO_PLACES)
            picture, frame = np.empty((3, COARSE, COARSE), np.uint8), np.empty(3, np.float32)
            write_global_grid(grids.cells[0], looks.counts[0], grids.bounds[0], picture, frame)
            gains = np.array(candidates.gains(0))
            np.testing.assert_array_equal(looks.bounds[0], known_bounds(looks.counts[0]))
            seen.append((candidates.rows(0).copy(), candidates.lengths(0).copy(), gains, picture, frame))
            sizes.add(grids.size)
        found.append((seen, sizes))
    assert found[0][1] == {GRID_SIZES[0], GRID_SIZES[1]}
    assert found[1][1] == {LARGEST_SIZE}
    kinds = np.zeros(2, bool)
    for parts, expected in zip(found[0][0], found[1][0], strict=True):
        for part, wanted in zip(parts, expected, strict=True):
            np.testing.assert_array_equal(part, wanted)
        kinds |= [~np.isnan(parts[0][:16, 0]).all(), ~np.isnan(parts[0][16:28, 0]).all()]
    assert kinds.all()


def _range_in_room(pose: FloatArray, angle: float) -> float:
    """Return the distance along a ray to the walls of a corridor of 6 m around the line y = 0.4 x, open at its ends."""
    s = math.sin(pose[2] + angle) - 0.4 * math.cos(pose[2] + angle)
    across = pose[1] - 0.4 * pose[0]
    return min(REACH, ((3.0 if s > 0.0 else -3.0) - across) / s) if s != 0.0 else REACH


def plain_gains(cells: Any, looks: Any, weak: Any, view: Any) -> FloatArray:
    """Return what `view_gains` returns from its definition, by many narrow rays marched in short steps."""
    seen: set[tuple[int, int]] = set()
    walls: dict[tuple[int, int], float] = {}
    x, y, theta = view
    for angle in np.linspace(theta - HALF_FOV, theta + HALF_FOV, 400):
        last = None
        for along in np.arange(0.0, REACH, 0.03):
            row, col = cell_of((x + along * math.cos(angle), y + along * math.sin(angle)))
            if cells[row, col] == OCCUPIED:
                if last is not None and along >= NEAREST:
                    walls.setdefault(last, angle)
                break
            if cells[row, col] == UNKNOWN:
                seen.add((row, col))
            last = (row, col)
    wall = 0.0
    for (row, col), angle in walls.items():
        around = cells[row - 1 : row + 2, col - 1 : col + 2] == OCCUPIED
        normal = np.array([around[:, 2].sum() - around[:, 0].sum(), around[2].sum() - around[0].sum()], float)
        beside = around[0, 1] | around[2, 1] | around[1, 0] | around[1, 2]
        lack = max(1.0 - looks[row - 1 : row + 2, col - 1 : col + 2].sum() / LOOKED, 0.0)
        if beside and cells[row, col] == FREE and normal @ [math.cos(angle), math.sin(angle)] > 0.5 * np.hypot(*normal):
            wall += CELL * lack
    count = 0
    for place in weak:
        gap, bearing = np.hypot(*(place - [x, y])), math.atan2(place[1] - y, place[0] - x)
        way = [cell_of(np.array([x, y]) + s * (place - [x, y])) for s in np.arange(0, 1 - 0.3 / gap, 0.02)]
        in_view = abs(math.remainder(bearing - theta, 2 * math.pi)) < HALF_FOV and gap < REACH
        count += in_view and all(cells[tuple(cell)] != OCCUPIED for cell in way)
    return np.array([CELL**2 * len(seen), wall, count])


@pytest.mark.parametrize("view", [(0.1, 0.3, 0.0), (1.0, -1.3, 2.0), (-1.0, 2.0, -0.7), (4.0, 0.1, 3.0)])
def test_gains_agree_with_a_plain_fan_of_rays(view: tuple[float, float, float]) -> None:
    """Unknown area, unseen wall and weak landmarks are those of a fine fan of rays, to its resolution."""
    rng = np.random.default_rng(4)
    cells = walled(inner=3.0)
    rows, cols = np.array([cell_of((0.0, 0.0)), cell_of((2.4, 2.5))]).T
    cells[rows[0] : rows[1], cols[0] : cols[1]] = UNKNOWN
    looks = np.zeros((GRID_SIZE, GRID_SIZE), np.uint8)
    looks[: cell_of((0.0, 0.5))[0]] = 2  # of five for each cell
    looks[: cell_of((0.0, -1.0))[0]] = MOST_LOOKS
    weak = rng.uniform([-2.0, -4.0], [6.0, 4.0], (40, 2))
    gains = np.zeros(4)
    gains_of(cells, looks, weak, np.array(view), CAMERA, gains)
    area, wall, count = plain_gains(cells, looks, weak, view)
    assert gains[0] == pytest.approx(area, abs=0.15 + 0.15 * area)
    assert gains[1] == pytest.approx(wall, abs=0.45 + 0.2 * wall)
    assert abs(gains[2] - count) <= 1


def test_unknown_area_of_an_open_view_is_that_of_its_sector() -> None:
    """In the unknown a camera sees the sector of its field of view."""
    cells, gains = np.full((GRID_SIZE, GRID_SIZE), UNKNOWN, np.uint8), np.zeros(4)
    gains_of(cells, np.zeros_like(cells), np.empty((0, 2)), np.array([0.3, 0.2, 0.9]), CAMERA, gains)
    assert gains[0] == pytest.approx(HALF_FOV * REACH**2, rel=0.03)


class Robot:
    """Candidates of one robot in a room that it knows."""

    def __init__(self, cells: np.ndarray) -> None:
        self.grids, self.candidates = TeamGrids(1), TeamCandidates(1, (HALF_FOV, REACH, 0.2))
        evidence = np.where(cells == FREE, -5, np.where(cells == OCCUPIED, 5, 0)).astype(np.int8)
        know(self.grids.grids[0], evidence)
        self.team_looks = TeamLooks(1, ANGLES, HALF_FOV, REACH)
        self.looks = self.team_looks.counts[0]

    def update(self, pose: Any = (0.0, 0.0, 0.0), landmarks: Any = NO_LANDMARKS, places: Any = NO_PLACES) -> FloatArray:
        """Update twice, since new places are sought in every other update; return the rows of places to look from."""
        poses = np.array([[pose]], float)
        for _ in range(2):
            self.candidates.update(0, self.grids, self.team_looks, poses, landmarks, places)
        return self.candidates.rows(0)[16:28]


def test_places_to_look_from_cover_the_unseen_walls() -> None:
    """In a room never looked at, places to look from see most of the walls, and none is left once all is looked at."""
    cells = walled()
    robot = Robot(cells)
    rows = robot.update()
    held = rows[~np.isnan(rows[:, 0])]
    assert len(held) >= 6
    kinds = robot.candidates.features(np.zeros((1, 1, 3)), np.full((1, 1, 2), np.nan))[0, 16:28]
    assert (kinds[: len(held), CANDIDATE_FEATURES.index("is_revisit")] == 1.0).all()
    total, free = 0.0, cells == FREE
    border = free[1:-1, 1:-1] & (
        (cells[:-2, 1:-1] == OCCUPIED) | (cells[2:, 1:-1] == OCCUPIED)
        | (cells[1:-1, :-2] == OCCUPIED) | (cells[1:-1, 2:] == OCCUPIED)
    )  # fmt: skip
    total = CELL * border.sum()
    assert held[:, 3].sum() > 0.7 * total
    for x, y, heading, size, length in held:
        assert cells[tuple(cell_of((x, y)))] == FREE
        assert size >= 0.6
        gains = np.zeros(4)
        gains_of(cells, robot.looks, np.empty((0, 2)), np.array([x, y, heading]), CAMERA, gains)
        assert gains[1] >= 0.5 * size
        assert length >= np.hypot(x, y) - 0.3
    robot.looks[:] = LOOKED
    assert np.isnan(robot.update()).all()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_the_first_place_sees_most_of_all_targets(seed: int) -> None:
    """Among all places of the lattice, and all targets, near and far, it is the one with the best heading."""
    rng, corner, side = np.random.default_rng(seed), np.array([60, 66]), 180
    low, high = centre_of(corner, GRID_SIZE), centre_of(corner + side, GRID_SIZE)
    places, values = rng.uniform(low, high, (80, 2)), rng.uniform(0.5, 1.0, 80)
    targets = np.hstack([places, np.zeros((80, 2)), values[:, None], np.zeros((80, 1))])
    lattice = np.stack(np.meshgrid(*[np.arange(0, side, SPACING)] * 2, indexing="ij"), axis=-1).reshape(-1, 2) + corner
    spots = centre_of(lattice, GRID_SIZE)
    away = places[None] - spots[:, None]
    near = (np.hypot(*away.T).T >= NEAREST) & (np.hypot(*away.T).T <= FARTHEST)
    bins = np.floor(np.arctan2(away[..., 1], away[..., 0]) / (2 * np.pi) * BINS + 0.5).astype(int) % BINS
    totals = [
        [(values * seen * ((own - b + 1) % BINS <= 2)).sum() for b in range(BINS)]
        for own, seen in zip(bins, near, strict=True)
    ]
    rows, cells = np.full((12, 5), np.nan), np.full((GRID_SIZE, GRID_SIZE), FREE, np.uint8)
    places_of(cells, np.zeros((side, side), np.int32), tuple(corner.tolist()), CAMERA, targets, values.copy(), rows)
    assert rows[0, 3] == pytest.approx(np.max(totals))
    at = np.hypot(*(spots - rows[0, :2]).T).argmin()
    assert rows[0, 3] == pytest.approx(np.max(totals[at]))


def test_places_keep_their_slots_while_something_is_left_to_see() -> None:
    """A look from one place empties its slot and leaves the others where they are."""
    robot = Robot(walled())
    before = robot.update().copy()
    goal = before[0]
    cells = robot.grids.grids[0].cells
    scan = np.array([_range(cells, goal[:3], angle) for angle in ANGLES])
    looks = TeamLooks(1, ANGLES, HALF_FOV, REACH)
    for _ in range(12):
        looks.update(ALONE, goal[:3][None, None], scan[None], GRID_SIZE)
    robot.looks += looks.counts[0]
    after = robot.update()
    assert not np.array_equal(after[0, :2], before[0, :2])
    stays = np.isclose(after[1:, :3], before[1:, :3], equal_nan=True).all(axis=1)
    assert stays.mean() > 0.6


def _range(cells: np.ndarray, pose: FloatArray, angle: float) -> float:
    """Return the distance to the first occupied cell along a ray."""
    for along in np.arange(0.0, REACH, 0.02):
        x, y = pose[:2] + along * np.array([math.cos(pose[2] + angle), math.sin(pose[2] + angle)])
        if cells[tuple(cell_of((x, y)))] == OCCUPIED:
            return float(along)
    return REACH


def test_what_stays_unseen_is_given_up() -> None:
    """Where a robot looks in vain for some updates, the place is dropped and its walls no longer attract it."""
    robot = Robot(walled())
    goal = robot.update()[0].copy()
    for _ in range(PATIENCE):
        rows = robot.update(goal[:3])
    assert not (np.isclose(rows[:, :3], goal[:3]).all(axis=1)).any()
    assert (robot.looks == MOST_LOOKS).any()
    np.testing.assert_array_equal(robot.team_looks.bounds[0], known_bounds(robot.looks))


def test_weak_landmarks_are_counted_but_make_no_places_to_look_from() -> None:
    """Views count landmarks measured once or twice at walls that lack looks; no robot is sent to see them alone."""
    places = np.array([[2.0, 3.9, 0.4, 0.1], [2.6, 3.9, 0.2, 0.1], [3.1, 3.9, 0.1, 0.1]])
    inside = np.array([0.0, 1.5, 0.0, 0.0])
    plain = Robot(walled()).update()
    for count, shift, wanted in ((1, 0.0, True), (2, 0.0, True), (3, 0.0, False), (1, inside, False)):
        robot = Robot(walled())
        start = np.array([0.4, -0.2, 0.3])  # from the map frame to the start frame
        seen = places - shift
        moved = compose(inverse(start), np.column_stack([seen[:, :2], np.zeros(3)]))
        marks = np.column_stack([moved[:, :2], seen[:, 2:]]), np.full((3, 2), count), start
        rows = robot.update(landmarks=marks)
        np.testing.assert_array_equal(rows, plain)
        assert (robot.candidates.gains(0).weak_landmarks.sum() >= 2) == wanted


def test_teammates_paths_are_those_of_a_search_from_them() -> None:
    """Lengths to all candidates agree with searches from the robots' places; unknown robots have none."""
    grids, candidates = TeamGrids(3), TeamCandidates(3, (HALF_FOV, REACH, 0.2))
    cells = walled(inner=3.0)
    row = cell_of((0.0, 2.0))[0]
    cells[row : row + 7, cell_of((3.0, 0.0))[1]] = FREE  # a door
    evidence = np.where(cells == FREE, -5, np.where(cells == OCCUPIED, 5, 0)).astype(np.int8)
    know(grids.grids[1], evidence)
    poses = np.full((3, 3, 3), np.nan)
    poses[1, 1], poses[1, 0] = [0.0, 0.0, 0.0], [5.0, -2.0, 1.0]
    for _ in range(2):
        candidates.update(1, grids, TeamLooks(2, ANGLES, HALF_FOV, REACH), poses, NO_LANDMARKS, NO_PLACES)
    rows = candidates.rows(1)
    valid = ~np.isnan(rows[:, 0])
    ways = distance_map(grids.grids[1].cells, (0.0, 0.0))
    expected = lengths_between(ways, poses[1, [1, 0], :2], rows[valid, :2])
    np.testing.assert_allclose(candidates.lengths(1)[valid, 1], expected[0], atol=0.05)
    np.testing.assert_allclose(candidates.lengths(1)[valid, 0], expected[1], rtol=0.12, atol=0.9)
    assert np.isinf(candidates.lengths(1)[:, 2]).all()
    assert np.isinf(candidates.lengths(1)[~valid]).all()


def test_features_are_what_their_names_say() -> None:
    """Columns hold positions and headings in the robot frame, goals, distances and kinds; empty slots zeros."""
    robot = Robot(walled())
    pose = np.array([0.5, -0.4, 0.7])
    places = NO_PLACES.copy()
    places[0] = [3.0, 3.0, 0.2]
    robot.update(pose, places=places)
    rows = robot.candidates.rows(0)
    goals = np.array([[rows[17, :2] + [0.1, 0.1]]])
    features = robot.candidates.features(pose[None, None], goals)[0]
    assert features.shape == (NUM_CANDIDATES, len(CANDIDATE_FEATURES))
    columns: dict[str, FloatArray] = dict(zip(CANDIDATE_FEATURES, features.T, strict=True))
    valid = np.flatnonzero(~np.isnan(rows[:, 0]))
    assert (features[np.isnan(rows[:, 0])] == 0.0).all()
    seen = np.column_stack([columns["x"], columns["y"], np.arctan2(columns["heading_sin"], columns["heading_cos"])])
    np.testing.assert_allclose(compose(pose, seen[valid].astype(float))[:, :2], rows[valid, :2], atol=1e-4)
    np.testing.assert_allclose(np.cos(pose[2] + seen[valid, 2] - rows[valid, 2]), 1.0, atol=1e-5)
    np.testing.assert_allclose(columns["path_length"][valid], rows[valid, 4], rtol=1e-6)
    np.testing.assert_allclose(columns["size"][valid], rows[valid, 3], rtol=1e-6)
    assert np.flatnonzero(columns["own_goal"]).tolist() == [17]
    assert (columns["teammate_path_length"][valid] == 60.0).all()
    assert not columns["teammate_goal"].any()
    for name, gain in robot.candidates.gains(0)._asdict().items():
        np.testing.assert_allclose(columns[name], gain, rtol=1e-6, err_msg=name)
    gaps = np.linalg.norm(rows[valid, None, :2] - rows[None, valid, :2], axis=2) + 60.0 * np.eye(len(valid))
    np.testing.assert_allclose(columns["nearest_candidate"][valid], gaps.min(axis=1), rtol=1e-5)
    assert columns["is_rendezvous"][28] == 1.0
    assert features[valid, -3:].sum(axis=1).tolist() == [1.0] * len(valid)


def test_paths_far_from_known_landmarks_are_uncertain() -> None:
    """A path is uncertain all along without landmarks, and not at all where landmarks measured often are around."""
    for count, share in ((3, 0.0), (2, 1.0)):
        robot = Robot(walled())
        xs, ys = np.meshgrid(np.arange(-2.0, 6.1), np.arange(-4.0, 4.1))
        positions = np.column_stack([xs.ravel(), ys.ravel(), np.zeros((xs.size, 2))])
        rows = robot.update(landmarks=(positions, np.full((xs.size, 2), count), np.zeros(3)))
        held = ~np.isnan(rows[:, 0])
        assert held.any()
        uncertain = robot.candidates.gains(0).uncertain_length[16:28][held]
        np.testing.assert_allclose(uncertain, share * rows[held, 4], atol=1e-9)


def _points(starts: FloatArray, own: FloatArray, sigma: float = 0.0) -> TeamPoses:
    """Return pose estimates of robots in one map frame: starts (K, 3) and poses (K, 3) there."""
    team_poses = TeamPoses(len(starts))
    team_poses.beliefs.fill(0.0)
    for robot, start in enumerate(starts):
        team_poses.poses[robot] = compose(inverse(start), own)
        team_poses.starts[robot] = inverse(start)
        team_poses.own[robot] = team_poses.poses[robot, robot]
    team_poses.sigmas.fill(sigma)
    return team_poses


def test_rendezvous_before_and_after_merges() -> None:
    """Alone: own start and richest area; merged: starts of teammates until visited; lost ones: their last place."""
    starts = np.array([[0.0, 0.0, 0.3], [5.0, 1.0, -1.0], [2.0, 6.0, 2.0]])
    own = np.array([[1.0, 1.0, 0.0], [6.0, 1.0, 0.0], [2.0, 4.0, 0.0]])
    team_poses, rendezvous = _points(starts, own), Rendezvous(3)
    alone, both = np.array([1, 0, 0]), np.array([1, 1, 1])
    marks = np.array([[5.0, 5.0, 0.0, 0.1], [6.0, 5.0, 0.0, 0.1], [-9.0, 1.0, 0.0, 0.1]])
    landmarks = marks, np.full((3, 2), 5), np.zeros(3)
    places = rendezvous.update(0, team_poses, (0,), alone, landmarks)
    assert places[OWN_START].tolist() == [0.0, 0.0, 0.0]
    assert places[RICHEST] == pytest.approx([5.5, 5.0, math.atan2(5.0, 5.5)])
    assert np.isnan(places[2:]).all()
    places = rendezvous.update(0, team_poses, (0, 1, 2), both, landmarks)
    assert np.isnan(places[:2]).all()
    expected = compose(inverse(starts[0]), starts[1:])
    np.testing.assert_allclose(places[2:, :2], expected[:, :2], atol=1e-9)
    np.testing.assert_allclose(np.cos(places[2:, 2] - expected[:, 2]), 1.0)
    visiting = _points(starts, np.array([[5.0, 2.0, 0.0], *own[1:]]), sigma=0.5)
    places = rendezvous.update(0, visiting, (0, 1, 2), both, landmarks)
    assert places[OWN_START].tolist() == [0.0, 0.0, 0.0]  # the pose is uncertain
    np.testing.assert_allclose(places[2, :2], expected[1, :2], atol=1e-9)
    assert np.isnan(places[3]).all()
    other = Rendezvous(3)
    restore(other, take(rendezvous))
    lost = np.array([1, 0, 1])
    for each in (rendezvous, other):
        places = each.update(0, team_poses, (0, 1, 2), lost, landmarks)
        np.testing.assert_allclose(places[2, :2], team_poses.poses[0, 1, :2])
        np.testing.assert_allclose(places[3, :2], expected[1, :2], atol=1e-9)


def test_places_for_a_rendezvous_become_reachable_candidates() -> None:
    """A place in a wall moves to free floor nearby; one behind the walls, or where the robot stands, makes none."""
    robot, places = Robot(walled()), NO_PLACES.copy()
    places[0], places[1], places[2] = [5.95, 0.0, 1.0], [20.0, 0.0, 0.0], [0.2, 0.0, 0.0]
    robot.update(places=places)
    rows = robot.candidates.rows(0)[28:]
    assert robot.grids.grids[0].cells[tuple(cell_of(rows[0, :2]))] == FREE
    assert np.hypot(*(rows[0, :2] - places[0, :2])) < 1.0
    assert rows[0, 2] == 1.0
    assert np.isnan(rows[1:]).all()


def test_the_global_grid_shows_all_that_was_seen() -> None:
    """Shares of free and occupied cells in blocks, and of walls looked at, are those of numpy, at the stated place."""
    cells = walled(x=9.0, inner=4.0)
    looks = np.zeros(cells.shape, np.uint8)
    looks[: GRID_SIZE // 2] = LOOKED
    picture, frame, bounds = np.empty((3, COARSE, COARSE), np.uint8), np.empty(3, np.float32), known_bounds(cells)
    write_global_grid(cells, looks, bounds, picture, frame)
    scale = round(float(frame[2]) / CELL)
    assert scale == -(-max(bounds[2] - bounds[0], bounds[3] - bounds[1]) // COARSE) == 2
    top, left = (
        int(i)
        for i in cell_of(frame[:2].astype(float) - 0.5 * (COARSE - 1) * frame[2] - 0.5 * (scale - 1) * CELL + 1e-4)
    )
    side = COARSE * scale
    blocks = cells[top : top + side, left : left + side].reshape(COARSE, scale, COARSE, scale).swapaxes(1, 2)
    np.testing.assert_array_equal(picture[0], (blocks == FREE).sum(axis=(2, 3)) * 255 // scale**2)
    np.testing.assert_array_equal(picture[1], (blocks == OCCUPIED).sum(axis=(2, 3)) * 255 // scale**2)
    lower, upper = picture[2, : COARSE // 2 - 1], picture[2, COARSE // 2 + 1 :]
    assert lower.max() == 255
    assert upper.max() == 0
    assert picture[0].astype(bool).any(axis=0).sum() > 20


def test_candidates_of_beliefs_are_those_of_observations() -> None:
    """Kinds, gains and teammates' paths of a belief agree with the features; slots keep their kinds."""
    env = small_env(action_type="goal", max_cycles=40)
    env.reset(seed=5, options={"start_poses": MEETING})
    rng = np.random.default_rng(3)
    kinds: set[int] = set()
    for _ in range(30):
        chosen = {a: rng.choice([0, *(1 + np.flatnonzero(env.belief(a).candidates.valid))]) for a in env.agents}
        observations = env.step(chosen)[0]
        for agent in env.agents:
            belief, seen = env.belief(agent), observations[agent]["candidates"]
            candidates = belief.candidates
            assert (candidates.valid == (candidates.kinds >= 0)).all()
            assert (observations[agent]["action_mask"] == [True, *candidates.valid]).all()
            expected: IntArray = np.repeat([0, 1, 2], [16, 12, 4])
            assert (candidates.kinds[candidates.valid] == expected[candidates.valid]).all()
            kinds |= set(candidates.kinds.tolist())
            columns = dict(zip(CANDIDATE_FEATURES, seen.T, strict=True))
            for name, gain in candidates.gains._asdict().items():
                np.testing.assert_allclose(columns[name], gain, rtol=1e-6, err_msg=name)
            assert candidates.teammate_lengths.shape == (NUM_CANDIDATES, len(belief.teammates))
            if belief.teammates:
                nearest = np.minimum(candidates.teammate_lengths.min(axis=1), 60.0)[candidates.valid]
                np.testing.assert_allclose(columns["teammate_path_length"][candidates.valid], nearest, rtol=1e-6)
            assert observations[agent]["time_left"][0] == pytest.approx(belief.seconds_left)
    assert any(event.kind == "merge" for event in env.events)
    assert kinds == {-1, 0, 1, 2}
    assert list(CandidateKind) == [-1, 0, 1, 2]


def test_snapshots_continue_with_candidates_of_all_kinds() -> None:
    """From a snapshot with candidates of all kinds a twin goes on to the bit, also when it was elsewhere before."""
    env = small_env(action_type="goal", max_cycles=100)
    env.reset(seed=5, options={"start_poses": MEETING})
    rng = np.random.default_rng(3)

    def go_on(one: Any, draws: np.random.Generator) -> dict[str, Any]:
        slots = {a: [0, *(1 + np.flatnonzero(one.belief(a).candidates.valid))] for a in one.agents}
        return dict(one.step({a: draws.choice(slots[a]) for a in one.agents})[0])

    while set(env.belief("robot_0").candidates.kinds.tolist()) != {-1, 0, 1, 2}:
        go_on(env, rng)
    twin = small_env(action_type="goal", max_cycles=100)
    twin.reset(seed=8)
    for _ in range(3):
        go_on(twin, rng)
    twin.set_state(env.get_state())
    draws = np.random.default_rng(1), np.random.default_rng(1)
    for _ in range(12):
        expected, found = go_on(env, draws[0]), go_on(twin, draws[1])
        for agent, parts in expected.items():
            for name, part in parts.items():
                np.testing.assert_array_equal(found[agent][name], part, err_msg=name)
            np.testing.assert_array_equal(twin.belief(agent).looks, env.belief(agent).looks)


def test_teammates_tell_their_goals() -> None:
    """After a merge a robot knows the goal of its teammate, in its own frame, and sees it among the candidates."""
    env = small_env(action_type="goal", max_cycles=60)
    env.reset(seed=5, options={"start_poses": MEETING})
    told = False
    for _ in range(40):
        chosen, goals = {}, {}
        for agent in env.agents:
            candidates = env.belief(agent).candidates
            slots = np.flatnonzero(candidates.valid)
            chosen[agent] = 1 + int(slots[0]) if len(slots) else 0
            goals[agent] = candidates.goals[slots[0]] if len(slots) else np.full(2, np.nan)
        env.step(chosen)
        for agent, other in (("robot_0", "robot_1"), ("robot_1", "robot_0")):
            belief, mate = env.belief(agent), env.belief(other)
            if belief.teammates and not np.isnan(goals[other]).any():
                own_from_mate = compose(belief.start_from_group, inverse(mate.start_from_group))
                expected = compose(own_from_mate, np.array([*goals[other], 0.0]))[:2]
                np.testing.assert_allclose(belief.teammates[0].goal, expected, atol=1e-9)
                told = True
    assert told


def test_robots_look_at_walls_again_when_nothing_is_left_to_explore() -> None:
    """After exploring, going to the places to look from again measures more landmarks than staying does."""
    held = {}
    for looks_again in (False, True):
        env = vslam_v0.parallel_env(world="hall", num_robots=1, action_type="goal", max_cycles=90)
        env.reset(seed=3)
        for step in range(90):
            candidates = env.belief("robot_0").candidates
            slots = candidates.of_kind(CandidateKind.FRONTIER if step < 30 else CandidateKind.REVISIT)
            worth = candidates.sizes[slots] - 0.2 * candidates.lengths[slots] + candidates.own_goal[slots]
            best = int(slots[np.argmax(worth)]) if len(slots) else -1
            infos = env.step({"robot_0": 1 + best if looks_again or step < 30 else 0})[4]
        held[looks_again] = infos["robot_0"]["map_recall"]
    assert held[True] > held[False] + 0.1


def test_turning_on_the_spot_counts_looks() -> None:
    """A robot that turns in a room looks at more and more of its walls, and forgets nothing."""
    env = small_env(max_cycles=60)
    env.reset(seed=1)
    totals = []
    for _ in range(60):
        env.step(turning(env.agents, 0.0, 0.8))
        totals.append(int(env.belief("robot_0").looks.astype(int).sum()))
    assert (np.diff(totals) >= 0).all()
    assert totals[-1] > 3 * max(totals[4], 1)
    assert ray_directions(ANGLES).shape == (2, len(ANGLES))
