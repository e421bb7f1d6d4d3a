"""Stereo sensor: rendered images measured by the stereo front end."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import BoolArray, FloatArray, IntArray, argument_error, check_float, check_kind
from slam_backend.frontend import CornerOptions, FrontEndOptions, StereoFrame, StereoFrontEnd
from slam_backend.frontend.images import LARGEST, SMALLEST, Image
from slam_backend.models.camera import StereoCamera
from slam_backend.models.measurements import Measurements
from slam_backend.state import INT64, UINT8, Array, Each, Record, with_state
from vslam_env.sensors.landmark_sensor import padded
from vslam_env.sensors.stereo.cameras import ImagingConfig, StereoRenderer
from vslam_env.sensors.stereo.ground_truth import TextureCorners
from vslam_env.sensors.stereo.textures import TextureConfig, WallTextures, draw_textures
from vslam_env.world.freespace import FreeSpace
from vslam_env.world.spec import Landmarks, World
from vslam_env.world.visibility import view_limits, visible_landmarks

FINEST = 2e3  # [px/m] limit of the resolution of corner detection
SPURIOUS_PX = 1.0  # a point with a larger disparity error is false


def default_front_end() -> FrontEndOptions:
    """Return the default options of the front end.

    A frame has at most 20 points, spread over the image, with descriptors of a window of 0.6 m. From twice the
    distance, these match 91 % of the landmarks of a wall, and descriptors of a window of constant pixel size 20 %.
    """
    return FrontEndOptions(max_measurements=20, window=0.6)


@short_repr
@dataclass(frozen=True, slots=True, kw_only=True)
class StereoSensorConfig:
    """Configuration of rendered stereo cameras: textures, imaging and front end.

    Attributes:
        camera: Optics and size of the images; its sigmas are unused, since noise arises in the images.
        textures: Textures of the walls.
        imaging: Noise and exposure of the images.
        front_end: Options of the stereo front end.
        working_distance: Camera distance whose resolution is used to detect the true landmarks in the textures [m].
        max_incidence: Largest angle between line of sight and face normal at which landmarks are visible [rad].
        tolerance: Largest distance on a wall between a measured point and its true landmark [m].
    """

    camera: StereoCamera = field(default_factory=StereoCamera)
    textures: TextureConfig = field(default_factory=TextureConfig)
    imaging: ImagingConfig = field(default_factory=ImagingConfig)
    front_end: FrontEndOptions = field(default_factory=default_front_end)
    working_distance: float = 3.0
    max_incidence: float = float(np.radians(60.0))
    tolerance: float = 0.08

    def __post_init__(self) -> None:
        parts = {"camera": StereoCamera, "textures": TextureConfig, "imaging": ImagingConfig}
        for name, kind in (parts | {"front_end": FrontEndOptions}).items():
            check_kind(f"stereo.{name}", getattr(self, name), kind)
        check_float("stereo.max_incidence", self.max_incidence, "Give radians.", above=0.0, at_most=np.pi / 2)
        check_float("stereo.working_distance", self.working_distance, "Give metres.", at_least=0.1, at_most=1e3)
        check_float("stereo.tolerance", self.tolerance, "Give metres.", above=0.0, at_most=1e3)
        width, height = self.camera.width, self.camera.height
        if min(width, height) < SMALLEST or width * height > LARGEST:
            expected = f"images of at least {SMALLEST} rows and columns and at most {LARGEST} pixels"
            raise argument_error("stereo.camera", expected, f"a size of {width} x {height}", "Choose another size.")
        if (resolution := self.camera.focal_px / self.working_distance) > FINEST:
            expected, hint = f"a resolution of at most {FINEST:g} px/m", "Lower focal_px, or raise the distance."
            raise argument_error("stereo.working_distance", expected, f"a resolution of {resolution:g} px/m", hint)

    @property
    def farthest(self) -> float:
        """Largest measured distance from the camera [m]; farther points are discarded."""
        return self.camera.max_range


@short_repr
class RenderedFrame(NamedTuple):
    """Images of one robot in one tick, and the measurements from them.

    Attributes:
        measurements, true_ids: Measurements and true landmarks, see `SensorFrame`.
        left: (H, W) uint8. Left image.
        right: (H, W) uint8. Right image.
        seen: Result of the front end.
    """

    measurements: Measurements
    true_ids: IntArray
    left: Image
    right: Image
    seen: StereoFrame


@short_repr
@with_state(
    measurements=Each(Record(Measurements), "K"),
    true_ids=Each(Array(INT64, "*", -1, "WORLD", constant=True), "K"),
    left=Each(Array(UINT8, "HEIGHT WIDTH", constant=True), "K"),
    right=Each(Array(UINT8, "HEIGHT WIDTH", constant=True), "K"),
    seen=Each(Record(StereoFrame), "K"),
)
class TeamRenderedFrames(NamedTuple):
    """The frames of all robots in one tick, with the fields of `RenderedFrame` by robot."""

    measurements: Sequence[Measurements]
    true_ids: Sequence[IntArray]
    left: Sequence[Image]
    right: Sequence[Image]
    seen: Sequence[StereoFrame]

    @property
    def padded_ids(self) -> IntArray:
        """(K, B) int64. True landmarks of each robot's points; -1 for a false point and beyond them."""
        return padded(self.true_ids)

    def per_robot(self) -> list[RenderedFrame]:
        """Return the frame of each robot, with copies of the true ids."""
        return list(map(RenderedFrame, *self._replace(true_ids=[ids.copy() for ids in self.true_ids])))


class StereoSensor:
    """Stereo cameras of all robots that measure the textured walls of one world.

    Args:
        config: Textures, imaging and front end.
        world: World with the walls; its own landmarks are ignored.
        free_space: Free space of this world.
        rng: Source of the textures.
        robot_radius: Radius of the robots, which occlude walls [m].

    Attributes:
        config: Textures, imaging and front end.
        textures: Textures of the walls.
        corners: True landmarks.
        robot_radius: Radius of the robots [m].
    """

    def __init__(
        self,
        config: StereoSensorConfig,
        world: World,
        free_space: FreeSpace,
        rng: np.random.Generator,
        robot_radius: float = 0.2,
    ) -> None:
        textures = draw_textures(world.walls, rng, config.textures)
        resolution = config.camera.focal_px / config.working_distance
        options: CornerOptions = config.front_end.corners
        corners = TextureCorners(world, textures, free_space, resolution, options, config.tolerance)
        self._settle(config, world.walls, textures, corners, robot_radius)

    def _settle(
        self,
        config: StereoSensorConfig,
        walls: FloatArray,
        textures: WallTextures,
        corners: TextureCorners,
        robot_radius: float,
    ) -> None:
        """Initialise from known textures and corners."""
        self.config, self.textures, self.corners = config, textures, corners
        self._walls, self.robot_radius = walls, robot_radius
        self._view = view_limits(config.camera, config.max_incidence)
        self._eye = StereoRenderer(config.camera, config.imaging, walls, textures, robot_radius)
        self._front_end = StereoFrontEnd(config.camera, config.front_end)

    @classmethod
    def of_textures(
        cls,
        config: StereoSensorConfig,
        walls: FloatArray,
        textures: WallTextures,
        corners: TextureCorners,
        robot_radius: float,
    ) -> "StereoSensor":
        """Return a sensor with known textures and corners; see `StereoSensor` for the other arguments."""
        self = cls.__new__(cls)
        self._settle(config, walls, textures, corners, robot_radius)
        return self

    @property
    def landmarks(self) -> Landmarks:
        """True landmarks."""
        return self.corners.landmarks

    def visible(self, poses: FloatArray) -> BoolArray:
        """Return which true landmarks are visible (K, N) from poses (K, 3) [m, m, rad], world frame."""
        return visible_landmarks(poses, self.landmarks, self._walls, self.robot_radius, self._view)

    def measure(self, poses: FloatArray, rng: np.random.Generator) -> TeamRenderedFrames:
        """Render and measure a pair of images for each robot.

        Args:
            poses: (K, 3) float64 [m, m, rad], world frame. True poses.
            rng: Source of exposure and noise.

        Returns:
            One frame per robot, with the true landmark of each point. It is -1 for points without one: on edges outside
            the textures, on robots, or with a wrong depth.
        """
        frames = []
        for robot in range(len(poses)):
            left, right = self._eye.take(poses, robot, rng)
            seen = self._front_end.measure(left, right)
            frames.append(RenderedFrame(seen.measurements, self._true_ids(poses, robot, seen), left, right, seen))
        return TeamRenderedFrames(*zip(*frames, strict=True))

    def _true_ids(self, poses: FloatArray, robot: int, frame: StereoFrame) -> IntArray:
        """Return the true landmark (n,) int64 of each measured point, -1: none.

        It is the landmark at the hit of the point's ray on a wall, if the measured disparity agrees with the wall to a
        pixel; otherwise the point is false.
        """
        camera = self.config.camera
        traced = self._eye.trace(poses, robot, frame.pixels[:, 0])
        with np.errstate(invalid="ignore"):
            rise = (0.5 * (camera.height - 1) - frame.pixels[:, 1]) / camera.focal_px * traced.depths
        heights = np.where(traced.walls >= 0, camera.mount[2] + rise, 0.0)
        ids = self.corners.true_ids(traced, heights)
        spurious = np.abs(frame.pixels[:, 2] - camera.focal_px * camera.baseline / traced.depths) > SPURIOUS_PX
        ids[spurious] = -1
        return ids
