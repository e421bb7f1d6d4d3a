"""Robots that stand, however long: they are rejuvenated once they move, and what they saw meanwhile is condensed."""

from typing import Any

import numpy as np
import pytest
from same_bits import assert_same
from small_problems import TIGHT, camera_of, logs_of, small_run, upper

from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.run_log import RobotLog
from slam_backend.models.measurements import Measurements
from slam_backend.models.odometry import OdometryModel
from slam_backend.smoother.graph import PathGraph
from slam_backend.smoother.graph_building import extended
from slam_backend.smoother.graph_reduction import MOST_FRAMES, at_mode, coarsened
from slam_backend.smoother.optimizer import find_mode
from slam_backend.smoother.options import SmoothingOptions
from training.bench.accuracy.runs import StereoRun

EVERY = 10
FEW_KEYS = {"max_keys": 10, "fresh_keys": 5}  # so that a log is taken in 20 steps at a time


def at_rest(run: StereoRun, step: int, count: int, odometry: Any = None) -> list[dict[str, Any]]:
    """Return readings of a robot that stands where the run is after a step: the same points, measured anew."""
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


@pytest.mark.parametrize("slice_steps", [None, 4])
def test_a_robot_that_waits_is_rejuvenated_once_it_moves(slice_steps: int | None) -> None:
    """However long it stands at its start there is no pose to seek, told once per interval; then there are poses."""
    run = small_run()
    slam = filter_of(run, smoothing=SmoothingOptions(slice_steps=slice_steps, **FEW_KEYS))
    waited = [slam.step(**reading).rejuvenation for reading in at_rest(run, 0, 60)]
    moved = [slam.step(**reading).rejuvenation for reading in list(run.readings())[1:]]
    assert [told.reason for told in waited if told is not None] == 6 * ["no pose to seek"]
    reasons = [told.reason for told in moved if told is not None]
    assert reasons == len(reasons) * [""]
    assert reasons
    off = slam.pose().mean - run.true_paths[0, -1]
    assert np.hypot(off[0], off[1]) < 0.1


@pytest.mark.parametrize("before", [0, 8])
def test_a_wait_of_any_length_needs_no_more_room(before: int) -> None:
    """At the start or on the way, what is to be worked through never exceeds what `MOST_FRAMES` frames hold."""
    run = small_run()
    slam, held = filter_of(run), []
    for reading in list(run.readings())[: before + 1]:
        slam.step(**reading)
    for reading in at_rest(run, before, 4 * MOST_FRAMES):
        if slam.step(**reading).rejuvenation is not None:
            state = slam.get_state()["rejuvenation"]
            held.append(len(state["graph"]["points"]) + len(state["graph"]["frozen_keys"]))
            assert len(state["guesses"][0][0]) < EVERY
    assert len(held) >= 4 * MOST_FRAMES // EVERY
    assert max(held) <= run.spec.measurements * (before + MOST_FRAMES + EVERY)


def test_many_frames_of_one_key_are_condensed_at_the_mode() -> None:
    """A fresh key of too many frames keeps none of its measurements, and mode and information stay as they are."""
    run = small_run()
    log, moving = RobotLog(), logs_of(run)[0]
    camera = run.spec.noise.camera
    for step, reading in enumerate(at_rest(run, 0, MOST_FRAMES + 1)):
        points = camera.robot_from_camera(reading["measurements"][0].points) - np.array(camera.mount)
        log.append(step, points=points, ids=run.names[0][0])
    for row in list(moving)[1:]:
        log.append(MOST_FRAMES + row.step, row.motion, points=row.points, ids=row.ids)
    start = PathGraph.at_starts(run.true_paths[:, 0])
    graph = extended(start, [log.arrays()], run.spec.noise.motion, np.array(camera.mount))
    mode = find_mode(graph, camera_of(run), TIGHT)
    fewer = coarsened(at_mode(graph, mode), camera_of(run), TIGHT)
    assert fewer.num_keys == graph.num_keys
    assert sorted(set(fewer.frozen_keys)) == [0]
    assert not (fewer.frame_keys[fewer.point_frames] == 0).any()
    again = find_mode(fewer, camera_of(run), TIGHT)
    np.testing.assert_allclose(again.poses, mode.poses, atol=1e-8)
    one, same = upper(again), upper(mode)
    np.testing.assert_allclose(one.T @ one, same.T @ same, rtol=1e-6, atol=1e-3)


@pytest.mark.parametrize("slice_steps", [None, 4])
def test_a_filter_restored_while_it_waits_goes_on_bit_for_bit(slice_steps: int | None) -> None:
    """What a robot saw at rest is in snapshots, condensed or not."""
    run = small_run()
    slam = filter_of(run, smoothing=SmoothingOptions(slice_steps=slice_steps, **FEW_KEYS))
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
