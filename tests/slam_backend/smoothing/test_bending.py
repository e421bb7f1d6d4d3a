"""Bent paths: exact where motions are Gaussian, of unchanged volume, and taken where headings are uncertain."""

from typing import Any

import numpy as np
import pytest
from small_problems import TIGHT, camera_of, graph_of, small_run

from slam_backend.core.validation import FloatArray
from slam_backend.fastslam.run_log import RobotLog
from slam_backend.geometry import between, compose
from slam_backend.models.odometry import OdometryModel
from slam_backend.smoother.graph import PathGraph
from slam_backend.smoother.graph_building import extended
from slam_backend.smoother.optimizer import find_mode
from slam_backend.smoother.sampling import _weighed, bend, draw_paths

PREVIOUS = np.array([2, 0, 4, -1, 3, 0])  # a tree whose keys do not lie in the order of its branches
CAMERA = np.array([320.0, 0.12, 0.2, 0.1, 0.0, 0.0, 0.0])


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
    paths = bend(mode, PREVIOUS, offsets)
    for i in range(5):
        off = paths[:, :, i] - reference(mode, offsets[:, :, i])
        np.testing.assert_allclose(off[:, :2], 0.0, atol=1e-6)
        np.testing.assert_allclose(np.sin(0.5 * off[:, 2]), 0.0, atol=1e-6)
    still = bend(mode, PREVIOUS, np.zeros((6, 3, 1)))[:, :, 0]
    np.testing.assert_allclose(still, mode, atol=1e-12)


def test_volumes_stay_as_they_are():
    """The determinant of the derivative of paths by offsets is 1, so that log q is that of the Gaussian."""
    mode, offsets = tree(0.4)
    sought = [key for key in range(6) if key != 3]
    columns = []
    for key in sought:
        for c in range(3):
            nudged = np.repeat(offsets[:, :, :1], 2, axis=2)
            nudged[key, c] += [1e-5, -1e-5]
            paths = bend(mode, PREVIOUS, nudged)[sought]
            columns.append(((paths[:, :, 0] - paths[:, :, 1]) / 2e-5).reshape(-1))
    assert np.linalg.det(np.array(columns).T) == pytest.approx(1.0, abs=1e-6)


def test_small_offsets_are_taken_as_they_are():
    """Straight and bent paths differ to second order only."""
    mode, offsets = tree(1e-4)
    np.testing.assert_allclose(bend(mode, PREVIOUS, offsets), mode[:, :, None] + offsets, atol=1e-6)


def wandering(turn: float) -> tuple[PathGraph, Any]:
    """Return a robot that sees a new landmark at each of 25 steps, so that odometry alone knows its path; the mode."""
    motion = OdometryModel(
        sigma_along=0.05, sigma_across=0.02, sigma_heading=0.0, sigma_turn=0.0, floor_position=0.01, floor_heading=turn
    )
    log = RobotLog()
    for step in range(25):
        move = np.array([1.0, 0.0, 0.05]) if step else None
        log.append(step, move, points=np.array([[3.0, 0.5, 0.1]]), ids=np.array([step]))
    graph = extended(PathGraph.at_starts(np.zeros((1, 3))), [log.arrays()], motion, np.zeros(3))
    return graph, find_mode(graph, CAMERA, TIGHT)


def test_where_only_odometry_knows_the_path_bent_paths_are_drawn_from_the_posterior_itself():
    """Headings uncertain by half a radian in the end: straight paths are nearly all refused, bent ones weigh alike."""
    graph, mode = wandering(turn=0.1)
    poses, log_proposals = mode.paths(200, np.random.default_rng(1))
    assert _weighed(graph, mode, poses, log_proposals).sample_size < 20.0
    draws = draw_paths(graph, mode, 200, np.random.default_rng(1))
    assert np.ptp(draws.log_weights) < 1e-3
    assert draws.sample_size == pytest.approx(200.0, rel=1e-5)
    np.testing.assert_allclose(draws.poses[:, :, 0], mode.poses, atol=1e-12)


def test_straight_paths_stay_where_they_serve():
    """With landmarks seen again and again the Gaussian of poses is good: it is drawn from, to the bit."""
    run = small_run()
    graph = graph_of(run)
    mode = find_mode(graph, camera_of(run), TIGHT)
    draws = draw_paths(graph, mode, 60, np.random.default_rng(2))
    assert draws.sample_size > 30.0
    np.testing.assert_array_equal(draws.poses, mode.paths(60, np.random.default_rng(2))[0])
