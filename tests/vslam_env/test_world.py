"""Worlds are checked when they are built, and can be named in several ways."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vslam_env.world import FreeSpace, LandmarkConfig, Landmarks, World, make_world, place_landmarks
from vslam_env.world.landmarks import CORNER, draw_descriptors

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


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: World("w", []), r"world\.walls: expected"),
        (lambda: World("w", [[0, 0, 1]]), r"world\.walls: expected an array of shape \(n, 4\), got shape \(1, 3\)"),
        (lambda: World("w", [[0, 0, 1, np.nan]]), r"world\.walls: expected finite numbers, got NaN"),
        (lambda: World("w", [*ROOM, [1, 1, 1, 1]]), r"world\.walls\[4\]: expected a wall longer than 0\.001 m"),
        (lambda: World("w", [[0, 0, 5000, 0]]), r"world\.walls: expected an extent of at most 200 m, .* 5000 m"),
        (lambda: World(3, ROOM), r"world\.name: expected a string, got 3"),
        (lambda: World("w", ROOM, start_poses=[[1, 2]]), r"world\.start_poses: expected an array of shape \(n, 3\)"),
        (lambda: World("w", ROOM, landmarks(walls=[0, 9])), r"world\.landmarks\.walls: expected wall indices 0 to 3"),
        (lambda: World("w", ROOM, "many"), r"world\.landmarks: expected Landmarks or None"),
        (lambda: landmarks(normals=[[0, 1], [0, 2]]), r"landmarks\.normals: expected unit vectors, got a length of 2"),
        (lambda: landmarks(descriptors=np.zeros((2, 7))), r"landmarks\.descriptors: expected unit vectors"),
        (lambda: landmarks(walls=[0]), r"landmarks\.walls: expected an array of shape \(2,\)"),
        (lambda: LandmarkConfig(density=0.0), r"landmarks\.density: expected a finite number > 0"),
        (lambda: LandmarkConfig(min_height=1.0, max_height=0.0), r"landmarks\.max_height: expected .* >= 1"),
        (lambda: LandmarkConfig(distinctness=1.5), r"landmarks\.distinctness"),
        (lambda: LandmarkConfig(repeated=-0.1), r"landmarks\.repeated"),
    ],
)
def test_bad_worlds_are_refused(build: Callable[[], object], message: str) -> None:
    """A world that makes no sense is refused in one sentence that names the argument."""
    with pytest.raises(ValueError, match=message):
        build()


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


@pytest.mark.parametrize(
    ("world", "message"),
    [
        ("ofice", r"world: expected one of 'office', .*'fig5', or a path .*, got 'ofice'"),
        ("missing.png", r"world: expected a file, got 'missing\.png'"),
        ("missing.json", r"world: expected a file, got 'missing\.json'"),
        (lambda rng: [ROOM], r"world: expected a function that returns a World"),
        (7, r"world: expected a name, a path, a World or a function, got 7"),
    ],
)
def test_unknown_worlds_are_refused(world: Any, message: str) -> None:
    """What is no world is refused with the list of what would be one."""
    with pytest.raises(ValueError, match=message):
        make_world(world, np.random.default_rng(0))


@pytest.mark.parametrize("text", ["{", "[1, 2]", '{"wals": []}', '{"walls": [], "extra": 1}', '{"walls": "x"}'])
def test_bad_json_is_refused(tmp_path: Path, text: str) -> None:
    """A malformed file of walls gives one clear error."""
    path = tmp_path / "bad.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"^world.*: expected .*, got .*\. .*metres"):
        make_world(path, np.random.default_rng(0))


def test_an_empty_folder_is_refused(tmp_path: Path) -> None:
    """A folder without plans says what to put there."""
    with pytest.raises(ValueError, match="expected a folder with floor plans"):
        make_world(tmp_path, np.random.default_rng(0))


@pytest.mark.parametrize("family", ["office", "fig5", "maze", "loops", "hall"])
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


def test_unknown_keys_of_json_worlds_are_named(tmp_path: Path) -> None:
    """A key that means nothing, perhaps misspelt, is refused by its name."""
    path = tmp_path / "room.json"
    path.write_text(json.dumps({"walls": ROOM, "start_pose": [[1, 1, 0]]}), encoding="utf-8")
    with pytest.raises(ValueError, match=r"world: expected no other keys in .*, got 'start_pose'"):
        make_world(path, np.random.default_rng(0))
