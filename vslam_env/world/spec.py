"""Immutable, validated description of a world: walls, landmarks and optional start poses."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.read_only import as_read_only
from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import FloatArray, IntArray, argument_error, check_array
from slam_backend.state import FLOAT32, FLOAT64, INT64, Array, Maybe, Record, Sizes, State, Text

SHORTEST_WALL = 1e-3  # [m] below, the direction is ill-defined
LARGEST_EXTENT = 200.0  # [m] limits the size of the free-space raster
LONGEST = 1e6  # limit of vector components: squares fit in float32
MOST_WALLS = 30_000  # rooms of 2.5 m in 200 m have 22,801
MOST_LANDMARKS = 100_000
FARTHEST_PLACE = 1e8  # [m] from the origin: map frames on earth fit, and differences keep micrometres


def check_counts(walls: Any, landmarks: Any = ()) -> None:
    """Refuse more walls or landmarks than can be simulated, before memory is taken for them.

    Raises:
        ValueError: If there are more than `MOST_WALLS` or `MOST_LANDMARKS`.
    """
    hint = "Simplify the plan, for example with a larger tolerance_px, or cut it into several worlds."
    for name, rows, most in (("walls", walls, MOST_WALLS), ("landmarks", landmarks, MOST_LANDMARKS)):
        if hasattr(rows, "__len__") and len(rows) > most:
            raise argument_error(f"world.{name}", f"at most {most:,} {name}", f"a number of {len(rows):,}", hint)


@short_repr
@dataclass(frozen=True, slots=True, eq=False)
class Landmarks:
    """Point landmarks on the faces of walls.

    Attributes:
        positions: (N, 3) float64 [m], world frame. Positions, z relative to the robots' reference height.
        normals: (N, 2) float64 [-], world frame. Horizontal unit normals of the faces, pointing outwards.
        walls: (N,) int64. Index of each landmark's wall.
        descriptors: (N, d) float32 [-]. Unit appearance vectors.

    Raises:
        ValueError: If a shape is wrong, a number is not finite, or a vector is not of length 1.
    """

    STATE: ClassVar[State] = State(
        positions=Array(FLOAT64, "n 3", constant=True),
        normals=Array(FLOAT64, "n 2", constant=True),
        walls=Array(INT64, "n", constant=True),
        descriptors=Array(FLOAT32, "n d", constant=True),
    )

    positions: FloatArray
    normals: FloatArray
    walls: IntArray
    descriptors: NDArray[np.float32]

    def __post_init__(self) -> None:
        hint = "Give one row per landmark."
        check_counts((), self.positions)
        positions: Any = check_array("landmarks.positions", self.positions, (None, 3), hint, within=FARTHEST_PLACE)
        normals: Any = check_array("landmarks.normals", self.normals, (len(positions), 2), hint, within=LONGEST)
        walls: Any = check_array("landmarks.walls", self.walls, (len(positions),), hint, dtype=np.int64)
        descriptors: Any = check_array(
            "landmarks.descriptors", self.descriptors, (len(positions), None), hint, dtype=np.float32, within=LONGEST
        )
        for name, vectors in (("normals", normals), ("descriptors", descriptors)):
            lengths = np.linalg.norm(vectors, axis=1)
            if len(lengths) and not np.allclose(lengths, 1.0, atol=1e-4):
                worst = float(lengths[np.argmax(np.abs(lengths - 1.0))])
                raise argument_error(f"landmarks.{name}", "unit vectors", f"a length of {worst:g}", "Normalise them.")
        for name, array in zip(self.__slots__, (positions, normals, walls, descriptors), strict=True):
            object.__setattr__(self, name, as_read_only(array))

    @classmethod
    def check_state(cls, parts: Mapping[str, Any], sizes: Sizes) -> None:
        """Raise unless the constructor accepts the parts."""
        cls(**parts)

    def __reduce__(self) -> tuple[Any, ...]:
        """Keep copies and unpickled instances read-only."""
        return Landmarks, (self.positions, self.normals, self.walls, self.descriptors)

    def __len__(self) -> int:
        return len(self.positions)


@short_repr
@dataclass(frozen=True, slots=True, eq=False)
class World:
    """Two-dimensional floor plan in metres.

    Attributes:
        name: Name for tables and pictures.
        walls: (S, 4) float64 [m], world frame. Thin, opaque, solid segments, rows x1 y1 x2 y2.
        landmarks: Landmarks on the walls; None: placed by the environment.
        start_poses: (K, 3) float64 [m, m, rad], world frame. Start poses for up to K robots; None: drawn by the
            environment.

    Raises:
        ValueError: If there is no wall, a wall has no length, the world spans more than 200 m or has more than
            30,000 walls, a number is not finite, or a wall index of a landmark is invalid.

    >>> World("room", [[0, 0, 4, 0], [4, 0, 4, 3], [4, 3, 0, 3], [0, 3, 0, 0]]).bounds
    (0.0, 0.0, 4.0, 3.0)
    """

    STATE: ClassVar[State] = State(
        name=Text(),
        walls=Array(FLOAT64, "walls 4", constant=True),
        landmarks=Maybe(Record(Landmarks)),
        start_poses=Maybe(Array(FLOAT64, "starts 3", constant=True)),
    )

    name: str
    walls: FloatArray
    landmarks: Landmarks | None = field(default=None)
    start_poses: FloatArray | None = field(default=None)

    def __post_init__(self) -> None:
        if not isinstance(self.name, str):
            raise argument_error("world.name", "a string", self.name, "Give the world a name.")
        hint = "Give rows x1 y1 x2 y2 in metres."
        check_counts(self.walls)
        walls: Any = check_array("world.walls", self.walls, (None, 4), hint, within=FARTHEST_PLACE)
        if not len(walls):
            raise argument_error("world.walls", "at least one wall", "no rows", hint)
        lengths = np.hypot(walls[:, 2] - walls[:, 0], walls[:, 3] - walls[:, 1])
        if lengths.min() < SHORTEST_WALL:
            at = int(np.argmin(lengths))
            raise argument_error(
                f"world.walls[{at}]",
                f"a wall longer than {SHORTEST_WALL:g} m",
                f"a length of {lengths[at]:g} m",
                "Remove it, or check that the unit is metres.",
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
            indices = self.landmarks.walls
            if len(indices) and (indices.min() < 0 or indices.max() >= len(walls)):
                raise argument_error(
                    "world.landmarks.walls",
                    f"wall indices 0 to {len(walls) - 1}",
                    [int(indices.min()), int(indices.max())],
                    "Count walls from 0.",
                )
        if self.start_poses is not None:
            hint = "Give rows x y theta in metres and radians."
            starts: Any = check_array("world.start_poses", self.start_poses, (None, 3), hint, within=FARTHEST_PLACE)
            object.__setattr__(self, "start_poses", as_read_only(starts))

    @classmethod
    def check_state(cls, parts: Mapping[str, Any], sizes: Sizes) -> None:
        """Raise unless the constructor accepts the parts."""
        cls(**parts)

    def __reduce__(self) -> tuple[Any, ...]:
        """Keep copies and unpickled instances read-only."""
        return World, (self.name, self.walls, self.landmarks, self.start_poses)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Bounding box (xmin, ymin, xmax, ymax) [m] of all walls."""
        x, y = self.walls[:, 0::2], self.walls[:, 1::2]
        return float(x.min()), float(y.min()), float(x.max()), float(y.max())
