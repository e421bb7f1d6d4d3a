"""Frames of large maps are compared with the landmarks in reach alone, which changes no match."""

from typing import Any

import numpy as np
import pytest
from builders.filters import plain_filter

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.fastslam._kernels.association.candidates import LARGE_MAP
from slam_backend.fastslam.filter import FastSlam
from slam_backend.geometry import compose, inverse, transform_points
from slam_backend.models.camera import ROBOT_FROM_CAMERA, StereoCamera
from slam_backend.models.measurements import Measurements
from slam_backend.models.odometry import OdometryModel
from tests.builders.filters import load_landmarks

MOTION = OdometryModel(sigma_along=0.1, sigma_across=0.05, sigma_heading=0.02, sigma_turn=0.05)
LOOSE = OdometryModel(sigma_along=12.0, sigma_across=8.0, sigma_heading=0.02, sigma_turn=0.05)
COARSE = StereoCamera(sigma_px=5.0, sigma_disparity_px=2.0)  # five sigmas leave a depth of 7.7 m unbounded
MOVE = np.array([0.8, 0.05, 0.2])
NUM_LOOKS = 12
OTHERS = LARGE_MAP + 1  # landmarks that look like nothing that is ever measured


def looks(kinds: IntArray, others: int = 0) -> np.ndarray:
    """Return descriptors (n + others, 16): unit vectors by kind, and another one."""
    return np.eye(16, dtype=np.float32)[np.concatenate([kinds, np.full(others, NUM_LOOKS)])]


def filter_with(
    points: FloatArray, kinds: IntArray, others: int, seed: int, scatter: float, largest_sigma: float, **options: Any
) -> FastSlam:
    """Return a filter that knows landmarks, by ids from 0 on, and as many others.

    Args:
        points: (n, 3) [m] where they are; particles disagree by some centimetres.
        kinds: (n,) what they look like.
        others: Number of landmarks that look like nothing measured.
        seed: Seed of places and covariances.
        scatter: Standard deviation of the particles' starts [m].
        largest_sigma: Largest standard deviation of a landmark along each axis [m].
        options: See `FastSlam`.
    """
    rng = np.random.default_rng(seed)
    slam = plain_filter(seed=5, **({"motion": MOTION, "num_particles": 60} | options))
    state, num, m = slam.state, len(points) + others, slam.num_particles
    values = np.zeros((num, 9, m))
    values[: len(points), :3] = points[:, :, None] + 0.05 * rng.standard_normal((len(points), 3, m))
    values[: len(points), [3, 6, 8]] = rng.uniform(0.001, largest_sigma, (len(points), 1, 1)) ** 2
    values[len(points) :, :2] = rng.uniform(-100.0, 100.0, (others, 2, 1))
    values[len(points) :, [3, 6, 8]] = 0.01
    ids = np.arange(num)
    load_landmarks(
        state.maps, values, np.full((num, 1), 2), looks(kinds, others), ids, np.full(num, -1), 10 * LARGE_MAP
    )
    state.poses[0, :2, :m] = scatter * np.random.default_rng(3).standard_normal((2, m))
    state.means[:] = state.poses
    return slam


def drive(
    slam: FastSlam, points: FloatArray, kinds: IntArray, seed: int, sigma: float | None, strangers: int = 2
) -> list[bytes]:
    """Drive a robot 40 steps, 8 of them without a look around; return what the filter says after each.

    Args:
        slam: The filter.
        points, kinds: Landmarks of the world.
        seed: Seed of the motion and the measurements.
        sigma: Stated standard deviation of measurements along each axis [m]; None: by the camera's model.
        strangers: Number of measurements in each frame that no landmark of the world has caused.
    """
    rng, pose, told = np.random.default_rng(seed), np.zeros(3), []
    for step in range(40):
        pose = compose(pose, MOVE + rng.standard_normal(3) * MOTION.sigmas(MOVE))
        frame = None
        if not 15 <= step < 23:
            local = transform_points(inverse(pose), points)
            seen = np.flatnonzero((local[:, 0] > 0.5) & (np.hypot(local[:, 0], local[:, 1]) < 9.0))[:8]
            noisy = local[seen] * (1.0 + 0.01 * rng.standard_normal((len(seen), 1)))
            of_nothing = rng.uniform([1.0, -1.0, -0.5], [8.0, 1.0, 0.5], (strangers, 3))
            all_points = np.concatenate([noisy, of_nothing])
            all_looks = looks(np.concatenate([kinds[seen], rng.integers(0, NUM_LOOKS, strangers)]))
            covariances = None if sigma is None else np.tile(sigma**2 * np.eye(3), (len(all_points), 1, 1))
            frame = Measurements(all_points @ ROBOT_FROM_CAMERA, all_looks, covariances)
        report = slam.step([MOVE], [frame])
        numbers = np.array([report.num_new, report.num_matched, report.num_rejected])
        told.append(
            slam.state.poses[:, :, : slam.num_particles].tobytes() + slam.state.weights.tobytes() + numbers.tobytes()
        )
    return told


@pytest.mark.parametrize("proposal", ["fastslam1", "fastslam2"])
@pytest.mark.parametrize(
    ("sigma", "largest_sigma", "scatter", "options"),
    [
        (0.2, 0.02, 0.0, {}),
        (0.2, 0.02, 15.0, {}),
        (0.2, 0.02, 0.0, {"motion": LOOSE, "num_particles": 3}),
        (0.2, 6.0, 0.0, {}),
        (5.0, 0.02, 0.0, {}),
    ],
)
def test_no_landmark_is_left_out_that_could_be_matched(
    proposal: str, sigma: float, largest_sigma: float, scatter: float, options: dict[str, Any]
) -> None:
    """Without recovery, candidates outside of all gates play no part, at any distance.

    So a map that is compared wholly gives the same as one that is large by landmarks which look like nothing measured.
    """
    assert_alike(scatter, largest_sigma, sigma, 2, 2.8, proposal=proposal, recovery_position=0.0, **options)


@pytest.mark.parametrize("camera", [StereoCamera(), COARSE])
def test_no_landmark_is_left_out_whose_depth_may_agree(camera: StereoCamera) -> None:
    """The same with the camera's own noise, for landmarks known well.

    Others at right angles to the heading have a small D at any distance: they are linearised at a depth near zero.
    """
    assert_alike(0.0, 0.002, None, 0, 4.0, proposal="fastslam1", camera=camera)


def assert_alike(
    scatter: float, largest_sigma: float, sigma: float | None, strangers: int, farther: float, **options: Any
) -> None:
    """Drive with a map that is compared wholly and with one that is not, and expect the same.

    Args:
        scatter, largest_sigma, options: See `filter_with`.
        sigma, strangers: See `drive`.
        farther: Factor by which some landmarks are farther than others of their looks, which are seen first [-].
    """
    rng = np.random.default_rng(7)
    points = np.column_stack([rng.uniform(-60.0, 60.0, (1500, 2)), rng.uniform(-0.5, 0.5, 1500)])
    points[:40, :2] = rng.uniform(-14.0, 14.0, (40, 2))
    kinds = rng.integers(0, NUM_LOOKS, len(points))
    points[8:16, 0], points[8:16, 1:] = 8.5, rng.uniform(-1.0, 1.0, (8, 2))
    points[:8], kinds[:8] = farther * points[8:16], kinds[8:16]  # far behind them in the same direction
    small = filter_with(points, kinds, 0, 7, scatter, largest_sigma, **options)
    large = filter_with(points, kinds, OTHERS, 7, scatter, largest_sigma, **options)
    assert drive(small, points, kinds, 3, sigma, strangers) == drive(large, points, kinds, 3, sigma, strangers)


@pytest.mark.parametrize("sigma", [None, 0.2])
@pytest.mark.parametrize("proposal", ["fastslam1", "fastslam2"])
def test_landmarks_out_of_reach_play_no_part(proposal: str, sigma: float | None) -> None:
    """A thousand that look alike, 70 m away and more, neither match nor tell the filter that it is lost."""
    rng = np.random.default_rng(8)
    angles, distances = rng.uniform(-np.pi, np.pi, 1060), rng.uniform(70.0, 300.0, 1060)
    points = np.column_stack([distances * np.cos(angles), distances * np.sin(angles), np.zeros(1060)])
    near = np.sort(rng.permutation(1060)[:60])
    points[near] = np.column_stack([rng.uniform(-14.0, 14.0, (60, 2)), rng.uniform(-0.5, 0.5, 60)])
    kinds = rng.integers(0, NUM_LOOKS, 1060)
    small = filter_with(points[near], kinds[near], 0, 2, 0.1, 0.1, proposal=proposal)
    large = filter_with(points, kinds, OTHERS, 2, 0.1, 0.1, proposal=proposal)
    large.state.maps.blocks[near] = small.state.maps.blocks[:60]
    assert drive(small, points[near], kinds[near], 6, sigma) == drive(large, points[near], kinds[near], 6, sigma)


def test_a_snapshot_of_a_large_map_goes_on_in_the_same_way() -> None:
    """Which landmarks are in reach follows from a state alone, whatever slots they had before.

    Landmarks at right angles to the heading show it: beyond the reach they are compared in no layout of the slots.
    """
    rng = np.random.default_rng(4)
    points = np.column_stack([rng.uniform(-150.0, 150.0, (4000, 2)), rng.uniform(-0.5, 0.5, 4000)])
    points[rng.permutation(4000)[:40], :2] = rng.uniform(-14.0, 14.0, (40, 2))
    kinds = rng.integers(0, NUM_LOOKS, len(points))
    slam = filter_with(points, kinds, OTHERS, 3, 0.1, 0.5)
    slam.state.maps.release(np.arange(1000, 1100))
    drive(slam, points, kinds, 1, None)
    other = plain_filter(num_particles=60, motion=MOTION, seed=9)
    other.set_state(slam.get_state())
    assert drive(slam, points, kinds, 2, None) == drive(other, points, kinds, 2, None)
    a, b = slam.state.maps, other.state.maps
    places_a, places_b = a.places[:, a.used_slots()], b.places[:, b.used_slots()]
    assert places_a.shape[1] > LARGE_MAP
    np.testing.assert_array_equal(places_a, places_b)
