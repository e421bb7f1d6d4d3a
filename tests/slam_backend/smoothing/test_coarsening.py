from dataclasses import replace

import numpy as np
import pytest
from plain_coarsening import plainly_coarsened
from small_problems import TIGHT, camera_of, graph_of, logs_of, small_run, upper

from slam_backend.fastslam.run_log import RobotLog
from slam_backend.geometry import compose
from slam_backend.smoother.graph import PathGraph
from slam_backend.smoother.graph_building import extended
from slam_backend.smoother.graph_reduction import at_mode, coarsened
from slam_backend.smoother.optimizer import find_mode
from slam_backend.smoother.options import SmoothingOptions
from slam_backend.smoother.rejuvenation import rejuvenate
from slam_backend.smoother.sampling import draw_paths, lane_rows, replay


def limits(max_keys, fresh_keys):
    """Return options under which so many keys are left."""
    return SmoothingOptions(max_keys=max_keys, fresh_keys=fresh_keys, kernel=0.0)


def test_condensed_sightings_of_single_poses_change_nothing():
    """Frozen at the mode, all measurements give the same mode, the same information and the same map."""
    run = small_run(2)
    graph = graph_of(run)
    mode = find_mode(graph, camera_of(run), TIGHT)
    frozen = coarsened(at_mode(graph, mode, np.zeros(graph.num_keys)), camera_of(run), limits(1000, 2))
    assert len(frozen.points) < len(graph.points)
    assert frozen.num_keys == graph.num_keys
    again = find_mode(frozen, camera_of(run), TIGHT)
    np.testing.assert_allclose(again.poses, mode.poses, atol=1e-8)
    np.testing.assert_allclose(again.landmarks, mode.landmarks, atol=1e-8)
    one, same = upper(again), upper(mode)
    np.testing.assert_allclose(one.T @ one, same.T @ same, rtol=1e-6, atol=1e-3)


def test_frames_taken_while_standing_belong_to_one_key():
    """A robot that stands still has one pose: its frames add up to one sighting of each landmark."""
    run = small_run()
    log = RobotLog()
    points = run.spec.noise.camera.robot_from_camera(run.frames[0][0].points) - np.array(run.spec.noise.camera.mount)
    log.append(0, points=points, ids=run.names[0][0])
    log.append(1, points=points, ids=run.names[0][0])
    log.append(2, np.array([0.2, 0.0, 0.0]), points=points - [0.2, 0.0, 0.0], ids=run.names[0][0])
    start = PathGraph.at_starts(np.zeros((1, 3)))
    graph = extended(start, [log.arrays()], run.spec.noise.motion, np.zeros(3))
    assert graph.num_keys == 2
    assert graph.frame_keys.tolist() == [0, 0, 1]
    mode = find_mode(graph, camera_of(run), TIGHT)
    assert mode.sightings.counts.tolist() == [2, 1] * len(points)


def test_rigid_neighbours_keep_what_they_see():
    """Keys that are joined at the mode leave landmarks, newest pose and likelihood at the mode where they were."""
    run = small_run()
    graph = graph_of(run)
    mode = find_mode(graph, camera_of(run), TIGHT)
    spreads = draw_paths(graph, mode, 50, np.random.default_rng(1)).spreads
    fewer = coarsened(at_mode(graph, mode, spreads), camera_of(run), limits(9, 3))
    assert fewer.num_keys == 9
    np.testing.assert_allclose(fewer.poses[fewer.tips], mode.poses[graph.tips])
    again = find_mode(fewer, camera_of(run), TIGHT)
    assert again.reason == ""
    tiles, _ = replay(again, lane_rows(fewer.poses[:, :, None]), 1)
    np.testing.assert_allclose(tiles[:, 0, :3, 0], mode.landmarks, atol=1e-7)  # the old poses ask for the old map
    np.testing.assert_allclose(again.poses[fewer.tips][:, :2], mode.poses[graph.tips][:, :2], atol=0.01)


def test_odometry_is_carried_to_the_joined_keys():
    """Composed with the links that are left, the start leads to the newest pose by measured and smoothed motion."""
    run = small_run()
    graph = graph_of(run)
    mode = find_mode(graph, camera_of(run), TIGHT)
    fewer = coarsened(at_mode(graph, mode, np.full(graph.num_keys, 1e-6)), camera_of(run), limits(5, 2))
    for b in np.flatnonzero(fewer.previous >= 0):
        old = np.flatnonzero((np.abs(mode.poses - fewer.poses[b]) < 1e-12).all(axis=1))[0]
        before = compose(mode.poses[old - 1], graph.motions[old])
        after = compose(fewer.poses[fewer.previous[b]], fewer.motions[b])
        np.testing.assert_allclose(after[:2], before[:2], atol=1e-9)
        assert np.linalg.det(fewer.noises[b]) > 0.0
        np.testing.assert_allclose(np.linalg.eigvalsh(fewer.noises[b]), np.linalg.eigvalsh(graph.noises[old]))


def test_unseen_keys_vanish_without_loss():
    """A key from which nothing was measured, and which is no longer the newest, is chained away: same mode without."""
    run = small_run()
    logs = logs_of(run, skip=(7, 8))
    mount = np.array(run.spec.noise.camera.mount)
    first = logs[0].arrays()
    upto, rest = _until(first, 9), first.since(9)
    grown = extended(PathGraph.at_starts(run.true_paths[:, 0]), [upto], run.spec.noise.motion, mount)
    whole = extended(grown, [rest], run.spec.noise.motion, mount)
    mode = find_mode(whole, camera_of(run), TIGHT)
    fewer = coarsened(at_mode(whole, mode, np.zeros(whole.num_keys)), camera_of(run), limits(1000, 2))
    assert fewer.num_keys == whole.num_keys - 1
    again = find_mode(fewer, camera_of(run), TIGHT)
    np.testing.assert_allclose(again.poses, np.delete(mode.poses, 7, axis=0), atol=1e-3)


def _until(log, step):
    cut = RobotLog()
    for t in range(len(log)):
        row = log.row(t)
        if row.step < step:
            cut.append(row.step, row.motion if row.kind else None, points=row.points, ids=row.ids)
    return cut.arrays()


def test_a_long_run_stays_bounded():
    """However long a run, keys stay at their limit and memory at what keys and landmarks in view ask for."""
    run = small_run(length=30.0)
    logs = logs_of(run)
    graph, sizes = PathGraph.at_starts(run.true_paths[:, 0]), []
    options = SmoothingOptions(max_keys=30, fresh_keys=12)
    arrays = logs[0].arrays()
    for last in range(10, run.num_steps, 10):
        part = _until(arrays.since(int(graph.latest[0]) + 1), last)
        result = rejuvenate(
            graph, [part], run.spec.noise.motion, camera_of(run), 20, np.random.default_rng(last), options
        )
        assert result.reason == ""
        graph = result.graph
        sizes.append((graph.num_keys, len(graph.points), graph.nbytes))
    assert max(size[0] for size in sizes) <= 30
    assert sizes[-1][1] <= 12 * 7
    assert sizes[-1][2] < 1.5 * sizes[5][2]


def test_further_robots_have_further_keys():
    """Two robots may have more keys than one, and have them; without further ones they share those of one."""
    run = small_run(robots=2, length=10.0)
    for further, most in ((0, 20), (6, 26)):
        options = SmoothingOptions(max_keys=20, further_keys=further, fresh_keys=8)
        assert options.most_keys(1) == 20
        assert options.most_keys(2) == most
        result = rejuvenate(
            PathGraph.at_starts(run.true_paths[:, 0]), [log.arrays() for log in logs_of(run)], run.spec.noise.motion,
            camera_of(run), 20, np.random.default_rng(3), options,
        )  # fmt: skip
        assert result.graph.num_keys == most


def test_a_graph_is_not_changed_by_what_is_made_of_it():
    """Snapshots may share graphs: extending, solving, drawing and coarsening leave every array as it was."""
    run = small_run()
    graph = graph_of(run)
    before = {name: getattr(graph, name).copy() for name in graph.__dataclass_fields__}
    mode = find_mode(graph, camera_of(run), TIGHT)
    draws = draw_paths(graph, mode, 9, np.random.default_rng(1))
    fewer = coarsened(at_mode(graph, mode, draws.spreads), camera_of(run), limits(7, 3))
    kept = {name: getattr(fewer, name).copy() for name in fewer.__dataclass_fields__}
    coarsened(at_mode(fewer, find_mode(fewer, camera_of(run), TIGHT), np.ones(7)), camera_of(run), limits(4, 2))
    replace(graph)
    for name, value in before.items():
        np.testing.assert_array_equal(getattr(graph, name), value)
    for name, value in kept.items():
        np.testing.assert_array_equal(getattr(fewer, name), value)


@pytest.mark.parametrize("max_keys", [3, 14, 30, 1000])
@pytest.mark.parametrize("kernel", [0.0, 0.2])
def test_keys_are_joined_as_by_the_plain_program(max_keys, kernel):
    """Kernels leave the same keys as numpy: blind ones, measurements that contradict, and joining twice included."""
    run = small_run(2, length=8.0)
    options = SmoothingOptions(max_keys=max_keys, further_keys=0, fresh_keys=6, kernel=kernel)
    graph = graph_of(run, skip=(3, 4, 7))
    blind = graph.point_frames == 5  # that a key measured nothing is the exception
    names = ("points", "point_noises", "given", "point_frames", "point_landmarks")
    graph = replace(graph, **{name: getattr(graph, name)[~blind] for name in names})
    for _ in range(2):
        mode = find_mode(graph, camera_of(run), TIGHT)
        graph = at_mode(graph, mode, mode.spreads())
        found, expected = (how(graph, camera_of(run), options) for how in (coarsened, plainly_coarsened))
        assert found.num_keys <= max(options.most_keys(2), 8)
        for name in graph.__dataclass_fields__:
            one, other = getattr(found, name), getattr(expected, name)
            assert one.dtype == other.dtype
            np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-7, err_msg=name)
        options = replace(options, max_keys=max(2, max_keys - 2))
        graph = found
