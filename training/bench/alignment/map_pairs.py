"""Pairs of maps with the true motion between them, drawn: alignable ones, and ones that nobody can align."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.validation import FloatArray, IntArray, check_choice, check_float
from slam_backend.geometry import inverse, transform_points
from slam_backend.maps.fusion import alignment_jacobian
from slam_backend.maps.landmark_map import LandmarkMap

NOISE = 0.05  # standard deviation of each landmark in each map and axis [m]
LANDMARKS = 200  # of each map
SQUARE = 30.0  # side of the area that they are spread over [m]
HEIGHT = 1.5  # they hang up to here [m]
DESCRIPTOR_SIZE = 64
DESCRIPTOR_NOISE = 0.17  # root mean square length

FEWEST_TRUE = 12  # true pairs of an identifiable pair of maps
LEAST_SPREAD = 2.0  # they extend over this at least [m]
UNALIGNABLE = (
    "no overlap", "no overlap, corridors", "no overlap, look-alikes", "no overlap, look-alikes in corridors",
    "mirrored corridor", "mirrored map", "shifted corridor", "twin rooms", "half alike",
)  # fmt: skip
IDENTIFIABLE = ("area", "corridor", "area, rival", "corridor, rival", "area, look-alikes")
CLASS = 3  # so many of all landmarks look the same where there are look-alikes


@dataclass(frozen=True, slots=True, eq=False)
class MapPair:
    """Two maps, and what is true of them."""

    a: LandmarkMap  # The map whose frame an alignment leads to
    b: LandmarkMap  # The other
    pose: FloatArray  # (3,) float64 [m, m, rad]. True motion a_from_b; NaN where there is none.
    pairs: IntArray  # (n, 2) int64 rows (a, b) of the landmarks that are truly the same

    def bound(self) -> FloatArray:
        """Return the Cramer-Rao bound (3, 3) [m, m, rad] of (tx, ty, theta), were the true pairs known.

        The inverse of the sum of J^T (Sigma_a + R Sigma_b R^T)^-1 J, for the equal, round covariances that are drawn.
        """
        jacobian = alignment_jacobian(self.pose[2], self.b.means[self.pairs[:, 1]])
        fisher = np.einsum("nij,nik->jk", jacobian, jacobian) / (2.0 * NOISE**2)
        return np.asarray(np.linalg.solve(fisher, np.eye(3)))


def draw_pair(overlap: float, outliers: float, rng: np.random.Generator) -> MapPair:
    """Draw two maps of 200 landmarks of which some are common, and some others look alike.

    Raises:
        ValueError: If there are not enough landmarks for so many wrong pairs.
    """
    check_float("overlap", overlap, "Give a share.", at_least=0.0, at_most=1.0)
    right = round(overlap * LANDMARKS)
    most = 1.0 - right / LANDMARKS
    check_float("outliers", outliers, f"At most {most:g} with this overlap.", at_least=0.0, at_most=most)
    wrong = round(right * outliers / (1.0 - outliers)) if right else round(LANDMARKS * outliers)
    points_a, points_b = _spread(LANDMARKS, (SQUARE, SQUARE), rng), _spread(LANDMARKS, (SQUARE, SQUARE), rng)
    return _pair(points_a, _common(points_a, points_b, right, wrong), right, right + wrong, rng)


def draw_identifiable(kind: str, rng: np.random.Generator) -> MapPair:
    """Draw maps that can be aligned, but only just: 12 to 40 true pairs, spread over 2 m to 15 m, among 200.

    Args:
        kind: "area" or "corridor": where the true pairs lie; "..., rival": up to half as many wrong ones agree on
            another motion; "..., look-alikes": three of all landmarks always look the same.
    """
    check_choice("kind", kind, IDENTIFIABLE)
    right = int(rng.integers(FEWEST_TRUE, 41))
    alike = int(rng.integers(right, LANDMARKS + 1))
    extent = rng.uniform(LEAST_SPREAD, 15.0)
    strip = (extent, min(2.5, extent)) if kind.startswith("corridor") else (extent, extent)
    points_a, points_b = _spread(LANDMARKS, (SQUARE, SQUARE), rng), _spread(LANDMARKS, (SQUARE, SQUARE), rng)
    patch = _spread(right, strip, rng)
    patch[:2, 0] = [0.0, extent]  # so that they do reach so far
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
    """Draw maps that must not be aligned: nothing tells where one lies in the other, or two places say so alike.

    Args:
        kind: "no overlap": other places, where all landmarks look alike pairwise by chance. "..., corridors": likewise,
            but thin. "..., look-alikes": three of all landmarks always look the same. "mirrored corridor": its two
            walls are swapped. "mirrored map": the mirror image of an area. "shifted corridor": doors that repeat, so
            that two shifts are supported almost alike. "twin rooms": two rooms that look the same, of which b has seen
            one. "half alike": half of all landmarks look like wrong ones that agree on another place, about as many as
            agree on a first.
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
    agreeing = int(count * rng.uniform(0.25, 0.4))  # on the second place; the other has at most 1.4 times as many
    first = int(agreeing * rng.uniform(1.0, 1.4))
    moved = np.array(points)
    elsewhere = _other_motion(rng) if kind == "half alike" else np.array([rng.uniform(2.0, 8.0), 0.0, 0.0])
    moved[:agreeing] = transform_points(elsewhere, points[:agreeing])
    rest = slice(agreeing + first, None)
    moved[rest] = _spread(count, (float(np.ptp(points[:, 0])), float(np.ptp(points[:, 1]))), rng)[rest]
    return _pair(points, moved, 0, count, rng)


def _twin_rooms(count: int, rng: np.random.Generator) -> MapPair:
    """Draw a map with the same room twice, and one with it once: each of b's landmarks fits in both places."""
    half = count // 2
    room = _spread(half, (8.0, 6.0), rng)
    a = np.concatenate([room, transform_points([14.0, *rng.uniform(-3.0, 3.0, 2)], room)])
    looks = _unit(half, rng)
    return _pair_of(a, np.concatenate([looks, looks]), room, looks, 0, rng)


def _look_alikes(points_a: FloatArray, points_b: FloatArray, right: int, rng: np.random.Generator) -> MapPair:
    """Return maps with the first `right` rows in common, in which three of all landmarks always look the same."""
    count = len(points_a) + len(points_b) - right
    classes = rng.permutation(count) // CLASS
    looks = _unit(-(-count // CLASS), rng)[classes]
    looks_b = np.concatenate([looks[:right], looks[len(points_a) :]])
    return _pair_of(points_a, looks[: len(points_a)], points_b, looks_b, right, rng)


def _spread(count: int, size: tuple[float, float], rng: np.random.Generator) -> FloatArray:
    return rng.uniform(0.0, (*size, HEIGHT), (count, 3))


def _common(points_a: FloatArray, points_b: FloatArray, right: int, wrong: int) -> FloatArray:
    """Return b's points with the first `right` put where a's are; heights never tell the `wrong` ones after them."""
    points = np.array(points_b)
    points[:right] = points_a[:right]
    points[right : right + wrong, 2] = points_a[right : right + wrong, 2]
    return points


def _other_motion(rng: np.random.Generator) -> FloatArray:
    """Draw a motion that differs clearly from none."""
    angle = rng.uniform(0.0, 2.0 * np.pi)
    return np.array([*(rng.uniform(3.0, 10.0) * np.array([np.cos(angle), np.sin(angle)])), rng.uniform(-np.pi, np.pi)])


def _pair(points_a: FloatArray, points_b: FloatArray, right: int, alike: int, rng: np.random.Generator) -> MapPair:
    """Return maps whose first `alike` rows look alike pairwise, and the first `right` of these truly are the same."""
    looks = _unit(len(points_a), rng)
    looks_b = np.concatenate([looks[:alike], _unit(len(points_b) - alike, rng)])
    points = np.array(points_b)
    points[:alike, 2] = points_a[:alike, 2]
    return _pair_of(points_a, looks, points, looks_b, right, rng)


def _pair_of(
    points_a: FloatArray, looks_a: FloatArray, points_b: FloatArray, looks_b: FloatArray, right: int,
    rng: np.random.Generator,
) -> MapPair:  # fmt: skip
    """Return noisy maps of points in one frame, b in a frame of its own that lies among its landmarks, shuffled."""
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
    """Draw unit descriptors (count, d)."""
    looks = rng.standard_normal((count, DESCRIPTOR_SIZE))
    return np.asarray(looks / np.linalg.norm(looks, axis=1, keepdims=True))


def _blurred(looks: FloatArray, rng: np.random.Generator) -> NDArray[np.float32]:
    """Return descriptors with noise, of unit length again."""
    noisy = looks + DESCRIPTOR_NOISE / np.sqrt(DESCRIPTOR_SIZE) * rng.standard_normal(looks.shape)
    return np.asarray(noisy / np.linalg.norm(noisy, axis=1, keepdims=True), dtype=np.float32)
