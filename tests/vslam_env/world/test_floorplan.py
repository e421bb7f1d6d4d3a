"""Worlds from images and from maps of ROS."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from slam_backend.models.camera import StereoCamera
from vslam_env.world import (
    FreeSpace,
    World,
    load_floorplan,
    load_ros_map,
    load_walls_json,
    make_world,
    place_landmarks,
    save_walls_json,
)
from vslam_env.world.spec import World as Spec


def area_inside(world: Spec, step: float = 0.05) -> float:
    """The area that the walls enclose [m^2], by counting crossings of horizontal rays."""
    xmin, ymin, xmax, ymax = world.bounds
    x = np.arange(xmin, xmax, step) + 0.5 * step + 1e-7
    total = 0
    for y in np.arange(ymin, ymax, step) + 0.5 * step + 1e-7:
        x1, y1, x2, y2 = world.walls.T
        cut = (y1 > y) != (y2 > y)
        crossings = x1[cut] + (y - y1[cut]) / (y2[cut] - y1[cut]) * (x2[cut] - x1[cut])
        total += int(((crossings[:, None] < x).sum(axis=0) % 2).sum())
    return total * step * step


def write(path: Path, image: Any) -> Path:
    """Save an image."""
    assert cv2.imwrite(str(path), np.asarray(image, dtype=np.uint8))
    return path


def test_a_drawn_plan_is_traced_exactly(tmp_path: Path) -> None:
    """A rectilinear room with a pillar becomes its ten walls, in metres, y upwards, to the pixel's edge."""
    image = np.zeros((110, 170))
    image[20:100, 30:150] = 255
    image[40:60, 50:80] = 0
    image[20:60, 120:150] = 0
    world = load_floorplan(write(tmp_path / "plan.png", image), metres_per_pixel=0.1)
    assert world.name == "plan"
    assert world.bounds == pytest.approx((3.0, 1.0, 15.0, 9.0))
    assert len(world.walls) == 10
    corners = {tuple(np.round(corner, 6)) for corner in world.walls.reshape(-1, 2)}
    outer = {(3.0, 1.0), (15.0, 1.0), (15.0, 5.0), (12.0, 5.0), (12.0, 9.0), (3.0, 9.0)}
    assert corners == outer | {(5.0, 5.0), (8.0, 5.0), (8.0, 7.0), (5.0, 7.0)}
    assert area_inside(world, 0.1) == pytest.approx((80 * 120 - 20 * 30 - 40 * 30) * 0.01)


def test_slanted_walls_become_few_long_ones(tmp_path: Path) -> None:
    """The staircase of pixels along a slanted wall is straightened, and nothing else is lost."""
    image = np.zeros((300, 400), dtype=np.uint8)
    cv2.fillPoly(image, [np.array([[40, 50], [350, 20], [370, 260], [200, 280], [60, 200]], dtype=np.int32)], 255)
    world = load_floorplan(write(tmp_path / "slanted.png", image), metres_per_pixel=0.05)
    assert len(world.walls) < 25
    assert area_inside(world) == pytest.approx((image > 0).sum() * 0.05**2, rel=0.01)


def test_the_marked_part_is_kept(tmp_path: Path) -> None:
    """The part with the coloured start cell is the world, even if another part is larger."""
    image = np.full((120, 260, 3), 128)
    image[20:100, 20:60] = 195
    image[20:100, 100:240] = 195
    image[30:40, 30:40] = (0, 216, 255)
    world = load_floorplan(write(tmp_path / "two.png", image), metres_per_pixel=0.1)
    assert world.bounds == pytest.approx((2.0, 2.0, 6.0, 10.0))


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((50, 60)), "no free space distinct from walls"),
        (np.full((50, 60), 127), "no free space distinct from walls"),
        (np.full((50, 60), 255), "no free space distinct from walls"),
        (np.pad(np.full((4, 30), 255), 10), r"expected free space for robots of radius 0\.2 m, got a largest width"),
    ],
)
def test_plans_without_room_are_refused(tmp_path: Path, image: Any, message: str) -> None:
    """A plan in which nothing is free, or too little for a robot, is refused."""
    with pytest.raises(ValueError, match=message):
        load_floorplan(write(tmp_path / "bad.png", image))


def test_a_tolerance_that_leaves_no_walls_is_refused(tmp_path: Path) -> None:
    """Outlines that are straightened until nothing is left are refused by the tolerance."""
    room = write(tmp_path / "room.png", np.pad(np.full((40, 60), 255), 10))
    with pytest.raises(
        ValueError, match=r"tolerance_px: expected less than the width of the free part of .*, got 1000000000\.0"
    ):
        load_floorplan(room, tolerance_px=1e9)


def building(margin: int) -> Any:
    """A plan of a room of 60 x 40 pixels with walls of two pixels, on a white page with a margin."""
    walls = np.pad(np.full((40, 60), 255), 2)
    return np.pad(walls, margin, constant_values=255)


@pytest.mark.parametrize("margin", [1, 30, 300])
def test_a_building_on_a_page_is_the_world(tmp_path: Path, caplog: pytest.LogCaptureFixture, margin: int) -> None:
    """Of a closed plan on a white page the inside is the world, whatever the margin; `outside="keep"` overrides."""
    path = write(tmp_path / "plan.png", building(margin))
    low, width, height = 0.1 * (margin + 2), 6.0, 4.0
    assert load_floorplan(path, 0.1).bounds == pytest.approx((low, low, low + width, low + height))
    is_page_larger = margin > 20
    assert ("24 m² enclosed by walls are the world" in caplog.text) == is_page_larger
    caplog.clear()
    kept = make_world(f"{path}:metres_per_pixel=0.1:outside=keep", np.random.default_rng(0))
    assert kept.bounds[0] == pytest.approx(0.0 if is_page_larger else low)
    assert not caplog.text


def test_a_transparent_page_is_white(tmp_path: Path) -> None:
    """Black walls on a transparent page, with any colour under the transparency, give the same world as on white."""
    levels = building(300)
    opaque = load_floorplan(write(tmp_path / "white.png", levels), 0.1)
    pixels = np.zeros((*levels.shape, 4))
    pixels[..., 3] = 255 - levels
    clear = load_floorplan(write(tmp_path / "clear.png", pixels), 0.1)
    np.testing.assert_array_equal(clear.walls, opaque.walls)


@pytest.mark.parametrize("sides", ["left", "left and right", "one corner", "two corners"])
def test_rooms_that_the_edge_cuts_stay(tmp_path: Path, caplog: pytest.LogCaptureFixture, sides: str) -> None:
    """A hall that the picture's edge cuts is the world, although a closed room stands in it."""
    image = np.zeros((200, 300))
    image[20:180, 20:280] = 255
    room = np.pad(np.full((30, 30), 255), 2)
    image[80:114, 100:134] = room
    image[40:60, : 300 if "right" in sides else 100] = 255
    if "corner" in sides:
        image[: 60 if "one" in sides else 200, :60] = 255
    world = load_floorplan(write(tmp_path / "cut.png", image), 0.1)
    assert world.bounds[0] == pytest.approx(0.0)
    assert area_inside(world, 0.1) == pytest.approx(0.01 * ((image > 0).sum() - 900), rel=0.02)
    assert not caplog.text


def test_open_floor_is_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Where floor reaches the edge and surrounds nothing but pillars, one line says that the edge becomes a wall."""
    image = np.full((100, 150), 255)
    image[40:60, 40:60] = 0
    image[45:55, 45:55] = 255  # a hollow pillar of one square metre
    world = load_floorplan(write(tmp_path / "open.png", image), 0.1)
    assert world.bounds == pytest.approx((0.0, 0.0, 15.0, 10.0))
    assert caplog.text.count("edge, which becomes a wall") == 1
    caplog.clear()
    load_floorplan(tmp_path / "open.png", 0.1, outside="keep")
    assert not caplog.text


def test_a_marked_outside_is_kept(tmp_path: Path) -> None:
    """A coloured start cell outside of a building says that the outside is meant."""
    image = np.repeat(building(60)[:, :, None], 3, axis=2)
    image[5:12, 5:12] = (0, 216, 255)
    assert load_floorplan(write(tmp_path / "yard.png", image), 0.1).bounds[0] == pytest.approx(0.0)


@pytest.mark.parametrize(
    "option", ["outside=perhaps", "outside=", "metres_per_pixel=keep", "tolerance_px=1:tolerance_px=2"]
)
def test_bad_options_of_plans_are_refused(tmp_path: Path, option: str) -> None:
    """An option with a wrong value is refused with its name."""
    path = write(tmp_path / "plan.png", building(2))
    with pytest.raises(ValueError, match=r"^world.*: expected .*, got '"):
        make_world(f"{path}:{option}", np.random.default_rng(0))


def test_options_that_no_file_takes_are_refused(tmp_path: Path) -> None:
    """A ROS map takes `outside` but no scale, and a file of walls no option."""
    path = write_map(tmp_path)
    rng = np.random.default_rng(0)
    assert make_world(f"{path}:outside=keep", rng).bounds == make_world(path, rng).bounds
    with pytest.raises(ValueError, match="no option 'metres_per_pixel' for files of this kind"):
        make_world(f"{path}:metres_per_pixel=0.1", rng)


@pytest.mark.parametrize("suffix", [".yaml", ".pgm"])
def test_an_edited_file_is_read_again(tmp_path: Path, suffix: str) -> None:
    """A map is read again in the same process when its YAML file or its image has changed."""
    rng = np.random.default_rng(0)
    path = write_map(tmp_path)
    first = make_world(path, rng)
    assert make_world(path, rng) is first
    if suffix == ".pgm":
        write_map(tmp_path, np.pad(np.full((60, 60), 254), 10))
    else:
        write_map(tmp_path, resolution=0.1)
    assert make_world(path, rng).bounds != first.bounds


def test_too_many_walls_are_refused_before_they_are_read(tmp_path: Path) -> None:
    """A file of walls has a limit, which the error names."""
    (tmp_path / "many.json").write_text(json.dumps({"walls": [[0, 0, 1, 1]] * 30_001}))
    with pytest.raises(ValueError, match=r"world\.walls: expected at most 30,000 walls, got a number of 30,001"):
        make_world(tmp_path / "many.json", np.random.default_rng(0))


def test_dungeon_plans_are_traced_whole(data_dir: Path) -> None:
    """Every sixth dungeon plan becomes a few walls, keeps its free area, and has room for three robots."""
    for path in sorted((data_dir / "dungeon_maps" / "train").glob("*.png"))[::6]:
        world = load_floorplan(path)
        grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert 4 <= len(world.walls) < 120
        assert area_inside(world) == pytest.approx((grey > 160).sum() * 0.045**2, rel=0.01)
        free = FreeSpace(world)
        ends = free.free_area_cells
        farthest = max(np.linalg.norm(ends - end, axis=1).max() for end in ends[::37])
        assert farthest < 30.0
        rng = np.random.default_rng(0)
        marks = place_landmarks(world, rng, None, free)
        assert free.draw_starts(3, rng, 5.0, StereoCamera(), marks).shape == (3, 3)


def test_offices_have_the_stated_size_and_no_closed_areas() -> None:
    """Each of 60 offices has 39 to 66 walls on about 20 x 14 m, and no square metre that a robot cannot visit."""
    seen = []
    for seed in range(60):
        world = make_world("office", np.random.default_rng(seed))
        width, height = world.bounds[2], world.bounds[3]
        assert 19.0 <= width <= 21.0
        assert 13.0 <= height <= 15.0
        assert 39 <= len(world.walls) <= 66
        free = FreeSpace(world)
        assert 0.8 * width * height < 0.04 * len(free.free_area_cells) < 0.97 * width * height
        seen.append(world.walls.tobytes())
    assert len(set(seen)) == 60


def test_every_room_of_an_office_can_be_reached() -> None:
    """In 60 offices no space that a robot of radius 0.2 m could turn in is cut off, but inside furniture."""
    for seed in range(60):
        world = make_world("office", np.random.default_rng(seed))
        free = FreeSpace(world)
        whole = World("shell", np.vstack([world.walls[:4]]))
        cut_off = len(FreeSpace(whole).free_area_cells) - len(free.free_area_cells)
        on_walls = 0.04 * cut_off - 0.22 * np.hypot(*(world.walls[4:, :2] - world.walls[4:, 2:]).T).sum()
        assert on_walls < 8.0  # [m^2] tables and cabinets hold at most six times 1.3


def test_a_room_like_fig5_is_open() -> None:
    """The room has four outer walls and seven inside it that leave a way round."""
    for seed in range(30):
        world = make_world("fig5", np.random.default_rng(seed))
        assert len(world.walls) == 11
        width, height = world.bounds[2], world.bounds[3]
        assert 0.04 * len(FreeSpace(world).free_area_cells) > 0.88 * width * height


def test_a_world_of_another_format_is_refused(tmp_path: Path) -> None:
    """What is written bears the number of its format; what users write need not."""
    file = tmp_path / "room.json"
    world = World("room", [[0, 0, 4, 0], [4, 0, 4, 3], [4, 3, 0, 3], [0, 3, 0, 0]])
    save_walls_json(world, file)
    assert json.loads(file.read_text())["format"] == 1
    np.testing.assert_array_equal(load_walls_json(file).walls, world.walls)
    file.write_text(json.dumps({"format": 2, "walls": world.walls.tolist()}))
    with pytest.raises(ValueError, match=r"world: expected one of format 1 in .*, got a world of format 2"):
        load_walls_json(file)


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


@pytest.mark.parametrize("thresh", ["5e-2", "0.05", "+.5E-1"])
def test_numbers_are_read_as_ros_reads_them(tmp_path: Path, thresh: str) -> None:
    """An exponent needs no decimal point."""
    assert load_ros_map(write_map(tmp_path, resolution=thresh)).bounds == load_ros_map(write_map(tmp_path)).bounds


def test_unknown_stays_unknown_in_trinary_maps(tmp_path: Path) -> None:
    """With the `free_thresh` that ROS 2's map saver writes, unknown cells (205) are still not free."""
    strict = load_ros_map(write_map(tmp_path))
    assert load_ros_map(write_map(tmp_path, free_thresh=0.25, occupied_thresh=0.65)).bounds == strict.bounds
    scale = load_ros_map(write_map(tmp_path, free_thresh=0.25, mode="scale", occupied_thresh=0.65), outside="keep")
    assert scale.bounds == pytest.approx((-2.0, 1.0, 3.0, 5.0))


def test_transparent_cells_are_unknown(tmp_path: Path) -> None:
    """Free cells that are transparent are not free."""
    pixels = np.full((80, 100, 4), 254)
    pixels[..., 3] = 0
    pixels[9:51, 19:81] = (0, 0, 0, 255)
    pixels[10:50, 20:80] = 254
    path = write_map(tmp_path, image="map.png")
    write(tmp_path / "map.png", pixels)
    assert load_ros_map(path).bounds == load_ros_map(write_map(tmp_path)).bounds


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
        ({"image": "gone.pgm"}, r"world: expected a file, got no such file. Check '.*gone.pgm'"),
        ({"image": "map.yaml"}, "world: expected an image file"),
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
        ({"negate": "{"}, r"world: expected a file in YAML, got a syntax error: .* line 5, column 19 of .*map\.yaml"),
        ({"image": '"*m"'}, "world: expected a file, got"),
        ({"origin": "*m"}, r"an alias, which is not followed\. Correct line 3, column 9"),
    ],
)
def test_bad_maps_are_refused(tmp_path: Path, changed: dict[str, Any], says: str) -> None:
    """A map with a missing or senseless entry is refused by its name."""
    with pytest.raises(ValueError, match=says):
        load_ros_map(write_map(tmp_path, **changed))
