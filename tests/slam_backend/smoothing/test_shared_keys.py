"""Steps that stand rigidly to the key before: what the compiled walk makes of them, and what they cost."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_problems import camera_of, graph_of, logs_of, small_run

from slam_backend.geometry import between, compose, transform_points, wrap_angle
from slam_backend.log_arrays import ODOMETRY, REJECTED, STOOD
from slam_backend.motion import OdometryModel
from slam_backend.smoothing._walking import choose, mostly_new, place, walk
from slam_backend.smoothing.extending import chained, extended, scatter
from slam_backend.smoothing.graph import LEVER, PathGraph
from slam_backend.smoothing.options import SmoothingOptions
from slam_backend.smoothing.rejuvenation import rejuvenate
from training.stereo_runs import RunSpec, simulate_run


def walked(kinds, motions, variances, counts, guessed, guesses, start, rigid_within):
    """Return what the compiled walk found: keys, odometry between them, its noise, slack, frames."""
    n = len(kinds)
    poses, between_keys, offsets = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3))
    noises, slack, frame_keys = np.empty((n, 3, 3)), np.empty(n + 1), np.empty(n, dtype=np.int64)
    keys, frames = walk(
        kinds, motions, variances, counts, guessed, guesses, start, rigid_within, LEVER, poses, between_keys, noises,
        slack, frame_keys, offsets,
    )  # fmt: skip
    return poses[:keys], between_keys[:keys], noises[:keys], slack[: keys + 1], frame_keys[:frames], offsets[:frames]


def plainly_walked(kinds, motions, variances, counts, guessed, guesses, start, rigid_within):
    """Return the same, step by step with whole matrices."""
    pose, keys, slack, frames = start, [], [0.0], []
    chain, noise, moved = np.zeros(3), np.zeros((3, 3)), False
    for t in range(len(kinds)):
        if kinds[t] == ODOMETRY:
            chain, noise = chained(chain, noise, motions[t], np.diag(variances[t]))
            pose, moved = compose(pose, motions[t]), True
        if guessed[t]:
            pose = guesses[t]
        far = counts[t] > 0 and scatter(noise[None])[0] >= rigid_within**2
        if moved and (far or t == len(kinds) - 1):
            keys.append((pose, chain, noise))
            slack.append(0.0)
            chain, noise, moved = np.zeros(3), np.zeros((3, 3)), False
        if counts[t]:
            frames.append((len(keys) - 1, chain))
            slack[-1] = max(slack[-1], scatter(noise[None])[0])
    poses, between_keys, noises = (np.array([key[i] for key in keys]) for i in range(3))
    offsets = np.array([offset for _, offset in frames]).reshape(-1, 3)
    return (
        poses.reshape(-1, 3), between_keys.reshape(-1, 3), noises.reshape(-1, 3, 3), np.array(slack),
        np.array([key for key, _ in frames], dtype=np.int64), offsets,
    )  # fmt: skip


@settings(deadline=None, max_examples=60)
@given(st.integers(1, 30), st.sampled_from([0.0, 0.02, 0.2]), st.integers(0, 2**32 - 1))
def test_the_compiled_walk_is_the_plain_one(steps, rigid_within, seed):
    """Keys, frames, odometry between keys, its noise and the slack are those of the walk with whole matrices."""
    rng = np.random.default_rng(seed)
    kinds = rng.choice([STOOD, ODOMETRY], steps, p=[0.2, 0.8]).astype(np.int8)
    motions = np.where(kinds[:, None] == ODOMETRY, rng.normal(size=(steps, 3)) * [0.2, 0.05, 0.5], 0.0)
    arguments = (
        kinds, motions, OdometryModel().variances(motions), rng.integers(0, 3, steps), rng.random(steps) < 0.3,
        rng.normal(size=(steps, 3)), rng.normal(size=3), rigid_within,
    )  # fmt: skip
    for found, expected in zip(walked(*arguments), plainly_walked(*arguments), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)


def test_measurements_with_names_are_taken():
    """Which rows bear a name, and of which frame they are if each step with such a row makes one."""
    ids, starts = np.array([4, REJECTED, 9, REJECTED, 4, 2]), np.array([0, 0, 3, 4, 5, 6])
    counts, rows, frames = np.empty(5, dtype=np.int64), np.empty(6, dtype=np.int64), np.empty(6, dtype=np.int64)
    taken = choose(ids, starts, counts, rows, frames)
    assert counts.tolist() == [0, 2, 0, 1, 1]
    assert rows[:taken].tolist() == [0, 2, 4, 5]
    assert frames[:taken].tolist() == [0, 0, 1, 2]


def test_points_are_placed_by_their_frames():
    """Compiled as composed: the key, the frame seen from it, the camera on the robot."""
    rng = np.random.default_rng(6)
    poses, offsets, mount = rng.normal(size=(3, 3)), rng.normal(size=(5, 3)), rng.normal(size=3)
    frame_keys, frames, points = rng.integers(0, 3, 5), rng.integers(0, 5, 20), rng.normal(size=(20, 3))
    found = np.empty((20, 3))
    place(poses, frame_keys, offsets, frames, points, mount, found)
    for n, frame in enumerate(frames):
        at = compose(poses[frame_keys[frame]], offsets[frame])
        np.testing.assert_allclose(found[n], transform_points(at, points[n] + mount), atol=1e-12)


def test_landmarks_are_mostly_new_that_have_more_new_measurements_than_old():
    """Old ones are those in frozen sightings and raw ones; as many is not more."""
    frozen, counts, raw, new = np.array([0, 1, 1]), np.array([2, 1, 1]), np.array([0, 2]), np.array([0, 1, 1, 1, 2, 3])
    assert mostly_new(frozen, counts, raw, new, 5).tolist() == [False, True, False, True, False]


def test_variances_are_squared_sigmas():
    """The variances of many readings are the squares of the deviations of each."""
    model, motions = OdometryModel(), np.random.default_rng(1).normal(size=(20, 3))
    np.testing.assert_allclose(model.variances(motions), [model.sigmas(motion) ** 2 for motion in motions])


def test_frames_stand_where_odometry_says():
    """A frame seen from its key is where the odometry between puts it, and the newest pose is always a key."""
    run = small_run()
    start, [log] = PathGraph.at_starts(run.true_paths[:, 0]), logs_of(run)
    mount, motion = np.array(run.spec.noise.camera.mount), run.spec.noise.motion
    shared = extended(start, [log.arrays()], motion, mount, rigid_within=0.06)
    each = graph_of(run)
    assert 2 < shared.num_keys < each.num_keys / 1.5
    assert len(shared.frame_keys) == len(each.frame_keys)
    np.testing.assert_allclose(shared.poses[shared.tips], each.poses[each.tips], atol=1e-12)
    stood = compose(shared.poses[shared.frame_keys], shared.frame_offsets)
    off = stood - compose(each.poses[each.frame_keys], each.frame_offsets)
    off[:, 2] = wrap_angle(off[:, 2])
    np.testing.assert_allclose(off, 0.0, atol=1e-12)
    np.testing.assert_allclose(shared.landmarks, each.landmarks, atol=1e-12)
    assert shared.slack.max() < 0.06**2
    assert (shared.slack > 0).any()


@pytest.mark.parametrize("rigid_within", [0.0, 0.02])
def test_steps_in_one_place_share_its_key(rigid_within):
    """A robot that hardly turns measures from few keys if they may be shared, and what it has seen is all there."""
    run = small_run()
    [log] = logs_of(run)
    still = log.arrays()
    motions = np.where(still.kinds[:, None] == ODOMETRY, [0.0, 0.0, 1e-4], 0.0)
    still = type(still)(**{name: getattr(still, name) for name in still.__dataclass_fields__} | {"motions": motions})
    graph = extended(
        PathGraph.at_starts(np.zeros((1, 3))), [still], run.spec.noise.motion, np.zeros(3), rigid_within=rigid_within
    )
    assert graph.num_keys == (len(still) if rigid_within == 0.0 else 2)  # the start, and where it stands now
    assert len(graph.points) == len(still.ids)


@pytest.mark.parametrize("seed", [101, 102])
def test_shared_keys_cost_little_truth(seed):
    """Where keys share less than measurements err, the newest pose agrees with that of a key at each step."""
    run = simulate_run(RunSpec(length=15.0, landmarks=120, measurements=7, preset="paper"), seed)
    log, motion, camera = logs_of(run)[0].arrays(), run.spec.noise.motion, camera_of(run)
    start = PathGraph.at_starts(run.true_paths[:, 0])
    results = []
    for rigid_within in (0.0, 0.02):
        options = SmoothingOptions(max_keys=1000, fresh_keys=1000, rigid_within=rigid_within)
        results.append(rejuvenate(start, [log], motion, camera, 50, np.random.default_rng(1), options))
    each, shared = results
    assert each.reason == shared.reason == ""
    assert shared.graph.num_keys < each.graph.num_keys / 3
    apart = between(each.particles.means[0], shared.particles.means[0])
    assert apart @ np.linalg.solve(each.particles.covariances[0], apart) < 0.5
