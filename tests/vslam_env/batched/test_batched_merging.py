"""Merging of groups within one Gaussian: moves and conditioning by the formulas, and consistent teams."""

from typing import Any

import numpy as np
import pytest
from builders.batched import ASSUMED, drive, jax, jnp, run, stacked, started
from scipy.stats import chi2

from slam_backend.geometry import between, compose, inverse, wrap_angle
from slam_backend.metrics import align_se2, nees

merging = pytest.importorskip("vslam_env.batched.merging")
ROWS, MOST_PAIRS = 96, 40


def both_maps(seed: int) -> tuple[Any, Any]:
    """Return the belief of two robots that drove apart, and their readings."""
    readings = drive(seed, num_robots=2)
    return run(started(2, ROWS), readings.odometry, readings.frames, ASSUMED)[0], readings


def common(belief: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows (q, 2) of landmarks that both robots hold, padded, and which are valid."""
    true_ids, owners = np.asarray(belief.true_ids), np.asarray(belief.owners)
    held = np.asarray(belief.counts) > 0
    sides = [{int(true_ids[row]): row for row in np.flatnonzero(held & (owners == robot))} for robot in range(2)]
    pairs = [(sides[0][name], sides[1][name]) for name in sorted(sides[0].keys() & sides[1].keys())]
    padded = np.zeros((MOST_PAIRS, 2), np.int64)
    padded[: len(pairs)] = pairs
    return padded, np.arange(MOST_PAIRS) < len(pairs)


AWAY = np.array([3.0, -5.0, 2.0])


def joined(belief: Any) -> Any:
    """Return the belief after a merge of both robots, one of which has another frame, by their common landmarks."""
    pairs, valid = common(belief)
    away = merging.moved_group(belief, 1, jnp.asarray(AWAY))
    places = np.asarray(away.places, np.float64)
    motion = align_se2(places[pairs[valid, 0]], places[pairs[valid, 1]])
    near = merging.moved_group(away, 1, jnp.asarray(motion))
    return merging.fused(near, jnp.asarray(pairs), valid, merging.lever_of(near, 1, jnp.zeros(2)))._replace(
        groups=jnp.zeros(2, jnp.int32), owners=jnp.zeros(ROWS, jnp.int32)
    )


def test_a_group_that_is_moved_and_moved_back_is_as_before() -> None:
    """A motion changes the group alone, its start too, keeps its distances, and its inverse takes it back."""
    belief, _ = both_maps(1)
    motion = np.array([1.0, -2.0, 0.7])
    moved = merging.moved_group(belief, 1, jnp.asarray(motion))
    np.testing.assert_array_equal(moved.robots[0], belief.robots[0])
    expected = compose(motion, np.asarray(belief.robots[1, :3], np.float64))
    np.testing.assert_allclose(moved.robots[1, :2], expected[:2], atol=1e-5)
    assert wrap_angle(float(moved.robots[1, 2]) - expected[2]) == pytest.approx(0.0, abs=1e-5)
    np.testing.assert_allclose(moved.robots[1, 5:], motion, atol=1e-6)
    back = merging.moved_group(moved, 1, jnp.asarray(inverse(motion)))
    np.testing.assert_allclose(back.robots, belief.robots, atol=1e-5)
    np.testing.assert_allclose(back.places, belief.places, atol=1e-5)
    np.testing.assert_allclose(back.covariance, belief.covariance, atol=1e-7)


def test_levers_are_derivatives_of_the_motion() -> None:
    """They equal finite differences about the origin, and a turn about another centre is that with a shift."""
    belief, _ = both_maps(2)
    lever = np.asarray(merging.lever_of(belief, 1, jnp.zeros(2)))
    for axis in range(3):
        step = 1e-2 * np.eye(3)[axis]
        after, before = (merging.moved_group(belief, 1, jnp.asarray(sign * step)) for sign in (1.0, -1.0))
        change = np.concatenate([np.ravel(after.robots - before.robots), np.ravel(after.places - before.places)])
        np.testing.assert_allclose(lever[:, axis], change / 2e-2, atol=2e-3)
    other = np.asarray(merging.lever_of(belief, 1, jnp.array([2.0, -1.0])))
    np.testing.assert_allclose(other @ [0.0, 0.0, 1.0], lever @ [-1.0, -2.0, 1.0], atol=1e-5)


def test_a_merge_is_conditioning_on_equal_places() -> None:
    """Means are those of dense formulas in double precision with a very uncertain motion, for all but the freed rows.

    Without a motion the covariance is that of conditioning, but for what turns with headings.
    """
    belief, _ = both_maps(2)
    pairs, valid = common(belief)
    for is_moved in (True, False):
        lever = np.asarray(merging.lever_of(belief, 1, jnp.zeros(2)), np.float64) * is_moved
        mean = np.concatenate([np.ravel(belief.robots), np.ravel(belief.places)]).astype(np.float64)
        covariance = np.asarray(belief.covariance, np.float64) + 1e4 * lever @ lever.T
        jacobian = np.zeros((2 * valid.sum(), len(mean)))
        for i, (kept, other) in enumerate(pairs[valid]):
            for axis in range(2):
                jacobian[2 * i + axis, 16 + 2 * kept + axis] = 1.0
                jacobian[2 * i + axis, 16 + 2 * other + axis] = -1.0
        innovation = jacobian @ covariance @ jacobian.T + merging.EQUAL**2 * np.eye(len(jacobian))
        gain = np.linalg.solve(innovation, jacobian @ covariance).T
        mean -= gain @ jacobian @ mean
        covariance -= gain @ jacobian @ covariance
        found = merging.fused(belief, jnp.asarray(pairs), valid, jnp.asarray(lever))
        stay = np.ones(len(mean), bool)
        stay[(16 + 2 * pairs[valid, 1][:, None] + np.arange(2)).ravel()] = False
        np.testing.assert_allclose(found.robots.ravel(), mean[:16], atol=1e-3)
        np.testing.assert_allclose(
            np.asarray(found.covariance)[np.ix_(stay, stay)], covariance[np.ix_(stay, stay)], atol=2e-4
        )
        assert not np.asarray(found.covariance)[~stay].any()
        assert (np.asarray(found.counts)[pairs[valid, 1]] == 0).all()
        total = np.asarray(belief.counts)[pairs[valid]].sum(axis=1)
        np.testing.assert_array_equal(np.asarray(found.counts)[pairs[valid, 0]], total)


def test_merged_robots_share_one_map_and_go_on() -> None:
    """After a merge each landmark is held once, both robots measure it, and errors stay small."""
    belief, readings = both_maps(3)
    merged = joined(belief)
    assert np.asarray(merged.groups).tolist() == [0, 0]
    standing = np.zeros_like(readings.odometry)
    still = jax.tree.map(lambda values: jnp.repeat(values[-1:], len(values), axis=0), readings.frames)
    after, (robots, _) = run(merged, standing, still, ASSUMED)
    true_ids, counts = np.asarray(after.true_ids), np.asarray(after.counts)
    assert len(true_ids[counts > 0]) == len(set(true_ids[counts > 0].tolist()))
    errors = np.asarray(robots)[-1, :, :2] - readings.paths[-1, :, :2]
    assert np.hypot(*errors.T).max() < 0.15


@pytest.mark.nightly
def test_merged_robots_know_how_well_they_know_each_other() -> None:
    """NEES of the pose of one robot as the other sees it is chi-square over 30 teams: nothing is counted twice."""
    drives = [drive(200 + seed, num_robots=2) for seed in range(30)]
    odometry, frames = stacked(drives)
    beliefs, _ = jax.vmap(run, (None, 0, 0, None))(started(2, ROWS), odometry, frames, ASSUMED)
    found = []
    for row, readings in enumerate(drives):
        merged = joined(jax.tree.map(lambda values, row=row: values[row], beliefs))
        poses, truth = np.asarray(merged.robots[:, :3], np.float64), readings.paths[-1]
        error = between(poses[0], poses[1]) - between(truth[0], truth[1])
        error[2] = wrap_angle(error[2])
        first, second = (np.asarray(by) for by in jax.jacfwd(seen_pose, (0, 1))(*jnp.asarray(poses)))
        among = np.asarray(merged.covariance, np.float64)
        blocks = [[among[8 * i : 8 * i + 3, 8 * j : 8 * j + 3] for j in range(2)] for i in range(2)]
        jacobian = np.hstack([first, second])
        found.append(float(nees(error[None], (jacobian @ np.block(blocks) @ jacobian.T)[None])[0]))
    assert chi2.ppf(0.0005, 90) < sum(found) < chi2.ppf(0.9995, 90)


def seen_pose(first: Any, second: Any) -> Any:
    """Return a pose (3,) in the frame of another."""
    c, s = jnp.cos(first[2]), jnp.sin(first[2])
    dx, dy = second[0] - first[0], second[1] - first[1]
    return jnp.stack([c * dx + s * dy, c * dy - s * dx, second[2] - first[2]])
