from typing import Any

import numpy as np
import pytest
from builders.linear_world import LANDMARKS
from builders.runs import TIGHT, camera_of, graph_of, small_run, upper
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.fastslam._kernels import LANES as FILTER_LANES
from slam_backend.fastslam.run_log import RobotLog
from slam_backend.geometry import between, compose
from slam_backend.models.odometry import OdometryModel
from slam_backend.smoother._kernels import LANES, normalise, weigh_deviations
from slam_backend.smoother.graph import SlamGraph
from slam_backend.smoother.graph_building import extend_graph
from slam_backend.smoother.graph_reduction import reduce_keyframes, relinearise
from slam_backend.smoother.optimizer import MapEstimate, optimize
from slam_backend.smoother.options import SmoothingOptions
from slam_backend.smoother.sampling import (
    PathLandmarks,
    PathSamples,
    has_single_sighting,
    importance_weights,
    lane_rows,
    odometry_log_density,
    replay,
    retract_on_se2,
    sample_paths,
    tempered,
)

MOUNT = np.array([0.1, -0.05, 0.2])
CAMERA = np.array([320.0, 0.12, 0.2, 0.1, *MOUNT])
# Headings as good as known: all else is linear, and Gaussian.
LINEAR = OdometryModel(
    sigma_along=0.1, sigma_across=0.06, sigma_heading=0.0, sigma_turn=0.0, floor_position=0.01, floor_heading=1e-7
)


def full(upper: FloatArray) -> FloatArray:
    """Return symmetric matrices (..., 3, 3) from their upper triangles (..., 6)."""
    return upper[..., [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]


def linear_toy(steps: int = 6) -> tuple[SlamGraph, MapEstimate]:
    """Return a robot that turns among three landmarks, measures them with covariances of its own, and the mode."""
    rng = np.random.default_rng(5)
    log = RobotLog()
    position, theta = np.zeros(2), 0.0
    for step in range(steps):
        move = np.array([0.4, 0.1, 0.5])
        if step:
            c, s = np.cos(theta), np.sin(theta)
            position = position + np.array([[c, -s], [s, c]]) @ (move[:2] + rng.normal(size=2) * [0.04, 0.03])
            theta += 0.5
        c, s = np.cos(theta), np.sin(theta)
        roots = 0.05 * (np.eye(3) + rng.uniform(-0.4, 0.4, (3, 3, 3)))
        seen = (LANDMARKS - [*position, 0.0]) @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) - MOUNT
        seen += np.einsum("nij,nj->ni", roots, rng.normal(size=(3, 3)))
        upper = (roots @ roots.transpose(0, 2, 1))[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
        log.append(step, move if step else None, points=seen, ids=np.arange(3), covariances=upper)
    graph = extend_graph(SlamGraph.at_starts(np.zeros((1, 3))), [log.arrays()], LINEAR, MOUNT)
    return graph, optimize(graph, CAMERA, TIGHT)


def test_where_all_is_linear_the_weights_are_constant():
    """The Gaussian about the mode is then the posterior itself, and importance weights have nothing to correct."""
    graph, mode = linear_toy()
    weights = sample_paths(graph, mode, 500, np.random.default_rng(1)).log_weights
    assert np.ptp(weights) < 1e-3


def test_where_all_is_linear_the_paths_scatter_as_the_posterior():
    """The sample's mean and covariance agree with mode and information: chi-square at a false alarm rate of 1 %."""
    graph, mode = linear_toy()
    m = 4000
    poses = sample_paths(graph, mode, m + 1, np.random.default_rng(2)).poses[1:, :, 1:]  # the first path is the mode
    off = (poses - mode.poses[1:, :, None]).reshape(-1, m)
    white = upper(mode) @ off
    n = len(white)
    assert m * (white.mean(axis=1) ** 2).sum() < chi2.ppf(0.99, n)
    squares = (white**2).sum()
    assert chi2.ppf(0.005, n * m) < squares < chi2.ppf(0.995, n * m)
    correlations = (white @ white.T / m)[np.triu_indices(n, 1)]
    assert m * (correlations**2).sum() < chi2.ppf(0.99, len(correlations))


def test_weights_are_those_of_their_logarithms():
    """They sum to 1, whatever their scale; where one is not finite none means anything."""
    log_weights = np.random.default_rng(6).normal(size=70) - 2000.0
    size = normalise(log_weights, weights := np.empty(70))
    expected = np.exp(log_weights + 2000.0) / np.exp(log_weights + 2000.0).sum()
    np.testing.assert_allclose(weights, expected, rtol=1e-12)
    assert size == pytest.approx(1.0 / (expected**2).sum(), rel=1e-12)
    log_weights[3] = -np.inf
    normalise(log_weights, weights)
    assert weights[3] == 0.0
    for wrong in (np.nan, np.inf):
        log_weights[5] = wrong
        assert np.isnan(normalise(log_weights, weights))
        assert np.isnan(weights).all()


def test_the_first_path_is_the_most_probable_one():
    """Of all paths drawn it alone is the mode, so that the best particle has the best map."""
    graph, mode = linear_toy()
    draws = sample_paths(graph, mode, 3, np.random.default_rng(3))
    np.testing.assert_array_equal(draws.poses[:, :, 0], mode.poses)
    tiles, _ = replay(mode, lane_rows(draws.poses), 3)
    np.testing.assert_allclose(tiles[:, 0, :3, 0], mode.landmarks, atol=1e-9)


def test_replayed_landmarks_are_those_of_kalman_filters_along_the_path():
    """Means, covariances and likelihood along a path are those of one Kalman filter per landmark, taken in turn."""
    graph, mode = linear_toy()
    poses = sample_paths(graph, mode, 70, np.random.default_rng(4)).poses  # more than one block of lanes
    tiles, log_likelihood = replay(mode, lane_rows(poses), 70)
    values = tiles.transpose(0, 2, 1, 3).reshape(3, 9, -1)
    expected = []
    for m in (0, 1, 63, 64, 69):
        total = 0.0
        for landmark in range(3):
            mean, covariance = np.zeros(3), np.zeros((3, 3))
            for n in np.flatnonzero(graph.point_landmarks == landmark):
                x, y, theta = poses[graph.frame_keys[graph.point_frames[n]], :, m]
                c, s = np.cos(theta), np.sin(theta)
                turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
                seen = turn @ (graph.points[n] + MOUNT) + [x, y, 0.0]
                noise = turn @ full(graph.point_noises[n]) @ turn.T
                if not covariance.any():
                    mean, covariance = seen, noise
                    continue
                innovation = covariance + noise
                off = seen - mean
                total -= 0.5 * (off @ np.linalg.solve(innovation, off) + np.linalg.slogdet(innovation)[1])
                gain = np.linalg.solve(innovation, covariance).T
                mean = mean + gain @ off
                covariance = covariance - gain @ covariance
            np.testing.assert_allclose(values[landmark, :3, m], mean, atol=1e-9)
            np.testing.assert_allclose(full(values[landmark, 3:, m]), covariance, atol=1e-10)
        expected.append(total)
    differences = log_likelihood[[0, 1, 63, 64, 69]] - log_likelihood[0]
    np.testing.assert_allclose(differences, np.array(expected) - expected[0], atol=1e-6)


def test_stereo_paths_have_nearly_equal_weights():
    """With real headings and a stereo camera the Gaussian still fits: nine tenths of the paths count."""
    run = small_run()
    graph = graph_of(run)
    mode = optimize(graph, camera_of(run), TIGHT)
    weights = sample_paths(graph, mode, 300, np.random.default_rng(6)).log_weights
    weights = np.exp(weights - weights.max())
    assert weights.sum() ** 2 / (weights**2).sum() > 270.0


@pytest.mark.parametrize("size", [0, 1, 3, 9])
def test_deviations_have_their_gaussian_density(size):
    """Half of the squared Mahalanobis distance off zero, which stays exactly 0."""
    rng = np.random.default_rng(size)
    root, off = rng.normal(size=(size, size + 2)), rng.normal(size=(size, 70))
    off[:, 0] = 0.0
    covariance, found = root @ root.T, np.empty(70)
    expected = -0.5 * (off * np.linalg.solve(covariance, off)).sum(axis=0)
    before = covariance.copy()
    assert weigh_deviations(covariance, off, found)
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    assert found[0] == 0.0
    np.testing.assert_array_equal(covariance, before)


@pytest.mark.parametrize("least", [0.0, -1.0, np.nan])
def test_an_indefinite_covariance_has_no_density(least):
    """The kernel reports it instead of returning a number."""
    assert not weigh_deviations(np.diag([1.0, 2.0, least]), np.ones((3, 4)), np.empty(4))


def test_odometry_of_paths_has_its_gaussian_density():
    """Compiled densities of odometry differ from path to path as the plain formula says."""
    run = small_run(2)
    graph = graph_of(run)
    mode = optimize(graph, camera_of(run), TIGHT)
    poses = sample_paths(graph, mode, 65, np.random.default_rng(7)).poses
    found, transition_variances = odometry_log_density(graph, mode, lane_rows(poses), 65)
    linked = np.flatnonzero(graph.parents >= 0)
    expected, motions = np.zeros(65), []
    for b in linked:
        first, second = poses[graph.parents[b]], poses[b]
        c, s = np.cos(first[2]), np.sin(first[2])
        dx, dy = second[:2] - first[:2]
        turn = (second[2] - first[2] + np.pi) % (2.0 * np.pi) - np.pi
        motion = np.array([c * dx + s * dy, -s * dx + c * dy, turn])
        off = motion - graph.odometry[b][:, None]
        expected -= 0.5 * (off * np.linalg.solve(graph.odometry_covariances[b], off)).sum(axis=0)
        motions.append(motion)
    np.testing.assert_allclose(found - found[0], expected - expected[0], atol=1e-7)
    scatter = [((m - m[:, :1])[0] ** 2 + (m - m[:, :1])[1] ** 2 + 9.0 * (m - m[:, :1])[2] ** 2).mean() for m in motions]
    np.testing.assert_allclose(transition_variances[linked], scatter, rtol=1e-6)


@pytest.mark.parametrize("m", [1, 64, 65])
def test_any_number_of_paths_can_be_drawn(m):
    """Blocks of lanes are filled up, and what fills them is not returned."""
    graph, mode = linear_toy()
    draws = sample_paths(graph, mode, m, np.random.default_rng(8))
    assert draws.poses.shape == (6, 3, m)
    tiles, log_likelihood = replay(mode, lane_rows(draws.poses), m)
    assert tiles.shape == (3, -(-m // LANES), 9, LANES)
    assert np.isfinite(tiles).all()
    assert log_likelihood.shape == (m,)
    assert draws.log_weights.shape == (m,)


def test_lanes_are_filled_up_with_the_first_path():
    """Positions, cosine, sine and heading of each path lie lane by lane; the surplus is a copy."""
    poses = np.random.default_rng(9).normal(size=(4, 3, 70))
    rows = lane_rows(poses)
    assert rows.shape == (2, 4, 5, LANES)
    lanes = rows.transpose(1, 2, 0, 3).reshape(4, 5, 2 * LANES)
    np.testing.assert_array_equal(lanes[:, [0, 1, 4], :70], poses)
    np.testing.assert_allclose(lanes[:, 2, :70], np.cos(poses[:, 2]), rtol=1e-15)
    np.testing.assert_allclose(lanes[:, 3, :70], np.sin(poses[:, 2]), rtol=1e-15)
    np.testing.assert_array_equal(lanes[:, :, 70:], np.repeat(lanes[:, :, :1], 2 * LANES - 70, axis=2))


def test_tiles_of_the_smoother_and_the_filter_have_equal_size():
    """The filter takes the smoother's tiles as they are, so both have as many lanes."""
    assert LANES == FILTER_LANES


PREVIOUS = np.array([2, 0, 4, -1, 3, 0])  # a tree whose keys do not lie in the order of its branches
FLAT_CAMERA = np.array([320.0, 0.12, 0.2, 0.1, 0.0, 0.0, 0.0])


def tree(spread: float) -> tuple[FloatArray, FloatArray]:
    """Return poses (6, 3) and offsets (6, 3, 5) of which that of the given key is zero."""
    rng = np.random.default_rng(8)
    mode, offsets = rng.normal(size=(6, 3)) * [4.0, 4.0, 1.5], spread * rng.normal(size=(6, 3, 5))
    offsets[3] = 0.0
    return mode, offsets


def reference(mode: FloatArray, offsets: FloatArray) -> FloatArray:
    """Return one path (6, 3) from its offsets (6, 3): derivatives by differences, and motions composed one by one."""
    path = np.full((6, 3), np.nan)
    path[3] = mode[3]
    for b in (4, 2, 0, 1, 5):
        a = PREVIOUS[b]
        ahead, back = (between(mode[a] + h * offsets[a], mode[b] + h * offsets[b]) for h in (1e-6, -1e-6))
        path[b] = compose(path[a], between(mode[a], mode[b]) + (ahead - back) / 2e-6)
    return path


def test_motions_change_as_the_offsets_say_to_first_order():
    """Compiled as in the plain reference, headings on the circle; nothing is moved by offsets of zero."""
    mode, offsets = tree(0.2)
    paths = retract_on_se2(mode, PREVIOUS, offsets)
    for i in range(5):
        off = paths[:, :, i] - reference(mode, offsets[:, :, i])
        np.testing.assert_allclose(off[:, :2], 0.0, atol=1e-6)
        np.testing.assert_allclose(np.sin(0.5 * off[:, 2]), 0.0, atol=1e-6)
    still = retract_on_se2(mode, PREVIOUS, np.zeros((6, 3, 1)))[:, :, 0]
    np.testing.assert_allclose(still, mode, atol=1e-12)


def test_the_retraction_preserves_volume():
    """The determinant of the derivative of paths by offsets is 1, so that log q is that of the Gaussian."""
    mode, offsets = tree(0.4)
    sought = [key for key in range(6) if key != 3]
    columns = []
    for key in sought:
        for c in range(3):
            nudged = np.repeat(offsets[:, :, :1], 2, axis=2)
            nudged[key, c] += [1e-5, -1e-5]
            paths = retract_on_se2(mode, PREVIOUS, nudged)[sought]
            columns.append(((paths[:, :, 0] - paths[:, :, 1]) / 2e-5).reshape(-1))
    assert np.linalg.det(np.array(columns).T) == pytest.approx(1.0, abs=1e-6)


def test_retracted_and_straight_paths_agree_to_first_order():
    """The two kinds of paths differ to second order only."""
    mode, offsets = tree(1e-4)
    np.testing.assert_allclose(retract_on_se2(mode, PREVIOUS, offsets), mode[:, :, None] + offsets, atol=1e-6)


def wandering(turn: float) -> tuple[SlamGraph, Any]:
    """Return a robot that sees a new landmark at each of 25 steps, so that odometry alone knows its path; the mode."""
    motion = OdometryModel(
        sigma_along=0.05, sigma_across=0.02, sigma_heading=0.0, sigma_turn=0.0, floor_position=0.01, floor_heading=turn
    )
    log = RobotLog()
    for step in range(25):
        move = np.array([1.0, 0.0, 0.05]) if step else None
        log.append(step, move, points=np.array([[3.0, 0.5, 0.1]]), ids=np.array([step]))
    graph = extend_graph(SlamGraph.at_starts(np.zeros((1, 3))), [log.arrays()], motion, np.zeros(3))
    return graph, optimize(graph, FLAT_CAMERA, TIGHT)


def test_dead_reckoned_paths_are_sampled_exactly_by_retraction():
    """With a heading uncertainty of 0.5 rad nearly all Gaussian paths lose their weight; retracted ones keep it."""
    graph, mode = wandering(turn=0.1)
    poses, log_proposals = mode.paths(200, np.random.default_rng(1))
    assert importance_weights(graph, mode, poses, log_proposals).sample_size < 20.0
    draws = sample_paths(graph, mode, 200, np.random.default_rng(1))
    assert np.ptp(draws.log_weights) < 5e-3  # the weak prior of landmarks seen from one key is in the proposal alone
    assert draws.sample_size == pytest.approx(200.0, rel=1e-5)
    np.testing.assert_allclose(draws.poses[:, :, 0], mode.poses, atol=1e-12)


def test_gaussian_paths_are_kept_if_their_sample_size_suffices():
    """With landmarks seen again and again the Gaussian of poses is good: it is drawn from, to the bit."""
    run = small_run()
    graph = graph_of(run)
    mode = optimize(graph, camera_of(run), TIGHT)
    draws = sample_paths(graph, mode, 60, np.random.default_rng(2))
    assert draws.sample_size > 30.0
    np.testing.assert_array_equal(draws.poses, mode.paths(60, np.random.default_rng(2))[0])


def seen_once() -> tuple[SlamGraph, MapEstimate, IntArray]:
    """Return a graph with landmarks that have a single sighting, its mode, and the rows of these landmarks."""
    run = small_run()
    fewer = graph_of(run)
    camera, mode = camera_of(run), optimize(fewer, camera_of(run), TIGHT)
    draws = sample_paths(fewer, mode, 30, np.random.default_rng(1))
    limits = SmoothingOptions(max_keys=5, recent_keys=2, tolerance=1e-9)
    fewer = reduce_keyframes(relinearise(fewer, mode, draws.transition_variances), camera, limits)
    mode = optimize(fewer, camera, TIGHT)
    return fewer, mode, np.flatnonzero(has_single_sighting(mode.sightings))


def test_landmarks_are_written_as_they_are_replayed():
    """Landmarks with one sighting are placed rigidly, others replayed; both agree with the replay, plus the walk."""
    graph, mode, single = seen_once()
    assert 0 < len(single) < len(mode.landmarks)
    poses = sample_paths(graph, mode, LANES + 7, np.random.default_rng(2)).poses
    rows, walk = lane_rows(poses), 1e-3
    expected, _ = replay(mode, rows, LANES + 7)
    expected[:, :, [3, 6, 8]] += walk
    chosen = np.random.default_rng(3).permutation(len(mode.landmarks))[:-1]
    tiles = np.full((len(chosen) + 2, 2, 9, LANES), 7.0)
    PathLandmarks(rows, mode, np.arange(len(mode.landmarks))).write(chosen, walk, tiles)
    np.testing.assert_allclose(tiles[:-2], expected[chosen], atol=1e-7)
    assert (tiles[-2:] == 7.0).all()


def test_landmarks_of_one_key_do_not_change_the_weights():
    """Weights with and without their likelihoods agree: it is the same given any path."""
    graph, mode, single = seen_once()
    poses, log_proposals = mode.paths(60, np.random.default_rng(4))
    found = importance_weights(graph, mode, poses, log_proposals)
    rows = lane_rows(poses)
    log_odometry, _ = odometry_log_density(graph, mode, rows, 60)
    whole = replay(mode, rows, 60)[1] + log_odometry - log_proposals
    apart = found.log_weights - whole
    assert len(single) > 0
    assert np.ptp(apart) < 1e-4


@given(
    logs=st.lists(st.floats(-1e6, 1e6), min_size=2, max_size=40),
    share=st.floats(0.0, 1.0),
)
def test_tempered_weights_are_a_power_with_the_given_sample_size(logs: list[float], share: float) -> None:
    """It is the largest power of the weights that reaches the sample size; paths and order stay."""
    paths = np.zeros((1, 3, len(logs)))
    draws = PathSamples.weighed(paths, np.array(logs), np.zeros(1))
    least = 1.0 + share * (len(logs) - 1.0) * 0.999
    found = tempered(draws, least)
    assert found.poses is paths
    assert found.sample_size >= least * (1.0 - 1e-9)
    if draws.sample_size < least:
        spread = np.ptp(logs)
        power = np.ptp(found.log_weights) / spread
        more = PathSamples.weighed(paths, (power + 1e-8 + 1e-6 * power) * np.array(logs), np.zeros(1))
        assert more.sample_size <= least * (1.0 + 1e-6) or power > 1.0 - 1e-6
    else:
        np.testing.assert_allclose(found.weights, draws.weights, rtol=1e-5, atol=1e-12)
