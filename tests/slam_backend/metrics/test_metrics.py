import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from slam_backend import metrics
from slam_backend.geometry import compose, inverse, transform_points

GRID = np.array([[3.0 * i, 3.0 * j, 0.1 * i] for i in range(4) for j in range(3)])  # farther apart than 2 c


def points(max_size: int = 5) -> st.SearchStrategy[np.ndarray]:
    """Up to `max_size` points in a box a few cutoffs wide."""
    return st.integers(0, max_size).flatmap(lambda n: hnp.arrays(np.float64, (n, 3), elements=st.floats(-2.0, 2.0)))


def test_map_error_counts_each_kind_of_mistake() -> None:
    """Held, far, duplicate, false, uncounted and missed landmarks each add exactly their stated share."""
    truths = GRID[:5]
    offsets = [[0.3, 0, 0], [0, 7.0, 0], [0, 0, 0], [0, 0, 0.2]]
    means = np.vstack([truths[[0, 1, 2, 2]] + offsets, [[9, 9, 9]] * 2])
    claims = np.array([0, 1, 2, 2, -1, -2])
    c = 0.8
    expected = (0.3**2 + c**2 + 0.0 + c**2 / 2 * (2 + 1 + 1)) / 5  # two missed, one false, one duplicate
    assert metrics.map_error(means, claims, truths, cutoff=c) == pytest.approx(np.sqrt(expected))
    half = c**2 / 2 / 5
    parts = metrics.map_error_parts(means, claims, truths, cutoff=c)
    assert parts == pytest.approx(((0.3**2 + c**2) / 5, 2 * half, half, half))
    assert metrics.map_error(np.empty((0, 3)), np.empty(0, np.int64), truths) == pytest.approx(np.sqrt(0.5))
    assert metrics.map_error(truths, np.arange(5), truths) == 0.0


def test_the_nearest_claimant_holds_a_landmark_in_any_order() -> None:
    """The order of the map's rows does not matter."""
    rng = np.random.default_rng(1)
    claims = rng.integers(-2, 12, 40)
    means = GRID[claims] + rng.normal(0.0, 0.4, (40, 3))
    order = rng.permutation(40)
    expected = metrics.map_error(means, claims, GRID)
    assert sum(metrics.map_error_parts(means, claims, GRID)) == pytest.approx(expected**2)
    assert metrics.map_error(means[order], claims[order], GRID) == pytest.approx(expected, rel=1e-12)


@given(seed=st.integers(0, 2**32 - 1))
def test_gospa_agrees_with_map_error_where_truths_lie_apart(seed: int) -> None:
    """With true landmarks more than 2 c apart, claims and optimal assignment give the same error."""
    rng = np.random.default_rng(seed)
    claims = rng.integers(0, len(GRID), 9)
    near = GRID[claims] + rng.uniform(-0.55, 0.55, (9, 3))
    false = rng.uniform(50.0, 59.0, (4, 3))
    means, claims = np.vstack([near, false]), np.append(claims, [-1] * 4)
    result = metrics.gospa(means, GRID, cutoff=1.0)
    assert result.error == pytest.approx(metrics.map_error(means, claims, GRID, cutoff=1.0), rel=1e-12)
    assert result.distance**2 == pytest.approx(result.localisation + 0.5 * (result.missed + result.false))
    assert result.distance**2 == pytest.approx(result.error**2 * len(GRID))


@given(x=points(), y=points(), z=points())
def test_gospa_and_ospa_are_metrics(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> None:
    """Identity, symmetry and the triangle inequality hold for sets of any sizes."""
    for order in (1.0, 2.0):
        for name, d in (
            ("gospa", lambda a, b, p=order: metrics.gospa(a, b, order=p).distance),
            ("ospa", lambda a, b, p=order: metrics.ospa(a, b, order=p)),
        ):
            assert d(x, x) == 0.0, name
            assert d(x, y) == pytest.approx(d(y, x), abs=1e-12), name
            assert d(x, z) <= d(x, y) + d(y, z) + 1e-9, name


def test_gospa_counts_far_pairs_as_missed_and_false() -> None:
    """An estimate farther than the cutoff from every truth is false, and that truth is missed."""
    result = metrics.gospa([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]], [[0.0, 0.3, 0.0], [5.0, 4.0, 0.0], [9.0, 9.0, 9.0]])
    assert (result.missed, result.false) == (2, 1)
    assert result.localisation == pytest.approx(0.09)
    assert metrics.gospa([[0.0, 0.0]], np.empty((0, 2)), alpha=1.0).distance == pytest.approx(1.0)
    assert metrics.gospa(np.empty((0, 3)), np.empty((0, 3))).error == 0.0


def test_map_rmse_matches_one_to_one() -> None:
    """Two estimates of one landmark give one match, the nearer; recall and precision count the rest."""
    truths = GRID[:4]
    means = truths[[0, 0, 2, 3]] + [[0.2, 0, 0], [0.1, 0, 0], [0, 0.45, 0], [0.6, 0, 0]]
    by_distance = metrics.map_rmse(means, truths)
    assert by_distance.matched.tolist() == [[1, 0], [2, 2]]
    assert (by_distance.recall, by_distance.precision) == (0.5, 0.5)
    assert by_distance.rmse == pytest.approx(np.sqrt((0.1**2 + 0.45**2) / 2))
    by_claims = metrics.map_rmse(means, truths, claims=[0, 0, -2, 3])
    assert by_claims.matched.tolist() == [[1, 0], [3, 3]]
    assert (by_claims.recall, by_claims.precision) == (0.5, pytest.approx(2 / 3))
    assert by_claims.rmse == pytest.approx(np.sqrt((0.1**2 + 0.6**2) / 2))


def test_map_rmse_of_nothing_is_not_a_number() -> None:
    """Without a single match there is no error to state, and recall and precision are 0."""
    score = metrics.map_rmse(np.empty((0, 3)), GRID)
    assert np.isnan(score.rmse)
    assert (score.recall, score.precision, score.matched.shape) == (0.0, 0.0, (0, 2))


poses = st.tuples(st.floats(-30.0, 30.0), st.floats(-30.0, 30.0), st.floats(-3.1, 3.1)).map(np.array)


@given(pose=poses, seed=st.integers(0, 1000))
def test_aligning_exact_points_recovers_the_motion(pose: np.ndarray, seed: int) -> None:
    """Points moved by any motion are aligned by it, with any weights, and then have no error left."""
    rng = np.random.default_rng(seed)
    b = rng.uniform(-10.0, 10.0, (7, 2))
    a = transform_points(pose, b)
    for weights in (None, rng.uniform(0.1, 3.0, 7)):
        np.testing.assert_allclose(metrics.align_se2(a, b, weights), pose, atol=1e-9)
    result = metrics.ate(b, a)
    assert result.aligned == pytest.approx(0.0, abs=1e-9)
    assert result.start == pytest.approx(np.sqrt(((a - b) ** 2).sum(axis=1).mean()))


def test_alignment_is_the_least_squares_optimum() -> None:
    """No small change of the fitted motion lowers the weighted sum of squares."""
    rng = np.random.default_rng(2)
    b, w = rng.uniform(-5.0, 5.0, (9, 2)), rng.uniform(0.0, 2.0, 9)
    a = transform_points([1.0, 2.0, 0.7], b) + rng.normal(0.0, 0.5, (9, 2))
    best = metrics.align_se2(a, b, w)

    def cost(pose: np.ndarray) -> float:
        return float(w @ ((a - transform_points(pose, b)) ** 2).sum(axis=1))

    for axis in range(3):
        for sign in (-1.0, 1.0):
            assert cost(best + sign * 1e-4 * np.eye(3)[axis]) > cost(best)


def test_ate_ignores_headings_and_alignment_can_be_left_out() -> None:
    """Poses and positions give the same error; without alignment the aligned error is the raw one."""
    rng = np.random.default_rng(3)
    guess, true = rng.normal(size=(6, 3)), rng.normal(size=(6, 3))
    with_poses, with_positions = metrics.ate(guess, true), metrics.ate(guess[:, :2], true)
    assert (with_poses.start, with_poses.aligned) == (with_positions.start, with_positions.aligned)
    raw = metrics.ate(guess, true, align=False)
    assert raw.aligned == raw.start == with_poses.start
    assert with_poses.aligned < raw.start
    np.testing.assert_array_equal(raw.transform, 0.0)


def test_points_at_one_place_leave_the_rotation_at_zero() -> None:
    """A robot that never moved can still be scored."""
    np.testing.assert_allclose(metrics.align_se2([[2.0, 3.0]] * 4, [[1.0, 1.0]] * 4), [1.0, 2.0, 0.0])


@given(pose=poses)
def test_rpe_does_not_depend_on_the_frame(pose: np.ndarray) -> None:
    """Moving the whole estimated path by any motion changes no relative error."""
    rng = np.random.default_rng(5)
    guess, true = rng.normal(size=(8, 3)), rng.normal(size=(8, 3))
    one, moved = metrics.rpe(guess, true, delta=3), metrics.rpe(compose(pose, guess), true, delta=3)
    assert moved.translation == pytest.approx(one.translation)
    assert moved.rotation == pytest.approx(one.rotation)


def test_rpe_of_a_known_drift() -> None:
    """A path that is 2 % too long has a relative error of 2 % of each motion."""
    true = np.column_stack([np.arange(11.0), np.zeros((11, 2))])
    result = metrics.rpe(true * [1.02, 1.0, 1.0], true, delta=5)
    assert result.translation == pytest.approx(0.1)
    assert result.rotation == 0.0
    turned = metrics.rpe(compose(true, [0.0, 0.0, 0.3]), compose(inverse([1.0, 1.0, 1.0]), true))
    assert turned.rotation == pytest.approx(0.0, abs=1e-12)


def test_honest_errors_have_an_anees_of_one() -> None:
    """Errors drawn from their claimed covariances give 1 +- 0.05 (5 sigma: false alarm below 1e-6)."""
    rng = np.random.default_rng(6)
    roots = rng.standard_normal((4000, 5, 5))
    covariances = roots @ roots.transpose(0, 2, 1)
    errors = (roots @ rng.standard_normal((4000, 5, 1)))[..., 0]
    assert metrics.anees(errors, covariances) == pytest.approx(1.0, abs=5.0 * np.sqrt(2.0 / (4000 * 5)))
    np.testing.assert_array_equal(metrics.nis(errors, covariances), metrics.nees(errors, covariances))
    assert metrics.anees(3.0 * errors, covariances) == pytest.approx(9.0 * metrics.anees(errors, covariances))
