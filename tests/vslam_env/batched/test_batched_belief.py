"""The Gaussian belief of a team: the formulas of the exact models, laws of the filter, and simulated drives."""

from dataclasses import replace

import numpy as np
import pytest
from builders.batched import ASSUMED, MOST, MOTION, OPTIONS, bf, drive, jax, jnp, run, stacked, started
from scipy.stats import chi2

from slam_backend.geometry import compose, wrap_angle
from slam_backend.metrics import nees

predict, match, update = (
    jax.jit(part, static_argnames=("assumed",)) for part in (bf.predict, bf.match, bf.update)
)  # fmt: skip


def test_motion_is_that_of_the_odometry_model() -> None:
    """The motion is the reading minus the error by the biases, and its noise that of the model, in the map frame."""
    rng = np.random.default_rng(1)
    for _ in range(20):
        robot, odometry = rng.normal(size=8), rng.normal(size=3) * 0.3
        expected = compose(robot[:3], odometry - MOTION.bias_jacobians(odometry[None])[0] @ [*robot[3:5], 0.0])
        found = np.asarray(bf.moved(jnp.asarray(robot), jnp.asarray(odometry)))
        np.testing.assert_allclose(found[:2], expected[:2], atol=1e-5)
        assert wrap_angle(found[2] - expected[2]) == pytest.approx(0.0, abs=1e-5)
        variances = MOTION.variances(odometry[None])[0]
        c, s = np.cos(robot[2]), np.sin(robot[2])
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        noise = np.asarray(bf.motion_noise(robot[2], jnp.asarray(odometry), ASSUMED))
        np.testing.assert_allclose(noise[:3, :3], turn @ np.diag(variances) @ turn.T, rtol=1e-4, atol=1e-8)
    standing = jax.jacfwd(bf.moved)(jnp.zeros(8), jnp.zeros(3))
    assert np.isfinite(standing).all()


def test_sights_are_those_of_the_camera() -> None:
    """Places are where the camera sees them, and their noise is that of the stereo camera in the plane."""
    rng, camera = np.random.default_rng(2), OPTIONS.camera
    for _ in range(20):
        robot, point = rng.normal(size=8), np.array([*rng.uniform(-1.0, 1.0, 2), rng.uniform(1.0, 6.0)])
        local = camera.robot_from_camera(point)
        world = compose(robot[:3], np.array([local[0], local[1], 0.0]))
        seen = np.asarray(bf.seen_from(jnp.asarray(robot), jnp.asarray(world[:2]), ASSUMED))
        np.testing.assert_allclose(seen, [point[2], -point[0]], atol=1e-4)
        np.testing.assert_allclose(bf.place_of(jnp.asarray(robot), seen, ASSUMED), world[:2], atol=1e-4)
        assert float(bf.height_of(jnp.asarray(point), point[2], ASSUMED)) == pytest.approx(local[2], abs=1e-5)
        whole = camera.covariance(point)
        planar = np.array([[whole[2, 2], -whole[2, 0]], [-whole[0, 2], whole[0, 0]]])
        planar += bf.ROUNDING**2 * np.eye(2)
        np.testing.assert_allclose(bf.sight_noise(seen, ASSUMED), planar, rtol=1e-3, atol=1e-9)


def test_a_step_is_that_of_a_dense_kalman_filter() -> None:
    """Prediction and update of one landmark equal the textbook formulas in double precision.

    In variables in which all that a robot sees turns with its heading: those of an invariant filter.
    """
    readings = drive(3)
    belief, _ = run(started(), readings.odometry, readings.frames, ASSUMED)
    odometry, frames = np.full((1, 3), 1e-3), jax.tree.map(lambda v: v[-1], readings.frames)
    predicted = predict(belief, jnp.asarray(odometry), assumed=ASSUMED)
    mean = np.concatenate([np.ravel(belief.robots), np.ravel(belief.places)]).astype(np.float64)
    covariance = np.asarray(belief.covariance, np.float64)
    motion = np.eye(len(mean))
    motion[:8, :8] = jax.jacfwd(bf.moved)(belief.robots[0], jnp.asarray(odometry[0]))
    expected = motion @ covariance @ motion.T
    expected[:8, :8] += np.asarray(bf.motion_noise(belief.robots[0, 2], jnp.asarray(odometry[0]), ASSUMED))
    np.testing.assert_allclose(predicted.covariance, expected, atol=1e-7)
    frame = jax.tree.map(lambda v: v[0], frames)
    rows = np.array(match(predicted, jnp.asarray(0), frame, assumed=ASSUMED).rows)
    matched = int(np.flatnonzero(rows < 64)[0])
    alone = np.where(np.arange(MOST) == matched, rows, 64)[None]
    updated = update(predicted, frames, jnp.asarray(alone), assumed=ASSUMED)
    mean[:8], place = np.asarray(predicted.robots[0]), predicted.places[rows[matched]]
    by_pose, by_place = jax.jacfwd(bf.seen_from, (0, 1))(predicted.robots[0], place, ASSUMED)
    jacobian = np.zeros((2, len(mean)))
    column = 8 + 2 * rows[matched]
    jacobian[:, :8], jacobian[:, column : column + 2] = by_pose, by_place
    seen = bf.seen_from(predicted.robots[0], place, ASSUMED)
    innovation = jacobian @ expected @ jacobian.T + np.asarray(bf.sight_noise(seen, ASSUMED))
    gain = expected @ jacobian.T @ np.linalg.inv(innovation)
    point = frame.points[matched]
    change = gain @ (np.array([point[2], -point[0]]) - np.asarray(seen))
    np.testing.assert_allclose(updated.robots.ravel(), (mean + change)[:8], atol=1e-5)
    np.testing.assert_allclose(updated.places.ravel(), (mean + change)[8:], atol=1e-5)
    before, after = turning(mean), turning(mean + change)
    conditioned = expected - gain @ innovation @ gain.T
    carried = after @ np.linalg.solve(before, np.linalg.solve(before, conditioned).T) @ after.T
    np.testing.assert_allclose(updated.covariance, carried, atol=1e-7)


def turning(mean: np.ndarray) -> np.ndarray:
    """Return the derivatives of one robot's variables by those of an invariant filter: all turn about the origin."""
    by = np.eye(len(mean))
    places = mean[8:].reshape(-1, 2)
    by[:2, 2] = -mean[1], mean[0]
    by[8:, 2] = np.column_stack([-places[:, 1], places[:, 0]]).ravel()
    return by


def test_robots_find_their_way_and_each_landmark_once() -> None:
    """Two robots come back to their landmarks; their parts are independent, and covariances symmetric and positive."""
    readings = drive(4, num_robots=2)
    belief, (robots, _) = run(started(2, 96), readings.odometry, readings.frames, ASSUMED)
    errors = np.hypot(*np.moveaxis(np.asarray(robots)[..., :2] - readings.paths[..., :2], -1, 0))
    assert errors.max() < 0.15
    counts, true_ids, owners = (np.asarray(part) for part in (belief.counts, belief.true_ids, belief.owners))
    for robot in range(2):
        held = true_ids[(counts > 0) & (owners == robot)]
        assert len(held) == len(set(held.tolist())) > 30
    covariance = np.asarray(belief.covariance)
    np.testing.assert_array_equal(covariance, covariance.T)
    assert np.linalg.eigvalsh(covariance.astype(np.float64)).min() > -1e-6
    assert not covariance[:8, 8:16].any()
    of_second = 16 + 2 * np.flatnonzero((counts > 0) & (owners == 1))
    assert not covariance[:8, of_second].any()


def test_errors_agree_with_the_covariance() -> None:
    """NEES of the pose at the end is chi-square: its sum over 40 runs lies within 99.9 % bounds."""
    drives = [drive(100 + seed) for seed in range(40)]
    odometry, frames = stacked(drives)
    _, (robots, covariances) = jax.vmap(run, (None, 0, 0, None))(started(), odometry, frames, ASSUMED)
    errors = np.asarray(robots)[:, -1, 0, :3] - np.array([each.paths[-1, 0] for each in drives])
    errors[:, 2] = wrap_angle(errors[:, 2])
    found = nees(errors, np.asarray(covariances, np.float64)[:, -1, :3, :3])
    assert chi2.ppf(0.0005, 120) < sum(found) < chi2.ppf(0.9995, 120)


def test_padding_and_batches_change_nothing() -> None:
    """Frames with more room give the same belief, and a batch gives for each run what it gives alone."""
    narrow, wide = drive(5), drive(5, most=MOST + 3)
    one, more = (run(started(), each.odometry, each.frames, ASSUMED)[0] for each in (narrow, wide))
    np.testing.assert_allclose(one.robots, more.robots, atol=1e-5)
    np.testing.assert_array_equal(one.counts, more.counts)
    odometry, frames = stacked([drive(5), drive(6)])
    both = jax.vmap(run, (None, 0, 0, None))(started(), odometry, frames, ASSUMED)[0]
    np.testing.assert_allclose(both.robots[0], one.robots, atol=1e-4)
    np.testing.assert_array_equal(both.counts[0], one.counts)


def test_empty_frames_and_full_tables_leave_numbers() -> None:
    """Without measurements the belief is dead reckoning; without free rows landmarks are left out."""
    readings = drive(7)
    blind = readings.frames._replace(valid=jnp.zeros_like(readings.frames.valid))
    belief, (robots, _) = run(started(), readings.odometry, blind, ASSUMED)
    path = np.zeros(3)
    for move in readings.odometry[:, 0]:
        path = compose(path, move)
    np.testing.assert_allclose(np.asarray(robots)[-1, 0, :2], path[:2], atol=1e-3)
    assert not np.asarray(belief.counts).any()
    full, _ = run(started(rows=6), readings.odometry, readings.frames, ASSUMED)
    assert (np.asarray(full.counts) > 0).all()
    assert all(np.isfinite(part).all() for part in jax.tree.leaves(full))


def test_what_is_assumed_is_that_of_the_options() -> None:
    """Each field comes from the camera, the odometry, or the gates."""
    changed = replace(OPTIONS, position_gate=9.0, motion=replace(MOTION, sigma_turn=0.07))
    found = bf.Assumed.of(changed)
    assert (found.focal, found.mount) == (OPTIONS.camera.focal_px, (0.1, -0.05, 0.4))
    assert (found.position_gate, found.sigma_turn) == (9.0, 0.07)
