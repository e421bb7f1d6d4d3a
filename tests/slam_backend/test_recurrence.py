"""A constellation that occurs twice in a map is no place to merge at."""

import numpy as np
import pytest

from slam_backend.geometry import inverse, transform_points
from slam_backend.maps.alignment import AlignmentOptions, align_maps
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.maps.verification import recurs

SHARED, OTHERS = 24, 80
DOUBLE = np.array([9.0, -4.0, 1.2])  # where a constellation hangs a second time
A_FROM_B = np.array([3.0, -7.0, 2.0])
SIGMA = 0.03  # [m]


def looks(rng: np.random.Generator, n: int) -> np.ndarray:
    """Draw n unit descriptors."""
    drawn = rng.standard_normal((n, 32))
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


def mapped(rng: np.random.Generator, points: np.ndarray, descriptors: np.ndarray) -> LandmarkMap:
    """Return the map of a robot that has measured points with `SIGMA` and descriptors with a noise of 0.17."""
    seen = descriptors + 0.17 / np.sqrt(32) * rng.standard_normal(descriptors.shape)
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    noise = SIGMA * rng.standard_normal(points.shape)
    return LandmarkMap(points + noise, np.tile(SIGMA**2 * np.eye(3), (len(points), 1, 1)), seen)


def maps_with_doubles(seed: int, doubles: int, scattered: bool = False) -> tuple[LandmarkMap, LandmarkMap]:
    """Return two maps with 24 landmarks in common, of which so many have a double in map a.

    Args:
        seed: Of all draws.
        doubles: How many have one; b has seen none of the doubles.
        scattered: Each double hangs anywhere, at its own height; if not, all of them by one motion.
    """
    rng = np.random.default_rng([seed, 5])
    size = [5.0, 4.0, 1.5]
    points, shapes = rng.uniform(0.0, size, (SHARED, 3)), looks(rng, SHARED)
    again = transform_points(DOUBLE, points[:doubles])
    if scattered:
        again[:, :2] = rng.uniform([6.0, -10.0], [16.0, 10.0], (doubles, 2))
    own_a, own_b = (rng.uniform([-10.0, -12.0, 0.0], [0.0, 12.0, 1.5], (OTHERS, 3)) for _ in range(2))
    map_a = mapped(
        rng, np.concatenate([points, again, own_a]), np.concatenate([shapes, shapes[:doubles], looks(rng, OTHERS)])
    )
    map_b = mapped(rng, np.concatenate([points, own_b]), np.concatenate([shapes, looks(rng, OTHERS)]))
    return map_a, map_b.moved(inverse(A_FROM_B))


@pytest.mark.parametrize("seed", range(5))
def test_what_two_maps_share_must_not_occur_elsewhere_in_one_of_them(seed: int) -> None:
    """Half of the shared landmarks hang a second time in one map, as a group: refused, from either side."""
    map_a, map_b = maps_with_doubles(seed, doubles=12)
    for pair in ((map_a, map_b), (map_b, map_a)):
        found = align_maps(*pair)
        assert (found.success, found.reason) == (False, "ambiguous")
        assert found.ratio < AlignmentOptions().max_ratio  # the rival in the other map alone would not have refused it


@pytest.mark.parametrize(("doubles", "scattered"), [(0, False), (4, False), (24, True)])
@pytest.mark.parametrize("seed", range(5))
def test_single_doubles_do_not_refuse_an_alignment(seed: int, doubles: int, scattered: bool) -> None:
    """A sixth of the landmarks may recur as a group, and all of them each for itself: the motion is found."""
    found = align_maps(*maps_with_doubles(seed, doubles, scattered))
    assert found.success
    np.testing.assert_allclose(found.transform, A_FROM_B, atol=0.1)


def test_whether_a_constellation_recurs_is_the_same_in_any_frame() -> None:
    """Moving the map changes nothing, and the double recurs as the original does."""
    options, rows = AlignmentOptions(), np.arange(12)
    map_a, _ = maps_with_doubles(7, doubles=12)
    for landmarks in (map_a, map_a.moved(np.array([5.0, 2.0, -2.5]))):
        assert recurs(landmarks, rows, SIGMA**2, options)
        assert recurs(landmarks, rows + SHARED, SIGMA**2, options)
        assert not recurs(landmarks, np.arange(12, SHARED), SIGMA**2, options)


def test_a_map_in_which_all_looks_alike_tells_nothing() -> None:
    """Among a hundred landmarks of one look at random places no constellation is said to recur."""
    rng = np.random.default_rng(3)
    points = rng.uniform(0.0, [20.0, 20.0, 1.5], (100, 3))
    same = np.repeat(looks(rng, 1), 100, axis=0)
    landmarks = LandmarkMap(points, np.tile(SIGMA**2 * np.eye(3), (100, 1, 1)), same)
    for _ in range(5):
        assert not recurs(landmarks, rng.choice(100, 20, replace=False), SIGMA**2, AlignmentOptions())
