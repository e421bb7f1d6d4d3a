"""Drawing of one frame: top view of the world and the robots' beliefs, header and footer."""

import numpy as np

from slam_backend.core.validation import FloatArray, argument_error, check_int
from vslam_env.rendering import palette
from vslam_env.rendering.canvas import (
    Image,
    Viewport,
    disc,
    dots,
    ellipse_outlines,
    fill,
    lines,
    path,
    translucent_fill,
)
from vslam_env.rendering.merge_effect import draw_captions, draw_flashes
from vslam_env.rendering.overlays import draw_footer, draw_header
from vslam_env.rendering.palette import mix, robot_colour
from vslam_env.rendering.scene import RobotView, Scene

SMALLEST_SIZE = (160, 120)
WALL_WIDTH_M = 0.08
PARTICLES_SHOWN = 100
EMPTY_EXTENT_M = 2.0  # [m] margin around the robots if there are no walls


def draw_frame(scene: Scene, size: tuple[int, int] = (960, 720)) -> Image:
    """Draw a scene, with a scale bar in the header.

    The truth is grey or faint: walls, landmarks, paths and filled bodies. Estimates have the robot's colour: dots with
    95 % ellipses are its map, the outlined disc and the particle cloud its pose. A group has one map and halos in the
    colour of its first robot. A merge flashes for `merge_effect.FLASH_TICKS` ticks.

    Args:
        scene: Content of the picture in the world frame.
        size: Width and height [px], at least 160 x 120; the aspect ratio of the world is kept.

    Returns:
        (height, width, 3) uint8, RGB. New array.

    Raises:
        ValueError: If the size is not a pair of sufficiently large integers.
    """
    width, height = _checked_size(size)
    unit = min(width / 960.0, height / 720.0)
    image: Image = np.empty((height, width, 3), np.uint8)
    fill(image, palette.PAPER)
    top, bottom = round(46 * max(unit, 0.4)), height - round(64 * max(unit, 0.4))
    plot = image[top:bottom]
    view = Viewport.around(_extent(scene), width, bottom - top)
    _draw_truth(plot, view, scene, unit)
    for first in dict.fromkeys(scene.map_owners):
        _draw_map(plot, view, scene.robots[first], robot_colour(first), unit)
    for index, robot in enumerate(scene.robots):
        _draw_belief(plot, view, robot, robot_colour(index), unit, scene.robot_radius)
    draw_flashes(plot, view, scene, unit)
    _draw_bodies(plot, view, scene, unit)
    draw_captions(plot, scene, unit)
    draw_header(image[:top], scene, view.scale)
    draw_footer(image[bottom:], scene)
    return image


def _checked_size(size: tuple[int, int]) -> tuple[int, int]:
    """Return the validated width and height, or raise."""
    if not isinstance(size, (tuple, list)) or len(size) != 2:
        raise argument_error("size", "a pair (width, height)", size, "Give the size of the picture in pixels.")
    width = check_int("size[0]", size[0], SMALLEST_SIZE[0], "Give the width in pixels.")
    height = check_int("size[1]", size[1], SMALLEST_SIZE[1], "Give the height in pixels.")
    return width, height


def _extent(scene: Scene) -> FloatArray:
    """Return points (n, 2) that the picture must show: the walls, or without walls the true robots."""
    if len(scene.walls):
        return np.concatenate([scene.walls[:, :2], scene.walls[:, 2:]])
    spread = EMPTY_EXTENT_M * np.array([[-1.0, -1.0], [1.0, 1.0]])
    centres = [robot.true_pose[:2] for robot in scene.robots] or [np.zeros(2)]
    return np.concatenate([centre + spread for centre in centres])


def _draw_truth(plot: Image, view: Viewport, scene: Scene, unit: float) -> None:
    """Draw the true landmarks, paths and walls."""
    for index, robot in enumerate(scene.robots):
        faint = mix(robot_colour(index), palette.PAPER, 0.72)
        path(plot, view.pixels(robot.true_path), faint, max(1, round(4 * unit)))
    wall_width = max(2, round(WALL_WIDTH_M * view.scale))
    lines(plot, view.pixels(scene.walls.reshape(-1, 2, 2)), palette.WALL, wall_width, False)
    dots(plot, view.pixels(scene.landmarks), max(1.2, 1.5 * unit), palette.TRUE_LANDMARK)


def _draw_map(plot: Image, view: Viewport, robot: RobotView, colour: palette.Colour, unit: float) -> None:
    """Draw the landmarks of a robot's map with their 95 % ellipses."""
    means, covariances = robot.landmark_means, robot.landmark_covariances[:, :2, :2]
    finite = np.isfinite(means).all(axis=1) & np.isfinite(covariances).all(axis=(1, 2))
    dot = max(1.4, 2.2 * unit)
    outlines = ellipse_outlines(means[finite, :2], covariances[finite], view, dot + 1.5)
    lines(plot, outlines, mix(colour, palette.PAPER, 0.55), 1, True)
    dots(plot, view.pixels(means[finite]), dot, colour)


def _draw_belief(
    plot: Image, view: Viewport, robot: RobotView, colour: palette.Colour, unit: float, radius: float
) -> None:
    """Draw a robot's estimated path, pose and particles, and the lines of sight to seen landmarks."""
    path(plot, view.pixels(robot.estimated_path), mix(colour, palette.PAPER, 0.2), max(1, round(1.6 * unit)))
    body = view.pixels(robot.true_pose)
    if len(robot.sight_lines):
        rays = np.stack([np.broadcast_to(body, (len(robot.sight_lines), 2)), view.pixels(robot.sight_lines)], axis=1)
        lines(plot, rays, mix(colour, palette.PAPER, 0.45), 1, False)
    stride = max(1, len(robot.particles) // PARTICLES_SHOWN)
    cloud = robot.particles[::stride]
    translucent_fill(plot, view.pixels(cloud[np.isfinite(cloud).all(axis=1)]), max(1.6, 2.6 * unit), colour, 0.16)
    if np.isfinite(robot.estimated_pose).all():
        _outline(plot, view, robot.estimated_pose, max(radius * view.scale, 5.0 * unit), colour, unit)


def _outline(plot: Image, view: Viewport, pose: FloatArray, radius: float, colour: palette.Colour, unit: float) -> None:
    """Draw an estimated pose: an outlined disc with a line in its heading."""
    centre, ahead = view.pixels(pose), np.array([np.cos(pose[2]), -np.sin(pose[2])])
    pen = max(1, round(2 * unit))
    disc(plot, centre, radius + 2.0 * unit, colour, pen)
    lines(plot, [np.stack([centre + radius * ahead, centre + 1.9 * radius * ahead])], colour, pen, False)


def _draw_bodies(plot: Image, view: Viewport, scene: Scene, unit: float) -> None:
    """Draw the true robots; members of larger groups with a halo in the colour of the group's first robot."""
    radius = max(scene.robot_radius * view.scale, 5.0 * unit)
    owners = scene.map_owners
    for index, robot in enumerate(scene.robots):
        colour, centre = robot_colour(index), view.pixels(robot.true_pose)
        if owners.count(owners[index]) > 1:
            accent = robot_colour(owners[index])
            for reach in (2.1, 1.6):
                translucent_fill(plot, centre[None], reach * radius, accent, 0.18)
        disc(plot, centre, radius + max(1.0, 1.5 * unit), palette.PAPER)
        disc(plot, centre, radius, colour)
        ahead = np.array([np.cos(robot.true_pose[2]), -np.sin(robot.true_pose[2])])
        lines(plot, [np.stack([centre, centre + radius * ahead])], palette.PAPER, max(1, round(2.4 * unit)), False)
