"""Office of aisles around blocks of rooms, with landmarks on its walls, smooth paths, and visibility."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from slam_backend.core.validation import BoolArray, FloatArray, argument_error, check_float, check_int
from slam_backend.geometry import compose, inverse, transform_points, wrap_angle
from slam_backend.models.camera import StereoCamera

AISLE = 3.0  # width [m]
BLOCK = (4.5, 2.5)  # size of a block of rooms [m]
BLOCKS = (2, 2)  # along x and y
CROSSINGS = [(i, j) for i in range(BLOCKS[0] + 1) for j in range(BLOCKS[1] + 1)]  # of the aisles, along x and y
HEIGHTS = (0.1, 1.9)  # range of landmark heights above the floor [m]
OFF_WALL = 0.01  # distance of landmarks from their wall [m]
MAX_INCIDENCE = np.radians(80.0)  # largest angle to the normal at which landmarks are visible [rad]
CORNER_RADIUS = 1.0  # radius of paths around corners [m]


@dataclass(frozen=True, slots=True, eq=False)
class Office:
    """Rectangular building with free-standing blocks, and the landmarks on their walls."""

    size: FloatArray  # (2,) float64 [m]. Corner of the building opposite the origin of the world frame.
    # (S, 4) float64 [m], world frame. Rows x1 y1 x2 y2, x1 < x2 and y1 < y2: opaque blocks.
    blocks: FloatArray
    crossings: tuple[FloatArray, FloatArray]  # Centre lines of the aisles: (x of those along y, y of those along x) [m]
    landmarks: FloatArray  # (N, 3) float64 [m], world frame
    normals: FloatArray  # (N, 2) float64 [-], world frame. Outward normal of each landmark's wall.

    @classmethod
    def draw(cls, num_landmarks: int, rng: np.random.Generator) -> Self:
        """Distribute landmarks uniformly over the walls of the building and of the blocks."""
        check_int("num_landmarks", num_landmarks, 1, "Use at least one landmark.")
        starts = [AISLE + np.arange(count) * (side + AISLE) for count, side in zip(BLOCKS, BLOCK, strict=True)]
        size = np.array([count * (side + AISLE) + AISLE for count, side in zip(BLOCKS, BLOCK, strict=True)])
        blocks = np.array([[x, y, x + BLOCK[0], y + BLOCK[1]] for x in starts[0] for y in starts[1]])
        crossings = tuple(np.append(start, end) - 0.5 * AISLE for start, end in zip(starts, size, strict=True))
        corners, edges, normals = _faces(size, blocks)
        lengths = np.linalg.norm(edges, axis=1)
        face = rng.choice(len(edges), num_landmarks, p=lengths / lengths.sum())
        share, height = rng.uniform(0.0, 1.0, num_landmarks), rng.uniform(*HEIGHTS, num_landmarks)
        planar = corners[face] + share[:, None] * edges[face] + OFF_WALL * normals[face]
        return cls(size, blocks, (crossings[0], crossings[1]), np.column_stack([planar, height]), normals[face])

    def visible(self, pose: FloatArray, camera: StereoCamera) -> BoolArray:
        """Return which landmarks (N,) a robot sees.

        A landmark is visible if it is in the image and within the camera's range, if the line of sight meets the front
        of its wall at no more than `MAX_INCIDENCE` to the normal, and if no block is in between.
        """
        eye = compose(pose, np.array([*camera.mount[:2], 0.0]))[:2]
        seen = camera.sees(camera.camera_from_robot(transform_points(inverse(pose), self.landmarks)))
        sight = eye - self.landmarks[:, :2]
        facing = np.einsum("nd,nd->n", sight, self.normals)
        seen &= facing >= np.cos(MAX_INCIDENCE) * np.linalg.norm(sight, axis=1)
        candidates = np.flatnonzero(seen)
        seen[candidates] = ~_hidden(eye, self.landmarks[candidates, :2], self.blocks)
        return seen

    def walk(self, node: tuple[int, int], length: float, step: float, rng: np.random.Generator) -> FloatArray:
        """Drive along random aisles without turning back, with corners rounded to arcs.

        Args:
            node: Crossing at the start of the path, (index along x, index along y).

        Returns:
            (T, 3) poses [m, m, rad], world frame, T = floor(length / step) + 1, with headings along the path.
        """
        check_float("length", length, "Give metres.", above=0.0)
        check_float("step", step, "Give the distance between poses in metres.", above=0.0)
        wanted: FloatArray = np.arange(int(length / step + 1e-9) + 1, dtype=np.float64) * step
        heading = _directions(self.crossings, node)
        ahead = heading[rng.integers(len(heading))]
        x, y = self.crossings[0][node[0]], self.crossings[1][node[1]]
        pose = np.array([x, y, np.arctan2(ahead[1], ahead[0])])
        pieces: list[tuple[float, float]] = []  # (length, curvature)
        total, entered = 0.0, 0.0  # length so far, part of the next straight covered by the last corner
        while total <= wanted[-1]:
            node = (node[0] + ahead[0], node[1] + ahead[1])
            spacing = self.crossings[0] if ahead[0] else self.crossings[1]
            straight = float(spacing[1] - spacing[0])
            choices = [way for way in _directions(self.crossings, node) if way != (-ahead[0], -ahead[1])]
            turn_to = choices[rng.integers(len(choices))]
            turn = ahead[0] * turn_to[1] - ahead[1] * turn_to[0]  # -1, 0 or 1
            cut = CORNER_RADIUS * abs(turn)
            pieces.append((straight - entered - cut, 0.0))
            if turn:
                pieces.append((0.5 * np.pi * CORNER_RADIUS, turn / CORNER_RADIUS))
            total = sum(piece for piece, _ in pieces)
            ahead, entered = turn_to, cut
        return _along(pose, np.array(pieces), wanted)


def check_crossings(robots: int) -> None:
    """Refuse more robots than crossings, because each starts at a different one."""
    if check_int("robots", robots, 1, "Use at least one robot.") > len(CROSSINGS):
        raise argument_error(
            "robots", f"at most {len(CROSSINGS)}", robots, "Each robot starts at a different crossing."
        )


def start_crossings(robots: int, rng: np.random.Generator) -> list[tuple[int, int]]:
    """Sample a different crossing for each robot."""
    check_crossings(robots)
    return [CROSSINGS[i] for i in rng.permutation(len(CROSSINGS))[:robots]]


def _faces(size: FloatArray, blocks: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return corners, edge vectors and normals, each (W, 2), of the building's inner and the blocks' outer faces."""
    corners, edges, normals = [], [], []
    for (x1, y1, x2, y2), sign in [((0.0, 0.0, *size), 1.0), *((block, -1.0) for block in blocks)]:
        for corner, edge, normal in (
            ((x1, y1), (x2 - x1, 0.0), (0.0, 1.0)), ((x1, y2), (x2 - x1, 0.0), (0.0, -1.0)),
            ((x1, y1), (0.0, y2 - y1), (1.0, 0.0)), ((x2, y1), (0.0, y2 - y1), (-1.0, 0.0)),
        ):  # fmt: skip
            corners.append(corner)
            edges.append(edge)
            normals.append((sign * normal[0], sign * normal[1]))
    return np.array(corners), np.array(edges), np.array(normals)


def _hidden(eye: FloatArray, points: FloatArray, blocks: FloatArray) -> BoolArray:
    """Return for which points (n, 2) the segment from `eye` (2,) passes through a block (S, 4), by the slab method."""
    with np.errstate(divide="ignore"):
        inverse_sight = 1.0 / (points - eye)[:, None, :]
    with np.errstate(invalid="ignore"):  # 0 * inf where a line of sight runs along the edge of a slab: not hidden
        low, high = (blocks[None, :, :2] - eye) * inverse_sight, (blocks[None, :, 2:] - eye) * inverse_sight
    enter, leave = np.minimum(low, high).max(axis=2), np.maximum(low, high).min(axis=2)
    return np.asarray(((enter < leave) & (enter < 1.0) & (leave > 0.0)).any(axis=1))


def _directions(crossings: tuple[FloatArray, FloatArray], node: tuple[int, int]) -> list[tuple[int, int]]:
    """Return the unit steps from a crossing that stay inside the grid."""
    last = len(crossings[0]) - 1, len(crossings[1]) - 1
    ways = ((1, 0), (-1, 0), (0, 1), (0, -1))
    return [(i, j) for i, j in ways if 0 <= node[0] + i <= last[0] and 0 <= node[1] + j <= last[1]]


def _along(start: FloatArray, pieces: FloatArray, wanted: FloatArray) -> FloatArray:
    """Return the poses (T, 3) at arc lengths `wanted` (T,) of a path of pieces (P, 2): length, constant curvature."""
    ends = np.cumsum(pieces[:, 0])
    starts = [start]
    for length, curvature in pieces:
        starts.append(compose(starts[-1], _arc(np.array([length]), np.array([curvature]))[0]))
    piece = np.minimum(np.searchsorted(ends, wanted, side="right"), len(pieces) - 1)
    poses = compose(np.array(starts)[piece], _arc(wanted - ends[piece] + pieces[piece, 0], pieces[piece, 1]))
    poses[:, 2] = wrap_angle(poses[:, 2])
    return poses


def _arc(lengths: FloatArray, curvatures: FloatArray) -> FloatArray:
    """Return the motions (n, 3) along arcs of lengths (n,) [m] and curvatures (n,) [1/m]."""
    turns = lengths * curvatures
    half = 0.5 * turns
    chord = lengths * np.sinc(half / np.pi)
    return np.column_stack([chord * np.cos(half), chord * np.sin(half), turns])
