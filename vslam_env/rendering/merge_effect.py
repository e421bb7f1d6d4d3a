"""Visual effect of a merge: fading lines between the groups, expanding rings and a caption."""

from typing import TYPE_CHECKING

import numpy as np

from slam_backend.core.lazy_import import LazyModule
from slam_backend.core.validation import FloatArray
from vslam_env.rendering import palette
from vslam_env.rendering.canvas import Image, Viewport, disc, lines, text_width, write
from vslam_env.rendering.palette import mix
from vslam_env.rendering.scene import MergeFlash, Scene

if TYPE_CHECKING:
    import cv2
else:
    cv2 = LazyModule("cv2")  # takes as long to import as numpy

FLASH_TICKS = 20
RING_M = 2.2  # [m] final radius of the rings


def draw_flashes(plot: Image, view: Viewport, scene: Scene, unit: float) -> None:
    """Draw rings and lines for merges younger than `FLASH_TICKS`.

    Args:
        plot: (H, W, 3) uint8. Part of the picture that shows the world; changed in place.
        view: Mapping from metres to pixels.
        scene: Content of the picture.
        unit: Relative size of the picture, 1 for 960 x 720.
    """
    for merge in _recent_merges(scene):
        _draw_glow(plot, view, scene, merge, unit)


def draw_captions(plot: Image, scene: Scene, unit: float) -> None:
    """Write captions of recent merges, the latest on top; see `draw_flashes` for the arguments."""
    for line, merge in enumerate(_recent_merges(scene)):
        _draw_caption(plot, merge, line, unit)


def _recent_merges(scene: Scene) -> list[MergeFlash]:
    """Return the merges younger than `FLASH_TICKS`, latest first."""
    recent = (merge for merge in scene.merges if merge.age_ticks < FLASH_TICKS)
    return sorted(recent, key=lambda merge: merge.age_ticks)


def caption(merge: MergeFlash) -> str:
    """Return the caption of a merge.

    >>> caption(MergeFlash(0, (1,), (2,)))
    'robot 1 + robot 2: maps merged'
    """
    return f"{_names(merge.robots_a)} + {_names(merge.robots_b)}: maps merged"


def _names(robots: tuple[int, ...]) -> str:
    """Return `robot 1` or `robots 0, 2`."""
    return ("robot " if len(robots) == 1 else "robots ") + ", ".join(str(robot) for robot in robots)


def _draw_glow(plot: Image, view: Viewport, scene: Scene, merge: MergeFlash, unit: float) -> None:
    """Draw a line from every robot of one group to the nearest of the other, and rings around each robot."""
    age = merge.age_ticks / FLASH_TICKS
    overlay = plot.copy()
    side_a, side_b = (_positions(view, scene, robots) for robots in (merge.robots_a, merge.robots_b))
    for start in side_a:
        end = side_b[np.argmin(np.hypot(*(side_b - start).T))]
        lines(overlay, [np.stack([start, end])], palette.FLASH, max(2, round(5 * unit)), False)
    start_radius = scene.robot_radius * view.scale
    for centre in (*side_a, *side_b):
        for lag in (0.0, 0.25):
            radius = start_radius + RING_M * view.scale * np.sqrt(max(age - lag, 0.0))
            disc(overlay, centre, radius, palette.FLASH, max(1, round((5 - 3 * age) * unit)))
    cv2.addWeighted(overlay, 0.9 * (1.0 - age), plot, 1.0 - 0.9 * (1.0 - age), 0.0, plot)


def _positions(view: Viewport, scene: Scene, robots: tuple[int, ...]) -> FloatArray:
    """Return the image positions (k, 2) [px] of the true robots."""
    return np.stack([view.pixels(scene.robots[robot].true_pose) for robot in robots])


def _draw_caption(plot: Image, merge: MergeFlash, line: int, unit: float) -> None:
    """Write the caption of a merge on a plate at the top of the plot."""
    age = merge.age_ticks / FLASH_TICKS
    size = max(6.0, 13.0 * unit)
    text = caption(merge)
    width, height = text_width(text, size) + 3.0 * size, 2.6 * size
    middle = 0.5 * plot.shape[1]
    row, column = round(8 * unit + line * 1.15 * height), round(middle - 0.5 * width)
    plate = plot[row : row + round(height), max(column, 0) : column + round(width)]
    fade = 0.5 * age * age
    before = plate.copy()
    plate[:] = mix(palette.FLASH, palette.PAPER, 0.25)
    write(plate, text, 1.5 * size, 0.5 * height, size, palette.INK)
    cv2.addWeighted(plate.copy(), 1.0 - fade, before, fade, 0.0, plate)
