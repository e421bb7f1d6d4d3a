"""A map of ROS, an image with a YAML file beside it, becomes a `World`."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from slam_backend.core.validation import argument_error, check_array, check_choice, check_float
from slam_backend.geometry import transform_points
from vslam_env.world.loaders.floorplan import existing, largest_part, read_image, trace
from vslam_env.world.spec import World

MODES = ("trinary", "scale", "raw")
CURE = "Write image, resolution, origin, negate, occupied_thresh and free_thresh, as map_server's map_saver does."


def load_ros_map(path: str | Path, tolerance_px: float = 1.0, robot_radius: float = 0.2) -> World:
    """Trace the walls of a map that ROS's map_server reads.

    A pixel of value v is occupied with probability (255 - v) / 255, or v / 255 if `negate` is set; with `mode: raw` it
    is v per cent, or 255 - v, and unknown above 100. It is free below `free_thresh`; the modes `trinary` and `scale`
    differ only in what is not. All else, unknown space included, is wall. The largest free part is kept. The world's
    frame is that of the map: `origin` is the pose of the image's lower left corner (http://wiki.ros.org/map_server).

    Args:
        path: Of the YAML file; `image` in it is a path beside it or an absolute one.
        tolerance_px: Outlines are straightened where they deviate less than this from a line [px].
        robot_radius: A map in which no such disc fits is refused [m].

    Raises:
        ValueError: If a file is missing or malformed, or nothing is free.
    """
    path = existing(path)
    tolerance_px = check_float("tolerance_px", tolerance_px, "Give pixels.", at_least=0.0)
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise argument_error("world", "a YAML file", f"a syntax error in {path}", CURE) from error
    settings = _checked(content, str(path))
    image = read_image(existing(path.parent / settings["image"]), cv2.IMREAD_GRAYSCALE).astype(np.float64)
    levels = 255.0 - image if settings["negate"] else image
    occupied = levels / 100.0 if settings["mode"] == "raw" else (255.0 - levels) / 255.0
    free = occupied < settings["free_thresh"]
    if not free.any():
        cure = "Check mode, negate and free_thresh."
        raise argument_error("world", "a map with free space", f"no free space in {path}", cure)
    walls = trace(largest_part(free), settings["resolution"], tolerance_px, robot_radius, str(path))
    return World(path.stem, transform_points(settings["origin"], walls.reshape(-1, 2)).reshape(-1, 4))


def _checked(content: Any, path: str) -> dict[str, Any]:
    """Return the settings that matter, checked."""
    for key in ("image", "resolution"):
        if not isinstance(content, dict) or key not in content:
            got = sorted(map(str, content)) if isinstance(content, dict) else content
            raise argument_error("world", f"a mapping with the key {key!r} in {path}", got, CURE)
    if not isinstance(content["image"], str):
        raise argument_error("world", f"a path as image in {path}", content["image"], CURE)
    name = "world: " + Path(path).name
    negate = content.get("negate", 0)
    if negate not in (0, 1):  # True and False are such numbers; a text is true whatever it says
        raise argument_error(f"{name} negate", "0 or 1", negate, CURE)
    free_thresh = check_float(
        f"{name} free_thresh", content.get("free_thresh", 0.196), "Give a probability.", above=0.0, at_most=1.0
    )
    if "occupied_thresh" in content:  # between the two a pixel is unknown, or partly occupied: a wall, too
        cure = "Give a probability that is not below free_thresh."
        check_float(f"{name} occupied_thresh", content["occupied_thresh"], cure, at_least=free_thresh, at_most=1.0)
    return {
        "image": content["image"],
        "resolution": check_float(f"{name} resolution", content["resolution"], "Give metres per pixel.", above=0.0),
        "origin": check_array(f"{name} origin", content.get("origin", [0.0, 0.0, 0.0]), (3,), "Give x, y, yaw."),
        "negate": bool(negate),
        "mode": check_choice(f"{name} mode", content.get("mode", "trinary"), MODES),
        "free_thresh": free_thresh,
    }
