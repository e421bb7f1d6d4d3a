"""What a world is: walls, the landmarks on them, and perhaps where robots start. Frozen and checked."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.read_only import as_read_only
from slam_backend.core.validation import FloatArray, IntArray, argument_error, check_array

SHORTEST_WALL = 1e-3  # [m] anything shorter has no direction worth the name
LARGEST_EXTENT = 200.0  # [m] grids of free space grow with its square
LONGEST = 1e6  # component of a vector whose square is still a float32
FARTHEST_PLACE = 1e8  # [m] from the origin; no map frame on earth has more, and differences keep their micrometres


@dataclass(frozen=True, slots=True, eq=False)
class Landmarks:
    """Points with a texture on the faces of walls.

    Attributes:
        positions: (N, 3) float64 [m], world frame. z is the height above the robots' reference height.
        normals: (N, 2) float64 [-], world frame. Unit vectors that point out of the face, horizontally.
        walls: (N,) int64. Index of the wall that carries the landmark.
        descriptors: (N, d) float32 [-]. Unit appearance vectors.

    Raises:
        ValueError: If a shape is wrong, a number is not finite, or a vector has not length 1.
    """

    positions: FloatArray
    normals: FloatArray
    walls: IntArray
    descriptors: NDArray[np.float32]

    def __post_init__(self) -> None:
        cure = "Give one row per landmark."
        positions: Any = check_array("landmarks.positions", self.positions, (None, 3), cure, within=FARTHEST_PLACE)
        normals: Any = check_array("landmarks.normals", self.normals, (len(positions), 2), cure, within=LONGEST)
        walls: Any = check_array("landmarks.walls", self.walls, (len(positions),), cure, dtype=np.int64)
        descriptors: Any = check_array(
            "landmarks.descriptors", self.descriptors, (len(positions), None), cure, dtype=np.float32, within=LONGEST
        )
        for name, vectors in (("normals", normals), ("descriptors", descriptors)):
            lengths = np.linalg.norm(vectors, axis=1)
            if len(lengths) and not np.allclose(lengths, 1.0, atol=1e-4):
                worst = float(lengths[np.argmax(np.abs(lengths - 1.0))])
                raise argument_error(f"landmarks.{name}", "unit vectors", f"a length of {worst:g}", "Normalise them.")
        for name, array in zip(self.__slots__, (positions, normals, walls, descriptors), strict=True):
            object.__setattr__(self, name, as_read_only(array))

    def __reduce__(self) -> tuple[Any, ...]:
        """Let copies and what was pickled be read-only, too."""
        return Landmarks, (self.positions, self.normals, self.walls, self.descriptors)

    def __len__(self) -> int:
        return len(self.positions)


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """A flat building seen from above, in metres.

    Attributes:
        name: Shown in tables and pictures.
        walls: (S, 4) float64 [m], world frame. Rows x1 y1 x2 y2: thin, opaque, solid segments.
        landmarks: None: an environment places them on the walls.
        start_poses: None, or (K, 3) float64 [m, m, rad], world frame, for K robots or fewer. None: an environment draws
            them.

    Raises:
        ValueError: If there is no wall, a wall has no length, the world spans more than 200 m, a number is not
            finite, or a landmark names no wall.

    >>> World("room", [[0, 0, 4, 0], [4, 0, 4, 3], [4, 3, 0, 3], [0, 3, 0, 0]]).bounds
    (0.0, 0.0, 4.0, 3.0)
    """

    name: str
    walls: FloatArray
    landmarks: Landmarks | None = field(default=None)
    start_poses: FloatArray | None = field(default=None)

    def __post_init__(self) -> None:
        if not isinstance(self.name, str):
            raise argument_error("world.name", "a string", self.name, "Give the world a name.")
        cure = "Give rows x1 y1 x2 y2 in metres."
        walls: Any = check_array("world.walls", self.walls, (None, 4), cure, within=FARTHEST_PLACE)
        if not len(walls):
            raise argument_error("world.walls", "at least one wall", "no rows", cure)
        lengths = np.hypot(walls[:, 2] - walls[:, 0], walls[:, 3] - walls[:, 1])
        if lengths.min() < SHORTEST_WALL:
            at = int(np.argmin(lengths))
            raise argument_error(
                f"world.walls[{at}]",
                f"a wall longer than {SHORTEST_WALL:g} m",
                f"a length of {lengths[at]:g} m",
                "Drop it, or check that the unit is metres.",
            )
        extent = float(np.ptp(walls.reshape(-1, 2), axis=0).max())
        if extent > LARGEST_EXTENT:
            raise argument_error(
                "world.walls",
                f"an extent of at most {LARGEST_EXTENT:g} m",
                f"a width or height of {extent:g} m",
                "Check that the unit is metres.",
            )
        object.__setattr__(self, "walls", as_read_only(walls))
        if self.landmarks is not None:
            if not isinstance(self.landmarks, Landmarks):
                raise argument_error(
                    "world.landmarks", "Landmarks or None", self.landmarks, "Build them with Landmarks."
                )
            named = self.landmarks.walls
            if len(named) and (named.min() < 0 or named.max() >= len(walls)):
                raise argument_error(
                    "world.landmarks.walls",
                    f"wall indices 0 to {len(walls) - 1}",
                    [int(named.min()), int(named.max())],
                    "Count walls from 0.",
                )
        if self.start_poses is not None:
            cure = "Give rows x y theta in metres and radians."
            starts: Any = check_array("world.start_poses", self.start_poses, (None, 3), cure, within=FARTHEST_PLACE)
            object.__setattr__(self, "start_poses", as_read_only(starts))

    def __reduce__(self) -> tuple[Any, ...]:
        """Let copies and what was pickled be read-only, too."""
        return World, (self.name, self.walls, self.landmarks, self.start_poses)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """The smallest box (xmin, ymin, xmax, ymax) [m] that holds all walls."""
        x, y = self.walls[:, 0::2], self.walls[:, 1::2]
        return float(x.min()), float(y.min()), float(x.max()), float(y.max())
