"""The work of a smoother in slices: the same result, and a bound on what is done in one step."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from same_bits import assert_same
from small_problems import TIGHT, camera_of, graph_of, logs_of, small_run

from slam_backend.fastslam.filter import FastSlam
from slam_backend.geometry import wrap_angle
from slam_backend.models.odometry import OdometryModel
from slam_backend.smoother import rejuvenation as slices
from slam_backend.smoother.graph import PathGraph
from slam_backend.smoother.graph_building import Guesses, Places, first_rows
from slam_backend.smoother.optimizer import find_mode
from slam_backend.smoother.options import SmoothingOptions
from slam_backend.smoother.rejuvenation import Draft, Smoother

NOWHERE = Places(np.zeros(0, dtype=np.int64), np.zeros((0, 3)))
IN_SLICES = SmoothingOptions(slice_steps=8, max_keys=20, fresh_keys=8)
IN_MANY = replace(IN_SLICES, tolerance=1e-9)  # no descent ends in the slice in which it begins


def test_slices_end_where_all_at_once_does():
    """Taken in four keys at a time, one Gauss-Newton step a slice, a run has the mode of the whole graph."""
    run = small_run(2)
    smoother = Smoother(run.spec.noise.motion, camera_of(run), TIGHT, np.random.default_rng(1))
    graph, steps = PathGraph.at_starts(run.true_paths[:, 0]), 0
    logs = [log.arrays() for log in logs_of(run)]
    for upto in range(4, run.num_steps + 4, 4):
        part = [first_rows(log, upto).since(int(graph.latest[0]) + 1) for log in logs]
        state = smoother.take_in(graph, part, 2 * [Guesses.none()], NOWHERE)
        while isinstance(state, Draft):
            state = smoother.descend(state)
            steps += 1
        assert isinstance(state, PathGraph)
        graph = state
    whole = graph_of(run)
    mode = find_mode(whole, camera_of(run), TIGHT)
    assert steps > 0
    for robot in range(2):
        apart = graph.poses[graph.robots == robot] - mode.poses[whole.robots == robot]
        apart[:, 2] = wrap_angle(apart[:, 2])
        np.testing.assert_allclose(apart, 0.0, atol=1e-6)
    order, same = np.argsort(graph.landmark_ids), np.argsort(whole.landmark_ids)
    np.testing.assert_allclose(graph.landmarks[order], mode.landmarks[same], atol=1e-6)


def test_no_step_does_more_than_its_slice(monkeypatch):
    """However long the run, no step solves for more keys than the limit and two slices, nor more than three times."""
    run = small_run(length=30.0)
    slam = run.build_filter(30, "fastslam2", 1, rejuvenate_every=25, smoothing=IN_SLICES)
    solved = []

    def noted(graph, *arguments):
        mode = find_mode(graph, *arguments)
        solved.append((graph.num_keys, mode.iterations))
        return mode

    monkeypatch.setattr(slices, "find_mode", noted)
    drawn = []
    for reading in run.readings():
        solved.clear()
        report = slam.step(**reading).rejuvenation
        assert len(solved) <= 1
        assert all(keys <= 20 + 2 * 8 and steps <= slices.LAST_STEPS for keys, steps in solved)
        drawn += [] if report is None else [report.reason]
    assert len(drawn) >= 3
    assert set(drawn) == {""}


def test_particles_drawn_in_slices_are_as_good():
    """In slices or at once, in the same step, the newest poses agree to a part of their doubt."""
    run = small_run(length=8.0)
    sliced = run.build_filter(200, "fastslam2", 1, rejuvenate_every=26, smoothing=SmoothingOptions(slice_steps=8))
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
def test_a_snapshot_between_slices_goes_on_bit_for_bit(taken):
    """Taken in the middle of a descent or not, a snapshot goes on as the filter does."""
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


def test_snapshots_catch_a_descent_in_the_middle():
    """Some steps leave a descent unfinished: the state says how far it is."""
    run = small_run(2)
    slam = run.build_filter(20, "fastslam2", 1, rejuvenate_every=18, smoothing=IN_MANY)
    drafts = []
    for reading in run.readings():
        slam.step(**reading)
        drafts.append(slam.get_state()["rejuvenation"]["draft"])
    assert any(draft is not None for draft in drafts)
    assert any(draft is None for draft in drafts[10:])


@pytest.mark.parametrize("slice_steps", [None, 8])
def test_a_descent_that_keeps_failing_blocks_nothing(slice_steps):
    """What cannot be smoothed is left out, the report says so, and the smoother goes on with what comes next."""
    run = small_run(length=8.0)
    smoothing = SmoothingOptions(max_iterations=1, tolerance=1e-5, slice_steps=slice_steps)
    slam = run.build_filter(20, "fastslam2", 1, landmark_noise=0.0, rejuvenate_every=6, smoothing=smoothing)
    reasons = [slam.step(**reading).rejuvenation for reading in run.readings()]
    told = [report.reason for report in reasons if report is not None]
    assert any(reason.endswith("; what was measured since the last time is left out") for reason in told)
    graph: Mapping[str, np.ndarray] = slam.get_state()["rejuvenation"]["graph"]
    assert graph["latest"][0] > 6
    assert len(slam.get_state()["rejuvenation"]["guesses"][0][0]) <= 2 * 6


def test_where_there_is_nothing_to_smooth_slices_wait():
    """Odometry without noise is found out once per interval, not in each step."""
    run = small_run()
    still = OdometryModel(
        sigma_along=0.0, sigma_across=0.0, sigma_heading=0.0, sigma_turn=0.0, floor_position=0.0, floor_heading=0.0
    )
    slam = run.build_filter(20, "fastslam2", 1, rejuvenate_every=8, smoothing=IN_SLICES, motion=still)
    told = [slam.step(**reading).rejuvenation for reading in run.readings()]
    assert [report.reason for report in told if report is not None] == 2 * ["odometry without noise"]
