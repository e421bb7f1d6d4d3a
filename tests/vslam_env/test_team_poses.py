"""What robots know of each other's poses, against plain compositions."""

import numpy as np

from slam_backend.errors import FloatArray
from slam_backend.geometry import compose
from slam_backend.reports import PoseEstimate
from slam_backend.team_knowledge import Standpoint
from vslam_env.team_poses import TeamPoses, position_sigmas


def _spread(rng: np.random.Generator) -> FloatArray:
    """Draw a covariance."""
    root = rng.normal(0.0, 0.2, (3, 3))
    return np.asarray(root @ root.T)


def _estimate(rng: np.random.Generator) -> PoseEstimate:
    """Draw a pose anywhere."""
    return PoseEstimate(rng.uniform(-3.0, 3.0, 3), _spread(rng))


def _points(rng: np.random.Generator) -> list[Standpoint]:
    """Draw where four robots stand: 0, 1 and 3 have merged, 1 has lost contact and goes by a fork, 2 is alone."""
    joint, fork, alone = ([_estimate(rng) for _ in range(count)] for count in (3, 3, 1))
    filters = {
        0: ((0, 1, 3), (0, 3), 5, joint),
        1: ((0, 1, 3), (1,), 6, fork),
        2: ((2,), (2,), 2, alone),
        3: ((0, 1, 3), (0, 3), 5, joint),
    }
    return [Standpoint(*of, _estimate(rng), rng.uniform(-3.0, 3.0, 3), 0.7) for of in filters.values()]


def test_each_robot_sees_the_others_from_its_own_start() -> None:
    """All whom a robot's filter knows are seen by that filter, moved from the map frame to the own start frame."""
    rng = np.random.default_rng(100)
    for _ in range(20):
        points = _points(rng)
        seen = TeamPoses(points)
        for robot, point in enumerate(points):
            known = {
                mate: (compose(point.start_from_group, estimate.mean), estimate.covariance)
                for mate, estimate in zip(point.members, point.poses, strict=True)
                if mate != robot
            }
            others = seen.others[robot]
            assert others.robots.tolist() == list(known)
            for pose, sigma, (expected, spread) in zip(others.poses, others.sigmas, known.values(), strict=True):
                np.testing.assert_array_equal(pose, expected)
                np.testing.assert_allclose(sigma, np.sqrt(np.trace(spread[:2, :2]) / 2.0))


def test_mates_are_those_of_the_same_filter() -> None:
    """The poses of whoever goes by the same filter, itself as in its own start frame, in the order of `mates`."""
    points = _points(np.random.default_rng(101))
    seen = TeamPoses(points)
    assert seen.mates == [(0, 3), (1,), (2,), (0, 3)]
    for robot, point in enumerate(points):
        own = point.own_pose
        np.testing.assert_array_equal(seen.own[robot], own.mean)
        np.testing.assert_array_equal(seen.covariances[robot], own.covariance)
        np.testing.assert_array_equal(seen.starts[robot], point.start_from_group)
        assert seen.mate_poses[robot].shape == (len(point.mates), 3)
        np.testing.assert_array_equal(seen.mate_poses[robot][point.mates.index(robot)], own.mean)
    joint, robots = points[0].poses, points[0].members
    for robot, mate in ((0, 3), (3, 0)):
        expected = compose(points[robot].start_from_group, joint[robots.index(mate)].mean)
        np.testing.assert_array_equal(seen.mate_poses[robot][points[robot].mates.index(mate)], expected)


def test_a_sigma_is_the_root_of_the_mean_variance() -> None:
    """Headings do not count, nor do correlations."""
    covariances = np.array([np.diag([0.01, 0.09, 7.0]), np.ones((3, 3))])
    np.testing.assert_allclose(position_sigmas(covariances), [np.sqrt(0.05), 1.0])
