import numpy as np
import pytest
from small_problems import TIGHT, camera_of, logs_of, small_run, upper

from slam_backend.geometry import between, compose
from slam_backend.smoother.graph import NONE, PathGraph, scattered
from slam_backend.smoother.graph_building import extended, joined
from slam_backend.smoother.optimizer import find_mode

OFFSET = 500  # by which other groups call landmarks differently


def group_graph(run, robots, offset=0):
    """Return the graph of some robots in the start frame of the first of them, and its landmarks' new names."""
    logs = [logs_of(run)[robot] for robot in robots]
    names = np.unique(np.concatenate([log.arrays().ids for log in logs]))
    arrays = [log.renamed(names, names + offset).arrays() for log in logs]
    starts = between(run.true_paths[robots[0], 0], run.true_paths[robots, 0])
    graph = extended(PathGraph.at_starts(starts), arrays, run.spec.noise.motion, np.array(run.spec.noise.camera.mount))
    return graph, np.column_stack([names + offset, names])


def from_the_start(run, groups, guess):
    """Return the graph of all robots from their logs, as a filter would build it whose particles differ by group."""
    starts = np.repeat(between(run.true_paths[0, 0], run.true_paths[:, 0])[:, :, None], 40, axis=2)
    rng = np.random.default_rng(1)
    for robots in groups[1:]:
        frames = compose(guess + 1e-2 * rng.normal(size=(40, 3)), starts[robots[0], :, 0])
        for robot in robots:
            starts[robot] = compose(frames, between(run.true_paths[robots[0], 0], run.true_paths[robot, 0])).T
    logs = [log.arrays() for log in logs_of(run)]
    mount = np.array(run.spec.noise.camera.mount)
    return extended(PathGraph.at_uncertain_starts(starts), logs, run.spec.noise.motion, mount)


def in_order(graph):
    """Return the keys of the robots, robot by robot, in the order of time."""
    return np.concatenate([np.flatnonzero(graph.robots == robot) for robot in range(len(graph.tips))])


def covariance(graph, mode):
    """Return the joint covariance of all sought poses, in the order of `in_order`."""
    half = np.linalg.inv(upper(mode))
    columns = mode.columns[in_order(graph)]
    rows = (columns[columns >= 0][:, None] + np.arange(3)).ravel()
    return (half @ half.T)[np.ix_(rows, rows)]


def assert_same_posterior(graph, other, run):
    """Both graphs have the same mode and the same covariance about it."""
    one, two = find_mode(graph, camera_of(run), TIGHT), find_mode(other, camera_of(run), TIGHT)
    assert one.reason == two.reason == ""
    np.testing.assert_allclose(one.poses[in_order(graph), :2], two.poses[in_order(other), :2], atol=1e-5)
    names, same = np.argsort(graph.landmark_ids), np.argsort(other.landmark_ids)
    np.testing.assert_array_equal(graph.landmark_ids[names], other.landmark_ids[same])
    np.testing.assert_allclose(one.landmarks[names], two.landmarks[same], atol=1e-5)
    np.testing.assert_allclose(covariance(graph, one), covariance(other, two), rtol=1e-3, atol=1e-9)


def test_two_groups_joined_are_what_their_logs_give_from_the_start():
    """Mode and covariance of the joined graph are those of the graph built from all logs; b's starts stay rigid."""
    run = small_run(3, seed=104, length=8.0)
    guess = np.array([0.15, -0.1, 0.04])
    a, _ = group_graph(run, [0])
    b, renamed = group_graph(run, [1, 2], OFFSET)
    motion = compose(guess, between(run.true_paths[0, 0], run.true_paths[1, 0]))
    both = joined(a, b, motion, renamed)
    assert both.previous[both.heads].tolist() == [NONE, a.num_keys, both.heads[1]]
    assert_same_posterior(both, from_the_start(run, [[0], [1, 2]], guess), run)


def test_a_third_robot_joins_later():
    """Joined one after the other, in either order, or built from all their logs: the posterior is the same."""
    run = small_run(3, seed=104, length=8.0)
    guess = np.array([0.1, 0.05, -0.03])
    whole = from_the_start(run, [[0], [1], [2]], guess)
    graphs = [group_graph(run, [robot], OFFSET * robot) for robot in range(3)]
    starts = run.true_paths[:, 0]

    def motion(a, b):
        return compose(guess, between(starts[a], starts[b]))

    first = joined(graphs[0][0], graphs[1][0], motion(0, 1), graphs[1][1])
    assert_same_posterior(joined(first, graphs[2][0], motion(0, 2), graphs[2][1]), whole, run)
    names = graphs[2][1] - [0, -OFFSET]
    pair = joined(graphs[1][0], graphs[2][0], motion(1, 2), names)
    names = np.column_stack([pair.landmark_ids, pair.landmark_ids - OFFSET])
    assert_same_posterior(joined(graphs[0][0], pair, motion(0, 1), names), whole, run)


def test_landmarks_without_a_new_name_are_left_out():
    """What the joint map does not hold is not in the joined graph either, and nothing else changes its place."""
    run = small_run(2, seed=104)
    (a, _), (b, renamed) = group_graph(run, [0]), group_graph(run, [1], OFFSET)
    lost = b.landmark_ids[3]
    both = joined(a, b, np.array([1.0, 2.0, 0.5]), renamed[renamed[:, 0] != lost])
    assert len(both.points) == len(a.points) + np.count_nonzero(b.landmark_ids[b.point_landmarks] != lost)
    np.testing.assert_array_equal(both.landmark_ids[both.point_landmarks[: len(a.points)]],
                                  a.landmark_ids[a.point_landmarks])  # fmt: skip
    assert np.unique(both.landmark_ids).size == both.landmark_ids.size


def test_words_for_one_landmark_follow_it():
    """Names that a group has given up go on standing for the landmark that was kept, under the joint map's names."""
    run = small_run(2, seed=104)
    (a, _), (b, renamed) = group_graph(run, [0]), group_graph(run, [1], OFFSET)
    old, kept = renamed[0], renamed[1]
    b = PathGraph(**b.to_mapping() | {"aliases": np.array([[old[0], kept[0]]])})
    both = joined(a, b, np.zeros(3), renamed)
    assert both.known_as(np.array([old[1], kept[1]])).tolist() == [kept[1], kept[1]]


@pytest.mark.parametrize("common", [0, 2])
def test_groups_without_landmarks_that_fix_the_motion_lie_as_the_merge_said(common):
    """Two groups that share too few landmarks are as uncertain against each other as the motion was, not lost."""
    run = small_run(2)
    (a, _), (b, renamed) = group_graph(run, [0]), group_graph(run, [1], OFFSET)
    shared = renamed[np.isin(renamed[:, 1], a.landmark_ids)][:common]
    own = renamed[~np.isin(renamed[:, 1], a.landmark_ids)]
    uncertainty = np.diag([0.03, 0.04, 0.01]) ** 2
    motion = between(run.true_paths[0, 0], run.true_paths[1, 0])
    both = joined(a, b, motion, np.concatenate([shared, own]), uncertainty)
    mode = find_mode(both, camera_of(run), TIGHT)
    assert mode.reason == ""
    half = np.linalg.inv(upper(mode))
    first = mode.columns[both.heads[1]] + np.arange(3)
    claimed = (half @ half.T)[np.ix_(first, first)]
    if common:
        assert np.linalg.eigvalsh(uncertainty - claimed).min() > -1e-9
        return
    np.testing.assert_allclose(mode.poses[both.heads[1]], motion, atol=1e-6)
    np.testing.assert_allclose(claimed, uncertainty, rtol=1e-3, atol=1e-9)


def test_scatter_is_the_covariance_about_the_mean_direction():
    """Poses on both sides of a half turn scatter as they would about zero."""
    rng = np.random.default_rng(3)
    poses = rng.normal(size=(3, 400)) * np.array([[0.3], [0.2], [0.1]])
    there = poses + np.array([[1.0], [2.0], [np.pi]])
    np.testing.assert_allclose(scattered(there), scattered(poses), rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(scattered(poses), np.cov(poses, bias=True), atol=1e-3)
