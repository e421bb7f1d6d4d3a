"""Simulated pairs of maps with their true transforms: alignable pairs, and pairs that cannot be aligned."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.validation import FloatArray, IntArray, check_choice, check_float
from slam_backend.geometry import inverse, transform_points
from slam_backend.maps.fusion import alignment_jacobian
from slam_backend.maps.landmark_map import LandmarkMap

NOISE = 0.05  # standard deviation of each landmark in each map and axis [m]
LANDMARKS = 200  # number of landmarks in each map
SQUARE = 30.0  # side of the mapped area [m]
HEIGHT = 1.5  # largest height of landmarks [m]
DESCRIPTOR_SIZE = 64
DESCRIPTOR_NOISE = 0.17  # RMS norm of the descriptor noise

FEWEST_TRUE = 12  # smallest number of true pairs of identifiable maps
LEAST_SPREAD = 2.0  # smallest extent of the true pairs [m]
UNALIGNABLE = (
    "no overlap", "no overlap, corridors", "no overlap, look-alikes", "no overlap, look-alikes in corridors",
    "mirrored corridor", "mirrored map", "shifted corridor", "twin rooms", "half alike",
)  # fmt: skip
IDENTIFIABLE = ("area", "corridor", "area, rival", "corridor, rival", "area, look-alikes")
CLASS = 3  # number of landmarks with the same descriptor, in kinds with look-alikes


@dataclass(frozen=True, slots=True, eq=False)
class MapPair:
    """Two maps with their true transform and matches."""

    a: LandmarkMap  # Map whose frame is the target of the alignment
    b: LandmarkMap  # Other map
    pose: FloatArray  # (3,) float64 [m, m, rad]. True transform a_from_b; NaN if there is none.
    pairs: IntArray  # (n, 2) int64. Rows (a, b) of the true matches.

    def bound(self) -> FloatArray:
        """Return the Cramer-Rao bound (3, 3) [m, m, rad] of (tx, ty, theta) for known true pairs.

        It is the inverse of the sum of J^T (Sigma_a + R Sigma_b R^T)^-1 J, for equal isotropic covariances.
        """
        jacobian = alignment_jacobian(self.pose[2], self.b.means[self.pairs[:, 1]])
        fisher = np.einsum("nij,nik->jk", jacobian, jacobian) / (2.0 * NOISE**2)
        return np.asarray(np.linalg.solve(fisher, np.eye(3)))


def draw_pair(overlap: float, outliers: float, rng: np.random.Generator) -> MapPair:
    """Sample two maps of 200 landmarks with some common and some wrong, similar landmarks.

    Raises:
        ValueError: If there are not enough landmarks for the wrong pairs.
    """
    check_float("overlap", overlap, "Give a share from 0 to 1.", at_least=0.0, at_most=1.0)
    right = round(overlap * LANDMARKS)
    most = 1.0 - right / LANDMARKS
    check_float("outliers", outliers, f"Use at most {most:g} with this overlap.", at_least=0.0, at_most=most)
    wrong = round(right * outliers / (1.0 - outliers)) if right else round(LANDMARKS * outliers)
    points_a, points_b = _spread(LANDMARKS, (SQUARE, SQUARE), rng), _spread(LANDMARKS, (SQUARE, SQUARE), rng)
    return _pair(points_a, _common(points_a, points_b, right, wrong), right, right + wrong, rng)


def draw_identifiable(kind: str, rng: np.random.Generator) -> MapPair:
    """Sample maps that can barely be aligned: 12 to 40 true pairs, spread over 2 m to 15 m, among 200.

    Args:
        kind: Distribution of the true pairs, "area" or "corridor"; "..., rival": up to half as many wrong pairs agree
            on another transform; "..., look-alikes": three landmarks each share a descriptor.
    """
    check_choice("kind", kind, IDENTIFIABLE)
    right = int(rng.integers(FEWEST_TRUE, 41))
    alike = int(rng.integers(right, LANDMARKS + 1))
    extent = rng.uniform(LEAST_SPREAD, 15.0)
    strip = (extent, min(2.5, extent)) if kind.startswith("corridor") else (extent, extent)
    points_a, points_b = _spread(LANDMARKS, (SQUARE, SQUARE), rng), _spread(LANDMARKS, (SQUARE, SQUARE), rng)
    patch = _spread(right, strip, rng)
    patch[:2, 0] = [0.0, extent]  # ensures the extent
    turned = transform_points([*rng.uniform(0.0, SQUARE - extent, 2), rng.uniform(-np.pi, np.pi)], patch)
    points_a[:right] = turned
    points_b = _common(points_a, points_b, right, alike - right)
    if kind.endswith("rival"):
        count = min(right // 2, alike - right)
        rows = slice(right, right + count)
        points_b[rows] = transform_points(_other_motion(rng), points_a[rows])
    if kind.endswith("look-alikes"):
        return _look_alikes(points_a, points_b, right, rng)
    return _pair(points_a, points_b, right, alike, rng)


def draw_unalignable(kind: str, rng: np.random.Generator) -> MapPair:
    """Sample maps that must not be aligned: without information on the transform, or with two equal hypotheses.

    Args:
        kind: "no overlap": different places, with all landmarks similar in pairs by chance. "..., corridors": the same
            for thin areas. "..., look-alikes": three landmarks each share a descriptor. "mirrored corridor": its two
            walls are swapped. "mirrored map": the mirror image of an area. "shifted corridor": repeated doors, so
            that two shifts have almost the same support. "twin rooms": two identical rooms, of which b contains
            one. "half alike": half of all landmarks have wrong matches that agree on a second transform, almost as
            well as the right ones on the first.
    """
    check_choice("kind", kind, UNALIGNABLE)
    count = int(rng.integers(40, LANDMARKS + 1))
    corridor = (rng.uniform(15.0, 40.0), rng.uniform(1.5, 4.0))
    area = (SQUARE, SQUARE)
    if kind.startswith("no overlap"):
        size = corridor if kind.endswith("corridors") else area
        if "look-alikes" in kind:
            return _look_alikes(_spread(count, size, rng), _spread(count, size, rng), 0, rng)
        return _pair(_spread(count, size, rng), _spread(count, size, rng), 0, count, rng)
    if kind.startswith("mirrored"):
        points = _spread(count, corridor if kind.endswith("corridor") else area, rng)
        if kind.endswith("corridor"):
            points[:, 1] = np.where(rng.random(count) < rng.uniform(0.4, 0.75), 0.0, corridor[1])
        return _pair(points, points * [1.0, -1.0, 1.0], 0, count, rng)
    if kind == "twin rooms":
        return _twin_rooms(count, rng)
    points = _spread(count, corridor if kind == "shifted corridor" else area, rng)
    agreeing = int(count * rng.uniform(0.25, 0.4))  # for the second transform; the first has at most 1.4 times as many
    first = int(agreeing * rng.uniform(1.0, 1.4))
    moved = np.array(points)
    elsewhere = _other_motion(rng) if kind == "half alike" else np.array([rng.uniform(2.0, 8.0), 0.0, 0.0])
    moved[:agreeing] = transform_points(elsewhere, points[:agreeing])
    rest = slice(agreeing + first, None)
    moved[rest] = _spread(count, (float(np.ptp(points[:, 0])), float(np.ptp(points[:, 1]))), rng)[rest]
    return _pair(points, moved, 0, count, rng)


def _twin_rooms(count: int, rng: np.random.Generator) -> MapPair:
    """Sample a map with two copies of a room, and a map with one copy: b's landmarks fit both places."""
    half = count // 2
    room = _spread(half, (8.0, 6.0), rng)
    a = np.concatenate([room, transform_points([14.0, *rng.uniform(-3.0, 3.0, 2)], room)])
    looks = _unit(half, rng)
    return _pair_of(a, np.concatenate([looks, looks]), room, looks, 0, rng)


def _look_alikes(points_a: FloatArray, points_b: FloatArray, right: int, rng: np.random.Generator) -> MapPair:
    """Return maps with the first `right` rows in common, in which groups of three landmarks share a descriptor."""
    count = len(points_a) + len(points_b) - right
    classes = rng.permutation(count) // CLASS
    looks = _unit(-(-count // CLASS), rng)[classes]
    looks_b = np.concatenate([looks[:right], looks[len(points_a) :]])
    return _pair_of(points_a, looks[: len(points_a)], points_b, looks_b, right, rng)


def _spread(count: int, size: tuple[float, float], rng: np.random.Generator) -> FloatArray:
    return rng.uniform(0.0, (*size, HEIGHT), (count, 3))


def _common(points_a: FloatArray, points_b: FloatArray, right: int, wrong: int) -> FloatArray:
    """Return b's points with the first `right` equal to a's; the heights of the `wrong` ones after them match too."""
    points = np.array(points_b)
    points[:right] = points_a[:right]
    points[right : right + wrong, 2] = points_a[right : right + wrong, 2]
    return points


def _other_motion(rng: np.random.Generator) -> FloatArray:
    """Sample a transform that differs clearly from the identity."""
    angle = rng.uniform(0.0, 2.0 * np.pi)
    return np.array([*(rng.uniform(3.0, 10.0) * np.array([np.cos(angle), np.sin(angle)])), rng.uniform(-np.pi, np.pi)])


def _pair(points_a: FloatArray, points_b: FloatArray, right: int, alike: int, rng: np.random.Generator) -> MapPair:
    """Return maps whose first `alike` rows are similar in pairs, and the first `right` of these are true matches."""
    looks = _unit(len(points_a), rng)
    looks_b = np.concatenate([looks[:alike], _unit(len(points_b) - alike, rng)])
    points = np.array(points_b)
    points[:alike, 2] = points_a[:alike, 2]
    return _pair_of(points_a, looks, points, looks_b, right, rng)


def _pair_of(
    points_a: FloatArray, looks_a: FloatArray, points_b: FloatArray, looks_b: FloatArray, right: int,
    rng: np.random.Generator,
) -> MapPair:  # fmt: skip
    """Return noisy maps of points in one frame, with b in a frame of its own amid its landmarks, shuffled."""
    centre = points_b[:, :2].mean(axis=0) + rng.uniform(-5.0, 5.0, 2)
    pose = np.array([*centre, rng.uniform(-np.pi, np.pi)])
    order = rng.permutation(len(points_b))
    maps = [
        LandmarkMap(
            points + NOISE * rng.standard_normal(points.shape),
            np.tile(NOISE**2 * np.eye(3), (len(points), 1, 1)),
            _blurred(looks, rng),
        )
        for points, looks in ((points_a, looks_a), (transform_points(inverse(pose), points_b), looks_b))
    ]
    pairs = np.column_stack([np.arange(right), np.argsort(order)[:right]])
    return MapPair(maps[0], maps[1].subset(order), pose if right else np.full(3, np.nan), pairs)


def _unit(count: int, rng: np.random.Generator) -> FloatArray:
    """Sample unit descriptors (count, d)."""
    looks = rng.standard_normal((count, DESCRIPTOR_SIZE))
    return np.asarray(looks / np.linalg.norm(looks, axis=1, keepdims=True))


def _blurred(looks: FloatArray, rng: np.random.Generator) -> NDArray[np.float32]:
    """Return normalised descriptors with noise."""
    noisy = looks + DESCRIPTOR_NOISE / np.sqrt(DESCRIPTOR_SIZE) * rng.standard_normal(looks.shape)
    return np.asarray(noisy / np.linalg.norm(noisy, axis=1, keepdims=True), dtype=np.float32)
