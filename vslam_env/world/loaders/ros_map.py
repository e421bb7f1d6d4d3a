"""ROS maps, a YAML file and an image: their loader, and the export of occupancy grids."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from slam_backend.core.files import checked_path, write_file
from slam_backend.core.image_files import grey_levels, read_image
from slam_backend.core.text_files import existing_file, read_yaml
from slam_backend.core.validation import argument_error, check_array, check_choice, check_float
from slam_backend.geometry import transform_points
from vslam_env.navigation.occupancy_grid import CELL, FREE, OCCUPIED, OccupancyGrid, centre_of
from vslam_env.world.loaders.floorplan import floor_part, trace
from vslam_env.world.spec import World

UNKNOWN = 205  # level of unknown cells in maps that map_saver writes, whatever `free_thresh` it adds
LEVELS = {FREE: 254, OCCUPIED: 0}  # levels of other cells that map_saver writes
SUFFIXES = (".yaml", ".yml")
MODES = ("trinary", "scale", "raw")
HINT = "Write image, resolution, origin, negate, occupied_thresh and free_thresh, like map_saver."


def load_ros_map(
    path: str | Path, tolerance_px: float = 1.0, robot_radius: float = 0.2, outside: str = "drop"
) -> World:
    """Trace the walls of a map in the format of ROS's map_server.

    A pixel of value v is occupied with probability (255 - v) / 255, or v / 255 if `negate` is set; with `mode: raw` the
    probability is v per cent, or 255 - v per cent, and unknown above 100. Pixels below `free_thresh` are free; the
    modes `trinary` and `scale` differ only for other pixels. In a trinary map the level 205 is unknown, although the
    `free_thresh` of 0.25 that ROS 2 writes lies above its probability; transparent pixels are unknown in all modes. All
    other pixels, including unknown ones, are wall. The largest free part is kept. The world frame is the map frame:
    `origin` is the pose of the image's lower left corner (http://wiki.ros.org/map_server).

    Args:
        path: Path of the YAML file; its `image` is relative to this file or absolute.
        tolerance_px: Largest deviation of the walls from the traced outlines [px].
        robot_radius: Radius of a robot that must fit into the free space [m].
        outside: "drop" or "keep" free space around a building, see `floor_part`.

    Raises:
        ValueError: If a file is missing or malformed, or there is no free space.
    """
    path = existing_file(path, "world")
    tolerance_px = check_float("tolerance_px", tolerance_px, "Give pixels.", at_least=0.0)
    settings = _read_settings(path)
    resolution = settings["resolution"]
    free = _free_pixels(*read_image(existing_file(path.parent / settings["image"], "world"), "world"), settings)
    if not free.any():
        hint = "Check mode, negate and free_thresh."
        raise argument_error("world", "a map with free space", f"no free space in {path}", hint)
    part = floor_part(free, resolution, str(path), outside)
    walls = trace(part, resolution, tolerance_px, robot_radius, str(path))
    return World(path.stem, transform_points(settings["origin"], walls.reshape(-1, 2)).reshape(-1, 4))


def save_ros_map(grid: OccupancyGrid, path: str | Path) -> None:
    """Write the known part of an occupancy grid as a map that map_server of ROS and Nav2 loads.

    A pixel is a cell: 254 where it is free, 0 where it is occupied, 205 where it is unknown. The map frame is the start
    frame of the grid's robot; `origin` is the lower left corner of the known part. `load_ros_map` traces its walls.

    Args:
        grid: Occupancy grid, for example `env.belief(agent).grid`.
        path: Path of the YAML file; the image goes beside it, with the suffix .pgm. Existing files are overwritten.

    Raises:
        ValueError: If nothing is known, the name does not end in .yaml or .yml, or a file cannot be written.
    """
    path = checked_path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise argument_error("path", "a name that ends in .yaml or .yml", path, "The image goes beside it.")
    top, left, bottom, right = grid.bounds.tolist()
    if bottom <= top:
        raise argument_error("grid", "a grid with known cells", "an empty grid", "Export it after the first scan.")
    cells = grid.cells[top:bottom, left:right]
    pixels = np.full(cells.shape, UNKNOWN, np.uint8)
    for state, level in LEVELS.items():
        pixels[cells == state] = level
    height, width = bottom - top, right - left
    x, y = map(float, (centre_of([top, left], len(grid.cells)) - 0.5 * CELL).round(9))
    image = path.with_suffix(".pgm")
    write_file(image, f"P5\n{width} {height}\n255\n".encode() + pixels[::-1].tobytes())  # rows from the top
    write_file(
        path,
        f"image: {json.dumps(image.name)}\nmode: trinary\nresolution: {CELL:g}\norigin: [{x!r}, {y!r}, 0.0]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n",
    )


def image_of_ros_map(path: Path) -> Path:
    """Return the path of the image that a YAML file names.

    Raises:
        ValueError: If the YAML file is malformed or the image is missing.
    """
    return existing_file(path.parent / _read_settings(path)["image"], "world")


def _free_pixels(colours: Any, opacity: Any, settings: dict[str, Any]) -> Any:
    """Return the free pixels (H, W) bool of an image."""
    level = np.arange(256.0)
    if settings["negate"]:
        level = 255.0 - level
    occupied = level / 100.0 if settings["mode"] == "raw" else (255.0 - level) / 255.0
    is_free = occupied < settings["free_thresh"]
    if settings["mode"] == "trinary":
        is_free &= level != UNKNOWN
    return is_free[grey_levels(colours)] & (opacity > 127)


def _read_settings(path: Path) -> dict[str, Any]:
    """Return the validated content of a YAML file."""
    return _checked(read_yaml(path, "world", HINT), str(path))


def _checked(content: Any, path: str) -> dict[str, Any]:
    """Return the validated settings."""
    for key in ("image", "resolution"):
        if not isinstance(content, dict) or key not in content:
            got = sorted(map(str, content)) if isinstance(content, dict) else content
            raise argument_error("world", f"a mapping with the key {key!r} in {path}", got, HINT)
    if not isinstance(content["image"], str):
        raise argument_error("world", f"a path as image in {path}", content["image"], HINT)
    name = "world: " + Path(path).name
    negate = content.get("negate", 0)
    if negate not in (0, 1):  # bools are equal to these; other values are ambiguous
        raise argument_error(f"{name} negate", "0 or 1", negate, HINT)
    free_thresh = check_float(
        f"{name} free_thresh", content.get("free_thresh", 0.196), "Give a probability.", above=0.0, at_most=1.0
    )
    if "occupied_thresh" in content:  # pixels between both thresholds are wall
        hint = "Give a probability of at least free_thresh."
        check_float(f"{name} occupied_thresh", content["occupied_thresh"], hint, at_least=free_thresh, at_most=1.0)
    return {
        "image": content["image"],
        "resolution": check_float(f"{name} resolution", content["resolution"], "Give metres per pixel.", above=0.0),
        "origin": check_array(f"{name} origin", content.get("origin", [0.0, 0.0, 0.0]), (3,), "Give x, y, yaw."),
        "negate": bool(negate),
        "mode": check_choice(f"{name} mode", content.get("mode", "trinary"), MODES),
        "free_thresh": free_thresh,
    }
