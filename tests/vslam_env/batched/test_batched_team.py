"""Attempts to merge in arrays of fixed shape, and the errors of the maps."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from builders.batched import ASSUMED, drive, jax, jnp, run, started

from slam_backend.geometry import transform_points
from slam_backend.maps.alignment_types import AlignmentOptions
from slam_backend.metrics import map_error, map_rmse

alignment = pytest.importorskip("vslam_env.batched.alignment")
merging = pytest.importorskip("vslam_env.batched.merging")
scoring = pytest.importorskip("vslam_env.batched.scoring")
team = pytest.importorskip("vslam_env.batched.team")
OPTIONS, ROWS, AWAY = AlignmentOptions(), 96, np.array([3.0, -5.0, 2.0])
attempt = jax.jit(partial(team.merged, in_contact=jnp.array(True), assumed=ASSUMED, options=OPTIONS, min_sigmas=5.0))


def apart(seed: int) -> Any:
    """Return the belief of two robots, one of which has a frame of its own."""
    readings = drive(seed, num_robots=2)
    belief = run(started(2, ROWS), readings.odometry, readings.frames, ASSUMED)[0]
    return merging.moved_group(belief, 1, jnp.asarray(AWAY))


def test_two_robots_with_common_landmarks_share_a_map() -> None:
    """An attempt finds the motion, later ones the copies that are left; then each landmark is held once."""
    belief, waits = apart(1), team.no_waits(2)
    for tick in range(4):
        belief, waits = attempt(belief, waits, tick, jax.random.key(tick))
        assert np.asarray(belief.groups).tolist() == [0, 0]
    np.testing.assert_allclose(belief.robots[1, 5:7], 0.0, atol=0.1)  # starts are equal
    true_ids, counts = np.asarray(belief.true_ids), np.asarray(belief.counts)
    held = true_ids[counts > 0]
    assert len(held) == len(set(held.tolist())) > 30
    assert (np.asarray(belief.owners)[counts > 0] == 0).all()
    assert np.linalg.eigvalsh(np.asarray(belief.covariance, np.float64)).min() > -1e-6


def test_robots_without_common_looks_stay_apart() -> None:
    """Without landmarks that look alike, with too few, or with look-alikes alone nothing changes but copies."""
    belief = apart(2)
    owners, rng = np.asarray(belief.owners), np.random.default_rng(0)
    others = rng.normal(size=belief.descriptors.shape)
    few = (owners == 1) & (np.cumsum(owners == 1) > 5)
    for looks in (
        np.where((owners == 1)[:, None], others, belief.descriptors),
        np.where(few[:, None], others, belief.descriptors), np.ones(belief.descriptors.shape),
    ):  # fmt: skip
        after, _ = attempt(belief._replace(descriptors=jnp.asarray(looks)), team.no_waits(2), 0, jax.random.key(0))
        assert np.asarray(after.groups).tolist() == [0, 1]
        np.testing.assert_array_equal(after.robots[:, :2], belief.robots[:, :2])


def test_uncertain_starts_wait_while_waiting_helps() -> None:
    """A pair beyond the limit is refused for some ticks; then it merges if it has become hardly more certain."""
    belief = apart(3)
    strict = jax.jit(
        partial(team.merged, in_contact=jnp.array(True), assumed=ASSUMED, options=OPTIONS, min_sigmas=1000.0)
    )
    after, waits = strict(belief, team.no_waits(2), 0, jax.random.key(0))
    assert np.asarray(after.groups).tolist() == [0, 1]
    assert waits.until[0, 1] == team.WAIT
    assert np.isfinite(waits.excess[0, 1])
    assert waits.excess[0, 1] > 1.0
    again, same = strict(after, waits, team.WAIT - 1, jax.random.key(1))
    assert np.asarray(again.groups).tolist() == [0, 1]
    np.testing.assert_array_equal(same.excess, waits.excess)
    improved = waits._replace(excess=2.0 * waits.excess)
    still, _ = strict(after, improved, team.WAIT, jax.random.key(1))
    assert np.asarray(still.groups).tolist() == [0, 1]
    joined, _ = strict(after, waits, team.WAIT, jax.random.key(1))
    assert np.asarray(joined.groups).tolist() == [0, 0]


def test_errors_are_those_of_the_metrics() -> None:
    """E, RMS error and recall of each robot equal those of `slam_backend.metrics` in its start frame."""
    belief, rng = apart(4), np.random.default_rng(4)
    landmarks = rng.uniform(-6.0, 6.0, (40, 3)).astype(np.float32)
    observable = rng.random(40) < 0.8
    true_ids = np.asarray(belief.true_ids).copy()
    true_ids[rng.random(ROWS) < 0.1] = -1
    belief = belief._replace(true_ids=jnp.asarray(true_ids))
    starts = np.array([[1.0, 2.0, 0.5], [-2.0, 0.0, -1.0]])
    found = scoring.score(belief, scoring.Truth(*map(jnp.asarray, (landmarks, observable, starts))), 2, 1.0)
    rows_of = np.where(observable, np.cumsum(observable) - 1, -2)
    for robot in range(2):
        held = (np.asarray(belief.counts) >= 2) & (np.asarray(belief.owners) == robot)
        claims = np.where(true_ids[held] < 0, -1, rows_of[true_ids[held]])
        own = np.column_stack([belief.places[held], belief.heights[held, 0]]).astype(np.float64)
        start = np.asarray(belief.robots[robot, 5:], np.float64)
        own[:, :2] = (own[:, :2] - start[:2]) @ np.array(
            [[np.cos(start[2]), -np.sin(start[2])], [np.sin(start[2]), np.cos(start[2])]]
        )
        own = transform_points(starts[robot], own)
        truths = landmarks[observable].astype(np.float64)
        assert float(found.map_errors[robot]) == pytest.approx(map_error(own, claims, truths), abs=1e-4)
        score = map_rmse(own, truths, claims=claims)
        assert float(found.map_rmses[robot]) == pytest.approx(score.rmse, abs=1e-3)
        assert float(found.map_recalls[robot]) == pytest.approx(score.recall, abs=1e-6)
