"""Looks at walls: how often the camera saw each wall stretch so that its landmarks could be measured."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.state import Each, Record, State
from vslam_env.navigation._grid_kernels import GRID_SIZE, LARGEST_HALF_WIDTH
from vslam_env.navigation._view_kernels import MOST_LOOKS, paint_looks
from vslam_env.navigation.grid_storage import LooksPart, known_bounds, size_for
from vslam_env.navigation.occupancy_grid import cell_of, centre_of
from vslam_env.navigation.validation import pose_floats, ray_directions

__all__ = ["TeamLooks"]

SLACK = 1e-6  # [rad] so that the outermost rays of a scan over the field of view count


class TeamLooks:
    """Looks of each robot at walls, in the frame and with the cells of its occupancy grid.

    Each ray of a scan that meets a wall within the range of the camera, not nearer than 1.4 m or half that range, where
    high and low landmarks are out of view, at an incidence below 60 degrees, is a look. It
    is counted on the free cell just before the wall, so that the two sides of a wall differ, once a tick and cell.
    Looks follow the grids when these grow and when robots merge, part and meet again.

    Args:
        num_robots: Number of robots K.
        angles: (R,) float64 [rad], robot frame. Directions of the rays.
        half_fov: Half the field of view of the camera [rad].
        reach: Range below which landmarks are measured [m].

    Attributes:
        counts: (K, S, S) uint8. Looks at each cell; a new array when the looks grow.
        bounds: (K, 4) int32. Bounds of the cells with looks, as in `GridStorage`.
    """

    STATE = State(parts=Each(Record(LooksPart), "K"))

    def __init__(self, num_robots: int, angles: FloatArray, half_fov: float, reach: float) -> None:
        self._directions, self._reach = ray_directions(angles), reach
        self._points = np.empty((len(angles), 2))
        self._directions[:, np.abs(angles) > half_fov + SLACK] = 0.0
        self.counts: NDArray[np.uint8] = np.zeros((num_robots, GRID_SIZE, GRID_SIZE), np.uint8)
        self.bounds: NDArray[np.int32] = np.zeros((num_robots, 4), np.int32)

    def update(self, shared: IntArray, poses: FloatArray, scans: FloatArray, size: int) -> None:
        """Count the looks of a tick; see `TeamGrids.update` for the arguments.

        Args:
            size: Number of cells S along a side of the grids, to which the looks grow.
        """
        self.reserve(size)
        paint_looks(
            self.counts, self.bounds, shared, poses, scans, self._directions, self._reach, self._points
        )  # fmt: skip

    def merge(self, robot: int, other: NDArray[np.uint8], self_from_other: ArrayLike) -> None:
        """Add another robot's looks (S', S') uint8; its start pose in this robot's frame is (3,) [m, m, rad]."""
        x, y, theta = pose_floats(self_from_other, "self_from_other")
        c, s, counts = math.cos(theta), math.sin(theta), self.counts[robot]
        u, v = centre_of(np.argwhere(other), len(other)).T
        points, far = np.column_stack([x + c * u - s * v, y + s * u + c * v]), 2.0 * LARGEST_HALF_WIDTH
        cells = cell_of(points.clip(-far, far), len(counts))
        inside = ((cells >= 0) & (cells < len(counts))).all(axis=1)
        places, which = np.unique(cells[inside], axis=0, return_inverse=True)
        more = np.bincount(which.ravel(), other[other > 0][inside], minlength=len(places)).astype(np.int64)
        there = tuple(places.T)
        counts[there] = np.minimum(counts[there] + more, MOST_LOOKS)
        self.bounds[robot] = known_bounds(counts)

    def reserve(self, size: int) -> None:
        """Grow to the size S of the grids, unless the looks have it; views taken before are no longer updated."""
        if size > self.counts.shape[1]:
            before, shift = self.counts, (size - self.counts.shape[1]) // 2
            self.counts = np.zeros((len(before), size, size), np.uint8)  # what is not written to takes no memory
            for k, (top, left, bottom, right) in enumerate(self.bounds.tolist()):
                there = (k, slice(top + shift, bottom + shift), slice(left + shift, right + shift))
                self.counts[there] = before[k, top:bottom, left:right]
                if bottom:
                    self.bounds[k] += shift

    @property
    def _parts(self) -> tuple[LooksPart, ...]:
        """Copies of the parts with looks of all robots."""
        return tuple(map(self.part, range(len(self.counts))))

    @_parts.setter
    def _parts(self, parts: Sequence[LooksPart]) -> None:
        for robot, part in enumerate(parts):
            self.restore_part(robot, part)

    def part(self, robot: int) -> LooksPart:
        """Return a copy of the part with looks of a robot."""
        return LooksPart.of(self.counts[robot], self.bounds[robot])

    def restore_part(self, robot: int, part: LooksPart) -> None:
        """Set the looks of a robot to a result of `part`."""
        self.reserve(size_for(part.reach))
        there, self.bounds[robot] = part.place(self.counts.shape[1])
        self.counts[robot] = 0
        self.counts[robot][there] = part.values
