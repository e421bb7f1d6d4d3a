import numpy as np
import pytest
from plain_coarsening import chained
from small_problems import camera_of, graph_of, logs_of, small_run

from slam_backend.fastslam.run_log import RobotLog
from slam_backend.geometry import between, compose
from slam_backend.smoother.graph import PathGraph
from slam_backend.smoother.graph_building import Guesses, Places, extended, first_rows
from slam_backend.smoother.graph_reduction import at_mode
from slam_backend.smoother.optimizer import find_mode
from slam_backend.smoother.options import SmoothingOptions
from slam_backend.smoother.rejuvenation import rejuvenate


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


def test_a_log_can_be_taken_in_part_by_part():
    """First rows and the rest are the log."""
    log = logs_of(small_run())[0].arrays()
    first = first_rows(log, 5)
    assert first.steps.tolist() == log.steps[:5].tolist()
    assert len(first.ids) == log.starts[5]
    assert len(first_rows(log, 1000)) == len(log)


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


def test_a_landmark_seen_mostly_anew_starts_where_the_filter_has_it():
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
    start = extended(PathGraph.at_starts(run.true_paths[:, 0]), [first_rows(log, first + 1)], motion, mount)
    start = at_mode(start, find_mode(start, camera, options))
    assert np.linalg.norm(start.landmarks[start.landmark_ids == name][0] - run.landmarks[name]) > 1.0
    rest = [log.since(first + 1)]
    guesses = [Guesses(np.arange(len(run.true_paths[0])), run.true_paths[0])]
    places = Places(np.arange(120), run.landmarks + 0.02)

    def error(guesses, places):
        graph = extended(start, rest, motion, mount, guesses, places=places)
        mode = find_mode(graph, camera, options)
        assert mode.reason == ""
        return np.linalg.norm(mode.landmarks[graph.landmark_ids == name][0] - run.landmarks[name])

    assert error(guesses, places) < 0.05
    assert error(guesses, None) > 2.0
    assert error([Guesses.none()], places) == error([Guesses.none()], None)
    few = [first_rows(rest[0], 1)]
    grown = extended(start, few, motion, mount, guesses, places=places)
    old = np.flatnonzero(np.isin(grown.landmark_ids, start.landmark_ids))
    np.testing.assert_array_equal(grown.landmarks[old], start.landmarks[old])


def test_a_long_log_taken_in_at_once_ends_where_short_ones_do():
    """Part by part inside one call, or in many calls: the newest poses agree to a part of their doubt."""
    run = small_run(length=15.0)
    log = logs_of(run)[0].arrays()
    options = SmoothingOptions(max_keys=40, fresh_keys=20)
    motion, camera = run.spec.noise.motion, camera_of(run)
    start = PathGraph.at_starts(run.true_paths[:, 0])
    whole = rejuvenate(start, [log], motion, camera, 50, np.random.default_rng(1), options)
    graph = start
    for upto in range(7, 62, 6):
        part = first_rows(log, upto).since(int(graph.latest[0]) + 1)
        result = rejuvenate(graph, [part], motion, camera, 50, np.random.default_rng(upto), options)
        graph = result.graph
    assert whole.reason == result.reason == ""
    apart = whole.particles.means[0] - result.particles.means[0]
    assert apart @ np.linalg.solve(whole.particles.covariances[0], apart) < 0.5
    assert whole.graph.num_keys <= 40


def test_starts_on_which_particles_agree_are_given():
    """After a merge the own group's starts stay fixed; the others' are sought, and stay rigid among themselves."""
    rng = np.random.default_rng(2)
    starts = np.zeros((3, 3, 30))
    starts[0] = [[1.0], [2.0], [0.3]]
    motions = rng.normal(size=(30, 3)) * [0.2, 0.2, 0.05] + [5.0, 1.0, 3.1]
    starts[1] = motions.T
    starts[2] = compose(motions, np.array([0.0, 2.0, 0.1])).T
    graph = PathGraph.at_uncertain_starts(starts)
    assert graph.previous.tolist() == [-1, 3, 1, -1]
    assert graph.robots.tolist() == [0, 1, 2, -1]
    np.testing.assert_allclose(graph.motions[2], [0.0, 2.0, 0.1], atol=1e-12)
    assert graph.noises[1, 0, 0] > 1e3
    assert graph.noises[2, 0, 0] < 1e-6


def test_a_start_that_is_not_known_is_found_by_shared_landmarks():
    """Robot 1's start, off by 20 cm and 3 degrees in the particles, is where the landmarks that both saw put it."""
    run = small_run(2, seed=104, length=8.0)
    true = run.true_paths[:, 0]
    starts = np.repeat(true[:, :, None], 40, axis=2)
    rng = np.random.default_rng(3)
    starts[1] += np.array([0.2, -0.1, 0.05])[:, None] + rng.normal(size=(3, 40)) * [[0.05], [0.05], [0.02]]
    shared = np.intersect1d(*(np.concatenate([names[i] for names in run.names]) for i in range(2)))
    assert len(shared) >= 3
    logs = [log.arrays() for log in logs_of(run)]
    options = SmoothingOptions(max_keys=200, fresh_keys=200, max_iterations=40)
    result = rejuvenate(
        PathGraph.at_uncertain_starts(starts), logs, run.spec.noise.motion, camera_of(run), 200,
        np.random.default_rng(4), options,
    )  # fmt: skip
    assert result.reason == ""
    found = result.particles.starts[1]
    np.testing.assert_array_equal(result.particles.starts[0], np.repeat(true[0][:, None], 200, axis=1))
    off = between(true[1], found.T)
    squared = off.mean(axis=0) @ np.linalg.solve(np.cov(off.T), off.mean(axis=0))
    assert squared < 11.34  # 99 % of 3 degrees of freedom


def test_robots_are_renumbered_with_all_that_is_theirs():
    """Exchanged twice, a graph is as before; once, each robot has the other's keys."""
    graph = graph_of(small_run(2))
    order = np.array([1, 0])
    other = graph.reordered(order)
    np.testing.assert_array_equal(other.poses[other.robots == 0], graph.poses[graph.robots == 1])
    assert other.tips.tolist() == graph.tips[::-1].tolist()
    np.testing.assert_array_equal(other.reordered(order).robots, graph.robots)


def test_a_graph_cannot_be_written():
    """Snapshots share graphs, so that their arrays refuse to change."""
    with pytest.raises(ValueError, match="read-only"):
        graph_of(small_run()).poses[0] = 0.0
