import numpy as np
from python_entry import python_entry

from slam_backend.core.packed_symmetric import UNPACK
from slam_backend.fastslam._kernels import LANES
from slam_backend.fastslam._kernels.relative_poses import AT_ORIGIN, KNOWN, SPREAD, see_from_starts, stand, start_kind
from slam_backend.fastslam.estimates import pose_mixtures
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.relative_poses import Standpoints
from slam_backend.geometry import between, compose, inverse, rotate_covariances, rotation, wrap_angle
from slam_backend.models.measurements import Measurements

see_from_starts, start_kind = map(python_entry, (see_from_starts, start_kind))

STARTS = np.array([[1.0, -2.0, 0.7], [4.0, 3.0, -2.0]])


def _moved(seed: int) -> FastSlam:
    """Return a filter of two robots that have driven a little, seeing two landmarks."""
    slam = FastSlam(num_robots=2, num_particles=13, seed=seed, initial_poses=STARTS)
    frame = Measurements([[0.2, 0.1, 3.0], [-0.5, 0.0, 2.0]], np.eye(2))
    for _ in range(5):
        slam.step([[0.1, 0.0, 0.05], [0.08, 0.0, -0.1]], [frame, None])
    return slam


def test_known_starts() -> None:
    """Where a start is known, the pose in the start frame is the pose in the map frame, moved."""
    slam = _moved(1)
    for robot in range(2):
        own, pose = slam.pose_from_start(robot), slam.pose(robot)
        assert np.allclose(compose(STARTS[robot], own.mean), pose.mean)
        assert np.isclose(np.trace(own.covariance), np.trace(pose.covariance))
        assert np.allclose(compose(STARTS[robot], slam.particles_from_start(robot)), slam.particles(robot)[0])


def test_starts_are_told_apart() -> None:
    """All at the origin, all at one place, or spread: surplus lanes do not count."""
    starts = np.zeros((3, 8))
    starts[:, 5:] = 9.0
    assert start_kind(starts, 5) == AT_ORIGIN
    starts[1, :5] = 4.0
    assert start_kind(starts, 5) == KNOWN
    starts[2, 4] = 1e-9
    assert start_kind(starts, 5) == SPREAD


def test_unknown_starts_do_not_blur_the_pose() -> None:
    """Moving robot and start of each particle alike, as a merge does, leaves the pose in the start frame as it was."""
    slam = _moved(2)
    before, particles = slam.pose_from_start(1), slam.particles_from_start(1)
    state = slam.get_state()
    motions = np.random.default_rng(5).normal(0.0, 0.5, (13, 3))
    for name in ("starts", "poses", "means"):  # (K, 3, P), P >= M
        state[name][1, :, :13] = compose(motions, state[name][1, :, :13].T).T
    turn = np.tile(np.eye(3), (13, 1, 1))
    turn[:, :2, :2] = np.array([[[np.cos(t), -np.sin(t)], [np.sin(t), np.cos(t)]] for t in motions[:, 2]])
    covariances = state["covariances"][1, :, :13].T[:, UNPACK]
    state["covariances"][1, :, :13] = (turn @ covariances @ turn.transpose(0, 2, 1))[:, *np.triu_indices(3)].T
    slam.set_state(state)
    after = slam.pose_from_start(1)
    assert np.allclose(between(before.mean, after.mean), 0.0, atol=1e-3)  # resampling noise of the estimate before
    assert np.allclose(after.covariance, before.covariance, atol=1e-3)
    difference = slam.particles_from_start(1) - particles
    difference[:, 2] = wrap_angle(difference[:, 2])
    assert np.allclose(difference, 0.0, atol=1e-12)


def test_the_change_of_frame_is_that_of_matrices() -> None:
    """Each particle's mean and covariance, seen from its start, are what rotation matrices make of them."""
    rng = np.random.default_rng(7)
    starts, means = rng.uniform(-3.0, 3.0, (2, 3, 11))
    roots = rng.normal(0.0, 0.3, (11, 3, 3))
    covariances = roots @ roots.transpose(0, 2, 1)
    packed = covariances[:, *np.triu_indices(3)].T
    seen, spread = np.zeros((3, 11)), np.zeros((6, 11))
    see_from_starts(starts, means, np.ascontiguousarray(packed), 9, seen, spread)
    for m in range(9):
        np.testing.assert_allclose(seen[:, m], between(starts[:, m], means[:, m]), atol=1e-12)
        turn = np.eye(3)
        turn[:2, :2] = rotation(-starts[2, m])
        np.testing.assert_allclose(spread[UNPACK, m], turn @ covariances[m] @ turn.T, atol=1e-12)
    assert not seen[:, 9:].any()
    assert not spread[:, 9:].any()


def test_own_frames_are_the_plain_definition() -> None:
    """Of robots that start at the origin, at a known place and at an unknown one; surplus lanes do not count.

    The team calls them 3, 0 and 2; robot 1 goes by another filter, and so does one that this filter knows as 4.
    """
    rng = np.random.default_rng(8)
    count, best = 9, 4
    starts, means = rng.uniform(-3.0, 3.0, (2, 3, 3, LANES))
    starts[0, :, :count], starts[1, :, :count] = 0.0, STARTS[1][:, None]
    roots = rng.normal(0.0, 0.3, (3, LANES, 3, 3))
    matrices = roots @ roots.transpose(0, 1, 3, 2)
    covariances = np.ascontiguousarray(matrices[:, :, *np.triu_indices(3)].transpose(0, 2, 1))
    weights = rng.dirichlet(np.ones(count))
    of_four = [np.concatenate([rows, rows[:1]]) for rows in (starts, means, covariances)]
    estimates = pose_mixtures(*of_four[1:], weights)
    robots = np.concatenate([rows.reshape(-1, 4, 3, LANES) for rows in (np.zeros((4, 3, LANES)), *of_four)])
    names, live = np.array([3, 0, 2, 4]), np.array([1, 1, 1, 0])
    points = Standpoints(5)
    points.poses.fill(7.0)
    points.beliefs.fill(7.0)
    stand(robots, weights, best, False, *estimates, np.array([names, live]), 0.5, points.poses, points.beliefs)

    for field in (points.poses, points.beliefs):
        assert (field[[1, 4]] == 7.0).all()
    poses, spreads, frames = points.own[names], points.covariances[names], points.starts[names[:3]]
    np.testing.assert_allclose(frames, inverse(starts[:, :, best]), atol=1e-15)
    np.testing.assert_array_equal(poses[0], estimates.means[0])
    np.testing.assert_array_equal(spreads[0], estimates.covariances[0])
    np.testing.assert_allclose(poses[1], between(STARTS[1], estimates.means[1]), atol=1e-12)
    np.testing.assert_allclose(spreads[1], rotate_covariances(-STARTS[1, 2], estimates.covariances[1]), atol=1e-12)
    np.testing.assert_array_equal(points.ess[names[:3]], 0.5)
    for i, viewer in enumerate(names[:3]):
        for j, mate in enumerate(names):
            pose, spread = (
                (poses[i], spreads[i]) if i == j else (compose(frames[i], estimates.means[j]), estimates.covariances[j])
            )
            np.testing.assert_allclose(points.poses[viewer, mate], pose, atol=1e-12)
            np.testing.assert_allclose(points.sigmas[viewer, mate], np.sqrt(np.trace(spread[:2, :2]) / 2.0), atol=1e-12)
        assert np.isnan(points.poses[viewer, 1]).all()
        assert np.isnan(points.sigmas[viewer, 1])
    seen = between(starts[2].T, means[2].T)[:count]
    turned = np.array([rotate_covariances(-starts[2, 2, m], matrices[2, m]) for m in range(count)])
    mean = np.append(weights @ seen[:, :2], np.angle(weights @ np.exp(1j * seen[:, 2])))
    off = seen - mean
    off[:, 2] = wrap_angle(off[:, 2])
    np.testing.assert_allclose(poses[2], mean, atol=1e-12)
    covariance = np.einsum("m,mij->ij", weights, turned) + (weights * off.T) @ off
    np.testing.assert_allclose(spreads[2], covariance, atol=1e-12)
