"""The pose-landmark graph of a run, and its maximum a posteriori estimate."""

from dataclasses import replace

import numpy as np
import pytest
from builders.plain_graph_reduction import chained
from builders.runs import (
    TIGHT,
    camera_of,
    graph_of,
    logs_of,
    plain_cost,
    problem_of,
    rejuvenate,
    small_run,
    upper,
)  # fmt: skip
from builders.worlds import EXACT_MOTION

from slam_backend.fastslam.run_log import RobotLog
from slam_backend.geometry import between, compose
from slam_backend.models.camera import StereoCamera
from slam_backend.models.odometry import OdometryModel
from slam_backend.smoother import _kernels
from slam_backend.smoother._kernels import FREE, CholeskyFactor, EquationBlocks, SymbolicFactor
from slam_backend.smoother.graph import SlamGraph
from slam_backend.smoother.graph_building import InitialPoses, LandmarkPositions, extend_graph, log_head
from slam_backend.smoother.graph_reduction import relinearise
from slam_backend.smoother.optimizer import optimize, sum_pose_information
from slam_backend.smoother.options import SmoothingOptions
from training.stereo_runs.batch_ml import batch_ml
from training.stereo_runs.runs import NoisePreset, RunSpec, simulate_run


def test_chained_odometry_has_the_spread_of_its_samples():
    """The covariance of two motions in a row is that of sampled motions, to first order."""
    rng = np.random.default_rng(1)
    first, second = np.array([1.0, 0.2, 0.7]), np.array([0.8, -0.1, -0.4])
    a, b = np.diag([0.01, 0.02, 0.015]) ** 2, np.diag([0.02, 0.01, 0.01]) ** 2
    samples = compose(
        first + rng.normal(size=(200_000, 3)) * np.sqrt(np.diag(a)),
        second + rng.normal(size=(200_000, 3)) * np.sqrt(np.diag(b)),
    )
    motion, noise = chained(first, a, second, b)
    np.testing.assert_allclose(motion, samples.mean(axis=0), atol=2e-3)
    np.testing.assert_allclose(noise, np.cov(samples.T), atol=4e-6)


def misplaced(run, name, by):
    """Return the log of a run's only robot whose first sighting of a landmark lies `by` [m] farther off."""
    log, moved = RobotLog(), False
    for row in logs_of(run)[0]:
        points = row.points.copy()
        if not moved and name in row.ids:
            points[row.ids == name] *= 1.0 + by / np.linalg.norm(points[row.ids == name])
            moved = True
        log.append(row.step, row.motion if row.kind else None, points=points, ids=row.ids)
    return log.arrays()


def test_a_landmark_with_mostly_new_sightings_starts_where_the_filter_has_it():
    """One false first sighting does not hold a landmark against many: the kernel gives up the one, not the many.

    Without what the filter thinks it does. What is mostly old stays where it was, and so does all where poses start
    from odometry.
    """
    run = small_run()
    name, first = 6, 5  # seen in twelve steps, in this one first
    assert [name in names for (names,) in run.names].index(True) == first
    log = misplaced(run, name, by=3.0)
    motion, camera, mount = run.spec.noise.motion, camera_of(run), np.array(run.spec.noise.camera.mount)
    options = SmoothingOptions()
    start = extend_graph(SlamGraph.at_starts(run.true_paths[:, 0]), [log_head(log, first + 1)], motion, mount)
    start = relinearise(start, optimize(start, camera, options))
    assert np.linalg.norm(start.landmarks[start.landmark_ids == name][0] - run.landmarks[name]) > 1.0
    rest = [log.since(first + 1)]
    initial_poses = [InitialPoses(np.arange(len(run.true_paths[0])), run.true_paths[0])]
    places = LandmarkPositions(np.arange(120), run.landmarks + 0.02)

    def error(initial_poses, places):
        graph = extend_graph(start, rest, motion, mount, initial_poses, places=places)
        mode = optimize(graph, camera, options)
        assert mode.reason == ""
        return np.linalg.norm(mode.landmarks[graph.landmark_ids == name][0] - run.landmarks[name])

    assert error(initial_poses, places) < 0.05
    assert error(initial_poses, None) > 2.0
    assert error([InitialPoses.empty()], places) == error([InitialPoses.empty()], None)
    few = [log_head(rest[0], 1)]
    grown = extend_graph(start, few, motion, mount, initial_poses, places=places)
    old = np.flatnonzero(np.isin(grown.landmark_ids, start.landmark_ids))
    np.testing.assert_array_equal(grown.landmarks[old], start.landmarks[old])


def test_a_long_log_taken_in_at_once_ends_where_short_ones_do():
    """Added in parts within one call, or in many calls: the newest poses agree within a share of their uncertainty."""
    run = small_run(length=15.0)
    log = logs_of(run)[0].arrays()
    options = SmoothingOptions(max_keys=40, recent_keys=20, steps_per_key=10**6)
    motion, camera = run.spec.noise.motion, camera_of(run)
    start = SlamGraph.at_starts(run.true_paths[:, 0])
    whole = rejuvenate(start, [log], motion, camera, 50, np.random.default_rng(1), options)
    graph = start
    for upto in range(7, 62, 6):
        part = log_head(log, upto).since(int(graph.latest[0]) + 1)
        result = rejuvenate(graph, [part], motion, camera, 50, np.random.default_rng(upto), options)
        graph = result.graph
    assert whole.reason == result.reason == ""
    apart = whole.particles.means[0] - result.particles.means[0]
    assert apart @ np.linalg.solve(whole.particles.covariances[0], apart) < 0.5
    assert whole.graph.num_keys <= 40


def test_starts_on_which_particles_agree_are_given():
    """After a merge the starts of the own group are fixed; those of the other are estimated, rigid among themselves."""
    rng = np.random.default_rng(2)
    starts = np.zeros((3, 3, 30))
    starts[0] = [[1.0], [2.0], [0.3]]
    motions = rng.normal(size=(30, 3)) * [0.2, 0.2, 0.05] + [5.0, 1.0, 3.1]
    starts[1] = motions.T
    starts[2] = compose(motions, np.array([0.0, 2.0, 0.1])).T
    graph = SlamGraph.at_uncertain_starts(starts)
    assert graph.parents.tolist() == [-1, 3, 1, -1]
    assert graph.robots.tolist() == [0, 1, 2, -1]
    np.testing.assert_allclose(graph.odometry[2], [0.0, 2.0, 0.1], atol=1e-12)
    assert graph.odometry_covariances[1, 0, 0] > 1e3
    assert graph.odometry_covariances[2, 0, 0] < 1e-6


def test_a_fixed_start_is_estimated_although_particles_agree_on_it():
    """It hangs on the origin by a vague prior, and on no other start, though none of them changes against another."""
    starts = np.repeat(np.array([[0.0, 0.0, 0.0], [5.0, 1.0, 3.1], [2.0, -1.0, 0.4]])[:, :, None], 30, axis=2)
    graph = SlamGraph.at_uncertain_starts(starts, np.array([False, True, True]))
    assert graph.parents.tolist() == [-1, 3, 3, -1]
    assert (graph.odometry_covariances[1:3, 0, 0] > 1e3).all()
    np.testing.assert_allclose(graph.poses[:3], starts[:, :, 0], atol=1e-12)


def test_an_unknown_start_is_estimated_from_shared_landmarks():
    """Robot 1's start, off by 20 cm and 3 degrees in the particles, is where the landmarks that both saw put it."""
    run = small_run(2, seed=104, length=8.0)
    true = run.true_paths[:, 0]
    starts = np.repeat(true[:, :, None], 40, axis=2)
    rng = np.random.default_rng(3)
    starts[1] += np.array([0.2, -0.1, 0.05])[:, None] + rng.normal(size=(3, 40)) * [[0.05], [0.05], [0.02]]
    shared = np.intersect1d(*(np.concatenate([names[i] for names in run.names]) for i in range(2)))
    assert len(shared) >= 3
    logs = [log.arrays() for log in logs_of(run)]
    options = SmoothingOptions(max_keys=200, recent_keys=200, max_iterations=40)
    result = rejuvenate(
        SlamGraph.at_uncertain_starts(starts), logs, run.spec.noise.motion, camera_of(run), 200,
        np.random.default_rng(4), options,
    )  # fmt: skip
    assert result.reason == ""
    given, found = result.particles.starts
    np.testing.assert_array_equal(given, np.repeat(true[0][:, None], 200, axis=1))
    np.testing.assert_array_equal(found, np.repeat(found[:, :1], 200, axis=1))
    off, claimed = between(found[:, 0], true[1]), result.particles.start_scatters
    assert off @ np.linalg.solve(claimed[1], off) < 11.34  # 99 % of 3 degrees of freedom
    assert not claimed[0].any()


def test_robots_are_renumbered_with_their_keyframes():
    """Exchanged twice, a graph is as before; once, each robot has the other's keys."""
    graph = graph_of(small_run(2))
    order = np.array([1, 0])
    other = graph.reordered(order)
    np.testing.assert_array_equal(other.poses[other.robots == 0], graph.poses[graph.robots == 1])
    assert other.last_keys.tolist() == graph.last_keys[::-1].tolist()
    np.testing.assert_array_equal(other.reordered(order).robots, graph.robots)


def test_a_graph_cannot_be_written():
    """Snapshots share graphs, so that their arrays refuse to change."""
    with pytest.raises(ValueError, match="read-only"):
        graph_of(small_run()).poses[0] = 0.0


@pytest.mark.parametrize("robots", [1, 2])
def test_with_every_step_a_key_the_mode_is_batch_maximum_likelihood(robots):
    """Two programs that share no line find the same paths, landmarks and cost."""
    run = small_run(robots)
    graph = graph_of(run)
    mode = optimize(graph, camera_of(run), TIGHT)
    batch = batch_ml(problem_of(run))
    assert mode.reason == ""
    assert mode.cost == pytest.approx(0.5 * batch.cost, rel=1e-9)
    for robot in range(robots):
        path = mode.poses[graph.robots == robot]
        np.testing.assert_allclose(path[:, :2], batch.paths[robot][:, :2], atol=1e-6)
    order = np.argsort(batch.names)
    rows = order[np.searchsorted(batch.names[order], graph.landmark_ids)]
    np.testing.assert_allclose(mode.landmarks, batch.landmarks[rows], atol=1e-5)


def test_the_information_of_the_paths_is_that_of_batch_maximum_likelihood():
    """The factor's inverse holds the covariances of all poses, landmarks integrated out."""
    run = small_run()
    mode = optimize(graph_of(run), camera_of(run), TIGHT)
    half = np.linalg.inv(upper(mode))
    covariance = (half @ half.T).reshape(-1, 3, len(half) // 3, 3)
    each = np.arange(len(covariance))
    batch = batch_ml(problem_of(run)).path_covariances[0, 1:]
    np.testing.assert_allclose(covariance[each, :, each, :], batch, rtol=1e-5, atol=1e-12)


def test_at_the_mode_the_plain_cost_is_flat():
    """Moving any pose or landmark by a thousandth of a millimetre, either way, does not lower the cost."""
    run = small_run(length=1.0)
    graph = graph_of(run)
    mode = optimize(graph, camera_of(run), TIGHT)
    best = plain_cost(run, mode.poses[None], dict(zip(graph.landmark_ids.tolist(), mode.landmarks, strict=True)))
    assert best == pytest.approx(mode.cost, rel=1e-9)
    for i in range(len(mode.poses) - 1):
        for axis in range(3):
            for sign in (-1e-6, 1e-6):
                moved = mode.poses.copy()
                moved[i + 1, axis] += sign
                named = dict(zip(graph.landmark_ids.tolist(), mode.landmarks, strict=True))
                assert plain_cost(run, moved[None], named) >= best - 1e-7
    for i in range(len(mode.landmarks)):
        for axis in range(3):
            moved = mode.landmarks.copy()
            moved[i, axis] += 1e-6
            named = dict(zip(graph.landmark_ids.tolist(), moved, strict=True))
            assert plain_cost(run, mode.poses[None], named) >= best - 1e-7


def test_without_noise_there_is_no_error():
    """A run read without noise is found again exactly, though the filter assumes noise."""
    exact = NoisePreset(
        sigma_px=1e-12, sigma_disparity_px=1e-12,
        motion=OdometryModel(
            sigma_along=0.0, sigma_across=0.0, sigma_heading=0.0, sigma_turn=0.0, floor_position=1e-12,
            floor_heading=1e-12,
        ),
    )  # fmt: skip
    run = simulate_run(RunSpec(length=4.0, landmarks=120, measurements=6, preset=exact), 103)
    assumed = StereoCamera(mount=exact.camera.mount)
    camera = np.array([assumed.focal_px, assumed.baseline, 0.2, 0.1, *assumed.mount])
    start = SlamGraph.at_starts(run.true_paths[:, 0])
    log = RobotLog()
    for step in range(run.num_steps):
        points = assumed.robot_from_camera(run.frames[step][0].points) - np.array(assumed.mount)
        move = None if step == 0 else run.odometry[step, 0]
        log.append(step, move, points=points, ids=run.names[step][0])
    graph = extend_graph(start, [log.arrays()], OdometryModel(), np.array(assumed.mount))
    mode = optimize(graph, camera, TIGHT)
    np.testing.assert_allclose(mode.poses[:, :2], run.true_paths[0, :, :2], atol=1e-9)
    np.testing.assert_allclose(mode.landmarks, run.landmarks[graph.landmark_ids], atol=1e-8)


def test_a_slowly_converging_descent_ends_with_the_last_iteration():
    """What can fall by five tolerances is a mode in the options' last iteration, but not where a slice ends.

    What can fall by twenty is none.
    """
    run = small_run()
    graph, camera = graph_of(run), camera_of(run)
    after_two = optimize(graph, camera, replace(TIGHT, max_iterations=2))
    rough = optimize(graph, camera, replace(TIGHT, tolerance=0.1))
    assert rough.iterations == 3
    promise = after_two.cost - rough.cost  # of the third step
    near = replace(TIGHT, max_iterations=3, tolerance=promise / 5.0)
    mode = optimize(graph, camera, near)
    assert mode.reason == ""
    np.testing.assert_array_equal(mode.poses, rough.poses)
    loose = optimize(graph, camera, replace(near, tolerance=promise / 50.0), looseness=10.0)
    assert loose.reason == ""
    np.testing.assert_array_equal(loose.poses, rough.poses)
    assert optimize(graph, camera, near, 3).reason == "no convergence in 3 iterations"
    assert optimize(graph, camera, replace(near, tolerance=promise / 20.0)).reason == "no convergence in 3 iterations"


def test_a_kernel_ignores_a_wrong_match():
    """One point taken for another landmark moves the paths by much under plain squares, hardly with the kernel."""
    run = small_run()
    graph = graph_of(run)
    wrong = graph.points.copy()
    wrong[60] += [0.0, 1.5, 0.0]
    swapped = type(graph)(**{name: getattr(graph, name) for name in graph.__dataclass_fields__} | {"points": wrong})
    right = optimize(graph, camera_of(run), TIGHT).poses
    plain = optimize(swapped, camera_of(run), TIGHT).poses
    robust = optimize(swapped, camera_of(run), SmoothingOptions(kernel=16.0, tolerance=1e-9, max_iterations=40)).poses
    assert np.abs(plain - right)[:, :2].max() > 10.0 * np.abs(robust - right)[:, :2].max()


def test_steps_without_measurements_are_eliminated_exactly():
    """Odometry chained over steps in which nothing was seen gives the keys the same mode as keeping those steps."""
    run = small_run()
    skip = (3, 4, 5, 11)
    chained = optimize(graph_of(run, skip), camera_of(run), TIGHT)
    kept = graph_of(run)
    points = ~np.isin(kept.point_frames, skip)
    seen = np.unique(kept.point_landmarks[points])
    names = ("points", "point_noises", "has_covariance", "point_frames", "point_landmarks")
    fewer = {name: getattr(kept, name)[points] for name in names}
    fewer["point_landmarks"] = np.searchsorted(seen, fewer["point_landmarks"])
    fewer |= {"landmarks": kept.landmarks[seen], "landmark_ids": kept.landmark_ids[seen]}
    whole = type(kept)(**{name: getattr(kept, name) for name in kept.__dataclass_fields__} | fewer)
    mode = optimize(whole, camera_of(run), TIGHT)
    np.testing.assert_allclose(chained.poses, np.delete(mode.poses, skip, axis=0), atol=2e-4)


def moving_log(steps: int) -> RobotLog:
    """Return a log of a robot that only moves."""
    log = RobotLog()
    for step in range(steps):
        log.append(step, np.array([0.1, 0.0, 0.01]))
    return log


def test_without_landmarks_the_mode_is_dead_reckoning():
    """Thousands of steps without a landmark are one link of odometry, and its covariance is that of the chain."""
    graph = extend_graph(
        SlamGraph.at_starts(np.zeros((1, 3))), [moving_log(3000).arrays()], OdometryModel(), np.zeros(3)
    )
    assert graph.num_keys == 2
    mode = optimize(graph, camera_of(small_run()), TIGHT)
    assert mode.reason == ""
    half = np.linalg.inv(upper(mode))
    np.testing.assert_allclose(half @ half.T, graph.odometry_covariances[1], rtol=1e-6)


def test_small_matrices_are_inverted_as_by_lapack():
    """The inverses of 3 x 3 covariances are numpy's; one that is not positive definite is reported."""
    rng = np.random.default_rng(5)
    roots = rng.normal(size=(50, 3, 3)) * [1e-3, 1e-2, 1.0]
    matrices = roots @ roots.transpose(0, 2, 1) + 1e-4 * np.eye(3)
    previous = np.zeros(50, dtype=np.int64)
    previous[[4, 20]] = -1
    expected = np.linalg.inv(matrices)
    expected[[4, 20]] = 0.0
    matrices[20] = 0.0
    _, found, _, is_noisy = sum_pose_information(previous, matrices)
    assert is_noisy
    np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-7)
    for bad in (np.zeros((3, 3)), np.diag([1.0, -1.0, -1.0]), np.diag([-1.0, 1.0, 1.0])):
        matrices[7] = bad
        assert not sum_pose_information(previous, matrices)[3]


def test_only_poses_with_odometry_from_another_are_estimated():
    """They get three rows each, in their order; poses that are given get none."""
    previous, noises = np.array([-1, 0, -1, 1, 2]), np.zeros((5, 3, 3))
    columns, _, size, is_noisy = sum_pose_information(previous, noises)
    assert columns.tolist() == [FREE, 0, FREE, 3, 6]
    assert (size, is_noisy) == (3, False)
    noises[[1, 3, 4]] = 0.5 * np.eye(3)
    _, informations, *rest = sum_pose_information(previous, noises)
    assert rest == [3, True]
    np.testing.assert_array_equal(informations, 4.0 * noises)


def test_an_increment_moves_poses_as_stated():
    """Given poses stay; the slope is taken along the whole increment; one that is not finite is never small."""
    rng = np.random.default_rng(8)
    change, poses, landmarks = (rng.normal(size=(n, 3)) for n in (5, 4, 2))
    columns, order, none = np.array([FREE, 0, 3, 6]), np.arange(5), np.zeros(0, dtype=np.int64)
    tops, empty = np.zeros(6, dtype=np.int64), np.zeros((0, 3))
    pattern = SymbolicFactor(order, order, tops, none, none, none, none, tops, none, none, 5)
    factor = CholeskyFactor(
        np.tile([1.0, 0.0, 1.0, 0.0, 0.0, 1.0], (5, 1)), np.zeros((0, 9)), order
    )  # of unit matrices

    def solved(vector):
        blocks = np.zeros((5, 6)), *(np.zeros((0, 3, 3)) for _ in range(3))
        return _kernels.step(
            EquationBlocks(empty[:, :2].copy(), *blocks, vector), factor, pattern, columns, poses, landmarks
        )

    new_poses, new_landmarks, rise, largest = solved(-change)
    assert rise == pytest.approx(-(change * change).sum())
    assert largest == np.abs(change[:3]).max()
    np.testing.assert_array_equal(new_poses, poses + np.concatenate([np.zeros((1, 3)), change[:3]]))
    np.testing.assert_array_equal(new_landmarks, landmarks + change[3:])
    for row, axis in ((0, 0), (2, 2)):
        bad = change.copy()
        bad[row, axis] = np.nan
        assert not solved(-bad)[3] < np.inf


def test_exact_motions_and_poses_leave_nothing_to_smooth():
    """Exact odometry has no information matrix, and a pose that was given as exact is not estimated."""
    start = SlamGraph.at_starts(np.zeros((1, 3)))
    graph = extend_graph(start, [moving_log(4).arrays()], EXACT_MOTION, np.zeros(3))
    assert optimize(graph, camera_of(small_run()), TIGHT).reason == "odometry without noise"
    log = RobotLog()
    log.append(0, pose=np.zeros(3))
    with pytest.raises(ValueError, match="logs: expected odometry"):
        extend_graph(start, [log.arrays()], OdometryModel(), np.zeros(3))


def test_a_landmark_with_uninformative_sightings_stays_and_does_not_block_others():
    """Frozen sightings that have lost their weight hold no landmark: it stays where it is, and poses are as without."""
    run = small_run()
    graph = graph_of(run)
    best = optimize(graph, camera_of(run), TIGHT)
    lost = np.array([3.0, -2.0, 0.5])
    ghost = {
        "condensed_keys": np.array([2, 4]),
        "condensed_landmarks": np.full(2, len(graph.landmarks)),
        "linearisation_points": np.array([[1.0, 0.0, 0.0], [40.0, 0.0, 0.0]]),
        "information": 1e-200 * np.array([[1.0, 0.0, 0.0, 1.0, 0.0, 1.0]] * 2),
        "gradients": np.zeros((2, 3)),
        "counts": np.ones(2, dtype=np.int64),
        "landmark_ids": np.append(graph.landmark_ids, 10_000),
        "landmarks": np.concatenate([graph.landmarks, lost[None]]),
    }
    mode = optimize(replace(graph, **ghost), camera_of(run), TIGHT)
    assert mode.reason == ""
    np.testing.assert_allclose(mode.landmarks[-1], lost, atol=1e-9)
    np.testing.assert_allclose(mode.poses, best.poses, atol=1e-9)
