"""Odometry biases as unknowns of the pose-landmark graph."""

import numpy as np
import pytest
from builders.runs import BIASED, TIGHT, camera_of, graph_of, logs_of, small_run
from numpy.testing import assert_allclose, assert_array_equal

from slam_backend.geometry import between, compose, wrap_angle
from slam_backend.models.odometry import OdometryModel
from slam_backend.smoother import _kernels
from slam_backend.smoother._kernels import BIAS, LEVER, NONE, Keys
from slam_backend.smoother.graph import SlamGraph
from slam_backend.smoother.graph_building import extend_graph, merge_graphs
from slam_backend.smoother.graph_reduction import reduce_keyframes, relinearise
from slam_backend.smoother.optimizer import MapEstimate, NormalEquations, optimize, sum_pose_information
from slam_backend.smoother.options import SmoothingOptions
from slam_backend.smoother.sampling import lane_rows, odometry_log_density, sample_paths, transition_variances

MOUNT = np.zeros(3)
CAMERA = camera_of(small_run())


def smoothed(robots: int = 1, length: float = 5.0) -> tuple[SlamGraph, MapEstimate]:
    """Return the graph of a biased run and its mode."""
    run = small_run(robots, length=length)
    graph = graph_of(run, motion=BIASED)
    return graph, optimize(graph, camera_of(run), TIGHT)


def whitened_odometry(graph: SlamGraph, poses: np.ndarray) -> np.ndarray:
    """Return half the squared distances of motions (k, 3) from the odometry, priors of starts and biases included."""
    total, biases = 0.0, graph.biases_of_odometry()
    for b, a in enumerate(graph.parents):
        if a >= 0:
            off = between(poses[a], poses[b]) - graph.odometry[b]
            if biases[b] >= 0:
                off = off + graph.bias_jacobians[b] @ poses[biases[b]]
            off[2] = wrap_angle(off[2])
            total += 0.5 * off @ np.linalg.solve(graph.odometry_covariances[b], off)
    return np.float64(total)


def test_a_graph_without_a_prior_has_no_biases():
    """No key, no jacobian, no block: zero standard deviations leave the graph as it was."""
    run = small_run()
    plain, named = graph_of(run), graph_of(run, motion=OdometryModel())
    for name in vars(plain):
        assert_array_equal(getattr(plain, name), getattr(named, name))
    assert plain.num_biases == 0
    assert (plain.bias_keys == NONE).all()
    assert not plain.bias_jacobians.any()
    assert not len(plain.biases_of_odometry())


def test_each_robot_has_a_bias_with_its_prior():
    """A bias hangs from the origin by a prior of zero mean and the model's covariance."""
    graph = graph_of(small_run(2), motion=BIASED)
    assert (graph.robots[graph.bias_keys] == BIAS).all()
    assert_array_equal(graph.robots[graph.parents[graph.bias_keys]], NONE)
    assert_allclose(graph.odometry_covariances[graph.bias_keys], [BIASED.bias_covariance] * 2)
    moved = (graph.parents >= 0) & (graph.robots >= 0)
    assert_array_equal(graph.biases_of_odometry()[moved], graph.bias_keys[graph.robots[moved]])


def test_the_slope_of_the_cost_is_its_difference():
    """The gradient by a bias is that of central differences, away from the mode."""
    run = small_run(2)
    graph = graph_of(run, motion=BIASED)
    columns, infos, size, _ = sum_pose_information(graph.parents, graph.odometry_covariances)
    seen = optimize(graph, camera_of(run), TIGHT).sightings
    system = NormalEquations(graph, columns, size, infos, seen, camera_of(run), TIGHT)
    rng = np.random.default_rng(3)
    poses = graph.poses + 0.01 * rng.standard_normal(graph.poses.shape) * (columns >= 0)[:, None]
    system.form(poses, graph.landmarks.copy())
    slope = system.equations.vector.copy()
    for key in graph.bias_keys.tolist():  # no sighting depends on a bias
        for axis in range(3):
            costs = []
            for sign in (1.0, -1.0):
                moved = poses.copy()
                moved[key, axis] += sign * 1e-6
                costs.append(whitened_odometry(graph, moved))
            expected = (costs[0] - costs[1]) / 2e-6
            assert slope[columns[key] // 3, axis] == pytest.approx(expected, rel=1e-4, abs=1e-3)


def test_chained_odometry_is_that_of_steps_corrected_one_by_one():
    """Over steps without measurements, odometry under a small bias is the composition of the corrected steps."""
    run = small_run()
    skip = tuple(range(3, 12))
    graph = graph_of(run, skip, motion=BIASED)
    bias = np.array([1e-3, -2e-3, 1.5e-3])
    motion = np.zeros(3)
    for step in range(3, 13):
        u = run.odometry[step, 0]
        motion = compose(motion, u - BIASED.bias_jacobians(u[None])[0] @ bias)
    found = [graph.odometry[b] - graph.bias_jacobians[b] @ bias for b in range(graph.num_keys) if graph.robots[b] == 0]
    assert min(np.abs(one - motion).max() for one in found) < 2e-4  # second order: (J b)^2
    assert min(np.abs(one - between(np.zeros(3), motion)).max() for one in graph.odometry) > 1e-3


def test_odometry_is_linearised_at_the_present_bias():
    """Steps added at an estimate of the bias measure, there, exactly the composed corrected motion."""
    run = small_run()
    start = SlamGraph.at_starts(run.true_paths[:, 0], BIASED)
    bias = np.array([0.05, -0.04, 0.1])
    poses = start.poses.copy()
    poses[start.bias_keys[0]] = bias
    log = logs_of(run, tuple(range(1, run.num_steps)))[0].arrays()
    graph = extend_graph(start.with_columns(poses=poses), [log], BIASED, MOUNT)
    motion = np.zeros(3)
    for step in range(1, run.num_steps):
        u = run.odometry[step, 0]
        motion = compose(motion, u - BIASED.bias_jacobians(u[None])[0] @ bias)
    last = graph.last_keys[0]
    found = graph.odometry[last] - graph.bias_jacobians[last] @ bias
    assert_allclose(found[:2], motion[:2], atol=1e-9)
    assert wrap_angle(found[2] - motion[2]) == pytest.approx(0.0, abs=1e-9)


def test_paths_have_the_density_of_their_odometry_under_their_own_biases():
    """Differences of compiled log-densities are those of the plain formula, path by path."""
    graph, mode = smoothed(2)
    poses = sample_paths(graph, mode, 65, np.random.default_rng(7)).poses
    found, _ = odometry_log_density(graph, mode, lane_rows(poses), 65)
    expected = np.array([-whitened_odometry(graph, poses[:, :, m]) for m in range(65)])
    assert_allclose(found - found[0], expected - expected[0], atol=1e-7)


def test_sampled_paths_and_biases_have_nearly_equal_weights():
    """The Gaussian of paths and biases is nearly the posterior: nine tenths of the draws count."""
    graph, mode = smoothed()
    draws = sample_paths(graph, mode, 300, np.random.default_rng(6))
    assert draws.sample_size > 270.0
    key = graph.bias_keys[0]
    scatter, claimed = np.cov(draws.poses[key]), mode.covariance(np.array([key]))
    assert_allclose(np.sqrt(np.diag(scatter)), np.sqrt(np.diag(claimed)), rtol=0.2)


def test_a_bias_given_its_path_is_the_conditional_gaussian():
    """Mean and covariance are those of regression of the biases on the motions of the path, with the prior."""
    graph, mode = smoothed(2)
    poses = sample_paths(graph, mode, 9, np.random.default_rng(8)).poses
    biases = graph.biases_of_odometry()
    for key in graph.bias_keys.tolist():
        args = graph.part(Keys), biases, mode.odometry_infos, key
        means, covariance = _kernels.condition_bias(poses, *args)
        information = np.linalg.inv(graph.odometry_covariances[key])
        for m in (0, 8):
            vector, total = information @ graph.odometry[key], information.copy()
            for b in np.flatnonzero(biases == key):
                off = graph.odometry[b] - between(poses[graph.parents[b], :, m], poses[b, :, m])
                off[2] = wrap_angle(off[2])
                weighed = graph.bias_jacobians[b].T @ np.linalg.inv(graph.odometry_covariances[b])
                vector, total = vector + weighed @ off, total + weighed @ graph.bias_jacobians[b]
            assert_allclose(means[:, m], np.linalg.solve(total, vector), rtol=1e-6, atol=1e-9)
            assert_allclose(covariance, np.linalg.inv(total), rtol=1e-6, atol=1e-12)


def test_a_known_bias_is_found():
    """Readings bent by a bias of one standard deviation show it: the estimate is within three of its own."""
    run = small_run(1, length=25.0)
    graph = graph_of(run, motion=BIASED)
    bias = np.array([0.03, -0.02, 0.05])
    moved = graph.biases_of_odometry() >= 0
    bent = graph.odometry.copy()
    bent[moved] += graph.bias_jacobians[moved] @ bias
    mode = optimize(graph.with_columns(odometry=bent), camera_of(run), TIGHT)
    key = graph.bias_keys
    off, covariance = mode.poses[key[0]] - bias, mode.covariance(key)
    assert (np.abs(off) < 3.0 * np.sqrt(np.diag(covariance))).all()
    assert (np.diag(covariance)[:2] < 0.5 * np.diag(BIASED.bias_covariance)[:2]).all()


def reduced(graph: SlamGraph, mode: MapEstimate, variances: np.ndarray) -> SlamGraph:
    """Return the graph at its mode with ten keys, and those of the biases."""
    options = SmoothingOptions(max_keys=10, further_keys=0, recent_keys=4, kernel=0.0)
    return reduce_keyframes(relinearise(graph, mode, variances), CAMERA, options)


def test_joining_keys_keeps_the_mode_of_paths_and_biases() -> None:
    """The reduced graph has the mode of the whole one, biases included, and its own odometry from key to key."""
    graph, mode = smoothed(length=10.0)
    after = reduced(graph, mode, transition_variances(graph, mode))
    assert after.num_keys <= 10 + 1
    assert (after.robots[after.bias_keys] == BIAS).all()
    again = optimize(after, CAMERA, TIGHT)
    whole = mode.poses[graph.bias_keys[0]]
    assert_allclose(again.poses[after.bias_keys[0]], whole, atol=2e-3)
    assert_allclose(again.poses[after.last_keys], mode.poses[graph.last_keys], atol=0.01)


def test_joining_keys_keeps_the_slope_of_the_cost_by_the_bias() -> None:
    """Prior and odometry pull the bias at the mode as strongly after the reduction as before, whatever is joined."""
    graph, mode = smoothed(length=10.0)
    poses = (
        mode.poses + 1e-3 * np.random.default_rng(2).standard_normal(mode.poses.shape) * (graph.robots >= 0)[:, None]
    )

    def slope(one: SlamGraph, at: np.ndarray) -> np.ndarray:
        key = int(one.bias_keys[0])
        total = np.linalg.solve(one.odometry_covariances[key], at[key] - one.odometry[key])
        for b in np.flatnonzero(one.biases_of_odometry() == key):
            off = between(at[one.parents[b]], at[b]) - one.odometry[b] + one.bias_jacobians[b] @ at[key]
            off[2] = wrap_angle(off[2])
            total = total + one.bias_jacobians[b].T @ np.linalg.solve(one.odometry_covariances[b], off)
        return np.asarray(total)

    before = graph.with_columns(poses=poses, transition_variances=transition_variances(graph, mode))
    options = SmoothingOptions(max_keys=10, further_keys=0, recent_keys=4, kernel=0.0)
    after = reduce_keyframes(before, CAMERA, options)
    assert_allclose(slope(after, after.poses), slope(before, poses), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("known", [True, False])
def test_rigid_motions_tell_of_the_bias_what_landmarks_tell_of_them(known: bool) -> None:
    """A motion that landmarks tell exactly informs of its bias wholly, one that odometry alone tells not at all."""
    graph, mode = smoothed(length=10.0)
    noises = graph.odometry_covariances
    alone = noises[:, 0, 0] + noises[:, 1, 1] + LEVER**2 * noises[:, 2, 2]
    after = reduced(graph, mode, np.zeros(graph.num_keys) if known else alone)
    key = graph.bias_keys[0]
    prior = np.linalg.inv(after.odometry_covariances[after.bias_keys[0]])
    expected = np.linalg.inv(BIASED.bias_covariance)
    if known:
        for b in np.flatnonzero(graph.biases_of_odometry() == key):
            if not (np.abs(after.poses - mode.poses[b]).max(axis=1) < 1e-12).any():  # joined
                jacobian = graph.bias_jacobians[b]
                expected = expected + jacobian.T @ np.linalg.solve(graph.odometry_covariances[b], jacobian)
    assert_allclose(prior, expected, rtol=1e-6)


def test_odometry_after_joined_keys_begins_with_their_rigid_motion() -> None:
    """From each key that is left, the corrected odometry leads where it led from the key that went."""
    graph, mode = smoothed(length=10.0)
    after = reduced(graph, mode, transition_variances(graph, mode))
    bias = mode.poses[graph.bias_keys[0]]
    for b in np.flatnonzero(after.biases_of_odometry() >= 0):
        old = np.flatnonzero(np.abs(mode.poses - after.poses[b]).max(axis=1) < 1e-12)[0]
        expected = compose(mode.poses[graph.parents[old]], graph.odometry[old] - graph.bias_jacobians[old] @ bias)
        found = compose(after.poses[after.parents[b]], after.odometry[b] - after.bias_jacobians[b] @ bias)
        assert_allclose(found, expected, atol=1e-9)


def test_merged_groups_keep_their_biases():
    """Biases do not depend on the frame: each robot of the joint graph has that of its own group, with its prior."""
    run = small_run(2)
    graphs = []
    for robot in range(2):
        start = SlamGraph.at_starts(np.zeros((1, 3)), BIASED)
        graphs.append(extend_graph(start, [logs_of(run)[robot].arrays()], BIASED, MOUNT))
        poses = graphs[-1].poses.copy()
        poses[graphs[-1].bias_keys] = [0.01 * (robot + 1), 0.02, 0.03]
        graphs[-1] = graphs[-1].with_columns(poses=poses)
    a, b = graphs
    names = np.column_stack([b.landmark_ids, b.landmark_ids])
    both = merge_graphs(a, b, np.array([3.0, -2.0, 0.7]), names)
    assert_allclose(both.poses[both.bias_keys], [[0.01, 0.02, 0.03], [0.02, 0.02, 0.03]])
    assert (both.robots[both.parents[both.bias_keys]] == NONE).all()
    assert np.count_nonzero(both.robots == NONE) == 1
    assert_array_equal(np.sort(both.bias_keys), np.flatnonzero(both.robots == BIAS))
    swapped = both.reordered(np.array([1, 0]))
    assert_array_equal(swapped.bias_keys, both.bias_keys[::-1])
    links = both.biases_of_odometry()
    assert_array_equal(links[both.last_keys], both.bias_keys)
