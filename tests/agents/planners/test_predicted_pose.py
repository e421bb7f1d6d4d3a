"""Predicted pose covariances: laws of the prediction, and the choices made with it."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from agents.planners.common.predicted_pose import _information, _poses_along, d_optimality, predict_covariances
from slam_backend.core.validation import FloatArray
from slam_backend.maps.landmark_map import LandmarkMap
from tests.agents.test_policies import ROOM
from vslam_env import CandidateKind, vslam_v0
from vslam_env.belief.team_belief import Belief
from vslam_env.navigation import OccupancyGrid, distance_map


def _belief(landmarks: list[tuple[float, float]], goal: tuple[float, float]) -> Belief:
    """Return a belief on free floor with one candidate, its heading along x, and a pose known to 1 mm."""
    env = vslam_v0.parallel_env(world=ROOM, num_robots=1, num_particles=5, action_type="goal", max_cycles=5)
    env.reset(seed=0)
    given = env.belief("robot_0")
    grid = OccupancyGrid()
    grid.clear_disc([0.0, 0.0, 0.0], 9.0)
    slots = given.candidates
    names = "goals", "headings", "lengths", "valid", "kinds"
    values: dict[str, Any] = {name: getattr(slots, name).copy() for name in names}
    values["goals"][0], values["headings"][0], values["lengths"][0], values["valid"][0] = goal, 0.0, 5.0, True
    values["kinds"][0] = CandidateKind.FRONTIER
    points = np.array([(*point, 0.0) for point in landmarks]).reshape(-1, 3)
    held = LandmarkMap(points, np.tile(1e-6 * np.eye(3), (len(points), 1, 1)), np.eye(len(points), 4, dtype=np.float32))
    changes = {
        "pose": np.zeros(3), "covariance": 1e-6 * np.eye(3), "grid": grid.read_only_view(), "group_map": held,
        "start_from_group": np.zeros(3), "candidates": dataclasses.replace(slots, **values),
    }  # fmt: skip
    return Belief(**{name: getattr(given, name) for name in given.__dataclass_fields__} | changes)


def _predict(landmarks: list[tuple[float, float]], goal: tuple[float, float]) -> FloatArray:
    (found,) = predict_covariances(_belief(landmarks, goal), np.array([0]))
    return found


def test_paths_do_not_influence_each_other() -> None:
    """Several candidates predicted together have the covariances of each one predicted alone."""
    env = vslam_v0.parallel_env(world=ROOM, num_robots=1, num_particles=5, action_type="goal", max_cycles=9)
    env.reset(seed=0)
    for _ in range(6):
        valid = env.belief("robot_0").candidates.valid
        env.step({"robot_0": 1 + int(valid.argmax()) if valid.any() else 0})
    belief = env.belief("robot_0")
    slots = np.flatnonzero(belief.candidates.valid)
    assert len(slots) > 1
    for slot, together in zip(slots, predict_covariances(belief, slots), strict=True):
        (alone,) = predict_covariances(belief, np.array([slot]))
        np.testing.assert_allclose(together, alone, rtol=1e-9)


def test_uncertainty_grows_without_landmarks() -> None:
    """Without landmarks the D-optimality grows along the path, and more on a longer one."""
    short, long = (d_optimality(_predict([], (x, 0.0))) for x in (2.0, 6.0))
    assert (np.diff(long[:-1]) > 0.0).all()  # the last pose differs in its heading only
    assert long[-1] > short[-1]


def test_landmarks_in_view_reduce_uncertainty() -> None:
    """A landmark ahead reduces the covariance of all that was predicted; one behind the robot changes nothing."""
    plain, ahead, behind = (_predict(points, (4.0, 0.0)) for points in ([], [(6.0, 0.5), (6.0, -0.7)], [(-3.0, 0.0)]))
    np.testing.assert_allclose(behind, plain, rtol=1e-9)
    for better, worse in zip(ahead, plain, strict=True):
        assert np.linalg.eigvalsh(worse - better).min() > -1e-9
    assert d_optimality(ahead[-1]) < 0.5 * d_optimality(plain[-1])


def test_the_information_of_a_landmark_agrees_with_finite_differences() -> None:
    """The information is that of the measured offset in the robot's frame, with a Jacobian by differences."""
    point = np.array([3.0, 1.0])
    belief = _belief([(3.0, 1.0)], (4.0, 0.0))
    ways = distance_map(belief.grid.cells, [0.0, 0.0])
    pose = np.array([0.7, -0.2, 0.3])

    def measured(at: np.ndarray) -> np.ndarray:
        c, s = np.cos(at[2]), np.sin(at[2])
        return np.array([[c, s], [-s, c]]) @ (point - at[:2])

    jacobian = np.column_stack([(measured(pose + h) - measured(pose - h)) / 2e-6 for h in 1e-6 * np.eye(3)])
    offset = measured(pose)
    distance = np.linalg.norm(offset)
    along = np.outer(offset, offset) / distance**2
    noise = (0.01 * distance**2) ** 2 * along + (0.01 * distance) ** 2 * (np.eye(2) - along) + 1e-6 * np.eye(2)
    expected = jacobian.T @ np.linalg.solve(noise, jacobian)
    np.testing.assert_allclose(
        _information(pose[None], ways, point[None], 1e-6 * np.eye(2)[None])[0], expected, rtol=1e-5, atol=1e-6
    )


def test_poses_follow_the_path() -> None:
    """Poses lie on the path, at most 1.5 m apart, head along it, and end at the goal with its heading."""
    poses = _poses_along(np.array([[0.0, 0.0], [2.5, 0.0], [2.5, 1.2]]), 2.0)
    assert poses[-1].tolist() == pytest.approx([2.5, 1.2, 2.0])
    assert poses[0, 2] == 0.0
    assert np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1).max() <= 1.5 + 1e-9


def test_d_optimality_is_the_side_of_a_cube_of_the_same_volume() -> None:
    """For a diagonal covariance it is the geometric mean of the variances."""
    assert d_optimality(np.diag([1.0, 2.0, 4.0])) == pytest.approx(2.0)
