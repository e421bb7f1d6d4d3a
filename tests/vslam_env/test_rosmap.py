"""Maps of ROS are read as map_server reads them."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from vslam_env.world import load_ros_map, make_world, save_walls_json

ROOM: dict[str, Any] = {"image": "map.pgm", "resolution": 0.05, "origin": [-2.0, 1.0, 0.0]}


def write_map(folder: Path, pixels: Any = None, **changed: Any) -> Path:
    """Write a map of 100 x 80 pixels with a free room of 60 x 40 at column 20, row 10; return the YAML's path."""
    if pixels is None:
        pixels = np.full((80, 100), 205)  # unknown
        pixels[9:51, 19:81] = 0
        pixels[10:50, 20:80] = 254
    cv2.imwrite(str(folder / "map.pgm"), np.asarray(pixels, dtype=np.uint8))
    lines = [f"{key}: {value}" for key, value in (ROOM | {"negate": 0, "free_thresh": 0.196} | changed).items()]
    path = folder / "map.yaml"
    path.write_text("\n".join(lines))
    return path


def test_a_room_lies_where_the_map_says(tmp_path: Path) -> None:
    """The lower left corner of the image is the origin, a pixel the resolution; grey is not free."""
    world = load_ros_map(write_map(tmp_path))
    assert world.name == "map"
    assert len(world.walls) == 4
    assert world.bounds == pytest.approx((-2.0 + 20 * 0.05, 1.0 + 30 * 0.05, -2.0 + 80 * 0.05, 1.0 + 70 * 0.05))


def test_a_turned_origin_turns_the_map(tmp_path: Path) -> None:
    """A yaw in the origin turns the map about its lower left corner."""
    world = load_ros_map(write_map(tmp_path, origin=[0.0, 0.0, np.pi / 2]))
    assert world.bounds == pytest.approx((-70 * 0.05, 20 * 0.05, -30 * 0.05, 80 * 0.05))


def test_negated_and_strict_maps(tmp_path: Path) -> None:
    """With `negate` dark is free; a strict threshold leaves grey out and a lax one lets it in."""
    image = np.full((80, 100), 255)
    image[10:50, 20:80] = 0
    assert len(load_ros_map(write_map(tmp_path, image, negate=1)).walls) == 4
    image = np.full((80, 100), 0)
    image[10:50, 20:80] = 254
    image[10:50, 50:80] = 220  # probability 0.14 of being occupied
    strict, lax = (load_ros_map(write_map(tmp_path, image, free_thresh=t)).bounds for t in (0.1, 0.2))
    assert strict[2] - strict[0] == pytest.approx(30 * 0.05)
    assert lax[2] - lax[0] == pytest.approx(60 * 0.05)


@pytest.mark.parametrize("mode", ["trinary", "scale"])
def test_what_is_free_is_so_in_both_modes_of_probability(tmp_path: Path, mode: str) -> None:
    """Between the thresholds `scale` knows degrees, none of which is free."""
    changed = {"mode": mode, "occupied_thresh": 0.65}
    assert load_ros_map(write_map(tmp_path, **changed)).bounds == load_ros_map(write_map(tmp_path)).bounds


def test_raw_maps_hold_percentages(tmp_path: Path) -> None:
    """A raw pixel is the probability in per cent, and unknown above 100; `negate` counts from 255 down."""
    image = np.full((80, 100), 255)
    image[9:51, 19:81] = 100
    image[10:50, 20:80] = 0
    image[10:50, 50:80] = 15
    for negate in (0, 1):
        pixels = 255 - image if negate else image
        changed = {"mode": "raw", "negate": negate}
        strict, lax = (load_ros_map(write_map(tmp_path, pixels, free_thresh=t, **changed)) for t in (0.1, 0.2))
        assert strict.bounds[2] - strict.bounds[0] == pytest.approx(30 * 0.05)
        assert lax.bounds[2] - lax.bounds[0] == pytest.approx(60 * 0.05)


def test_a_folder_counts_a_map_once(tmp_path: Path) -> None:
    """The image of a YAML file is no plan of its own in a folder; names ending in .yaml are maps."""
    path = write_map(tmp_path)
    rng = np.random.default_rng(0)
    worlds = {make_world(source, rng).bounds for source in (tmp_path, path, str(path)) for _ in range(4)}
    assert len(worlds) == 1


def test_an_imported_map_comes_back(tmp_path: Path) -> None:
    """What is saved as .json is read with the same walls."""
    world = load_ros_map(write_map(tmp_path))
    save_walls_json(world, tmp_path / "copy.json")
    np.testing.assert_allclose(make_world(tmp_path / "copy.json", np.random.default_rng(0)).walls, world.walls)
    with pytest.raises(ValueError, match="path: expected a file that can be written"):
        save_walls_json(world, tmp_path / "nowhere" / "copy.json")


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"image": "gone.pgm"}, r"world: expected a file, got '.*Check the path"),
        ({"image": "map.yaml"}, "world: expected an image that OpenCV can read"),
        ({"image": 3}, "world: expected a path as image"),
        ({"resolution": 0}, r"world: map\.yaml resolution: expected a finite number > 0, got 0"),
        ({"resolution": "fine"}, "resolution: expected a finite number"),
        ({"origin": [1, 2]}, r"origin: expected an array of shape \(3,\)"),
        ({"free_thresh": 3}, "free_thresh: expected a finite number > 0 and <= 1"),
        ({"occupied_thresh": 5}, "occupied_thresh: expected a finite number >= 0.196 and <= 1, got 5"),
        ({"free_thresh": 0.7, "occupied_thresh": 0.65}, "occupied_thresh: expected a finite number >= 0.7 and <= 1"),
        ({"mode": "fancy"}, "world: map.yaml mode: expected one of 'trinary', 'scale', 'raw', got 'fancy'"),
        ({"mode": 1}, "mode: expected one of 'trinary', 'scale', 'raw', got 1"),
        ({"free_thresh": 0.001}, "expected a map with free space"),
        ({"resolution": 0.001}, r"expected free space for robots of radius 0\.2 m"),
        ({"negate": "'false'"}, "negate: expected 0 or 1, got 'false'"),
        ({"negate": 2}, "negate: expected 0 or 1, got 2"),
        ({"negate": "{"}, "world: expected a YAML file, got a syntax error"),
    ],
)
def test_bad_maps_are_refused(tmp_path: Path, changed: dict[str, Any], says: str) -> None:
    """A map with a missing or senseless entry is refused by its name."""
    with pytest.raises(ValueError, match=says):
        load_ros_map(write_map(tmp_path, **changed))


def test_what_is_no_map_is_refused(tmp_path: Path) -> None:
    """A YAML file of something else is refused with what is missing."""
    path = tmp_path / "list.yaml"
    path.write_text("[1, 2]")
    with pytest.raises(ValueError, match="world: expected a mapping with the key 'image'"):
        load_ros_map(path)
