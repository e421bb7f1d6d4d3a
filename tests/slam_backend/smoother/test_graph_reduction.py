"""Graph reduction: joining and dropping keyframes, and condensing their measurements."""

from dataclasses import replace

import numpy as np
import pytest
from builders.plain_graph_reduction import chained, plain_reduced
from builders.runs import TIGHT, camera_of, graph_of, logs_of, rejuvenate, small_run, upper
from hypothesis import given, settings
from hypothesis import strategies as st

from slam_backend.fastslam.run_log import RobotLog
from slam_backend.geometry import between, compose, transform_points, wrap_angle
from slam_backend.models.odometry import OdometryModel
from slam_backend.smoother._kernels import (
    Condensed,
    Frames,
    Keys,
    Landmarks,
    Log,
    Points,
    add_keyframes,
)
from slam_backend.smoother.graph import LEVER, SlamGraph
from slam_backend.smoother.graph_building import (
    NO_LANDMARK_POSITIONS,
    InitialPoses,
    LandmarkPositions,
    extend_graph,
    log_head,
    number_landmarks,
)
from slam_backend.smoother.graph_reduction import reduce_keyframes, relinearise
from slam_backend.smoother.log_arrays import ODOMETRY, REJECTED, STATIONARY
from slam_backend.smoother.optimizer import optimize
from slam_backend.smoother.options import SmoothingOptions, keyframe_limit
from slam_backend.smoother.sampling import lane_rows, replay, sample_paths, transition_variances
from training.stereo_runs.runs import RunSpec, simulate_run


def limits(max_keys, recent_keys):
    """Return options under which so many keys are left."""
    return SmoothingOptions(max_keys=max_keys, recent_keys=recent_keys, kernel=0.0)


def test_condensed_sightings_of_single_poses_change_nothing():
    """Frozen at the mode, all measurements give the same mode, the same information and the same map."""
    run = small_run(2)
    graph = graph_of(run)
    mode = optimize(graph, camera_of(run), TIGHT)
    frozen = reduce_keyframes(relinearise(graph, mode, np.zeros(graph.num_keys)), camera_of(run), limits(1000, 2))
    assert len(frozen.points) < len(graph.points)
    assert frozen.num_keys == graph.num_keys
    again = optimize(frozen, camera_of(run), TIGHT)
    np.testing.assert_allclose(again.poses, mode.poses, atol=1e-8)
    np.testing.assert_allclose(again.landmarks, mode.landmarks, atol=1e-8)
    one, same = upper(again), upper(mode)
    np.testing.assert_allclose(one.T @ one, same.T @ same, rtol=1e-6, atol=1e-3)


def test_frames_of_a_stationary_robot_share_one_keyframe():
    """A robot that stands still has one pose: its frames add up to one sighting of each landmark."""
    run = small_run()
    log = RobotLog()
    points = run.spec.noise.camera.robot_from_camera(run.frames[0][0].points) - np.array(run.spec.noise.camera.mount)
    log.append(0, points=points, ids=run.names[0][0])
    log.append(1, points=points, ids=run.names[0][0])
    log.append(2, np.array([0.2, 0.0, 0.0]), points=points - [0.2, 0.0, 0.0], ids=run.names[0][0])
    start = SlamGraph.at_starts(np.zeros((1, 3)))
    graph = extend_graph(start, [log.arrays()], run.spec.noise.motion, np.zeros(3))
    assert graph.num_keys == 2
    assert graph.frame_keys.tolist() == [0, 0, 1]
    mode = optimize(graph, camera_of(run), TIGHT)
    assert mode.sightings.counts.tolist() == [2, 1] * len(points)


def test_joining_rigid_keyframes_keeps_the_estimate():
    """Keys that are joined at the mode leave landmarks, newest pose and likelihood at the mode where they were."""
    run = small_run()
    graph = graph_of(run)
    mode = optimize(graph, camera_of(run), TIGHT)
    variances = sample_paths(graph, mode, 50, np.random.default_rng(1)).transition_variances
    fewer = reduce_keyframes(relinearise(graph, mode, variances), camera_of(run), limits(9, 3))
    assert fewer.num_keys == 9
    np.testing.assert_allclose(fewer.poses[fewer.last_keys], mode.poses[graph.last_keys])
    again = optimize(fewer, camera_of(run), TIGHT)
    assert again.reason == ""
    tiles, _ = replay(again, lane_rows(fewer.poses[:, :, None]), 1)
    np.testing.assert_allclose(tiles[:, 0, :3, 0], mode.landmarks, atol=1e-7)  # the old poses ask for the old map
    np.testing.assert_allclose(again.poses[fewer.last_keys][:, :2], mode.poses[graph.last_keys][:, :2], atol=0.01)


def test_odometry_is_transferred_to_joined_keyframes():
    """Composed with the links that are left, the start leads to the newest pose by measured and smoothed motion."""
    run = small_run()
    graph = graph_of(run)
    mode = optimize(graph, camera_of(run), TIGHT)
    fewer = reduce_keyframes(relinearise(graph, mode, np.full(graph.num_keys, 1e-6)), camera_of(run), limits(5, 2))
    for b in np.flatnonzero(fewer.parents >= 0):
        old = np.flatnonzero((np.abs(mode.poses - fewer.poses[b]) < 1e-12).all(axis=1))[0]
        before = compose(mode.poses[old - 1], graph.odometry[old])
        after = compose(fewer.poses[fewer.parents[b]], fewer.odometry[b])
        np.testing.assert_allclose(after[:2], before[:2], atol=1e-9)
        assert np.linalg.det(fewer.odometry_covariances[b]) > 0.0
        np.testing.assert_allclose(
            np.linalg.eigvalsh(fewer.odometry_covariances[b]), np.linalg.eigvalsh(graph.odometry_covariances[old])
        )


def test_keyframes_without_measurements_are_removed_without_loss():
    """A key from which nothing was measured, and which is no longer the newest, is chained away: same mode without."""
    run = small_run()
    logs = logs_of(run, skip=(7, 8))
    mount = np.array(run.spec.noise.camera.mount)
    first = logs[0].arrays()
    upto, rest = _until(first, 9), first.since(9)
    grown = extend_graph(SlamGraph.at_starts(run.true_paths[:, 0]), [upto], run.spec.noise.motion, mount)
    whole = extend_graph(grown, [rest], run.spec.noise.motion, mount)
    mode = optimize(whole, camera_of(run), TIGHT)
    fewer = reduce_keyframes(relinearise(whole, mode, np.zeros(whole.num_keys)), camera_of(run), limits(1000, 2))
    assert fewer.num_keys == whole.num_keys - 1
    again = optimize(fewer, camera_of(run), TIGHT)
    np.testing.assert_allclose(again.poses, np.delete(mode.poses, 7, axis=0), atol=1e-3)


def _until(log, step):
    cut = RobotLog()
    for t in range(len(log)):
        row = log.row(t)
        if row.step < step:
            cut.append(row.step, row.motion if row.kind else None, points=row.points, ids=row.ids)
    return cut.arrays()


def test_a_long_run_stays_bounded():
    """However long a run, keys stay at their limit and memory at what keys and landmarks in view ask for."""
    run = small_run(length=30.0)
    logs = logs_of(run)
    graph, sizes = SlamGraph.at_starts(run.true_paths[:, 0]), []
    options = SmoothingOptions(max_keys=30, recent_keys=12, steps_per_key=10**6)
    arrays = logs[0].arrays()
    for last in range(10, run.num_steps, 10):
        part = _until(arrays.since(int(graph.latest[0]) + 1), last)
        result = rejuvenate(
            graph, [part], run.spec.noise.motion, camera_of(run), 20, np.random.default_rng(last), options
        )
        assert result.reason == ""
        graph = result.graph
        sizes.append((graph.num_keys, len(graph.points), graph.nbytes))
    assert max(size[0] for size in sizes) <= 30
    assert sizes[-1][1] <= 12 * 7
    assert sizes[-1][2] < 1.5 * sizes[5][2]


def test_the_keyframe_limit_grows_with_the_number_of_robots():
    """Two robots may have more keys than one, and have them; without further ones they share those of one."""
    run = small_run(robots=2, length=10.0)
    for further, most in ((0, 20), (6, 26)):
        options = SmoothingOptions(max_keys=20, further_keys=further, recent_keys=8, steps_per_key=10**6)
        result = rejuvenate(
            SlamGraph.at_starts(run.true_paths[:, 0]), [log.arrays() for log in logs_of(run)], run.spec.noise.motion,
            camera_of(run), 20, np.random.default_rng(3), options,
        )  # fmt: skip
        assert result.graph.num_keys == most


@pytest.mark.parametrize("robots", [1, 2, 3])
def test_the_keyframe_limit_grows_with_the_run_up_to_a_share_of_the_map(robots):
    """One more key for so many steps of all robots together, whichever walked them, up to one for so many landmarks."""
    options = SmoothingOptions(max_keys=20, further_keys=5, steps_per_key=8, landmarks_per_key=3)
    base, latest = 20 + 5 * (robots - 1), np.full(robots, 160)
    alone = np.append(np.zeros(robots - 1, dtype=np.int64), 160 * robots)
    for walked in (latest, alone):
        assert keyframe_limit(options, 10**6, walked) == base + 20 * robots
        assert keyframe_limit(options, 3 * 20 * robots - 1, walked) == base + 20 * robots - 1
        assert keyframe_limit(options, 0, walked) == base
    assert keyframe_limit(options, 10**6, np.full(robots, -1)) == base  # before the first step


def test_a_longer_run_keeps_more_keyframes():
    """The graph grows as its limit does, by one rule from the first step on; without new landmarks it stays."""
    run = small_run(length=15.0)
    log, start = logs_of(run)[0].arrays(), SlamGraph.at_starts(run.true_paths[:, 0])
    kept = {}
    for landmarks_per_key in (1, 10**6):
        options = SmoothingOptions(max_keys=10, recent_keys=5, steps_per_key=4, landmarks_per_key=landmarks_per_key)
        graph = start
        for upto in (20, 40, 60):
            part = log_head(log, upto).since(int(graph.latest[0]) + 1)
            graph = rejuvenate(
                graph, [part], run.spec.noise.motion, camera_of(run), 9, np.random.default_rng(3), options
            ).graph
            kept[landmarks_per_key, upto] = graph.num_keys
    assert kept == {(1, 20): 14, (1, 40): 19, (1, 60): 24} | {(10**6, upto): 10 for upto in (20, 40, 60)}


def test_using_a_graph_does_not_change_it():
    """Snapshots may share graphs: extending, solving, drawing and coarsening leave every array as it was."""
    run = small_run()
    graph = graph_of(run)
    before = {name: getattr(graph, name).copy() for name in graph.__dataclass_fields__}
    mode = optimize(graph, camera_of(run), TIGHT)
    draws = sample_paths(graph, mode, 9, np.random.default_rng(1))
    fewer = reduce_keyframes(relinearise(graph, mode, draws.transition_variances), camera_of(run), limits(7, 3))
    kept = {name: getattr(fewer, name).copy() for name in fewer.__dataclass_fields__}
    reduce_keyframes(
        relinearise(fewer, optimize(fewer, camera_of(run), TIGHT), np.ones(7)), camera_of(run), limits(4, 2)
    )
    replace(graph)
    for name, value in before.items():
        np.testing.assert_array_equal(getattr(graph, name), value)
    for name, value in kept.items():
        np.testing.assert_array_equal(getattr(fewer, name), value)


@pytest.mark.parametrize("max_keys", [3, 14, 30, 1000])
@pytest.mark.parametrize("kernel", [0.0, 0.2])
def test_keys_are_joined_as_by_the_plain_program(max_keys, kernel):
    """Kernels leave the same keys as numpy: blind ones, measurements that contradict, and joining twice included."""
    run = small_run(2, length=8.0)
    options = SmoothingOptions(max_keys=max_keys, further_keys=0, recent_keys=6, kernel=kernel)
    graph = graph_of(run, skip=(3, 4, 7))
    blind = graph.point_frames == 5  # that a key measured nothing is the exception
    names = ("points", "point_noises", "has_covariance", "point_frames", "point_landmarks")
    graph = replace(graph, **{name: getattr(graph, name)[~blind] for name in names})
    for _ in range(2):
        mode = optimize(graph, camera_of(run), TIGHT)
        graph = relinearise(graph, mode, transition_variances(graph, mode))
        found, expected = (how(graph, camera_of(run), options) for how in (reduce_keyframes, plain_reduced))
        assert found.num_keys <= max(keyframe_limit(options, len(graph.landmark_ids), graph.latest), 8)
        for name in graph.__dataclass_fields__:
            one, other = getattr(found, name), getattr(expected, name)
            assert one.dtype == other.dtype
            np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-7, err_msg=name)
        options = replace(options, max_keys=max(2, max_keys - 2))
        graph = found


OLD = 4  # keys and frames of others before
TIP = 2


def log_of(kinds, motions, variances, counts):
    """Return a log in which each step measured `counts` landmarks at one place."""
    n = int(counts.sum())
    return Log(
        np.arange(len(kinds)), kinds, motions, np.zeros(len(kinds), dtype=np.bool_), np.append(0, np.cumsum(counts)),
        np.ones((n, 3)), np.arange(n), np.empty((0, 6)), variances, np.empty((0, 3, 3)), np.zeros(3),
    )  # fmt: skip


def room_for(keys, frames, points):
    """Return so many rows of keys, frames and raw measurements, not yet written."""
    return (
        Keys(
            np.full(keys, -7), np.empty((keys, 3)), np.full(keys, -7), np.empty((keys, 3)), np.empty((keys, 3, 3)),
            np.empty((keys, 3, 3)), np.empty(keys), np.zeros(keys),
        ),
        Frames(np.full(frames, -7), np.empty((frames, 3))),
        Points(
            np.full((points, 3), -7.0), np.full((points, 6), -7.0), np.zeros(points, dtype=np.bool_),
            np.full(points, -7), np.full(points, -7),
        ),
    )  # fmt: skip


def walked(kinds, motions, variances, counts, initial_poses, start, rigid_within):
    """Return what the compiled walk of robot 1 found: keys, odometry between them, its noise, slack, frames."""
    keys, frames, raw = room_for(OLD + len(kinds), OLD + len(kinds), int(counts.sum()))
    keys.poses[TIP] = start
    tips, ends, known = np.array([0, TIP, 3]), np.array([OLD, OLD, 0]), np.flatnonzero(np.isfinite(initial_poses[:, 0]))
    log = log_of(kinds, motions, variances, counts)
    is_guided = add_keyframes(
        log, InitialPoses(known, initial_poses[known]), 1, rigid_within, tips, ends, keys, frames, raw
    )
    first = np.flatnonzero(counts)[:1]
    assert is_guided == np.isfinite(initial_poses[first, 0]).all()
    num_keys, num_frames, num_points = ends
    new = np.arange(OLD, num_keys)
    chain = np.array([TIP, *new])
    np.testing.assert_array_equal(keys.robots[new], 1)
    np.testing.assert_array_equal(keys.parents[new], chain[:-1])
    np.testing.assert_allclose(keys.transition_variances[new], scatter(keys.odometry_covariances[new]))
    np.testing.assert_array_equal(tips, [0, chain[-1], 3])
    assert num_points == counts.sum()
    own = frames.frame_keys[OLD:num_frames]
    own = np.searchsorted(new, own) - (own == TIP)
    return (
        keys.poses[new], keys.odometry[new], keys.odometry_covariances[new], keys.rigid_variances[chain], own,
        frames.frame_offsets[OLD:num_frames],
    )  # fmt: skip


def scatter(noises):
    """Return the mean squares (n,) [m^2] by which motions of covariances (n, 3, 3) scatter, headings at `LEVER`."""
    return noises[:, 0, 0] + noises[:, 1, 1] + LEVER**2 * noises[:, 2, 2]


def plainly_walked(kinds, motions, variances, counts, initial_poses, start, rigid_within):
    """Return the same, step by step with whole matrices."""
    pose, keys, slack, frames = start, [], [0.0], []
    chain, noise, moved = np.zeros(3), np.zeros((3, 3)), False
    for t in range(len(kinds)):
        if kinds[t] == ODOMETRY:
            chain, noise = chained(chain, noise, motions[t], np.diag(variances[t]))
            pose, moved = compose(pose, motions[t]), True
        if np.isfinite(initial_poses[t]).all():
            pose = initial_poses[t]
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


@pytest.mark.slow
@settings(deadline=None, max_examples=60)
@given(st.integers(1, 30), st.sampled_from([0.0, 0.02, 0.2]), st.integers(0, 2**32 - 1))
def test_the_compiled_walk_is_the_plain_one(steps, rigid_within, seed):
    """Keys, frames, odometry between keys, its noise and the slack are those of the walk with whole matrices."""
    rng = np.random.default_rng(seed)
    kinds = rng.choice([STATIONARY, ODOMETRY], steps, p=[0.2, 0.8]).astype(np.int8)
    motions = np.where(kinds[:, None] == ODOMETRY, rng.normal(size=(steps, 3)) * [0.2, 0.05, 0.5], 0.0)
    initial_poses = np.where(rng.random((steps, 1)) < 0.3, rng.normal(size=(steps, 3)), np.nan)
    arguments = (
        kinds, motions, OdometryModel().variances(motions), rng.integers(0, 3, steps), initial_poses,
        rng.normal(size=3), rigid_within,
    )  # fmt: skip
    for found, expected in zip(walked(*arguments), plainly_walked(*arguments), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("covered", [False, True])
def test_measurements_with_ids_are_selected(covered):
    """Which rows bear a name, and of which frame they are if each step with such a row makes one; others stay."""
    ids, starts = np.array([4, REJECTED, 9, REJECTED, 4, 2]), np.array([0, 0, 3, 4, 5, 6])
    rng, rows = np.random.default_rng(3), [0, 2, 4, 5]
    points, covariances = rng.normal(size=(6, 3)), rng.normal(size=(6 if covered else 0, 6))
    given_steps = np.array([False, True, False, False, True]) & covered
    keys, frames, raw = room_for(3, 9, 8)
    keys.poses[0] = 0.0
    kinds, still, ends = np.full(5, STATIONARY, dtype=np.int8), np.zeros((5, 3)), np.array([1, 5, 2])
    no_bias = np.empty((0, 3, 3)), np.zeros(3)
    log = Log(np.arange(5), kinds, still, given_steps, starts, points, ids, covariances, still, *no_bias)
    assert not add_keyframes(log, InitialPoses.empty(), 0, 0.0, np.zeros(1, dtype=np.int64), ends, keys, frames, raw)
    assert ends.tolist() == [1, 8, 6]
    assert frames.frame_keys.tolist() == [-7] * 5 + [0, 0, 0, -7]
    assert raw.point_landmarks.tolist() == [-7, -7, 4, 9, 4, 2, -7, -7]
    assert raw.point_frames.tolist() == [-7, -7, 5, 5, 6, 7, -7, -7]
    assert raw.has_covariance.tolist() == [False, False, covered, covered, False, covered, False, False]
    np.testing.assert_array_equal(raw.points[2:6], points[rows])
    np.testing.assert_array_equal(raw.point_noises[2:6], covariances[rows] if covered else np.zeros((4, 6)))
    assert (raw.points[[0, 1, 6, 7]] == -7.0).all()


NO_ALIASES = np.zeros((0, 2), dtype=np.int64)


def settled(known, names, aliases=NO_ALIASES, old=(), frozen=((), ()), held=NO_LANDMARK_POSITIONS, seed=0):
    """Return rows of new measurements' landmarks, all landmarks, and where each measurement lies in the map."""
    rng, n = np.random.default_rng(seed), len(names)
    poses, offsets, mount = rng.normal(size=(3, 3)), rng.normal(size=(5, 3)), rng.normal(size=3)
    frame_keys, frames = rng.integers(0, 3, 5), rng.integers(0, 5, n)
    raw = room_for(0, 0, n)[2]._replace(point_frames=frames, point_landmarks=np.array(names, dtype=np.int64))
    raw.points[:] = rng.normal(size=(n, 3))
    at = compose(poses[frame_keys[frames]], offsets[frames])
    expected = [transform_points(pose, point + mount) for pose, point in zip(at, raw.points, strict=True)]
    s = len(frozen[0])
    landmarks = number_landmarks(
        aliases, raw, np.array(old, dtype=np.int64),
        Condensed(
            np.zeros(s, dtype=np.int64), np.array(frozen[0], dtype=np.int64), np.zeros((s, 3)), np.zeros((s, 6)),
            np.zeros((s, 3)), np.array(frozen[1], dtype=np.int64),
        ),
        Landmarks(np.array(known, dtype=np.int64), np.full((len(known), 3), -1.0)), held,
        Frames(frame_keys, offsets), poses, mount,
    )  # fmt: skip
    return raw.point_landmarks, landmarks, np.array(expected).reshape(-1, 3)


@pytest.mark.slow
@given(st.lists(st.integers(0, 9), unique=True, max_size=8), st.lists(st.integers(0, 12), max_size=20))
def test_landmarks_are_numbered_in_order_of_appearance(known, names):
    """A known landmark keeps row and place, a new one gets the next row and the place of its first measurement.

    A point is placed as composed of the key, the frame seen from it and the camera on the robot.
    """
    expected = {name: row for row, name in enumerate(known)}
    first = [n for n, name in enumerate(names) if name not in known and name not in names[:n]]
    for n in first:
        expected[names[n]] = len(expected)
    rows, landmarks, places = settled(known, names)
    assert rows.tolist() == [expected[name] for name in names]
    assert landmarks.landmark_ids.tolist() == list(expected)
    assert (landmarks.landmarks[: len(known)] == -1.0).all()
    np.testing.assert_allclose(landmarks.landmarks[len(known) :], places[first], atol=1e-12)


@given(st.lists(st.integers(0, 5), max_size=8), st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5)), max_size=4))
def test_names_are_changed_in_the_order_in_which_landmarks_were_found_to_be_one(names, aliases):
    """Each pair is applied to all ids before the next one, in a graph as in new measurements."""
    given_aliases = np.array(aliases, dtype=np.int64).reshape(-1, 2)
    graph = replace(SlamGraph.at_starts(np.zeros((1, 3))), merged_ids=given_aliases)
    found, expected = graph.resolve_ids(np.array(names, dtype=np.int64)), list(names)
    for old, new in aliases:
        expected = [new if name == old else name for name in expected]
    assert found.tolist() == expected
    rows, landmarks, _ = settled([], names, given_aliases)
    assert landmarks.landmark_ids[rows].tolist() == expected


def test_landmarks_with_more_new_measurements_than_old_start_again():
    """Old ones are those in frozen sightings and raw ones; as many is not more. Only what the filter holds moves."""
    known, held = [9, 3, 8, 7, 1, 6], LandmarkPositions(np.array([1, 3, 7, 8, 9]), np.arange(15.0).reshape(5, 3))
    new = [9, 3, 3, 3, 8, 7, 6]
    old = {"old": (0, 2), "frozen": ((0, 1, 1), (2, 1, 1))}
    _, landmarks, _ = settled(known, new, held=held, **old)
    assert landmarks.landmarks[:, 0].tolist() == [-1.0, 3.0, -1.0, 6.0, -1.0, -1.0]  # 3 and 7 are held, and 6 is not
    assert (settled(known, new, **old)[1].landmarks == -1.0).all()


def test_variances_are_squared_sigmas():
    """The variances of many readings are the squares of the deviations of each."""
    model, motions = OdometryModel(), np.random.default_rng(1).normal(size=(20, 3))
    np.testing.assert_allclose(model.variances(motions), [model.sigmas(motion) ** 2 for motion in motions])


def test_frames_are_placed_by_odometry():
    """A frame seen from its key is where the odometry between puts it, and the newest pose is always a key."""
    run = small_run()
    start, [log] = SlamGraph.at_starts(run.true_paths[:, 0]), logs_of(run)
    mount, motion = np.array(run.spec.noise.camera.mount), run.spec.noise.motion
    shared = extend_graph(start, [log.arrays()], motion, mount, rigid_within=0.06)
    each = graph_of(run)
    assert 2 < shared.num_keys < each.num_keys / 1.5
    assert len(shared.frame_keys) == len(each.frame_keys)
    np.testing.assert_allclose(shared.poses[shared.last_keys], each.poses[each.last_keys], atol=1e-12)
    stood = compose(shared.poses[shared.frame_keys], shared.frame_offsets)
    off = stood - compose(each.poses[each.frame_keys], each.frame_offsets)
    off[:, 2] = wrap_angle(off[:, 2])
    np.testing.assert_allclose(off, 0.0, atol=1e-12)
    np.testing.assert_allclose(shared.landmarks, each.landmarks, atol=1e-12)
    assert shared.rigid_variances.max() < 0.06**2
    assert (shared.rigid_variances > 0).any()


@pytest.mark.parametrize("rigid_within", [0.0, 0.02])
def test_steps_in_one_place_share_its_key(rigid_within):
    """A robot that hardly turns measures from few keys if they may be shared, and what it has seen is all there."""
    run = small_run()
    [log] = logs_of(run)
    still = log.arrays()
    motions = np.where(still.kinds[:, None] == ODOMETRY, [0.0, 0.0, 1e-4], 0.0)
    still = type(still)(**{name: getattr(still, name) for name in still.__dataclass_fields__} | {"motions": motions})
    graph = extend_graph(
        SlamGraph.at_starts(np.zeros((1, 3))), [still], run.spec.noise.motion, np.zeros(3), rigid_within=rigid_within
    )
    assert graph.num_keys == (len(still) if rigid_within == 0.0 else 2)  # the start, and where it stands now
    assert len(graph.points) == len(still.ids)


@pytest.mark.parametrize("seed", [101, 102])
def test_sharing_keyframes_changes_the_newest_pose_little(seed):
    """Where keys share less than measurements err, the newest pose agrees with that of a key at each step."""
    run = simulate_run(RunSpec(length=15.0, landmarks=120, measurements=7, preset="paper"), seed)
    log, motion, camera = logs_of(run)[0].arrays(), run.spec.noise.motion, camera_of(run)
    start = SlamGraph.at_starts(run.true_paths[:, 0])
    results = []
    for rigid_within in (0.0, 0.02):
        options = SmoothingOptions(max_keys=1000, recent_keys=1000, rigid_within=rigid_within)
        results.append(rejuvenate(start, [log], motion, camera, 50, np.random.default_rng(1), options))
    each, shared = results
    assert each.reason == shared.reason == ""
    assert shared.graph.num_keys < each.graph.num_keys / 3
    apart = between(each.particles.means[0], shared.particles.means[0])
    assert apart @ np.linalg.solve(each.particles.covariances[0], apart) < 0.5
