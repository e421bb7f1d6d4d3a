"""Rendering of episodes: `Scene` holds the content of a picture, `draw_frame` draws it."""

from vslam_env.rendering.draw import draw_frame
from vslam_env.rendering.scene import MergeFlash, RobotView, Scene

__all__ = ["MergeFlash", "RobotView", "Scene", "draw_frame"]
