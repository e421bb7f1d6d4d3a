"""Pictures of an episode: `Scene` says what is to be seen, `draw_frame` paints it."""

from vslam_env.rendering.draw import draw_frame
from vslam_env.rendering.scene import MergeFlash, RobotView, Scene

__all__ = ["MergeFlash", "RobotView", "Scene", "draw_frame"]
