"""Smoothing in slices, one per step: the result of smoothing at once, with bounded work per step."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from builders.comparison import assert_same
from builders.runs import TIGHT, camera_of, graph_of, logs_of, small_run, upper
from builders.worlds import EXACT_MOTION
from hypothesis import given
from hypothesis import strategies as st

from slam_backend.fastslam import rejuvenation as scheduler
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.run_log import RobotLog
from slam_backend.geometry import wrap_angle
from slam_backend.maps.alignment_types import AlignmentOptions
from slam_backend.models.measurements import Measurements
from slam_backend.models.odometry import OdometryModel
from slam_backend.smoother import rejuvenation
from slam_backend.smoother.graph import SlamGraph
from slam_backend.smoother.graph_building import InitialPoses, LandmarkPositions, extend_graph, log_head
from slam_backend.smoother.graph_reduction import MAX_FRAMES, reduce_keyframes, relinearise
from slam_backend.smoother.log_arrays import LogArrays
from slam_backend.smoother.optimizer import MapEstimate, optimize
from slam_backend.smoother.options import SmoothingOptions, keyframe_limit
from slam_backend.smoother.rejuvenation import Draft, Smoother
from training.stereo_runs.runs import StereoRun

NOWHERE = LandmarkPositions(np.zeros(0, dtype=np.int64), np.zeros((0, 3)))
# Slices of eight steps of each robot: the least
IN_SLICES = SmoothingOptions(incremental=True, slice_share=0.01, max_keys=20, recent_keys=8)
IN_MANY = replace(IN_SLICES, tolerance=1e-9)  # no descent ends in the slice in which it begins


def test_slices_give_the_result_of_one_optimisation():
    """Taken in four keys at a time, one Gauss-Newton step a slice, a run has the mode of the whole graph."""
    run = small_run(2)
    smoother = Smoother(run.spec.noise.motion, camera_of(run), TIGHT, np.random.default_rng(1), AlignmentOptions())
    graph, steps = SlamGraph.at_starts(run.true_paths[:, 0]), 0
    logs = [log.arrays() for log in logs_of(run)]
    for upto in range(4, run.num_steps + 4, 4):
        part = [log_head(log, upto).since(int(graph.latest[0]) + 1) for log in logs]
        state = smoother.add_logs(graph, part, 2 * [InitialPoses.empty()], NOWHERE)
        while isinstance(state, Draft):
            state = smoother.optimise_slice(state)
            steps += 1
        assert isinstance(state, SlamGraph)
        graph = state
    whole = graph_of(run)
    mode = optimize(whole, camera_of(run), TIGHT)
    assert steps > 0
    for robot in range(2):
        apart = graph.poses[graph.robots == robot] - mode.poses[whole.robots == robot]
        apart[:, 2] = wrap_angle(apart[:, 2])
        np.testing.assert_allclose(apart, 0.0, atol=1e-6)
    order, same = np.argsort(graph.landmark_ids), np.argsort(whole.landmark_ids)
    np.testing.assert_allclose(graph.landmarks[order], mode.landmarks[same], atol=1e-6)


def test_the_work_per_step_is_bounded(monkeypatch):
    """However long the run, no step solves for more keys than the limit and two slices, nor more than three times."""
    run = small_run(length=30.0)
    slam = run.build_filter(30, "fastslam2", 1, rejuvenate_every=25, smoothing=IN_SLICES)
    solved = []

    def noted(graph, *arguments):
        mode = optimize(graph, *arguments)
        limit = keyframe_limit(IN_SLICES, len(graph.landmark_ids), graph.latest)
        solved.append((graph.num_keys - limit, mode.iterations))
        return mode

    monkeypatch.setattr(rejuvenation, "optimize", noted)
    drawn = []
    for reading in run.readings():
        solved.clear()
        report = slam.step(**reading).rejuvenation
        assert len(solved) <= 1
        assert all(surplus <= 2 * 8 and steps <= rejuvenation.LAST_STEPS for surplus, steps in solved)
        drawn += [] if report is None else [report.reason]
    assert len(drawn) >= 3
    assert set(drawn) == {""}


@pytest.mark.parametrize("share", [0.01, 0.5, 0.8])
def test_slices_grow_with_the_graph(share: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each slice takes its share of the keys as new steps, and at least eight, from the first step on."""
    taken, add_logs = [], Smoother.add_logs

    def noted(self: Smoother, graph: SlamGraph, logs: Sequence[LogArrays], *rest: Any) -> SlamGraph | Draft | str:
        taken.append((int(logs[0].steps[-1] - graph.latest[0]), graph.num_keys))
        return add_logs(self, graph, logs, *rest)

    monkeypatch.setattr(Smoother, "add_logs", noted)
    run = small_run(length=30.0)
    smoothing = replace(IN_SLICES, slice_share=share)
    slam = run.build_filter(30, "fastslam2", 1, rejuvenate_every=1000, smoothing=smoothing)
    for reading in run.readings():
        slam.step(**reading)
    assert [steps for steps, _ in taken] == [max(8, int(share * keys)) for _, keys in taken]
    assert len(taken) > 3


def test_all_slices_in_one_step_are_those_of_many() -> None:
    """A filter that smooths all at once is bit for bit one that does slice after slice of the same work."""
    run = small_run(2, length=8.0)
    found = []
    for incremental in (False, True):
        smoothing = SmoothingOptions(incremental=incremental, slice_share=0.01, max_keys=20, recent_keys=8)
        slam = run.build_filter(20, "fastslam2", 1, rejuvenate_every=1000, smoothing=smoothing)
        slam.may_smooth = False
        for reading in run.readings():
            slam.step(**reading)
        slices, work = 0, slam._smooth
        smoother = slam.rejuvenation
        assert smoother is not None
        smoother.request()
        while (report := work(smoother)) is None:
            slices += 1
        assert report.reason == ""
        assert (slices > 1) == incremental
        state = slam.get_state()
        found.append({name: value for name, value in state.items() if name != "options"})
    assert_same(*found)


def test_particles_sampled_in_slices_are_as_accurate():
    """In slices or at once, in the same step, the newest poses agree within a share of their uncertainty."""
    run = small_run(length=8.0)
    smoothing = SmoothingOptions(incremental=True, slice_share=0.01)
    sliced = run.build_filter(200, "fastslam2", 1, rejuvenate_every=26, smoothing=smoothing)
    readings = iter(run.readings())
    steps = next(step for step, reading in enumerate(readings, 1) if sliced.step(**reading).rejuvenation is not None)
    whole = run.build_filter(200, "fastslam2", 1, rejuvenate_every=steps)
    for reading in list(run.readings())[:steps]:
        report = whole.step(**reading).rejuvenation
    assert report is not None
    one, two = sliced.pose(0), whole.pose(0)
    apart = one.mean - two.mean
    assert apart @ np.linalg.solve(two.covariance, apart) < 0.5
    np.testing.assert_allclose(np.diag(one.covariance), np.diag(two.covariance), rtol=0.2)


@pytest.mark.parametrize("taken", range(8, 13))
def test_a_snapshot_between_slices_continues_bit_for_bit(taken):
    """Taken in the middle of a descent or not, a restored filter continues like the original."""
    run = small_run(2)
    readings = list(run.readings())
    slam = run.build_filter(20, "fastslam2", 1, rejuvenate_every=18, smoothing=IN_MANY)
    for reading in readings[:taken]:
        slam.step(**reading)
    state = slam.get_state()
    other = FastSlam(2, num_particles=3, seed=9)
    other.set_state(state)
    for reading in readings[taken:]:
        assert_same(slam.step(**reading), other.step(**reading), "report")
    assert_same(slam.get_state(), other.get_state())


def test_snapshots_hold_an_unfinished_descent():
    """Some steps leave a descent unfinished: the state says how far it is."""
    run = small_run(2)
    slam = run.build_filter(20, "fastslam2", 1, rejuvenate_every=18, smoothing=IN_MANY)
    drafts = []
    for reading in run.readings():
        slam.step(**reading)
        drafts.append(slam.get_state()["rejuvenation"]["draft"])
    assert any(draft is not None for draft in drafts)
    assert any(draft is None for draft in drafts[10:])


@pytest.mark.parametrize("incremental", [False, True])
def test_a_failing_descent_does_not_block_the_smoother(incremental):
    """What cannot be smoothed is left out, the report says so, and the smoother continues with new input."""
    run = small_run(length=8.0)
    smoothing = SmoothingOptions(max_iterations=1, tolerance=1e-5, incremental=incremental)
    slam = run.build_filter(20, "fastslam2", 1, landmark_noise=0.0, rejuvenate_every=6, smoothing=smoothing)
    reasons = [slam.step(**reading).rejuvenation for reading in run.readings()]
    told = [report.reason for report in reasons if report is not None]
    assert any(reason.endswith("; measurements since the last rejuvenation are dropped") for reason in told)
    smoother = slam.get_state()["rejuvenation"]
    assert smoother["graph"].latest[0] > 6
    assert len(smoother["initial_poses"][0].steps) <= 2 * 6


@pytest.mark.parametrize(("seed", "kernel", "tolerance"), [(139, 0.3, 1e-6), (150, 4.0, 1e-6), (101, 16.0, 1e-300)])
def test_a_slow_descent_is_not_repeated_within_a_step(
    seed: int, kernel: float, tolerance: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Once all keys are at the mode of slices, one descent decides: a rejuvenation at once has bounded work."""
    run, solved = small_run(length=12.0, seed=seed), []
    smoothing = SmoothingOptions(kernel=kernel, tolerance=tolerance, max_keys=20, recent_keys=8)
    slam = run.build_filter(20, "fastslam2", 1, rejuvenate_every=12, smoothing=smoothing)

    def noted(*arguments: Any) -> MapEstimate:
        solved.append(optimize(*arguments))
        assert solved[-1].iterations <= smoothing.max_iterations
        return solved[-1]

    monkeypatch.setattr(rejuvenation, "optimize", noted)
    tried = 0
    for reading in run.readings():
        solved.clear()
        tried += slam.step(**reading).rejuvenation is not None
        assert sum(mode.iterations for mode in solved) <= rejuvenation.LAST_STEPS + 2 * smoothing.max_iterations
    assert tried >= 3


def test_slices_wait_if_there_is_nothing_to_smooth():
    """Odometry without noise is found out once per interval, not in each step."""
    run = small_run()
    slam = run.build_filter(20, "fastslam2", 1, rejuvenate_every=8, smoothing=IN_SLICES, motion=EXACT_MOTION)
    told = [slam.step(**reading).rejuvenation for reading in run.readings()]
    assert [report.reason for report in told if report is not None] == 2 * ["odometry without noise"]


EVERY = 10
FEW_KEYS = {"max_keys": 10, "recent_keys": 5}  # so that a log is taken in 20 steps at a time


def at_rest(run: StereoRun, step: int, count: int, odometry: Any = None) -> list[dict[str, Any]]:
    """Return readings of a robot that stands where the run is after a step: the same points, measured again."""
    camera, rng, readings = run.spec.noise.camera, np.random.default_rng(7), []
    frame, names = run.frames[step][0], run.names[step][0]
    for _ in range(count):
        pixels = camera.project(frame.points)
        pixels += rng.standard_normal(pixels.shape) * [camera.sigma_px, camera.sigma_px, camera.sigma_disparity_px]
        seen = Measurements(camera.triangulate(pixels), frame.descriptors)
        readings.append({"odometry": [odometry], "measurements": [seen], "identities": [names]})
    return readings


def filter_of(run: StereoRun, **options: Any) -> FastSlam:
    """Return a filter for a run, rejuvenated every few steps."""
    return run.build_filter(30, "fastslam2", 1, rejuvenate_every=EVERY, **options)


@pytest.mark.parametrize("incremental", [False, True])
def test_a_stationary_robot_is_rejuvenated_once_it_moves(incremental: bool) -> None:
    """Without motion there is no pose to estimate, which is reported once per interval."""
    run = small_run()
    slam = filter_of(run, smoothing=SmoothingOptions(incremental=incremental, **FEW_KEYS))
    waited = [slam.step(**reading).rejuvenation for reading in at_rest(run, 0, 60)]
    moved = [slam.step(**reading).rejuvenation for reading in list(run.readings())[1:]]
    assert [told.reason for told in waited if told is not None] == 6 * ["no pose to seek"]
    reasons = [told.reason for told in moved if told is not None]
    assert reasons == len(reasons) * [""]
    assert reasons
    off = slam.pose().mean - run.true_paths[0, -1]
    assert np.hypot(off[0], off[1]) < 0.1


@pytest.mark.parametrize("before", [0, 8])
def test_memory_is_bounded_while_a_robot_waits(before: int) -> None:
    """At the start or later, the pending input never exceeds that of `MAX_FRAMES` frames."""
    run = small_run()
    slam, held = filter_of(run), []
    for reading in list(run.readings())[: before + 1]:
        slam.step(**reading)
    for reading in at_rest(run, before, 4 * MAX_FRAMES):
        if slam.step(**reading).rejuvenation is not None:
            state = slam.get_state()["rejuvenation"]
            held.append(len(state["graph"].points) + len(state["graph"].condensed_keys))
            assert len(state["initial_poses"][0].steps) < EVERY
    assert len(held) >= 4 * MAX_FRAMES // EVERY
    assert max(held) <= run.spec.measurements * (before + MAX_FRAMES + EVERY)


def test_many_frames_of_one_key_are_condensed_at_the_mode() -> None:
    """A fresh key of too many frames keeps none of its measurements, and mode and information stay as they are."""
    run = small_run()
    log, moving = RobotLog(), logs_of(run)[0]
    camera = run.spec.noise.camera
    for step, reading in enumerate(at_rest(run, 0, MAX_FRAMES + 1)):
        points = camera.robot_from_camera(reading["measurements"][0].points) - np.array(camera.mount)
        log.append(step, points=points, ids=run.names[0][0])
    for row in list(moving)[1:]:
        log.append(MAX_FRAMES + row.step, row.motion, points=row.points, ids=row.ids)
    start = SlamGraph.at_starts(run.true_paths[:, 0])
    graph = extend_graph(start, [log.arrays()], run.spec.noise.motion, np.array(camera.mount))
    mode = optimize(graph, camera_of(run), TIGHT)
    fewer = reduce_keyframes(relinearise(graph, mode), camera_of(run), TIGHT)
    assert fewer.num_keys == graph.num_keys
    assert sorted(set(fewer.condensed_keys)) == [0]
    assert not (fewer.frame_keys[fewer.point_frames] == 0).any()
    again = optimize(fewer, camera_of(run), TIGHT)
    np.testing.assert_allclose(again.poses, mode.poses, atol=1e-8)
    one, same = upper(again), upper(mode)
    np.testing.assert_allclose(one.T @ one, same.T @ same, rtol=1e-6, atol=1e-3)


@pytest.mark.parametrize("incremental", [False, True])
def test_a_filter_restored_while_it_waits_continues_bit_for_bit(incremental: bool) -> None:
    """A snapshot holds the measurements made at rest, condensed or not."""
    run = small_run()
    slam = filter_of(run, smoothing=SmoothingOptions(incremental=incremental, **FEW_KEYS))
    for reading in at_rest(run, 0, 47):
        slam.step(**reading)
    other = FastSlam(1, num_particles=3, seed=9)
    other.set_state(slam.get_state())
    for reading in run.readings():
        slam.step(**reading)
        other.step(**reading)
    assert_same(slam.get_state(), other.get_state())


@pytest.mark.parametrize(
    "without",
    [
        {"floor_position": 0.0, "floor_heading": 0.0},
        {"sigma_across": 0.0, "floor_position": 0.0},
        {"sigma_heading": 0.0, "sigma_turn": 0.0, "floor_heading": 0.0},
    ],
)
def test_odometry_of_which_a_part_has_no_noise_is_smoothed(without: dict[str, float]) -> None:
    """Neither a model without floors, whose robot stands for a while, nor a part that is exact makes it refuse."""
    run = small_run()
    slam = filter_of(run, motion=OdometryModel(**without), landmark_noise=0.0)
    readings = list(run.readings())
    readings[11:11] = at_rest(run, 10, 5, odometry=np.zeros(3))
    told = [slam.step(**reading).rejuvenation for reading in readings]
    reasons = [report.reason for report in told if report is not None]
    assert reasons == 2 * [""]


STEPS = st.lists(st.integers(0, 30), unique=True).map(sorted)


@given(STEPS, STEPS, st.integers(-1, 31))
def test_initial_poses_are_looked_up_and_dropped_by_step(known, asked, last):
    """What was said of a step comes back, NaN of any other; after a step only later ones are known."""
    by_step = {step: np.random.default_rng(step).normal(size=3) for step in known}
    initial_poses, half = InitialPoses.empty(), len(known) // 2
    for part in (known[:half], known[half:]):
        poses = np.array([by_step[step] for step in part]).reshape(-1, 3)
        initial_poses = initial_poses.with_later(np.array(part, dtype=np.int64), poses)
    for left, first in ((initial_poses, -1), (initial_poses.after(last), last)):
        expected = [by_step[step] if step in by_step and step > first else np.full(3, np.nan) for step in asked]
        found = left.at(np.array(asked, dtype=np.int64))
        np.testing.assert_array_equal(found, np.array(expected).reshape(-1, 3))
        assert left.steps.tolist() == [step for step in known if step > first]


def test_a_rejuvenation_in_one_step_ends_whatever_its_slices_add(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is due at the beginning is done, though the sightings that slices add would let a later one wait."""
    counted, count = [], scheduler.max_pending_steps

    def watched(*arguments: Any) -> int:
        counted.append(1)
        assert len(counted) < 1000
        return count(*arguments)

    monkeypatch.setattr(scheduler, "max_pending_steps", watched)
    run = small_run(length=12.0)
    smoothing = SmoothingOptions(effort=0.2, free_sightings=0, max_keys=10, recent_keys=5)
    slam = run.build_filter(20, "fastslam2", 1, rejuvenate_every=30, smoothing=smoothing)
    reports = [slam.step(**reading).rejuvenation for reading in run.readings()]
    assert [report.reason for report in reports if report is not None] == [""]
