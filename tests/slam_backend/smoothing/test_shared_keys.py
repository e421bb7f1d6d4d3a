"""Steps that stand rigidly to the key before: what the compiled walk makes of them, and what they cost."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plain_coarsening import chained
from python_entry import python_entry
from small_problems import camera_of, graph_of, logs_of, small_run

from slam_backend.geometry import between, compose, transform_points, wrap_angle
from slam_backend.models.odometry import OdometryModel
from slam_backend.smoother._kernels.keyframes import choose, number, place, rename, start_anew, walk
from slam_backend.smoother.graph import LEVER, PathGraph
from slam_backend.smoother.graph_building import extended
from slam_backend.smoother.log_arrays import ODOMETRY, REJECTED, STOOD
from slam_backend.smoother.options import SmoothingOptions
from slam_backend.smoother.rejuvenation import rejuvenate
from training.bench.accuracy.runs import RunSpec, simulate_run

choose, number, place, start_anew, walk = map(python_entry, (choose, number, place, start_anew, walk))

OLD = 4  # keys and frames of others before
TIP = 2


def walked(kinds, motions, variances, counts, guesses, start, rigid_within):
    """Return what the compiled walk of robot 1 found: keys, odometry between them, its noise, slack, frames."""
    n = OLD + len(kinds)
    robots, previous, frame_keys = (np.full(n, -7) for _ in range(3))
    poses, between_keys, offsets, noises = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3, 3))
    spreads, slack, tips = np.empty(n), np.zeros(n), np.array([0, TIP, 3])
    poses[TIP] = start
    keys, frames = walk(
        kinds, motions, variances, counts, guesses, 1, rigid_within, LEVER, OLD, OLD, tips, robots, poses, previous,
        between_keys, noises, spreads, slack, frame_keys, offsets,
    )  # fmt: skip
    new = np.arange(OLD, keys)
    chain = np.array([TIP, *new])
    np.testing.assert_array_equal(robots[new], 1)
    np.testing.assert_array_equal(previous[new], chain[:-1])
    np.testing.assert_allclose(spreads[new], scatter(noises[new]))
    np.testing.assert_array_equal(tips, [0, chain[-1], 3])
    own = np.searchsorted(new, frame_keys[OLD:frames]) - (frame_keys[OLD:frames] == TIP)
    return poses[new], between_keys[new], noises[new], slack[chain], own, offsets[OLD:frames]


def scatter(noises):
    """Return the mean squares (n,) [m^2] by which motions of covariances (n, 3, 3) scatter, headings at `LEVER`."""
    return noises[:, 0, 0] + noises[:, 1, 1] + LEVER**2 * noises[:, 2, 2]


def plainly_walked(kinds, motions, variances, counts, guesses, start, rigid_within):
    """Return the same, step by step with whole matrices."""
    pose, keys, slack, frames = start, [], [0.0], []
    chain, noise, moved = np.zeros(3), np.zeros((3, 3)), False
    for t in range(len(kinds)):
        if kinds[t] == ODOMETRY:
            chain, noise = chained(chain, noise, motions[t], np.diag(variances[t]))
            pose, moved = compose(pose, motions[t]), True
        if np.isfinite(guesses[t]).all():
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
    guesses = np.where(rng.random((steps, 1)) < 0.3, rng.normal(size=(steps, 3)), np.nan)
    arguments = (
        kinds, motions, OdometryModel().variances(motions), rng.integers(0, 3, steps), guesses, rng.normal(size=3),
        rigid_within,
    )  # fmt: skip
    for found, expected in zip(walked(*arguments), plainly_walked(*arguments), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("covered", [False, True])
def test_measurements_with_names_are_taken(covered):
    """Which rows bear a name, and of which frame they are if each step with such a row makes one; others stay."""
    ids, starts = np.array([4, REJECTED, 9, REJECTED, 4, 2]), np.array([0, 0, 3, 4, 5, 6])
    rng, rows = np.random.default_rng(3), [0, 2, 4, 5]
    points, covariances = rng.normal(size=(6, 3)), rng.normal(size=(6 if covered else 0, 6))
    given_steps = np.array([False, True, False, False, True]) & covered
    taken, noises, marks = np.full((8, 3), -7.0), np.full((8, 6), -7.0), np.zeros(8, dtype=np.bool_)
    names, frames, counts = np.full(8, -7), np.full(8, -7), np.empty(5, dtype=np.int64)
    num = choose(ids, points, given_steps, covariances, starts, 2, 5, counts, taken, noises, marks, frames, names)
    assert num == 6
    assert counts.tolist() == [0, 2, 0, 1, 1]
    assert names.tolist() == [-7, -7, 4, 9, 4, 2, -7, -7]
    assert frames.tolist() == [-7, -7, 5, 5, 6, 7, -7, -7]
    assert marks.tolist() == [False, False, covered, covered, False, covered, False, False]
    np.testing.assert_array_equal(taken[2:6], points[rows])
    np.testing.assert_array_equal(noises[2:6], covariances[rows] if covered else np.zeros((4, 6)))
    assert (taken[[0, 1, 6, 7]] == -7.0).all()


@given(st.lists(st.integers(0, 9), unique=True, max_size=8), st.lists(st.integers(0, 12), max_size=20))
def test_landmarks_are_numbered_as_they_come(known, names):
    """A known landmark keeps its row, a new one gets the next at its first measurement."""
    expected = {name: row for row, name in enumerate(known)}
    first = [n for n, name in enumerate(names) if name not in known and name not in names[:n]]
    for n in first:
        expected[names[n]] = len(expected)
    rows, ids, firsts = np.array(names, dtype=np.int64), np.full(len(known) + len(names), -7), np.full(len(names), -7)
    ids[: len(known)] = known
    assert number(rows, np.argsort(known).astype(np.int64), ids, firsts) == len(expected)
    assert rows.tolist() == [expected[name] for name in names]
    assert ids[: len(expected)].tolist() == list(expected)
    assert firsts[: len(first)].tolist() == first


@given(st.lists(st.integers(0, 5), max_size=8), st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5)), max_size=4))
def test_names_are_changed_in_the_order_in_which_landmarks_were_found_to_be_one(names, aliases):
    """Each pair is applied to all names before the next one is."""
    found, expected = np.array(names, dtype=np.int64), list(names)
    rename(found, np.array(aliases, dtype=np.int64).reshape(-1, 2))
    for old, new in aliases:
        expected = [new if name == old else name for name in expected]
    assert found.tolist() == expected


def test_points_are_placed_by_their_frames():
    """Compiled as composed: the key, the frame seen from it, the camera on the robot."""
    rng = np.random.default_rng(6)
    poses, offsets, mount = rng.normal(size=(3, 3)), rng.normal(size=(5, 3)), rng.normal(size=3)
    frame_keys, frames, points = rng.integers(0, 3, 5), rng.integers(0, 5, 20), rng.normal(size=(20, 3))
    chosen = rng.permutation(20)[:12]
    found = np.empty((12, 3))
    place(poses, frame_keys, offsets, frames, points, chosen, mount, found)
    for n, place_of_n in zip(chosen, found, strict=True):
        at = compose(poses[frame_keys[frames[n]]], offsets[frames[n]])
        np.testing.assert_allclose(place_of_n, transform_points(at, points[n] + mount), atol=1e-12)


def test_landmarks_start_anew_that_have_more_new_measurements_than_old():
    """Old ones are those in frozen sightings and raw ones; as many is not more. Only what the filter holds moves."""
    frozen, counts, raw = np.array([0, 1, 1]), np.array([2, 1, 1]), np.array([0, 2])
    new = np.array([0, 1, 1, 1, 2, 3, 5])
    names, held = np.array([9, 3, 8, 7, 1, 6]), np.array([1, 3, 7, 8, 9])
    means, landmarks = np.arange(15.0).reshape(5, 3), np.full((6, 3), -1.0)
    start_anew(frozen, counts, raw, new, names, held, means, landmarks)
    assert landmarks[:, 0].tolist() == [-1.0, 3.0, -1.0, 6.0, -1.0, -1.0]  # 3 and 7 are held, and 6 is not


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
