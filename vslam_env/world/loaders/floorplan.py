"""Loaders of floor plans, from images and JSON files of walls."""

import json
import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from slam_backend.core.files import write_file
from slam_backend.core.image_files import blend_over_white, grey_levels, read_image
from slam_backend.core.lazy_import import LazyModule
from slam_backend.core.text_files import existing_file, read_json
from slam_backend.core.validation import FloatArray, argument_error, check_choice, check_float
from vslam_env.world.spec import LARGEST_EXTENT, World, check_counts

if TYPE_CHECKING:
    import cv2
else:
    cv2 = LazyModule("cv2")  # takes as long to import as numpy

BRIGHT_SHARE = 0.85  # separates grey 195 from 128, white from black, and 254 from "unknown" 205 in ROS maps
COLOURED = 60  # least range of the channels of a coloured marker such as a yellow start cell
UPSAMPLING = 3
LEAST_BUILDING = 4.0  # [m^2] area of an enclosed part that makes the floor around it the outside
FORMAT = 1  # version of JSON files of walls
OUTSIDE = ("drop", "keep")

LOGGER = logging.getLogger(__name__)


def load_floorplan(
    path: str | Path,
    metres_per_pixel: float = 0.045,
    tolerance_px: float = 1.0,
    robot_radius: float = 0.2,
    outside: str = "drop",
) -> World:
    """Trace the walls of a floor plan.

    Pixels at least 85 % as bright as the brightest grey of the plan and coloured pixels are free; all others are wall.
    Transparent pixels are white. The connected part with the coloured cell is kept, or else the largest one; its
    outline and the outlines of its holes become walls. The origin of the world is the lower left corner of the image,
    y upwards.

    Args:
        path: PNG, JPEG, PGM or another image, see `slam_backend.core.image_files`.
        metres_per_pixel: Side of a pixel [m]. With 0.045, corridors of 640 x 480 dungeon plans (32 px) are 1.4 m wide,
            and the plans 29 x 22 m.
        tolerance_px: Largest deviation of the walls from the traced outlines [px].
        robot_radius: Radius of a robot that must fit into the free space [m].
        outside: "drop" or "keep" free space around a building, see `floor_part`.

    Raises:
        ValueError: If the file is missing or not an image, or its free space is too small.
    """
    metres_per_pixel = check_float("metres_per_pixel", metres_per_pixel, "Give the side of a pixel.", above=0.0)
    tolerance_px = check_float("tolerance_px", tolerance_px, "Give pixels.", at_least=0.0)
    path = existing_file(path, "world")
    image = blend_over_white(*read_image(path, "world", "Save the plan as PNG."))
    free, marked = _free_pixels(image, str(path))
    part = floor_part(free, metres_per_pixel, str(path), outside, marked)
    return World(path.stem, trace(part, metres_per_pixel, tolerance_px, robot_radius, str(path)))


def trace(free: Any, metres_per_pixel: float, tolerance_px: float, robot_radius: float, path: str) -> FloatArray:
    """Trace the outlines of the free part of a plan.

    Args:
        free: (H, W) uint8, rows downwards. 1 in the free part, which is connected.
        metres_per_pixel: Side of a pixel [m].
        tolerance_px: Largest deviation of the walls from the traced outlines [px].
        robot_radius: Radius of a robot that must fit into the free space [m].
        path: Path for error messages.

    Returns:
        Walls (S, 4) float64 [m], origin at the lower left corner of the image, y upwards.

    Raises:
        ValueError: If no robot fits, the plan is too large, or the tolerance leaves no outline.
    """
    x, y, width, height = cv2.boundingRect(free)
    if max(width, height) * metres_per_pixel > LARGEST_EXTENT:
        raise argument_error(
            "world",
            f"a plan of at most {LARGEST_EXTENT:g} m",
            f"{width * metres_per_pixel:.6g} x {height * metres_per_pixel:.6g} m in {path}",
            f"Lower metres_per_pixel, the resolution of a ROS map: it is {metres_per_pixel:g}.",
        )
    cropped = np.pad(free[y : y + height, x : x + width], 1)
    widest = 2.0 * metres_per_pixel * float(cv2.distanceTransform(cropped, cv2.DIST_L2, 3).max())
    if widest < 2.5 * robot_radius:
        raise argument_error(
            "world",
            f"free space for robots of radius {robot_radius:g} m",
            f"a largest width of {widest:.2f} m in {path}",
            "Raise metres_per_pixel, or draw wider rooms.",
        )
    corner = np.array([x - 1, y - 1])  # position of the cropped part in the image
    to_metres = metres_per_pixel * np.array([1.0, -1.0])  # rows count downwards, y upwards
    outlines = [(line + corner - (0, len(free))) * to_metres for line in _outlines(cropped, tolerance_px)]
    if not outlines:
        expected = f"less than the width of the free part of {path}"
        raise argument_error("tolerance_px", expected, tolerance_px, "Give one or two pixels.")
    return np.vstack([np.hstack([line, np.roll(line, -1, axis=0)]) for line in outlines])


def load_walls_json(path: str | Path) -> World:
    """Read `{"walls": [[x1, y1, x2, y2], ...], "start_poses": [[x, y, theta], ...]}`, in metres and radians.

    Args:
        path: Path of the file; its stem is the default of the optional `name`.

    Raises:
        ValueError: If the file is missing, not JSON, of another `format`, lacks `walls`, or has unknown keys.
    """
    path = existing_file(path, "world")
    hint = 'Write {"walls": [[x1, y1, x2, y2], ...]}, in metres; "start_poses" and "name" are optional.'
    content = read_json(path, "world", hint)
    if not isinstance(content, dict) or "walls" not in content:
        got = sorted(content) if isinstance(content, dict) else content
        raise argument_error("world", f"an object with the key 'walls' in {path}", got, hint)
    if (number := content.get("format", FORMAT)) != FORMAT or type(number) is not int:
        hint = "Use the release that wrote it, or write the walls again."
        raise argument_error("world", f"one of format {FORMAT} in {path}", f"a world of format {number!r}", hint)
    unknown = sorted(set(content) - {"format", "walls", "start_poses", "name"})
    if unknown:
        raise argument_error("world", f"no other keys in {path}", unknown[0], hint)
    check_counts(content["walls"])
    return World(content.get("name", path.stem), content["walls"], start_poses=content.get("start_poses"))


def save_walls_json(world: World, path: str | Path) -> None:
    """Write walls, start poses and name for `load_walls_json`; landmarks are omitted.

    Args:
        world: World to write, with walls rounded to micrometres.
        path: Path of the file; an existing file is overwritten.

    Raises:
        ValueError: If the file cannot be written.
    """
    content: dict[str, Any] = {"format": FORMAT, "name": world.name, "walls": np.round(world.walls, 6).tolist()}
    if world.start_poses is not None:
        content["start_poses"] = world.start_poses.tolist()
    write_file(path, json.dumps(content, indent=1) + "\n")


def _free_pixels(image: Any, path: str) -> tuple[Any, Any]:
    """Return the free and the coloured pixels (H, W) bool of an image (H, W, 3) uint8."""
    blue, green, red = cv2.split(image)
    strongest, weakest = cv2.max(cv2.max(blue, green), red), cv2.min(cv2.min(blue, green), red)
    coloured = cv2.subtract(strongest, weakest) > COLOURED
    grey = grey_levels(image)
    levels = grey[~coloured]
    brightest = float(levels.max()) if levels.size else 0.0
    if not levels.size or levels.min() >= BRIGHT_SHARE * brightest:
        raise argument_error(
            "world",
            "a plan with free space lighter than its walls",
            f"no free space distinct from walls in {path}",
            "Draw free space white and walls black.",
        )
    return (grey >= BRIGHT_SHARE * brightest) | coloured, coloured


def floor_part(free: Any, metres_per_pixel: float, path: str, outside: str = "drop", marked: Any = None) -> Any:
    """Return the 4-connected part of the free pixels that is the floor of the world.

    It is the part with the most marked pixels, or else the largest one. Free space at three or four corners of the
    image is the outside of the building: unless `outside` is "keep", it gives way to the largest other part of at
    least 4 m^2, and a message says so. If there is no such part, a message says that the edge of the image becomes a
    wall. Rooms that the edge cuts reach fewer corners.

    Args:
        free: (H, W) bool. Free pixels.
        metres_per_pixel: Side of a pixel [m].
        path: Path for messages.
        outside: "drop" or "keep".
        marked: (H, W) bool. Marked pixels, if any.

    Returns:
        (H, W) uint8. 1 in the part, else 0.

    Raises:
        ValueError: If `outside` is another word.
    """
    check_choice("outside", outside, OUTSIDE)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(free.astype(np.uint8), connectivity=4)
    votes = np.zeros(count) if marked is None else np.bincount(labels[marked], minlength=count)
    areas = stats[:, cv2.CC_STAT_AREA].astype(np.int64)
    areas[0] = votes[0] = 0
    part = int(np.argmax(votes if votes.any() else areas))
    corners = labels[[0, 0, -1, -1], [0, -1, 0, -1]]
    is_outside = np.count_nonzero(corners == part) >= 3 and not votes.any()
    if is_outside and outside == "drop":
        enclosed = areas.copy()
        enclosed[part] = 0
        largest = int(np.argmax(enclosed))
        square_metres = enclosed[largest] * metres_per_pixel**2
        if square_metres >= LEAST_BUILDING:
            part = largest
            words = "%s: %.0f m² enclosed by walls are the world, and the floor around them is outside; "
            words += "outside=keep uses all of it"
            LOGGER.warning(words, path, square_metres)
        else:
            words = "%s: the floor reaches the image's edge, which becomes a wall; draw closed outer walls, or say "
            words += "outside=keep"
            LOGGER.warning(words, path)
    return (labels == part).astype(np.uint8)


def _outlines(free: Any, tolerance_px: float) -> list[FloatArray]:
    """Return the closed outlines (n, 2) [px], x right and y down, along pixel edges of a mask with an empty margin.

    OpenCV traces pixel centres. In a mask enlarged threefold, rounding maps these to the corners of the original
    pixels.
    """
    enlarged = cv2.resize(free, None, fx=UPSAMPLING, fy=UPSAMPLING, interpolation=cv2.INTER_NEAREST)
    contours, _ = cv2.findContours(enlarged, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    outlines = []
    for contour in contours:
        corners = np.rint((contour[:, 0].astype(np.float64) + 0.5) / UPSAMPLING).astype(np.int32)
        corners = _without_flat_corners(corners[np.any(corners != np.roll(corners, 1, axis=0), axis=1)])
        straight = cv2.approxPolyDP(corners[:, None], tolerance_px, closed=True)[:, 0]
        straight = _without_flat_corners(straight)
        if len(straight) >= 3:
            outlines.append(straight.astype(np.float64))
    return outlines


def _without_flat_corners(corners: Any) -> Any:
    """Remove the corners (n, 2) of a closed outline between collinear edges."""
    before, after = corners - np.roll(corners, 1, axis=0), np.roll(corners, -1, axis=0) - corners
    return corners[before[:, 0] * after[:, 1] != before[:, 1] * after[:, 0]]
