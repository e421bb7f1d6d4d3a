"""`vslam replay graph`: pose graphs as logs."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_logs import small_graph

from slam_backend.geometry import between, compose, inverse
from slam_backend.models.odometry import OdometryModel
from slam_backend.pose_graph import Factors, PoseGraph
from slam_backend.readers.pose_graphs import write_graph
from training.replay.graphs import fitted_noise, read_graph_log


def joined(*parts: Factors) -> Factors:
    """Return all measurements of several parts."""
    return Factors(*map(np.concatenate, zip(*parts, strict=True)))


def changed(graph: PoseGraph, **parts: Any) -> PoseGraph:
    """Return a graph with some fields replaced."""
    return PoseGraph(**{name: getattr(graph, name) for name in graph.__slots__} | parts)


@pytest.mark.parametrize("suffix", ["g2o", "pyfg"])
@pytest.mark.parametrize("robots", [1, 2])
def test_log_has_the_motions_and_points_of_the_graph(suffix: str, robots: int, tmp_path: Path) -> None:
    """Odometry are the motions of successive poses, measurements the points in the camera's frame, with identities."""
    graph, true = small_graph(robots)
    write_graph(true, tmp_path / f"true.{suffix}")
    log = read_graph_log(write_graph(graph, tmp_path / f"a.{suffix}"), truth=str(tmp_path / f"true.{suffix}"))
    assert len(log.robots) == robots
    assert log.notes == ()
    assert np.array_equal(log.landmarks, true.landmarks)
    for number, robot in enumerate(log.robots):
        first = 40 * number
        assert np.array_equal(robot.odometry[1:], graph.motions.values[39 * number : 39 * number + 39])
        assert np.array_equal(robot.truth.poses, true.poses[first : first + 40])
        for step, (frame, rows) in enumerate(zip(robot.measurements, robot.identities, strict=True)):
            own = graph.sightings.rows[:, 0] == first + step
            assert np.array_equal(rows, graph.sightings.rows[own, 1])
            points = np.zeros((0, 3)) if frame is None else frame.points
            assert np.allclose(points[:, [2, 0]] * [1.0, -1.0], graph.sightings.values[own], atol=1e-15)


def test_estimates_of_vertices_are_not_truth(tmp_path: Path) -> None:
    """Without `truth` a log has neither true paths nor landmarks, whatever its vertices say."""
    log = read_graph_log(write_graph(small_graph()[1], tmp_path / "a.g2o"))
    assert log.landmarks is None
    assert log.robots[0].truth is None


def test_stamps_of_one_robot_are_times(tmp_path: Path) -> None:
    """Times are stamps that increase, else step numbers."""
    graph, _ = small_graph()
    for stamps, times in ((5.0 + 0.5 * np.arange(40), 5.0 + 0.5 * np.arange(40)), (np.zeros(40), np.arange(40.0))):
        log = read_graph_log(write_graph(changed(graph, times=stamps), tmp_path / "a.pyfg"))
        assert np.array_equal(log.times, times)


def test_motions_backwards_are_turned(tmp_path: Path) -> None:
    """Edges from later to earlier poses give the same log as edges forwards, their noise included."""
    graph, _ = small_graph()
    values, covariances = [], []
    for value, covariance in zip(graph.motions.values, graph.motions.covariances, strict=True):
        back, jacobian = inverse(value), np.empty((3, 3))
        for axis in range(3):  # error e of value x e, as an error of its inverse in axes of the inverse's second pose
            step = np.zeros(3)
            step[axis] = 1e-7
            jacobian[:, axis] = between(back, inverse(compose(value, step))) / 1e-7
        values.append(back)
        covariances.append(jacobian @ covariance @ jacobian.T)
    turned = Factors(graph.motions.rows[:, ::-1], np.array(values), np.array(covariances))
    logs = [
        read_graph_log(write_graph(changed(graph, motions=motions), tmp_path / "a.g2o"))
        for motions in (graph.motions, turned)
    ]
    np.testing.assert_allclose(logs[0].robots[0].odometry, logs[1].robots[0].odometry, atol=1e-12)
    for name in OdometryModel.__slots__:
        expected = getattr(logs[0].options["motion"], name)
        assert getattr(logs[1].options["motion"], name) == pytest.approx(expected, abs=1e-5)


def test_noise_of_a_model_is_found_again() -> None:
    """The fit to covariances that a model gives returns the model."""
    model = OdometryModel(
        sigma_along=0.08,
        sigma_across=0.03,
        sigma_heading=0.05,
        sigma_turn=0.1,
        floor_position=0.004,
        floor_heading=0.006,
    )
    odometry = np.random.default_rng(3).uniform([0.0, -0.1, -0.4], [0.5, 0.1, 0.4], (23, 3))
    covariances = np.array([np.diag(row) for row in model.variances(odometry)])
    fitted = fitted_noise(odometry, covariances)
    for name in OdometryModel.__slots__:
        assert getattr(fitted, name) == pytest.approx(getattr(model, name), abs=1e-6)


def test_what_is_not_used_is_counted(tmp_path: Path) -> None:
    """Notes count motions that close loops, repeated sightings and priors; the rest of the log is the same."""
    graph, _ = small_graph()
    loop = Factors(np.array([[0, 31], [5, 17]]), np.zeros((2, 3)), np.tile(np.eye(3), (2, 1, 1)))
    again = Factors(graph.sightings.rows[:1], np.ones((1, 2)), np.eye(2)[None])
    prior = Factors(np.array([0]), np.zeros((1, 3)), np.eye(3)[None])
    more = changed(
        graph, motions=joined(graph.motions, loop), sightings=joined(graph.sightings, again), pose_priors=prior
    )
    log, plain = (read_graph_log(write_graph(each, tmp_path / "a.pyfg")) for each in (more, graph))
    assert log.notes == (
        "Not used: 2 of the EDGE_SE2 close loops, link robots or repeat others: "
        "the filter takes odometry and landmarks.",
        "Not used: 1 further sightings of a landmark from the same pose.",
        "Not used: 1 priors: maps begin at the first pose.",
    )
    assert np.array_equal(log.robots[0].odometry, plain.robots[0].odometry)
    assert [frame and frame.points.tolist() for frame in log.robots[0].measurements] == [
        frame and frame.points.tolist() for frame in plain.robots[0].measurements
    ]


def test_graphs_that_cannot_be_replayed_are_refused(tmp_path: Path) -> None:
    """A graph without sightings, gaps in the odometry and a truth without a vertex are refused with a cure."""
    graph, true = small_graph()
    write_graph(changed(graph, sightings=Factors.none(2)), tmp_path / "a.g2o")
    with pytest.raises(
        ValueError, match=r"path: expected a graph with sightings of landmarks, got a graph without any\."
    ):
        read_graph_log(tmp_path / "a.g2o")
    gap = Factors(*(np.delete(column, 6, axis=0) for column in graph.motions))
    write_graph(changed(graph, motions=gap), tmp_path / "b.pyfg")
    with pytest.raises(ValueError, match="path: expected an odometry edge between A6 and A7, successive poses, got no"):
        read_graph_log(tmp_path / "b.pyfg")
    longer, _ = small_graph(steps=60)
    torn = changed(longer, motions=Factors(*(column[1::2] for column in longer.motions)))
    write_graph(torn, tmp_path / "torn.g2o")
    with pytest.raises(ValueError, match="path: expected a graph of at most 25 robots, got 31"):
        read_graph_log(tmp_path / "torn.g2o")
    few = PoseGraph(poses=true.poses, landmarks=true.landmarks[:5], landmark_ids=true.landmark_ids[:5])
    write_graph(graph, tmp_path / "c.pyfg")
    write_graph(few, tmp_path / "few.pyfg")
    with pytest.raises(
        ValueError, match=r"truth: expected the landmark L8 of the graph, got no such vertex\. Add it to "
    ):
        read_graph_log(tmp_path / "c.pyfg", truth=str(tmp_path / "few.pyfg"))


@pytest.mark.slow
@pytest.mark.parametrize("robots", [1, 2])
def test_command_maps_the_graph(robots: int, vslam: Any, tmp_path: Path) -> None:
    """The command replays a graph beside its truth: path and map are found to centimetres."""
    graph, true = small_graph(robots, steps=60)
    write_graph(graph, tmp_path / "a.pyfg")
    write_graph(true, tmp_path / "true.pyfg")
    said = vslam(
        "replay", "graph", "--path", str(tmp_path / "a.pyfg"), "--truth", str(tmp_path / "true.pyfg"), "--out",
        str(tmp_path / "run"),
    )  # fmt: skip
    assert said.status == 0, said.err
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert len(metrics["robots"]) == robots
    assert all(row["ate_aligned_m"] < 0.1 for row in metrics["robots"])
