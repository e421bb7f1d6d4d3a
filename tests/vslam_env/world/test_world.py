"""Worlds: walls, landmarks, families, and the space where robots fit."""

import json
import os
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from builders.environments import WALLS, room, small_env

from slam_backend.models.camera import StereoCamera
from vslam_env import EnvConfig, vslam_v0
from vslam_env.sensors import LandmarkSensor, LandmarkSensorConfig
from vslam_env.simulation.scenario import sample_scenario
from vslam_env.world import (
    SPLITS,
    WORLD_FAMILIES,
    FreeSpace,
    LandmarkConfig,
    Landmarks,
    World,
    draw_world_seed,
    is_single_layout,
    make_world,
    place_landmarks,
    portable_source,
    save_walls_json,
)
from vslam_env.world.clearance import distances_to_walls
from vslam_env.world.landmarks import CORNER, draw_descriptors
from vslam_env.world.loaders.splits import files_of_split

ROOM = [[0, 0, 5, 0], [5, 0, 5, 3], [5, 3, 0, 3], [0, 3, 0, 0]]


def landmarks(**changed: Any) -> Landmarks:
    """Two landmarks on the first wall of ROOM."""
    fields: dict[str, Any] = {
        "positions": [[1, 0, 0.2], [2, 0, -0.3]],
        "normals": [[0, 1], [0, 1]],
        "walls": [0, 0],
        "descriptors": np.eye(2, 7),
    }
    return Landmarks(**(fields | changed))


def test_world_is_frozen_and_knows_its_bounds() -> None:
    """A world's arrays are copies that cannot be written, and its bounds hold all walls."""
    walls = np.array(ROOM, dtype=float)
    world = World("room", walls, landmarks(), [[1, 1, 0]])
    walls[:] = 7.0
    assert world.bounds == (0.0, 0.0, 5.0, 3.0)
    for array in (world.walls, world.start_poses, world.landmarks.positions, world.landmarks.descriptors):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 1.0


def test_make_world_takes_names_worlds_functions_and_paths(tmp_path: Path) -> None:
    """A family name, a World, a function and a path or folder of paths all give a World."""
    rng = np.random.default_rng(3)
    world = World("mine", ROOM)
    (tmp_path / "room.json").write_text(json.dumps({"walls": ROOM, "start_poses": [[1, 1, 0.5]], "name": "hall"}))
    assert make_world("fig5", rng).name == "fig5"
    assert make_world(world, rng) is world
    assert make_world(lambda given: World(f"{given is rng}", ROOM), rng).name == "True"
    for path in (tmp_path, tmp_path / "room.json", str(tmp_path / "room.json")):
        loaded = make_world(path, rng)
        np.testing.assert_array_equal(loaded.walls, ROOM)
        np.testing.assert_array_equal(loaded.start_poses, [[1, 1, 0.5]])
        assert loaded.name == "hall"


# Each family once, large ones as small as they come, and floors of the sizes for which office has a second layout.
FAMILIES = sorted({*WORLD_FAMILIES, "rooms:extent=40", "campus:extent=70", "office:extent=30"} - {"rooms", "campus"})


@pytest.mark.parametrize("family", FAMILIES)
def test_landmarks_sit_on_faces_that_can_be_looked_at(family: str) -> None:
    """Each landmark lies on its wall, off its corners, spaced from its neighbours, and faces the free space."""
    rng = np.random.default_rng(11)
    world = make_world(family, rng)
    free = FreeSpace(world)
    config = LandmarkConfig(min_spacing=0.2)
    marks = place_landmarks(world, rng, config, free)
    a, b = world.walls[marks.walls, :2], world.walls[marks.walls, 2:]
    length = np.linalg.norm(b - a, axis=1)
    along = (b - a) / length[:, None]
    offset = marks.positions[:, :2] - a
    across = along[:, 0] * offset[:, 1] - along[:, 1] * offset[:, 0]
    where = np.einsum("ni,ni->n", along, offset)
    np.testing.assert_allclose(across, 0.0, atol=1e-9)
    np.testing.assert_allclose(np.einsum("ni,ni->n", along, marks.normals), 0.0, atol=1e-12)
    assert np.all((where >= CORNER - 1e-9) & (where <= length - CORNER + 1e-9))
    assert free.contains(marks.positions[:, :2] + 0.12 * marks.normals).all()
    assert np.all((marks.positions[:, 2] >= config.min_height) & (marks.positions[:, 2] <= config.max_height))
    side = along[:, 0] * marks.normals[:, 1] - along[:, 1] * marks.normals[:, 0] > 0
    for face in set(zip(marks.walls.tolist(), side.tolist(), strict=True)):
        own = np.sort(where[(marks.walls == face[0]) & (side == face[1])])
        assert np.all(np.diff(own) >= config.min_spacing - 1e-9)


def test_interior_walls_carry_landmarks_on_both_faces() -> None:
    """Both faces of a wall inside the room count; the outer faces of the outer walls do not."""
    world = World("divided", [*ROOM, [1, 1.6, 4, 1.6]])
    marks = place_landmarks(world, np.random.default_rng(0), LandmarkConfig(density=3.0))
    inner = marks.normals[marks.walls == 4, 1]
    assert (inner > 0).sum() >= 6
    assert (inner < 0).sum() >= 6
    assert np.all(marks.normals[marks.walls == 0, 1] > 0)


def test_descriptors_are_as_distinct_as_asked() -> None:
    """The typical distance of two descriptors is the one of the configuration, and the nearest is not far below."""
    for distinctness in (0.5, 0.8, 1.4):
        vectors = draw_descriptors(300, LandmarkConfig(distinctness=distinctness), np.random.default_rng(1))
        assert vectors.dtype == np.float32
        squares = np.maximum(0.0, 2.0 - 2.0 * vectors.astype(float) @ vectors.T.astype(float))
        distances = np.sqrt(squares[~np.eye(300, dtype=bool)].reshape(300, 299))
        assert abs(np.median(distances) - distinctness) < 0.02 * distinctness
        assert 0.7 * distinctness < np.median(distances.min(axis=1)) < 0.9 * distinctness


def test_a_share_of_descriptors_is_repeated() -> None:
    """With `repeated` = 0.4 about 40 % of 500 landmarks look exactly like another (4 sigma: 0.09)."""
    vectors = draw_descriptors(500, LandmarkConfig(repeated=0.4), np.random.default_rng(2))
    assert abs(1.0 - len(np.unique(vectors, axis=0)) / 500 - 0.4) < 0.09


@pytest.mark.parametrize("family", FAMILIES)
def test_all_floor_is_connected(family: str) -> None:
    """In 15 buildings of a family, 4 of large ones, the reachable part is nearly all floor in which a robot fits."""
    for seed in range(4 if "extent" in family else 15):
        world = make_world(family, np.random.default_rng(seed))
        space = FreeSpace(world)
        alone = FreeSpace(world, 0.05)  # a robot so small that it fits almost wherever there is floor
        x_min, y_min, x_max, y_max = world.bounds
        assert len(space.free_area_cells) == len(alone.free_area_cells)
        assert 0.04 * len(space.free_area_cells) > 0.35 * (x_max - x_min) * (y_max - y_min)
        assert space.reachable.sum() > 0.4 * space.open_space.sum()
        assert 10 <= len(world.walls) <= (100 if "extent" not in family else 0.3 * (x_max - x_min) * (y_max - y_min))


@pytest.mark.parametrize("family", FAMILIES)
def test_starts_are_free_reachable_and_apart(family: str) -> None:
    """Three robots start 5 m apart, or 7 m if that is asked, off the walls, in the same part, sharing no view."""
    for seed, apart in ((0, 5.0), (1, 7.0), (2, 5.0)):
        config = EnvConfig(world=family, min_start_distance=apart)
        scenario, _ = sample_scenario(config, family, np.random.SeedSequence(seed))
        starts = scenario.true_starts
        gaps = np.linalg.norm(starts[:, None, :2] - starts[:, :2], axis=2)[~np.eye(3, dtype=bool)]
        assert gaps.min() >= apart
        FreeSpace(scenario.world).check_starts(starts, 3)
        assert scenario.sensor.visible(starts).sum(axis=0).max() <= 1


@pytest.mark.parametrize("family", ["maze", "loops"])
def test_mazes_and_loops_have_cycles(family: str) -> None:
    """Free floor has a hole in most mazes, and in all loops one around each block: walls that touch no outer wall."""
    with_loops = 0
    for seed in range(10):
        open_space = FreeSpace(make_world(family, np.random.default_rng(seed))).open_space
        parts = cv2.connectedComponents((~open_space).astype(np.uint8), connectivity=8)[0] - 1  # the outside is one
        with_loops += parts >= 2
        if family == "loops":
            assert parts >= 5
    assert with_loops >= 7


def test_pillars_of_a_hall_stand_apart() -> None:
    """Pillars stand apart: each is passed on all sides by a robot, as the free floor goes around it."""
    world = make_world("hall", np.random.default_rng(5))
    pillars = world.walls[4:].reshape(-1, 4, 4)
    middles = pillars[:, :, :2].mean(axis=1)
    gaps = np.linalg.norm(middles[:, None] - middles, axis=2)[~np.eye(len(middles), dtype=bool)]
    assert len(pillars) >= 8
    assert gaps.min() > 1.4


@pytest.mark.parametrize(
    ("source", "size"),
    [
        ("rooms:extent=47:room=9", (47.0, 47.0)),
        ("rooms:room=2.5:extent=200", (200.0, 200.0)),
        ("office:extent=150", (150.0, 105.0)),
        ("campus:extent=200", (200.0, 160.0)),
    ],
)
def test_options_of_a_family_set_its_size(source: str, size: tuple[float, float]) -> None:
    """A large world has the extent that its options give, up to the largest, all its floor connected."""
    world = make_world(source, np.random.default_rng(3))
    assert world.bounds == pytest.approx((0.0, 0.0, *size))
    large, small = (FreeSpace(world, radius) for radius in (0.2, 0.05))
    assert len(large.free_area_cells) == len(small.free_area_cells)
    assert 0.04 * len(large.free_area_cells) > 0.8 * size[0] * size[1]


def test_rooms_have_the_size_of_the_option() -> None:
    """Walls between rooms lie on the grid of whole rooms, at least as large as asked: 5 of 9.4 m in 47 m."""
    walls = make_world("rooms:extent=47:room=9", np.random.default_rng(3)).walls
    long = walls[np.hypot(walls[:, 2] - walls[:, 0], walls[:, 3] - walls[:, 1]) > 5.2]  # furniture is shorter
    upright = long[:, 0] == long[:, 2]
    places = np.concatenate([long[upright, 0], long[~upright, 1]]) / 9.4
    assert set(places.round(6)) == {0.0, 1.0, 2.0, 3.0, 4.0, 5.0}


def test_paths_of_a_campus_lead_around_and_into_buildings() -> None:
    """Robots can go round along the fence, and into the buildings, which fill most of the campus."""
    space = FreeSpace(make_world("campus:extent=70", np.random.default_rng(4)))
    along, at = np.arange(1.2, 54.8, 0.1), np.full(536, 1.2)
    fence = [np.column_stack(pair) for pair in ((at, along), (70.0 - at, along), (along, at), (along, 56.0 - at))]
    assert space.contains(np.vstack(fence)).all()
    inner = space.free_area_cells[(np.abs(space.free_area_cells - [17.5, 28.0]) < 14.0).all(axis=1)]
    assert 0.04 * len(inner) > 0.75 * 28.0 * 28.0


def test_options_of_a_plan_set_its_scale(tmp_path: Path) -> None:
    """The scale of plans follows the path of a file or folder; a path made absolute keeps its options."""
    image = np.zeros((140, 180), np.uint8)
    image[10:130, 10:170] = 255
    cv2.imwrite(str(tmp_path / "plan.png"), image)
    rng = np.random.default_rng(0)
    for source in (f"{tmp_path}/plan.png", str(tmp_path)):
        world = make_world(f"{source}:metres_per_pixel=0.5", rng)
        assert world.bounds == pytest.approx((5.0, 5.0, 85.0, 65.0))
    assert portable_source(f"{tmp_path}/../{tmp_path.name}/plan.png:tolerance_px=2").endswith("plan.png:tolerance_px=2")
    assert portable_source("rooms:extent=30") == "rooms:extent=30"
    assert is_single_layout(f"{tmp_path}/plan.png:metres_per_pixel=0.5")
    assert not is_single_layout("rooms:extent=30")
    assert not is_single_layout(f"{tmp_path}:metres_per_pixel=0.5")


@pytest.mark.parametrize(
    ("source", "says"),
    [
        ("rooms:extent=201", r"^extent: expected a finite number > 0 and <= 200, got 201"),
        ("rooms:extent=15:room=10", r"^extent: expected at least 20 m for rooms of 10 m, got 15"),
        ("rooms:extent=30,room=5", r"^world: expected one of .* Write options as in rooms:extent=60:room=10\.$"),
        ("rooms:room=1000", r"^room: expected a finite number"),
        ("office:extent=20", r"^extent: expected a finite number >= 30 and <= 200, got 20.*leave it out"),
        ("campus:extent=nan", r"^extent: expected a finite number"),
        ("rooms:side=3", r"^world: expected options that 'rooms' has, got 'rooms:side=3'\. Options: extent, room"),
        ("rooms:extent=40:extent=50", r"^world: expected options that 'rooms' has"),
        ("rooms:extnt=40", r"^world: expected options that 'rooms' has, .* Did you mean 'extent'\? Options: "),
        ("ofice", r"^world: expected one of 'office', .*, got 'ofice'\. Did you mean 'office'\? Check"),
        ("ofice:extent=60", r"^world: expected one of 'office', .*, got 'ofice'\. Did you mean 'office'\? Check"),
        ("nowhere:extent=60", r"^world: expected one of 'office', .*, got 'nowhere'\. Check"),
        ("maze:extent=40", r"This family has no options"),
        ("rooms:extent=wide", r"^world: expected a number for 'extent', got 'rooms:extent=wide'"),
        (
            "plan.png:metres_per_pixel=10",
            r"^world: expected a plan of at most 200 m, got '1600 x 1200 m in plan.png'. Lower",
        ),
        ("plan.png:metres_per_pixel=-1", r"^metres_per_pixel: expected a finite number > 0"),
        ("plan.png:extent=60", r"Options: metres_per_pixel, tolerance_px"),
        ("room.json:metres_per_pixel=1", r"^world: expected no option 'metres_per_pixel' for files of this kind"),
    ],
)
def test_bad_sizes_and_scales_are_refused(source: str, says: str, tmp_path: Path, monkeypatch: Any) -> None:
    """Worlds that are too large, plans of kilometres and unknown options give one error, at the reset at the latest."""
    monkeypatch.chdir(tmp_path)
    image = np.zeros((140, 180), np.uint8)
    image[10:130, 10:170] = 255
    cv2.imwrite("plan.png", image)
    save_walls_json(World("room", ROOM), "room.json")
    with pytest.raises(ValueError, match=says):
        small_env(world=source).reset(seed=0)


def test_splits_are_disjoint() -> None:
    """The seeds of the splits are apart, and each draw stays in its own range."""
    ranges = sorted(SPLITS.values())
    assert all(end <= begin for (_, end), (begin, _) in pairwise(ranges))
    rng = np.random.default_rng(2)
    for split, (first, end) in SPLITS.items():
        drawn = [draw_world_seed(split, rng) for _ in range(200)]
        assert first <= min(drawn) <= max(drawn) < end
        assert len(set(drawn)) > 150


def test_a_split_environment_draws_from_its_seeds() -> None:
    """The buildings of a split are those of world seeds in its range; a world seed that is given is obeyed."""
    seen: list[int] = []

    def watched(rng: np.random.Generator) -> World:
        seen.append(int(rng.integers(2**40)))
        return room()

    env = small_env(world=watched, world_split="validation")
    env.reset(seed=4)
    env.reset(seed=4)
    first, end = SPLITS["validation"]
    possible = {
        int(np.random.default_rng(np.random.SeedSequence(seed).spawn(2)[0]).integers(2**40)): seed
        for seed in range(first, end)
    }
    assert seen[0] == seen[1]
    assert seen[0] in possible
    env.reset(seed=5)
    assert seen[2] in possible
    assert seen[2] != seen[0]
    env.reset(seed=5, options={"world_seed": 3})
    assert seen[3] not in possible


def test_files_are_split_by_turns(tmp_path: Path) -> None:
    """Of twelve files the first and the eleventh are for tests, the second and the twelfth for validation."""
    files = [tmp_path / f"{index:02d}.json" for index in range(12)]
    for file in files:
        save_walls_json(World(file.stem, WALLS), file)
    split = {name: files_of_split(files, name) for name in SPLITS}
    assert split["test"] == [files[0], files[10]]
    assert split["validation"] == [files[1], files[11]]
    assert split["train"] == files[2:10]
    names = {make_world(tmp_path, np.random.default_rng(seed), "test").name for seed in range(20)}
    assert names == {"00", "10"}


@pytest.mark.parametrize(
    ("act", "says"),
    [
        (lambda path: small_env(world_split="test"), "world_split: expected None for a single layout"),
        (lambda path: vslam_v0.parallel_env(world_split="exam"), "world_split: expected .*'train'.*, got 'exam'"),
        (lambda path: small_env(world=path, world_split="train").reset(), "world_split: expected files for 'train'"),
    ],
)
def test_bad_splits_are_refused(act: Callable[[Path], object], says: str, tmp_path: Path) -> None:
    """A split of what cannot be split, or that does not exist, is refused."""
    save_walls_json(room(), tmp_path / "room.json")
    with pytest.raises(ValueError, match=says):
        act(tmp_path)


def test_a_file_is_read_again_when_it_changes(tmp_path: Path) -> None:
    """A world that is loaded twice is read once, unless its file was written in between."""
    path, rng = tmp_path / "room.json", np.random.default_rng(0)
    save_walls_json(World("room", WALLS), path)
    first = make_world(path, rng)
    assert make_world(path, rng) is first
    save_walls_json(World("room", 2.0 * WALLS), path)
    os.utime(path, ns=(1, 1))
    np.testing.assert_array_equal(make_world(path, rng).walls, 2.0 * WALLS)


# A 6 x 3 m hall with a 1 m door in the wall x = 4, a closed closet in a corner, and a wall outside.
HALL = [
    [0, 0, 6, 0],
    [6, 0, 6, 3],
    [6, 3, 0, 3],
    [0, 3, 0, 0],
    [4, 0, 4, 1],
    [4, 2, 4, 3],
    [0, 1.5, 1, 1.5],
    [1, 1.5, 1, 3],
    [7, 0, 8, 1],
]


def test_free_space_is_what_the_walls_enclose() -> None:
    """The hall counts on both sides of its door; the closet and the outside do not."""
    free = FreeSpace(World("hall", HALL))
    inside = free.contains(np.array([[2.0, 1.0], [5.0, 2.5], [0.5, 2.5], [6.5, 1.0], [-9.0, 1.0], [9.0, 99.0]]))
    assert inside.tolist() == [True, True, False, False, False, False]
    area = 0.04 * len(free.free_area_cells)
    assert 0.85 * 16.5 < area < 16.5
    assert distances_to_walls(free.free_area_cells, np.array(HALL, dtype=float)).min() > 0.1


def test_a_narrow_door_keeps_large_robots_out() -> None:
    """What a robot reaches depends on its radius: through a door of 1 m goes a disc of 0.3 m, none of 0.6 m."""
    cells = [FreeSpace(World("hall", HALL), radius).reachable for radius in (0.3, 0.6)]
    columns = [np.flatnonzero(mask.any(axis=0)) * 0.1 - 0.3 for mask in cells]
    assert columns[0].max() > 5.5
    assert columns[1].max() < 4.0


def test_start_poses_of_the_world_choose_the_part() -> None:
    """With start poses given, the part that holds them counts, not the largest."""
    free = FreeSpace(World("hall", HALL, start_poses=[[0.5, 2.2, 0.0]]))
    assert free.contains(np.array([[0.5, 2.5], [2.0, 1.0]])).tolist() == [True, False]


@pytest.mark.parametrize(
    ("starts", "message"),
    [
        ([[2, 1, 0], [9, 1, 0]], r"start_poses\[1\]: expected a reachable place"),
        ([[2, 1, 0], [0.5, 2.2, 0]], r"start_poses\[1\]: expected a reachable place"),
        ([[2, 0.1, 0], [5, 1, 0]], r"start_poses\[0\]: expected a place at least 0\.2 m .* got a distance of 0\.100 m"),
        ([[2, 1, 0], [2.3, 1, 0]], r"start_poses\[1\]: expected .* got a distance of 0\.300 m to robot 0"),
        ([[2, 1, 0]], r"start_poses: expected an array of shape \(2, 3\), got shape \(1, 3\)"),
        ([[2, 1, 0], [2, np.nan, 0]], r"start_poses: expected finite numbers"),
    ],
)
def test_bad_starts_are_refused(starts: Any, message: str) -> None:
    """A start inside a wall, cut off, on top of another or of the wrong shape is refused; the robot is named."""
    with pytest.raises(ValueError, match=message):
        FreeSpace(World("hall", HALL)).check_starts(starts, 2)


def test_landmarks_out_of_every_view_do_not_count() -> None:
    """A landmark in the closet, on an outer face, or too high up to be in any view is not counted; others are."""
    positions = [[2.0, 3.0, 0.0], [0.5, 3.0, 0.0], [2.0, 3.0, 0.0], [2.0, 3.0, 4.0], [5.0, 0.0, 0.5]]
    normals = [[0, -1], [0, -1], [0, 1], [0, -1], [0, 1]]
    marks = Landmarks(positions, normals, [2, 2, 2, 2, 0], np.eye(5, 9))
    free = FreeSpace(World("hall", HALL, marks))
    assert free.visible_landmarks(marks, StereoCamera()).tolist() == [True, False, False, False, True]


def test_what_a_robot_sees_can_be_seen() -> None:
    """Whatever a camera sees from a reachable place is among the landmarks that count."""
    rng = np.random.default_rng(5)
    world = make_world("office", rng)
    free = FreeSpace(world)
    marks = place_landmarks(world, rng, None, free)
    countable = free.visible_landmarks(marks, StereoCamera())
    sensor = LandmarkSensor(LandmarkSensorConfig(), world.walls, marks)
    seen = np.zeros(len(marks), dtype=bool)
    for _ in range(150):
        seen |= sensor.visible(free.draw_starts(2, rng, 1.0)[:1])[0]
    assert seen.sum() > 100
    assert countable.mean() > 0.9
    assert (seen & ~countable).sum() == 0


def test_sight_does_not_depend_on_the_order_of_landmarks() -> None:
    """Neighbours are skipped together where they are out of range: scattered landmarks are seen as ordered ones are."""
    rng = np.random.default_rng(5)
    world = make_world("office:extent=60", rng)
    space = FreeSpace(world)
    marks = place_landmarks(world, rng, None, space)
    order = rng.permutation(len(marks))
    scattered = Landmarks(*(getattr(marks, name)[order] for name in marks.__slots__))
    poses = space.draw_starts(8, rng, min_distance=2.0)
    seen, again = (
        LandmarkSensor(LandmarkSensorConfig(), world.walls, each).visible(poses) for each in (marks, scattered)
    )
    assert seen.sum(axis=1).min() >= 1
    np.testing.assert_array_equal(seen[:, order], again)


def test_distant_walls_hide_nothing_from_observable_landmarks() -> None:
    """Landmarks of a room count the same alone and beside a hundred rooms out of range."""
    grid = np.array([[x, y, x, y] for x in range(0, 100, 20) for y in range(20, 100, 20)])
    beside = np.vstack([np.array(ROOM) + corner for corner in grid])
    marks = place_landmarks(World("room", ROOM), np.random.default_rng(1))
    alone, among = (
        FreeSpace(World("rooms", walls, start_poses=[[1, 1, 0]])).visible_landmarks(marks, StereoCamera())
        for walls in (ROOM, np.vstack([ROOM, beside]))
    )
    assert alone.any()
    np.testing.assert_array_equal(alone, among)
