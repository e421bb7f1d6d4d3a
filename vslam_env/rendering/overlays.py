"""The header, with time and coverage, and the footer, with the map error of each robot and who shares a map."""

import numpy as np

from vslam_env.rendering import palette
from vslam_env.rendering.canvas import Image, disc, fill, text_width, write
from vslam_env.rendering.palette import mix, robot_colour
from vslam_env.rendering.scene import Scene


def draw_header(strip: Image, scene: Scene) -> None:
    """Write the simulated time and how many maps there are, and draw the coverage as a bar.

    Args:
        strip: (H, W, 3) uint8, the top of the picture; changed in place, sizes go by its height.
        scene: What is to be seen.
    """
    height, width = strip.shape[:2]
    fill(strip, palette.STRIP)
    strip[-1] = palette.RULE
    size, middle, edge = 0.26 * height, 0.47 * height, 0.4 * height
    write(strip, f"{scene.time:.1f} s", edge, middle, size, palette.INK)
    maps = len({robot.group for robot in scene.robots})
    words = f"{maps} map{'s' * (maps != 1)} of {len(scene.robots)} robot{'s' * (len(scene.robots) != 1)}"
    write(strip, words, 0.5 * (width - text_width(words, size)), middle, size, palette.INK)
    percent = f"seen {100.0 * scene.coverage:.0f} %"
    bar = 0.12 * width
    left = width - edge - bar
    write(strip, percent, left - text_width("seen 100 %", size) - size, middle, size, palette.INK)
    half = 0.13 * height
    _bar(strip, left, left + bar, middle, half, palette.RULE)
    filled = float(np.clip(scene.coverage, 0.0, 1.0)) * bar
    if filled > 0.0:
        _bar(strip, left, left + filled, middle, half, palette.FAINT_INK)


def _bar(strip: Image, left: float, right: float, middle: float, half: float, colour: palette.Colour) -> None:
    """Fill a rectangle given in pixels."""
    strip[round(middle - half) : round(middle + half), round(left) : max(round(right), round(left) + 1)] = colour


def draw_footer(strip: Image, scene: Scene) -> None:
    """Give each robot a card with its map error [m], those of one group side by side on one plate.

    Args:
        strip: (H, W, 3) uint8, the foot of the picture; changed in place, sizes go by its height.
        scene: What is to be seen.
    """
    height, width = strip.shape[:2]
    fill(strip, palette.STRIP)
    strip[0] = palette.RULE
    if not scene.robots:
        return
    labels = [robot.group for robot in scene.robots]
    groups = [[i for i, label in enumerate(labels) if label == wanted] for wanted in dict.fromkeys(labels)]
    gap = 0.14 * height
    card = min((width - gap) / len(labels) - gap, 4.6 * height)
    left = 0.5 * (width - len(labels) * (card + gap) + gap)
    for members in groups:
        plate = len(members) * (card + gap) - gap
        accent = robot_colour(members[0]) if len(members) > 1 else palette.RULE
        _plate(strip, left, plate, gap, accent)
        for robot in members:
            error = scene.map_errors[robot] if robot < len(scene.map_errors) else float("nan")
            _card(strip, robot, error, left, card)
            left += card + gap


def _plate(strip: Image, left: float, width: float, gap: float, accent: palette.Colour) -> None:
    """Draw the plate that carries the cards of one group, with a thick edge in the group's colour."""
    height = strip.shape[0]
    top, bottom = round(gap), round(height - gap)
    start, end = round(left), round(left + width)
    strip[top:bottom, start:end] = mix(palette.PAPER, accent, 0.08)
    strip[bottom - max(2, round(0.05 * height)) : bottom, start:end] = accent


def _card(strip: Image, robot: int, error: float, left: float, width: float) -> None:
    """Write a robot's number and its map error, on one line or, where there is no room, in two."""
    height = strip.shape[0]
    size, middle = 0.19 * height, 0.48 * height
    disc(strip, np.array([left + 0.32 * height, middle]), 0.13 * height, robot_colour(robot))
    figure = f"{error:.2f} m" if np.isfinite(error) else "-"
    start, room = left + 0.56 * height, width - 0.7 * height
    name, wide = f"robot {robot}", f"robot {robot}   map error {figure}"
    if text_width(wide, size) <= room:
        write(strip, wide, start, middle, size, palette.INK)
    else:
        write(strip, name, start, middle - 0.8 * size, 0.85 * size, palette.FAINT_INK)
        write(strip, figure, start, middle + 0.8 * size, 0.85 * size, palette.INK)
