"""Scenes of the stereo benchmark: a hall of panels for speed, a long wall for changes of viewpoint."""

from dataclasses import dataclass

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.frontend import StereoFrame, StereoFrontEnd
from slam_backend.frontend.images import Image
from slam_backend.geometry import transform_points
from slam_backend.models.camera import StereoCamera
from vslam_env.sensors.stereo.cameras import ImagingConfig, StereoRenderer
from vslam_env.sensors.stereo.ground_truth import TextureCorners
from vslam_env.sensors.stereo.sensor import SPURIOUS_PX
from vslam_env.sensors.stereo.textures import TextureConfig, WallTextures, draw_textures
from vslam_env.world import FreeSpace, World

WALL = World("wall", np.array([[0, 0, 14, 0], [14, 0, 14, 9], [14, 9, 0, 9], [0, 9, 0, 0]], dtype=float))
WORKING_DISTANCE = 3.0  # distance at which true corners are detected [m]


def panel_hall(walls: int) -> World:
    """Return a hall of 8 x 6 m whose additional walls are short panels in two rows before its far side."""
    shell = [[0, 0, 8, 0], [8, 0, 8, 6], [8, 6, 0, 6], [0, 6, 0, 0]]
    panels = []
    for n in range(max(0, walls - len(shell))):
        x, y = 4.5 + 1.2 * (n % 2) + 0.05 * (n % 7), 0.4 + 5.2 * (n + 0.5) / max(1, walls - len(shell))
        panels.append([x, y, x + 0.15, y + 0.12])
    return World("hall of panels", np.array(shell + panels, dtype=float))


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """Image pair of a world from a known pose."""

    pose: FloatArray  # (3,) float64 [m, m, rad], world frame
    left: Image  # (H, W) uint8
    right: Image  # (H, W) uint8


@dataclass(frozen=True, slots=True, eq=False)
class Named:
    """Points of a view with their true landmarks."""

    frame: StereoFrame  # Measurements of the front end
    world: FloatArray  # (n, 3) float64 [m], world frame, from the true pose
    names: IntArray  # (n,) int64. True landmarks, -1: none.
    true_disparities: FloatArray  # (n,) float64 [px]. True disparities, by ray casting.


class Scene:
    """Textured world with cameras and true corners."""

    def __init__(
        self, world: World, camera: StereoCamera, seed: int, textures: TextureConfig | None = None,
        imaging: ImagingConfig | None = None,
    ) -> None:  # fmt: skip
        self.world, self.camera = world, camera
        self.textures: WallTextures = draw_textures(world.walls, np.random.default_rng(seed), textures)
        self.eye = StereoRenderer(camera, ImagingConfig() if imaging is None else imaging, world.walls, self.textures)

    def look(self, pose: FloatArray, rng: np.random.Generator) -> View:
        """Render a pair at a pose (3,) [m, m, rad]."""
        return View(pose, *self.eye.take(pose[None], 0, rng))

    def corners(self, front_end: StereoFrontEnd) -> TextureCorners:
        """Return the true corners, as detected by this front end."""
        resolution = self.camera.focal_px / WORKING_DISTANCE
        free = FreeSpace(self.world, 0.2)
        return TextureCorners(self.world, self.textures, free, resolution, front_end.options.corners)

    def named(self, view: View, front_end: StereoFrontEnd, corners: TextureCorners) -> Named:
        """Measure a view and find the true landmarks of its points."""
        camera = self.camera
        frame = front_end.measure(view.left, view.right)
        traced = self.eye.trace(view.pose[None], 0, frame.pixels[:, 0])
        rise = (0.5 * (camera.height - 1) - frame.pixels[:, 1]) / camera.focal_px
        heights = np.where(traced.walls >= 0, camera.mount[2] + rise * np.minimum(traced.depths, 1e3), 0.0)
        robot = camera.robot_from_camera(frame.measurements.points)
        world = np.column_stack([transform_points(view.pose, robot[:, :2]), robot[:, 2]])
        disparities = camera.focal_px * camera.baseline / traced.depths
        names = corners.true_ids(traced, heights)
        names[np.abs(frame.pixels[:, 2] - disparities) > SPURIOUS_PX] = -1
        return Named(frame, world, names, disparities)


def office_views(scene: Scene, count: int, rng: np.random.Generator) -> list[View]:
    """Render pairs at random free positions of a world, in random directions."""
    free = FreeSpace(scene.world, 0.2)
    x0, y0, x1, y1 = scene.world.bounds
    views: list[View] = []
    while len(views) < count:
        pose = np.array([rng.uniform(x0, x1), rng.uniform(y0, y1), rng.uniform(-np.pi, np.pi)])
        if free.contains(pose[None, :2])[0]:
            views.append(scene.look(pose, rng))
    return views


def wall_pose(along: float, distance: float, angle: float) -> FloatArray:
    """Return the pose (3,) of a camera that looks at a point of the long wall from a given distance and angle."""
    heading = -0.5 * np.pi + angle
    return np.array([along - distance * np.cos(heading), -distance * np.sin(heading), heading])
