from dataclasses import replace

import numpy as np
import pytest
from python_entry import python_entry
from small_problems import (
    TIGHT,
    camera_of,
    graph_of,
    plain_cost,
    problem_of,
    small_run,
    upper,
)  # fmt: skip

from slam_backend.fastslam.run_log import RobotLog
from slam_backend.models.camera import StereoCamera
from slam_backend.models.odometry import OdometryModel
from slam_backend.smoother._kernels import FREE
from slam_backend.smoother._kernels.factors import invert, seek, seek_poses
from slam_backend.smoother._kernels.normal_equations import advance
from slam_backend.smoother.graph import PathGraph
from slam_backend.smoother.graph_building import extended
from slam_backend.smoother.optimizer import find_mode
from slam_backend.smoother.options import SmoothingOptions
from training.bench.accuracy.batch_ml import batch_ml
from training.bench.accuracy.runs import NoisePreset, RunSpec, simulate_run

advance, invert, seek = map(python_entry, (advance, invert, seek))


@pytest.mark.parametrize("robots", [1, 2])
def test_with_every_step_a_key_the_mode_is_batch_maximum_likelihood(robots):
    """Two programs that share no line find the same paths, landmarks and cost."""
    run = small_run(robots)
    graph = graph_of(run)
    mode = find_mode(graph, camera_of(run), TIGHT)
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
    mode = find_mode(graph_of(run), camera_of(run), TIGHT)
    half = np.linalg.inv(upper(mode))
    covariance = (half @ half.T).reshape(-1, 3, len(half) // 3, 3)
    each = np.arange(len(covariance))
    batch = batch_ml(problem_of(run)).path_covariances[0, 1:]
    np.testing.assert_allclose(covariance[each, :, each, :], batch, rtol=1e-5, atol=1e-12)


def test_at_the_mode_the_plain_cost_is_flat():
    """Moving any pose or landmark by a thousandth of a millimetre, either way, does not lower the cost."""
    run = small_run(length=1.0)
    graph = graph_of(run)
    mode = find_mode(graph, camera_of(run), TIGHT)
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
    start = PathGraph.at_starts(run.true_paths[:, 0])
    log = RobotLog()
    for step in range(run.num_steps):
        points = assumed.robot_from_camera(run.frames[step][0].points) - np.array(assumed.mount)
        move = None if step == 0 else run.odometry[step, 0]
        log.append(step, move, points=points, ids=run.names[step][0])
    graph = extended(start, [log.arrays()], OdometryModel(), np.array(assumed.mount))
    mode = find_mode(graph, camera, TIGHT)
    np.testing.assert_allclose(mode.poses[:, :2], run.true_paths[0, :, :2], atol=1e-9)
    np.testing.assert_allclose(mode.landmarks, run.landmarks[graph.landmark_ids], atol=1e-8)


def test_a_descent_that_creeps_has_ended_in_the_last_iteration():
    """What can fall by five tolerances is a mode in the options' last iteration, but not where a slice ends.

    What can fall by twenty is none.
    """
    run = small_run()
    graph, camera = graph_of(run), camera_of(run)
    after_two = find_mode(graph, camera, replace(TIGHT, max_iterations=2))
    rough = find_mode(graph, camera, replace(TIGHT, tolerance=0.1))
    assert rough.iterations == 3
    promise = after_two.cost - rough.cost  # of the third step
    near = replace(TIGHT, max_iterations=3, tolerance=promise / 5.0)
    mode = find_mode(graph, camera, near)
    assert mode.reason == ""
    np.testing.assert_array_equal(mode.poses, rough.poses)
    loose = find_mode(graph, camera, replace(near, tolerance=promise / 50.0), looseness=10.0)
    assert loose.reason == ""
    np.testing.assert_array_equal(loose.poses, rough.poses)
    assert find_mode(graph, camera, near, 3).reason == "no convergence in 3 iterations"
    assert find_mode(graph, camera, replace(near, tolerance=promise / 20.0)).reason == "no convergence in 3 iterations"


def test_a_kernel_ignores_a_wrong_match():
    """One point taken for another landmark moves the paths by much under plain squares, hardly with the kernel."""
    run = small_run()
    graph = graph_of(run)
    wrong = graph.points.copy()
    wrong[60] += [0.0, 1.5, 0.0]
    swapped = type(graph)(**{name: getattr(graph, name) for name in graph.__dataclass_fields__} | {"points": wrong})
    right = find_mode(graph, camera_of(run), TIGHT).poses
    plain = find_mode(swapped, camera_of(run), TIGHT).poses
    robust = find_mode(swapped, camera_of(run), SmoothingOptions(kernel=16.0, tolerance=1e-9, max_iterations=40)).poses
    assert np.abs(plain - right)[:, :2].max() > 10.0 * np.abs(robust - right)[:, :2].max()


def test_steps_without_measurements_are_eliminated_exactly():
    """Odometry chained over steps in which nothing was seen gives the keys the same mode as keeping those steps."""
    run = small_run()
    skip = (3, 4, 5, 11)
    chained = find_mode(graph_of(run, skip), camera_of(run), TIGHT)
    kept = graph_of(run)
    points = ~np.isin(kept.point_frames, skip)
    seen = np.unique(kept.point_landmarks[points])
    names = ("points", "point_noises", "given", "point_frames", "point_landmarks")
    fewer = {name: getattr(kept, name)[points] for name in names}
    fewer["point_landmarks"] = np.searchsorted(seen, fewer["point_landmarks"])
    fewer |= {"landmarks": kept.landmarks[seen], "landmark_ids": kept.landmark_ids[seen]}
    whole = type(kept)(**{name: getattr(kept, name) for name in kept.__dataclass_fields__} | fewer)
    mode = find_mode(whole, camera_of(run), TIGHT)
    np.testing.assert_allclose(chained.poses, np.delete(mode.poses, skip, axis=0), atol=2e-4)


def moving_log(steps: int) -> RobotLog:
    """Return a log of a robot that only moves."""
    log = RobotLog()
    for step in range(steps):
        log.append(step, np.array([0.1, 0.0, 0.01]))
    return log


def test_without_landmarks_the_mode_is_dead_reckoning():
    """Thousands of steps without a landmark are one link of odometry, and its covariance is that of the chain."""
    graph = extended(PathGraph.at_starts(np.zeros((1, 3))), [moving_log(3000).arrays()], OdometryModel(), np.zeros(3))
    assert graph.num_keys == 2
    mode = find_mode(graph, camera_of(small_run()), TIGHT)
    assert mode.reason == ""
    half = np.linalg.inv(upper(mode))
    np.testing.assert_allclose(half @ half.T, graph.noises[1], rtol=1e-6)


def test_a_robot_that_has_not_moved_has_no_pose_to_seek():
    """A start is given: with it alone there is nothing to smooth, and the mode says so."""
    mode = find_mode(PathGraph.at_starts(np.zeros((2, 3))), camera_of(small_run()), TIGHT)
    assert mode.reason == "no pose to seek"


def test_small_matrices_are_inverted_as_by_lapack():
    """The kernel's inverses of 3 x 3 covariances are numpy's; one that is not positive definite is told."""
    rng = np.random.default_rng(5)
    roots = rng.normal(size=(50, 3, 3)) * [1e-3, 1e-2, 1.0]
    matrices = roots @ roots.transpose(0, 2, 1) + 1e-4 * np.eye(3)
    found, columns = np.empty_like(matrices), 3 * np.arange(50)
    columns[[4, 20]] = FREE
    expected = np.linalg.inv(matrices)
    expected[[4, 20]] = 0.0
    matrices[20] = 0.0
    assert invert(matrices, columns, found)
    np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-7)
    for bad in (np.zeros((3, 3)), np.diag([1.0, -1.0, -1.0]), np.diag([-1.0, 1.0, 1.0])):
        matrices[7] = bad
        assert not invert(matrices, columns, found)


def test_only_poses_with_odometry_from_another_are_sought():
    """They get three rows each, in their order; poses that are given get none."""
    columns = np.empty(5, dtype=np.int64)
    assert seek(np.array([-1, 0, -1, 1, 2]), columns) == 3
    assert columns.tolist() == [FREE, 0, FREE, 3, 6]
    noises, informations = np.zeros((5, 3, 3)), np.empty((5, 3, 3))
    assert seek_poses(np.array([-1, 0, -1, 1, 2]), noises, columns, informations) == (3, False)
    noises[[1, 3, 4]] = 0.5 * np.eye(3)
    assert seek_poses(np.array([-1, 0, -1, 1, 2]), noises, columns, informations) == (3, True)
    np.testing.assert_array_equal(informations, 4.0 * noises)


def test_a_change_leads_where_it_says():
    """Poses that are given stay; the slope is taken along all of it, and no change that is not finite looks small."""
    rng = np.random.default_rng(8)
    change, vector, poses, landmarks = (rng.normal(size=(n, 3)) for n in (5, 5, 4, 2))
    columns = np.array([FREE, 0, 3, 6])
    new_poses, new_landmarks = np.empty_like(poses), np.empty_like(landmarks)
    rise, largest = advance(change, vector, columns, poses, landmarks, new_poses, new_landmarks)
    assert rise == pytest.approx((change * vector).sum())
    assert largest == np.abs(change[:3]).max()
    np.testing.assert_array_equal(new_poses, poses + np.concatenate([np.zeros((1, 3)), change[:3]]))
    np.testing.assert_array_equal(new_landmarks, landmarks + change[3:])
    for row, axis in ((0, 0), (2, 2)):
        bad = change.copy()
        bad[row, axis] = np.nan
        assert not advance(bad, vector, columns, poses, landmarks, new_poses, new_landmarks)[1] < np.inf


def test_odometry_without_noise_is_refused_with_a_reason():
    """Exact odometry has no information matrix."""
    still = OdometryModel(
        sigma_along=0.0, sigma_across=0.0, sigma_heading=0.0, sigma_turn=0.0, floor_position=0.0, floor_heading=0.0
    )
    graph = extended(PathGraph.at_starts(np.zeros((1, 3))), [moving_log(4).arrays()], still, np.zeros(3))
    assert find_mode(graph, camera_of(small_run()), TIGHT).reason == "odometry without noise"


def test_a_descent_that_takes_too_long_is_refused_with_a_reason():
    """A single step from dead reckoning is not enough, and the mode says so."""
    run = small_run()
    mode = find_mode(graph_of(run), camera_of(run), SmoothingOptions(max_iterations=1))
    assert mode.reason == "no convergence in 1 iterations"


def test_exact_poses_are_refused():
    """Where a pose was given as exact, there is nothing to smooth."""
    log = RobotLog()
    log.append(0, pose=np.zeros(3))
    with pytest.raises(ValueError, match="logs: expected odometry"):
        extended(PathGraph.at_starts(np.zeros((1, 3))), [log.arrays()], OdometryModel(), np.zeros(3))


def test_a_landmark_whose_sightings_say_nothing_stays_and_keeps_nobody():
    """Frozen sightings that have lost their weight hold no landmark: it stays where it is, and poses are as without."""
    run = small_run()
    graph = graph_of(run)
    best = find_mode(graph, camera_of(run), TIGHT)
    lost = np.array([3.0, -2.0, 0.5])
    ghost = {
        "frozen_keys": np.array([2, 4]),
        "frozen_landmarks": np.full(2, len(graph.landmarks)),
        "centres": np.array([[1.0, 0.0, 0.0], [40.0, 0.0, 0.0]]),
        "infos": 1e-200 * np.array([[1.0, 0.0, 0.0, 1.0, 0.0, 1.0]] * 2),
        "slopes": np.zeros((2, 3)),
        "counts": np.ones(2, dtype=np.int64),
        "landmark_ids": np.append(graph.landmark_ids, 10_000),
        "landmarks": np.concatenate([graph.landmarks, lost[None]]),
    }
    mode = find_mode(replace(graph, **ghost), camera_of(run), TIGHT)
    assert mode.reason == ""
    np.testing.assert_allclose(mode.landmarks[-1], lost, atol=1e-9)
    np.testing.assert_allclose(mode.poses, best.poses, atol=1e-9)
