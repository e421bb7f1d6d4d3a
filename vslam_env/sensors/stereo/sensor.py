"""`StereoSensor`: rendered eyes and the image front end stand in for the landmark sensor."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from slam_backend.core.validation import BoolArray, FloatArray, IntArray, argument_error, check_float
from slam_backend.frontend import CornerOptions, FrontEndOptions, StereoFrame, StereoFrontEnd
from slam_backend.frontend.images import LARGEST, SMALLEST, Image
from slam_backend.models.camera import StereoCamera
from slam_backend.models.measurements import Measurements
from vslam_env.sensors.stereo.cameras import ImagingConfig, StereoRenderer
from vslam_env.sensors.stereo.ground_truth import TextureCorners
from vslam_env.sensors.stereo.textures import TextureConfig, WallTextures, draw_textures
from vslam_env.world.freespace import FreeSpace
from vslam_env.world.spec import Landmarks, World
from vslam_env.world.visibility import view_limits, visible_landmarks

FINEST = 2e3  # [px/m]; walls are looked at as a whole
SPURIOUS_PX = 1.0  # a point whose disparity is farther off than this is none of what its ray meets


def default_front_end() -> FrontEndOptions:
    """Return the default front end of a robot.

    At most 20 points a frame, spread over the image, each described by 0.6 m of wall around it: from twice as far 91 %
    of the landmarks of a wall are then found again by descriptor, and 20 % with a window of constant size in pixels.
    """
    return FrontEndOptions(max_measurements=20, window=0.6)


@dataclass(frozen=True, slots=True, kw_only=True)
class StereoSensorConfig:
    """Rendered eyes: what the walls look like, how images are taken, and how they are measured.

    Attributes:
        camera: Optics and size of the images; its sigmas are not used, since images have the noise that they have.
        textures: What the walls look like.
        imaging: Noise and exposure of the images.
        front_end: How images are measured.
        working_distance: True landmarks are the corners of the textures as a camera sees them from so far [m].
        max_incidence: True landmarks seen at a larger angle to their face are not expected to be found [rad].
        tolerance: A measured point is the true landmark nearest to it on its wall within this distance [m].
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
            if not isinstance(getattr(self, name), kind):
                cure = f"Build one: {kind.__name__}(...)."
                raise argument_error(f"stereo.{name}", f"a {kind.__name__}", getattr(self, name), cure)
        check_float("stereo.max_incidence", self.max_incidence, "Give radians.", above=0.0, at_most=np.pi / 2)
        check_float("stereo.working_distance", self.working_distance, "Give metres.", at_least=0.1, at_most=1e3)
        check_float("stereo.tolerance", self.tolerance, "Give metres.", above=0.0, at_most=1e3)
        width, height = self.camera.width, self.camera.height
        if min(width, height) < SMALLEST or width * height > LARGEST:
            expected = f"images of at least {SMALLEST} rows and columns and at most {LARGEST} pixels"
            raise argument_error("stereo.camera", expected, f"a size of {width} x {height}", "Render other images.")
        if (resolution := self.camera.focal_px / self.working_distance) > FINEST:
            expected, cure = f"a view of walls in at most {FINEST:g} px/m", "Lower focal_px, or look from farther."
            raise argument_error("stereo.working_distance", expected, f"a view in {resolution:g} px/m", cure)

    @property
    def farthest(self) -> float:
        """No point is reported that is farther from the camera than this [m]."""
        return self.camera.max_range


class RenderedFrame(NamedTuple):
    """What one robot's eyes saw in one tick, and what was made of it.

    Attributes:
        measurements, true_ids: As of a `Frame`.
        left: (H, W) uint8.
        right: (H, W) uint8.
        seen: What the front end found in them.
    """

    measurements: Measurements
    true_ids: IntArray
    left: Image
    right: Image
    seen: StereoFrame


class TeamRenderedFrames(NamedTuple):
    """The frames of all robots in one tick: per robot what its `RenderedFrame` has by the same name."""

    measurements: Sequence[Measurements]
    true_ids: Sequence[IntArray]
    left: Sequence[Image]
    right: Sequence[Image]
    seen: Sequence[StereoFrame]

    @property
    def names(self) -> Sequence[IntArray]:
        """The true ids, as those who ask any sensor's frames look for them."""
        return self.true_ids

    def per_robot(self) -> list[RenderedFrame]:
        """Return the frame of each robot; its true ids are copies."""
        return list(map(RenderedFrame, *self._replace(true_ids=[own.copy() for own in self.true_ids])))


class StereoSensor:
    """Measures the textured walls of one world with the eyes of all robots.

    Args:
        config: How.
        world: Its walls; landmarks of its own are not used.
        free_space: Of this world.
        rng: Source of the textures.
        robot_radius: Robots hide what stands behind them [m].

    Attributes:
        config: As given.
        textures: Of the walls.
        corners: The true landmarks.
        robot_radius: As given.
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
        """Look at a world whose textures and corners are known."""
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
        """Return the sensor of a world whose textures and corners are known; arguments of `StereoSensor`."""
        self = cls.__new__(cls)
        self._settle(config, walls, textures, corners, robot_radius)
        return self

    @property
    def landmarks(self) -> Landmarks:
        """The true landmarks."""
        return self.corners.landmarks

    def visible(self, poses: FloatArray) -> BoolArray:
        """Tell which true landmarks (K, N) the robots at `poses` (K, 3) [m, m, rad], world frame, can see."""
        return visible_landmarks(poses, self.landmarks, self._walls, self.robot_radius, self._view)

    def measure(self, poses: FloatArray, rng: np.random.Generator) -> TeamRenderedFrames:
        """Take and measure a pair of images with each robot's eyes.

        Args:
            poses: (K, 3) float64 [m, m, rad], world frame. True poses.
            rng: Source of exposure and noise.

        Returns:
            One frame of each robot, with the true landmark behind each point, -1 where there is none: on edges that
            are none of a texture, on robots, where nothing stands, and where the depth is wrong.
        """
        frames = []
        for robot in range(len(poses)):
            left, right = self._eye.take(poses, robot, rng)
            seen = self._front_end.measure(left, right)
            frames.append(RenderedFrame(seen.measurements, self._true_ids(poses, robot, seen), left, right, seen))
        return TeamRenderedFrames(*zip(*frames, strict=True))

    def _true_ids(self, poses: FloatArray, robot: int, frame: StereoFrame) -> IntArray:
        """Return the true landmark (n,) int64 behind each measured point, -1 where there is none.

        It is the one where the point's ray meets a wall, if the measured disparity is that of the wall to a pixel:
        a point in mid-air is spurious, whatever stands behind it.
        """
        camera = self.config.camera
        traced = self._eye.trace(poses, robot, frame.pixels[:, 0])
        with np.errstate(invalid="ignore"):
            rise = (0.5 * (camera.height - 1) - frame.pixels[:, 1]) / camera.focal_px * traced.depths
        heights = np.where(traced.walls >= 0, camera.mount[2] + rise, 0.0)
        names = self.corners.true_ids(traced, heights)
        spurious = np.abs(frame.pixels[:, 2] - camera.focal_px * camera.baseline / traced.depths) > SPURIOUS_PX
        names[spurious] = -1
        return names
