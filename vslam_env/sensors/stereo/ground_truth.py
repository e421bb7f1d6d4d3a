"""True landmarks of a textured world: the corners that the detector finds in the walls' own textures.

This is the simulator's side only. The map error counts how many of these landmarks a robot's map holds, and how far off
they are; a filter never learns of them.
"""

import cv2
import numpy as np

from slam_backend.core.read_only import as_constant, as_read_only
from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.frontend import CornerOptions, harris_corners, usurf_descriptors
from slam_backend.frontend.images import SMALLEST
from vslam_env.sensors.stereo.cameras import Traced
from vslam_env.sensors.stereo.textures import WallTextures
from vslam_env.world.freespace import FreeSpace
from vslam_env.world.spec import Landmarks, World

LOOK = 0.12  # [m] a face looks into the free space if the point this far in front of it lies there
ALL = 1 << 20


class TextureCorners:
    """The corners of all faces of a world, and which of them a point on a wall is.

    Args:
        world: Its walls.
        textures: Of these walls.
        free_space: Of this world: faces that no robot can stand before have no landmarks.
        pixels_per_metre: Working resolution at which corners are looked for [px/m]: that at which a camera sees a wall
            from a typical distance.
        corners: What is a corner; the numbers of corners are not limited.
        tolerance: A point on a wall is the corner nearest to it within this distance [m].

    Attributes:
        landmarks: The corners, in order of their faces; descriptors are u-SURF at working resolution.
        faces: (N,) int64, read-only. Their faces, as in `WallTextures`.
        offsets: (N, 2) float64 [m], read-only. How far along the wall, and the height.
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
            found, described = _corners_of(textures, face, pixels_per_metre, unlimited)
            wall, side = divmod(face, 2)
            normal = left[wall] if side == 0 else -left[wall]
            places = starts[wall] + found[:, :1] * along[wall] + LOOK * normal
            free = free_space.contains(places)
            faces.append(np.full(int(free.sum()), face))
            offsets.append(found[free])
            descriptors.append(described[free])
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
        """Hold corners that were found."""
        self.landmarks, self.faces, self.offsets = landmarks, as_constant(faces), as_constant(offsets)
        self._tolerance = tolerance
        self._lengths = as_read_only(np.linalg.norm(walls[:, 2:] - walls[:, :2], axis=1))
        self._begins = as_read_only(np.searchsorted(faces, np.arange(2 * len(walls) + 1)))

    @classmethod
    def found(
        cls, walls: FloatArray, landmarks: Landmarks, faces: IntArray, offsets: FloatArray, tolerance: float
    ) -> "TextureCorners":
        """Return corners that were found before.

        Args:
            walls: (S, 4) float64 [m], world frame.
            landmarks: The corners.
            faces: (N,) int64, ascending.
            offsets: (N, 2) float64 [m].
            tolerance: [m].
        """
        self = cls.__new__(cls)
        self._settle(walls, landmarks, faces, offsets, tolerance)
        return self

    def true_ids(self, traced: Traced, heights: FloatArray) -> IntArray:
        """Return which landmark (n,) int64 each point on a wall is, -1: none.

        Args:
            traced: What the rays to the points meet.
            heights: (n,) float64 [m]. Heights at which they meet it.
        """
        names = np.full(len(heights), -1, dtype=np.int64)
        for n in np.flatnonzero(traced.walls >= 0):
            wall = traced.walls[n]
            face = 2 * wall + traced.sides[n]
            rows = slice(int(self._begins[face]), int(self._begins[face + 1]))
            away = self.offsets[rows] - [traced.along[n] * self._lengths[wall], heights[n]]
            squares = (away * away).sum(axis=1)
            if len(squares) and squares.min() <= self._tolerance**2:
                names[n] = rows.start + int(squares.argmin())
        return names


def _corners_of(
    textures: WallTextures, face: int, pixels_per_metre: float, options: CornerOptions
) -> tuple[FloatArray, np.ndarray]:
    """Return the corners of a face, (n, 2) [m] along the wall and in height, and descriptors (n, 64)."""
    config, picture = textures.config, textures.picture(face)
    width, height = textures.columns[face] * textures.widths[face], config.ceiling - config.floor
    size = max(1, round(width * pixels_per_metre)), max(1, round(height * pixels_per_metre))
    if min(size) < SMALLEST:
        return np.empty((0, 2)), np.empty((0, 64), dtype=np.float32)
    seen = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    points = harris_corners(seen, options).points
    descriptors = usurf_descriptors(seen, points, 2.3)
    lively = descriptors.any(axis=1)
    points, descriptors = points[lively], descriptors[lively]
    scale = np.array([width / size[0], height / size[1]])
    offsets = (points + 0.5) * scale
    offsets[:, 1] = config.ceiling - offsets[:, 1]
    return offsets, descriptors
