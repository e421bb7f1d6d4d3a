"""Renderer of stereo images of a textured world."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from slam_backend.core.lazy_import import LazyModule
from slam_backend.core.read_only import as_read_only
from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import Float32Array, FloatArray, IntArray, check_float, check_int
from slam_backend.frontend.images import Image
from slam_backend.models.camera import StereoCamera
from vslam_env.sensors.stereo._render_kernels import Faces, expose, render, trace
from vslam_env.sensors.stereo.textures import WallTextures
from vslam_env.world._kernels import walls_in_wedge
from vslam_env.world.visibility import as_coordinate_rows

if TYPE_CHECKING:
    import cv2
else:
    cv2 = LazyModule("cv2")  # takes as long to import as numpy

VIEW = 60.0  # [m] farther walls are not drawn


@short_repr
@dataclass(frozen=True, slots=True, kw_only=True)
class ImagingConfig:
    """Noise, exposure and sampling of images.

    Attributes:
        noise: Standard deviation of the pixel noise, independent in both images [grey levels].
        gain_sigma: Standard deviation of the exposure, drawn for each pair: a factor about 1, the same in both eyes.
        eye_gain_sigma: Standard deviation of the factor by which the right eye's exposure differs.
        blur_px: Standard deviation of a Gaussian blur before noise [px]; 0: none.
        parts: Number of sub-columns rendered per column.
    """

    noise: float = 2.0
    gain_sigma: float = 0.02
    eye_gain_sigma: float = 0.01
    blur_px: float = 0.0
    parts: int = 2

    def __post_init__(self) -> None:
        for name in ("noise", "gain_sigma", "eye_gain_sigma", "blur_px"):
            check_float(f"imaging.{name}", getattr(self, name), "Use 0 for none.", at_least=0.0, at_most=100.0)
        check_int("imaging.parts", self.parts, 1, "2 are enough.", 1000)


class Traced(NamedTuple):
    """Hits of rays through image columns.

    Attributes:
        walls: (n,) int64. Index of the wall; -1: no hit, -2: a robot.
        sides: (n,) int64. 0: left face of the wall, seen from its start; 1: right face.
        depths: (n,) float64 [m]. Depth ahead of the camera; infinity without a hit.
        along: (n,) float64. Position along the wall in [0, 1].
    """

    walls: IntArray
    sides: IntArray
    depths: FloatArray
    along: FloatArray


class StereoRenderer:
    """Renderer of pairs of images of one world.

    The cameras are parallel, the right one `camera.baseline` to the right of the left one. Other robots occlude the
    walls.

    Args:
        camera: Optics, mount and size of the images.
        imaging: Noise and exposure.
        walls: (S, 4) float64 [m], world frame. Wall segments.
        textures: Textures of these walls.
        robot_radius: Radius of the robots [m].
    """

    def __init__(
        self,
        camera: StereoCamera,
        imaging: ImagingConfig,
        walls: FloatArray,
        textures: WallTextures,
        robot_radius: float = 0.2,
    ) -> None:
        self.camera, self.imaging, self.textures = camera, imaging, textures
        self._walls, self._radius = as_coordinate_rows(walls), robot_radius
        lens = camera.focal_px, 0.5 * (camera.width - 1), 0.5 * (camera.height - 1)
        paint = textures.config
        texel = (paint.ceiling - paint.floor) / textures.rows
        self._optics = as_read_only(np.array([*lens, camera.mount[2], paint.ceiling, texel]))
        self._tan_half = (0.5 * camera.width + 1.0) / camera.focal_px

    def take(self, poses: FloatArray, robot: int, rng: np.random.Generator) -> tuple[Image, Image]:
        """Render a pair of images.

        Args:
            poses: (K, 3) float64 [m, m, rad], world frame. True poses of all robots.
            robot: Index of the robot.
            rng: Source of exposure and noise.

        Returns:
            Left and right image (H, W) uint8.
        """
        imaging, camera = self.imaging, self.camera
        gain, difference = 1.0 + rng.standard_normal(2) * [imaging.gain_sigma, imaging.eye_gain_sigma]
        shape = (4, camera.height, camera.width)
        images = []
        for shift, exposure in ((0.0, gain), (camera.baseline, gain * difference)):
            radiance = self.radiance(poses, robot, shift)
            noise = np.frombuffer(rng.bytes(int(np.prod(shape))), dtype=np.uint8).reshape(shape)
            image = np.empty((camera.height, camera.width), dtype=np.uint8)
            expose(radiance, noise, exposure, 0.0, imaging.noise, image)
            images.append(image)
        return images[0], images[1]

    def radiance(self, poses: FloatArray, robot: int, shift: float = 0.0) -> Float32Array:
        """Return the noise-free grey levels (W, H) float32 of a camera `shift` [m] to the right of the left one."""
        eye = self._place(poses[robot], shift)
        local, indices = self._walls_ahead(eye)
        faces = Faces(self.textures.sums, self.textures.starts, self.textures.columns)
        radiance = np.empty((self.camera.width, self.camera.height), dtype=np.float32)
        others = self._others(poses, robot, eye)
        render(local, indices, others, self._radius, self._optics, faces, self.imaging.parts, radiance)
        blur = self.imaging.blur_px
        return radiance if blur == 0.0 else np.asarray(cv2.GaussianBlur(radiance, (0, 0), blur), dtype=np.float32)

    def _walls_ahead(self, eye: FloatArray) -> tuple[FloatArray, IntArray]:
        """Return the walls (n, 4) [m] in the view of a camera at pose `eye`, in its frame, and their indices (n,)."""
        local, indices = np.empty(self._walls.T.shape), np.empty(self._walls.shape[1], np.int64)
        x, y, theta = eye.tolist()
        c, s = np.cos(theta), np.sin(theta)
        count = walls_in_wedge(x, y, c, s, self._walls, self._tan_half, VIEW, local, indices)
        return local[:count], indices[:count]

    def trace(self, poses: FloatArray, robot: int, columns: FloatArray) -> Traced:
        """Return the hits of the left camera's rays through columns (n,) [px]; pixel centres are at integers."""
        eye = self._place(poses[robot], 0.0)
        local, indices = self._walls_ahead(eye)
        others = self._others(poses, robot, eye)
        rows, depths, along = trace(columns, local, others, self._radius, self._optics[0], self._optics[1])
        on_wall = rows >= 0
        walls, sides = rows.copy(), np.zeros(len(rows), dtype=np.int64)
        walls[on_wall] = indices[rows[on_wall]]
        x1, y1, x2, y2 = local[rows[on_wall]].T
        sides[on_wall] = np.where((x2 - x1) * y1 - (y2 - y1) * x1 < 0.0, 0, 1)
        return Traced(walls, sides, depths, along)

    def _place(self, pose: FloatArray, shift: float) -> FloatArray:
        """Return the planar pose (3,) of a camera, world frame."""
        c, s = np.cos(pose[2]), np.sin(pose[2])
        ahead, left = self.camera.mount[0], self.camera.mount[1] - shift
        return np.array([pose[0] + c * ahead - s * left, pose[1] + s * ahead + c * left, pose[2]])

    def _others(self, poses: FloatArray, robot: int, eye: FloatArray) -> FloatArray:
        """Return the positions of the other robots (K - 1, 2) [m] in the frame of a camera at pose `eye`."""
        offsets = np.delete(poses[:, :2], robot, axis=0) - eye[:2]
        c, s = np.cos(eye[2]), np.sin(eye[2])
        return np.column_stack([c * offsets[:, 0] + s * offsets[:, 1], c * offsets[:, 1] - s * offsets[:, 0]])
