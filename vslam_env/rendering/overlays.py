"""Header with time and coverage, and footer with the robots' map errors and groups."""

import numpy as np

from vslam_env.rendering import palette
from vslam_env.rendering.canvas import Image, disc, fill, text_width, write
from vslam_env.rendering.palette import mix, robot_colour
from vslam_env.rendering.scene import Scene


def draw_header(strip: Image, scene: Scene, scale: float) -> None:
    """Draw the simulated time, a scale bar, the number of maps and a bar of the coverage.

    Args:
        strip: (H, W, 3) uint8. Top of the picture, whose height sets all sizes; changed in place.
        scene: Content of the picture.
        scale: Scale of the top view below [px/m].
    """
    height, width = strip.shape[:2]
    fill(strip, palette.STRIP)
    strip[-1] = palette.RULE
    size, middle, edge = 0.26 * height, 0.47 * height, 0.4 * height
    write(strip, f"{scene.time:.1f} s", edge, middle, size, palette.INK)
    _scale_bar(strip, 2.0 * edge + text_width("9999.9 s", size), middle, size, scale)
    maps = len(set(scene.map_owners))
    words = f"{maps} map{'s' * (maps != 1)} of {len(scene.robots)} robot{'s' * (len(scene.robots) != 1)}"
    write(strip, words, 0.5 * (width - text_width(words, size)), middle, size, palette.INK)
    percent = f"coverage {100.0 * scene.coverage:.0f} %"
    bar = 0.12 * width
    left = width - edge - bar
    write(strip, percent, left - text_width("coverage 100 %", size) - size, middle, size, palette.INK)
    half = 0.13 * height
    _bar(strip, left, left + bar, middle, half, palette.RULE)
    filled = float(np.clip(scene.coverage, 0.0, 1.0)) * bar
    if filled > 0.0:
        _bar(strip, left, left + filled, middle, half, palette.FAINT_INK)


def scale_length(longest: float) -> float:
    """Return the longest length of 1, 2 or 5 times a power of ten [m] up to a given one, > 0.

    >>> scale_length(9.0), scale_length(0.25)
    (5.0, 0.2)
    """
    power = 10.0 ** np.floor(np.log10(longest))
    return float(power * max(factor for factor in (1.0, 2.0, 5.0) if factor * power <= longest * (1.0 + 1e-9)))


def _scale_bar(strip: Image, left: float, middle: float, size: float, scale: float) -> None:
    """Draw a bar of a round length, at most a twelfth of the picture wide, with its length [m]."""
    length = scale_length(strip.shape[1] / 12.0 / scale)
    right = left + length * scale
    half = max(1.0, 0.1 * size)
    _bar(strip, left, right, middle, half, palette.INK)
    for end in (left, right):
        _bar(strip, end - half, end + half, middle, 4.0 * half, palette.INK)
    write(strip, f"{length:g} m", right + 0.7 * size, middle, size, palette.INK)


def _bar(strip: Image, left: float, right: float, middle: float, half: float, colour: palette.Colour) -> None:
    """Fill a rectangle [px]."""
    strip[round(middle - half) : round(middle + half), round(left) : max(round(right), round(left) + 1)] = colour


def draw_footer(strip: Image, scene: Scene) -> None:
    """Draw a card with the map error [m] of each robot; the cards of a group share a plate.

    Args:
        strip: (H, W, 3) uint8. Bottom of the picture, whose height sets all sizes; changed in place.
        scene: Content of the picture.
    """
    height, width = strip.shape[:2]
    fill(strip, palette.STRIP)
    strip[0] = palette.RULE
    if not scene.robots:
        return
    owners = scene.map_owners
    groups = [[i for i, owner in enumerate(owners) if owner == first] for first in dict.fromkeys(owners)]
    gap = 0.14 * height
    card = min((width - gap) / len(owners) - gap, 4.6 * height)
    left = 0.5 * (width - len(owners) * (card + gap) + gap)
    for members in groups:
        plate = len(members) * (card + gap) - gap
        accent = robot_colour(members[0]) if len(members) > 1 else palette.RULE
        _plate(strip, left, plate, gap, accent)
        for robot in members:
            error = scene.map_errors[robot] if robot < len(scene.map_errors) else float("nan")
            _card(strip, robot, error, left, card)
            left += card + gap


def _plate(strip: Image, left: float, width: float, gap: float, accent: palette.Colour) -> None:
    """Draw the plate under the cards of one group, with a thick edge in the group's colour."""
    height = strip.shape[0]
    top, bottom = round(gap), round(height - gap)
    start, end = round(left), round(left + width)
    strip[top:bottom, start:end] = mix(palette.PAPER, accent, 0.08)
    strip[bottom - max(2, round(0.05 * height)) : bottom, start:end] = accent


def _card(strip: Image, robot: int, error: float, left: float, width: float) -> None:
    """Write a robot's index and map error, on two lines if one is too narrow."""
    height = strip.shape[0]
    size, middle = 0.19 * height, 0.48 * height
    disc(strip, np.array([left + 0.32 * height, middle]), 0.13 * height, robot_colour(robot))
    figure = f"{error:.2f} m" if np.isfinite(error) else "-"
    start, available = left + 0.56 * height, width - 0.7 * height
    name, wide = f"robot {robot}", f"robot {robot}   map error {figure}"
    if text_width(wide, size) <= available:
        write(strip, wide, start, middle, size, palette.INK)
    else:
        write(strip, name, start, middle - 0.8 * size, 0.85 * size, palette.FAINT_INK)
        write(strip, figure, start, middle + 0.8 * size, 0.85 * size, palette.INK)
