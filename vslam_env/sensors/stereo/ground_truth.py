"""True landmarks of a textured world: corners detected in the textures of its walls.

They serve the evaluation of maps only and are unknown to the filters.
"""

from typing import TYPE_CHECKING

import numpy as np

from slam_backend.core.lazy_import import LazyModule
from slam_backend.core.read_only import as_constant, as_read_only
from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.frontend import CornerOptions, harris_corners, usurf_descriptors
from slam_backend.frontend.images import SMALLEST
from vslam_env.sensors.stereo.cameras import Traced
from vslam_env.sensors.stereo.textures import WallTextures
from vslam_env.world.freespace import FreeSpace
from vslam_env.world.spec import Landmarks, World

if TYPE_CHECKING:
    import cv2
else:
    cv2 = LazyModule("cv2")  # takes as long to import as numpy

LOOK = 0.12  # [m] a face is visible if the point this far in front of it lies in the free space
ALL = 1 << 20


class TextureCorners:
    """Corners on all faces of a world, and the association of points on walls with them.

    Args:
        world: World with the walls.
        textures: Textures of these walls.
        free_space: Free space of this world; faces that do not border on it have no landmarks.
        pixels_per_metre: Resolution of the corner detection [px/m], that of a camera at a typical distance from a wall.
        corners: Options of the corner detector, except limits of the number of corners.
        tolerance: Largest distance between a point on a wall and its corner [m].

    Attributes:
        landmarks: Corners in order of their faces; descriptors are u-SURF at working resolution.
        faces: (N,) int64, read-only. Faces of the corners, see `WallTextures`.
        offsets: (N, 2) float64 [m], read-only. Position along the wall, and height.
    """

    def __init__(
        self,
        world: World,
        textures: WallTextures,
        free_space: FreeSpace,
        pixels_per_metre: float,
        corners: CornerOptions,
        tolerance: float = 0.08,
    ) -> None:
        starts, ends = world.walls[:, :2], world.walls[:, 2:]
        along = (ends - starts) / np.linalg.norm(ends - starts, axis=1)[:, None]
        left = np.stack([-along[:, 1], along[:, 0]], axis=1)
        unlimited = CornerOptions(
            most=ALL,
            block=corners.block,
            spacing=corners.spacing,
            relative=corners.relative,
            absolute=corners.absolute,
            border=corners.spacing,
            cell=corners.cell,
        )
        faces, offsets, descriptors = [], [], []
        for face in range(2 * len(world.walls)):
            found, face_descriptors = _corners_of(textures, face, pixels_per_metre, unlimited)
            wall, side = divmod(face, 2)
            normal = left[wall] if side == 0 else -left[wall]
            places = starts[wall] + found[:, :1] * along[wall] + LOOK * normal
            free = free_space.contains(places)
            faces.append(np.full(int(free.sum()), face))
            offsets.append(found[free])
            descriptors.append(face_descriptors[free])
        of_faces, places = np.concatenate(faces), np.concatenate(offsets)
        walls = of_faces // 2
        positions = starts[walls] + places[:, :1] * along[walls]
        landmarks = Landmarks(
            positions=np.column_stack([positions, places[:, 1]]),
            normals=np.where(of_faces % 2 == 0, 1.0, -1.0)[:, None] * left[walls],
            walls=walls,
            descriptors=np.concatenate(descriptors),
        )
        self._settle(world.walls, landmarks, of_faces, places, tolerance)

    def _settle(
        self, walls: FloatArray, landmarks: Landmarks, faces: IntArray, offsets: FloatArray, tolerance: float
    ) -> None:
        """Initialise from detected corners."""
        self.landmarks, self.faces, self.offsets = landmarks, as_constant(faces), as_constant(offsets)
        self._tolerance = tolerance
        self._lengths = as_read_only(np.linalg.norm(walls[:, 2:] - walls[:, :2], axis=1))
        self._begins = as_read_only(np.searchsorted(faces, np.arange(2 * len(walls) + 1)))

    @classmethod
    def found(
        cls, walls: FloatArray, landmarks: Landmarks, faces: IntArray, offsets: FloatArray, tolerance: float
    ) -> "TextureCorners":
        """Rebuild an instance from its detected corners.

        Args:
            walls: (S, 4) float64 [m], world frame. Wall segments.
            landmarks: Corners.
            faces: (N,) int64, ascending. Faces of the corners.
            offsets: (N, 2) float64 [m]. Position along the wall, and height.
            tolerance: Largest distance between a point on a wall and its corner [m].
        """
        self = cls.__new__(cls)
        self._settle(walls, landmarks, faces, offsets, tolerance)
        return self

    def true_ids(self, traced: Traced, heights: FloatArray) -> IntArray:
        """Return the landmark (n,) int64 of each point on a wall, -1: none.

        Args:
            traced: Hits of the rays to the points.
            heights: (n,) float64 [m]. Heights of the hits.
        """
        ids = np.full(len(heights), -1, dtype=np.int64)
        for n in np.flatnonzero(traced.walls >= 0):
            wall = traced.walls[n]
            face = 2 * wall + traced.sides[n]
            rows = slice(int(self._begins[face]), int(self._begins[face + 1]))
            differences = self.offsets[rows] - [traced.along[n] * self._lengths[wall], heights[n]]
            squares = (differences * differences).sum(axis=1)
            if len(squares) and squares.min() <= self._tolerance**2:
                ids[n] = rows.start + int(squares.argmin())
        return ids


def _corners_of(
    textures: WallTextures, face: int, pixels_per_metre: float, options: CornerOptions
) -> tuple[FloatArray, np.ndarray]:
    """Return the corners of a face (n, 2) [m], position along the wall and height, and descriptors (n, 64)."""
    config, picture = textures.config, textures.picture(face)
    width, height = textures.columns[face] * textures.widths[face], config.ceiling - config.floor
    size = max(1, round(width * pixels_per_metre)), max(1, round(height * pixels_per_metre))
    if min(size) < SMALLEST:
        return np.empty((0, 2)), np.empty((0, 64), dtype=np.float32)
    image = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    points = harris_corners(image, options).points
    descriptors = usurf_descriptors(image, points, 2.3)
    nonzero = descriptors.any(axis=1)
    points, descriptors = points[nonzero], descriptors[nonzero]
    scale = np.array([width / size[0], height / size[1]])
    offsets = (points + 0.5) * scale
    offsets[:, 1] = config.ceiling - offsets[:, 1]
    return offsets, descriptors
