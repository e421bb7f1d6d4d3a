from dataclasses import replace

import numpy as np
import pytest

from slam_backend.duplicates import DuplicateOptions, find_duplicates, fuse_duplicates
from slam_backend.landmark_map import FIELDS, LandmarkMap
from slam_backend.metrics import anees

SIGMA = np.diag([0.03, 0.05, 0.02]) ** 2


def doubled(rng: np.random.Generator, n: int = 30, twice: int = 8) -> tuple[LandmarkMap, np.ndarray]:
    """Return a map of n landmarks 2 m apart or more, of which the first `twice` appear twice, and their true places."""
    truth = np.column_stack([4.0 * np.arange(n), rng.uniform(-1.0, 1.0, (n, 2))])
    looks = rng.standard_normal((n, 16))
    looks /= np.linalg.norm(looks, axis=1, keepdims=True)
    rows = np.concatenate([np.arange(n), np.arange(twice)])
    means = truth[rows] + rng.standard_normal((len(rows), 3)) @ np.linalg.cholesky(SIGMA).T
    counts = np.concatenate([np.full(n, 3), np.full(twice, 5)])
    blurred = looks[rows] + 0.02 * rng.standard_normal((len(rows), 16))
    blurred /= np.linalg.norm(blurred, axis=1, keepdims=True)
    return LandmarkMap(means, np.tile(SIGMA, (len(rows), 1, 1)), blurred, counts, 100 + np.arange(len(rows))), truth


def test_doubles_are_found_and_nothing_else() -> None:
    """Each landmark that stands twice is found once; the one made of more measurements is kept."""
    held, _ = doubled(np.random.default_rng(0))
    assert find_duplicates(held).tolist() == [[30 + row, row] for row in range(8)]


def test_neighbours_that_look_different_or_lie_apart_are_none() -> None:
    """Neither place nor appearance alone makes a duplicate."""
    held, _ = doubled(np.random.default_rng(1))
    assert not len(find_duplicates(replace(held, descriptors=np.eye(38, dtype=np.float32))))
    moved = held.means.copy()
    moved[30:, 1] += 0.8  # far beyond 5 cm
    assert not len(find_duplicates(replace(held, means=moved)))
    vague = replace(held, means=moved, covariances=np.tile(np.eye(3), (38, 1, 1)))
    assert len(find_duplicates(vague)) == 8
    assert not len(find_duplicates(vague, DuplicateOptions(same_place=0.5)))


def test_duplicates_form_no_chains() -> None:
    """Of three in a row, of which the ends are too far from each other, the middle one, known best, keeps both."""
    means = [[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.6, 0.0, 0.0], [0.9, 0.0, 0.0]]
    options = DuplicateOptions(same_place=0.4)
    same = LandmarkMap(means, np.tile(0.04 * np.eye(3), (4, 1, 1)), np.ones((4, 1)), [1, 9, 1, 1])
    assert find_duplicates(same, options).tolist() == [[1, 0], [1, 2]]
    assert len(fuse_duplicates(same, find_duplicates(same, options))) == 2


def test_fused_duplicates_are_as_certain_as_they_claim() -> None:
    """Independent estimates fuse to half the covariance, and the errors of the result are of that size."""
    errors, claimed = [], []
    for seed in range(200):
        held, truth = doubled(np.random.default_rng([2, seed]), n=8)
        pairs = find_duplicates(held, DuplicateOptions(position_gate=60.0))
        fused = fuse_duplicates(held, pairs)
        assert len(fused) == 8
        order = np.argsort(fused.means[:, 0])
        errors.append(fused.means[order] - truth)
        claimed.append(fused.covariances[order])
    np.testing.assert_allclose(claimed[0][0], 0.5 * SIGMA, atol=1e-12)
    # 1,600 landmarks of 3 coordinates: 5 sigma
    assert anees(np.concatenate(errors), np.concatenate(claimed)) == pytest.approx(1.0, abs=0.1)


def test_common_errors_do_not_shrink() -> None:
    """Estimates whose errors are one and the same, as of a wrong path, keep their covariance by intersection."""
    held, _ = doubled(np.random.default_rng(3))
    pairs = find_duplicates(held)
    np.testing.assert_allclose(fuse_duplicates(held, pairs, independent=False).covariances[-1], SIGMA, rtol=1e-9)
    sharper = replace(held, covariances=np.concatenate([held.covariances[:30], 0.01 * held.covariances[30:]]))
    fused = fuse_duplicates(sharper, pairs, independent=False)
    assert np.linalg.eigvalsh(fused.covariances[-1] - 0.01 * SIGMA).min() > 0.0
    assert np.trace(fused.covariances[-1]) < 0.05 * np.trace(SIGMA)


def test_the_rest_of_the_map_stays_as_it_was() -> None:
    """Order, ids and arrays of the others stay; counts of what is fused add up, descriptors keep their length."""
    held, _ = doubled(np.random.default_rng(4))
    fused = fuse_duplicates(held, find_duplicates(held))
    assert fused.ids.tolist() == list(range(108, 138))
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(fused, name)[:22], getattr(held, name)[8:30])
    assert fused.counts[22:].tolist() == [8] * 8
    np.testing.assert_allclose(np.linalg.norm(fused.descriptors, axis=1), 1.0, atol=1e-6)
    untouched = fuse_duplicates(held, np.empty((0, 2), np.int64))
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(untouched, name), getattr(held, name))


def test_tiny_maps_have_no_duplicates() -> None:
    """No landmark, or one, has none."""
    held, _ = doubled(np.random.default_rng(5))
    for rows in ([], [3]):
        assert find_duplicates(held.subset(np.array(rows, dtype=np.int64))).shape == (0, 2)


def test_exact_landmarks_at_one_place_are_found() -> None:
    """Covariances of zero, without any floor, do not divide by zero."""
    exact = LandmarkMap(np.ones((3, 3)), np.zeros((3, 3, 3)), np.ones((3, 1)))
    assert find_duplicates(exact, DuplicateOptions(position_floor=0.0)).tolist() == [[0, 1], [0, 2]]


@pytest.mark.parametrize(
    ("pairs", "message"),
    [
        ([[0, 38]], "pairs: expected rows from 0 to 37, got a row outside"),
        ([[-1, 2]], "pairs: expected rows from 0 to 37, got a row outside"),
        ([[0, 1], [2, 1]], "pairs: expected each duplicate once, and none of them kept, got a row that repeats"),
        ([[0, 1], [1, 2]], "pairs: expected each duplicate once, and none of them kept, got a row that repeats"),
        ([0, 1], r"pairs: expected an array of shape .*2"),
    ],
)
def test_impossible_pairs_are_refused(pairs: list[list[int]], message: str) -> None:
    """Rows that do not exist, that repeat or that form a chain are refused by name."""
    held, _ = doubled(np.random.default_rng(6))
    with pytest.raises(ValueError, match=message):
        fuse_duplicates(held, pairs)


@pytest.mark.parametrize(
    ("name", "value"), [("descriptor_gate", 0.0), ("same_place", -1.0), ("position_floor", np.nan)]
)
def test_bad_options_are_refused(name: str, value: float) -> None:
    """Each is checked when it is set."""
    with pytest.raises(ValueError, match=f"options.{name}: expected a finite number"):
        replace(DuplicateOptions(), **{name: value})
