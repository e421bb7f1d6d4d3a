"""Export of occupancy grids as ROS maps."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slam_backend.core.image_files import grey_levels, read_image
from slam_backend.core.text_files import read_yaml
from vslam_env.navigation import CELL, FREE, OCCUPIED, UNKNOWN, OccupancyGrid, centre_of
from vslam_env.world import World, load_ros_map, make_world, save_ros_map
from vslam_env.world.loaders.ros_map import _free_pixels, _read_settings

X, Y = np.meshgrid(np.arange(-2.9, 4.2, 0.2), np.arange(1.1, 6.2, 0.2))  # centres of the cells of a floor
EDGE = (np.abs(X - X.mean()) > np.ptp(X) / 2 - 0.1) | (np.abs(Y - Y.mean()) > np.ptp(Y) / 2 - 0.1)


def room(pillar: bool = True) -> OccupancyGrid:
    """Return the grid of a room of 7 x 5 m, off the origin, with a gap in what is known and a pillar."""
    wall = EDGE | ((np.hypot(X - 1.1, Y - 4.1) < 0.3) & pillar)
    gap = np.hypot(X + 1.0, Y - 2.0) < 0.3
    grid = OccupancyGrid()
    grid.enter(np.column_stack([X[~wall & ~gap], Y[~wall & ~gap]]), np.column_stack([X[wall], Y[wall]]))
    return grid


def test_the_reader_gives_the_same_cells(tmp_path: Path) -> None:
    """Free, occupied and unknown cells come back as such, each at its place in the start frame."""
    grid = room()
    save_ros_map(grid, tmp_path / "map.yaml")
    settings: dict[str, Any] = _read_settings(tmp_path / "map.yaml")
    assert settings["mode"] == "trinary"
    assert settings["resolution"] == CELL
    colours, opacity = read_image(tmp_path / settings["image"], "world")
    levels = grey_levels(colours)
    assert set(np.unique(levels)) == {0, 205, 254}
    is_free = np.asarray(_free_pixels(colours, opacity, settings))
    cells = grid.cells
    for state, pixels in ((FREE, is_free), (OCCUPIED, levels == 0), (UNKNOWN, levels == 205)):
        rows, columns = np.nonzero(pixels[::-1])
        places = np.column_stack([columns + 0.5, rows + 0.5]) * CELL + settings["origin"][:2]
        known = np.argwhere(cells == state)
        if state == UNKNOWN:  # the image is the known part
            top, left, bottom, right = grid.bounds
            known = known[((known >= (top, left)) & (known < (bottom, right))).all(axis=1)]
        np.testing.assert_allclose(places, centre_of(known, len(cells)), atol=1e-6)


def test_walls_traced_from_an_export_enclose_its_floor(tmp_path: Path) -> None:
    """The world of an exported grid has its walls at the borders of the free cells, in the start frame."""
    grid = room(pillar=False)
    save_ros_map(grid, tmp_path / "map.yaml")
    world = load_ros_map(tmp_path / "map.yaml", tolerance_px=0.0)
    assert world.bounds == pytest.approx((-2.8, 1.2, 4.0, 6.0))
    assert isinstance(make_world(tmp_path / "map.yaml", np.random.default_rng(0)), World)


def test_fields_are_those_of_map_server(tmp_path: Path) -> None:
    """The YAML file has all fields that Nav2's map_server requires."""
    save_ros_map(room(), tmp_path / "first floor.yaml")
    content = read_yaml(tmp_path / "first floor.yaml", "world", "")
    assert content == {
        "image": "first floor.pgm", "mode": "trinary", "resolution": 0.2, "origin": [-3.0, 1.0, 0.0], "negate": 0,
        "occupied_thresh": 0.65, "free_thresh": 0.196,
    }  # fmt: skip


def test_empty_grids_and_other_names_are_refused(tmp_path: Path) -> None:
    """A grid without known cells and a name that is not one of YAML are refused, and nothing is written."""
    with pytest.raises(ValueError, match=r"grid: expected a grid with known cells, got 'an empty grid'\. Export"):
        save_ros_map(OccupancyGrid(), tmp_path / "map.yaml")
    with pytest.raises(ValueError, match=r"path: expected a name that ends in \.yaml or \.yml, got .*map\.pgm"):
        save_ros_map(room(), tmp_path / "map.pgm")
    assert not list(tmp_path.iterdir())
