"""What happens to particles and their accumulated weights when they are resampled, and snapshots."""

import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from same_bits import assert_same
from stereo_world import StereoWorld

from slam_backend import _kernels
from slam_backend.filter import FastSlam
from slam_backend.geometry import compose
from slam_backend.measurements import Measurements
from slam_backend.resampling import RESAMPLING

MOVE = np.array([0.25, 0.02, 0.3])
PROPOSALS = pytest.mark.parametrize("proposal", ["fastslam2", "fastslam1"])


def inputs(steps: int, seed: int = 0) -> list[tuple[Any, Any]]:
    """Return noisy odometry and frames of one robot that drives in a circle."""
    world = StereoWorld(np.random.default_rng(seed))
    pose, result = np.zeros(3), []
    for _ in range(steps):
        pose = compose(pose, MOVE)
        odometry = MOVE + world.rng.normal(0.0, [0.02, 0.01, 0.01])
        result.append(([odometry], [world.measure(pose, world.visible(pose))]))
    return result


def filter_after(steps: int, **changes: Any) -> FastSlam:
    """Return a filter that has lived through some steps."""
    slam = FastSlam(num_particles=11, seed=3, camera=StereoWorld(np.random.default_rng(0)).camera, **changes)
    for odometry, frames in inputs(steps):
        slam.step(odometry, frames)
    return slam


@PROPOSALS
def test_accumulated_weights_follow_the_ancestral_line(proposal: Any) -> None:
    """Eq. 12: a resampled particle carries its ancestor's accumulated log-weight, not that of its index."""
    slam = filter_after(3, proposal=proposal, resample_threshold=1.0)
    strangers = 0
    for odometry, frames in inputs(12)[3:]:
        twin = FastSlam()
        state = slam.get_state()
        twin.set_state(state | {"options": replace(slam.options, resample_threshold=0.0)})
        twin.step(odometry, frames)
        slam.step(odometry, frames)
        line = {tuple(pose): weight for pose, weight in zip(twin.particles()[0], twin._path_log_weights, strict=True)}
        expected = [line[tuple(pose)] for pose in slam.particles()[0]]
        np.testing.assert_array_equal(slam._path_log_weights, expected)
        np.testing.assert_allclose(slam.weights, 1.0 / 11.0)
        strangers += int(np.sum(slam._path_log_weights != twin._path_log_weights))
    assert strangers > 10, "the indices have changed their meaning many times"


def test_weights_are_kept_until_the_particles_are_resampled() -> None:
    """Without resampling a step multiplies the weights of before; with it they start from 1/M."""
    slam = filter_after(3, resample_threshold=0.0)
    before, paths = slam.particles()[1], slam._path_log_weights.copy()
    odometry, frames = inputs(4)[3]
    slam.step(odometry, frames)
    gained = slam._path_log_weights - paths
    expected = before + gained
    np.testing.assert_allclose(slam.particles()[1], expected - np.logaddexp.reduce(expected), atol=1e-12)


@pytest.mark.parametrize("scheme", list(RESAMPLING))
def test_particles_share_no_memory(scheme: str) -> None:
    """Writing to one particle leaves its siblings and earlier snapshots alone."""
    slam = filter_after(8, resampling=scheme, resample_threshold=1.0, proposal="fastslam1")
    state = slam.get_state()
    landmarks, poses = slam._landmarks.copy(), slam._poses.copy()
    slam._landmarks[:, :, 4] += 1.0
    slam._poses[:, 4] += 1.0
    others = np.arange(11) != 4
    np.testing.assert_array_equal(slam._landmarks[:, :, others], landmarks[:, :, others])
    np.testing.assert_array_equal(slam._poses[:, others], poses[:, others])
    np.testing.assert_array_equal(state["_landmarks"], landmarks)
    np.testing.assert_array_equal(state["_poses"], poses)


def test_the_kernel_updates_a_landmark_in_its_own_particle_only() -> None:
    """Where one particle alone holds a landmark, its update leaves all that the slot keeps for others alone."""
    slam = filter_after(8, resample_threshold=1.0)
    slot = int(np.argmax(np.where(slam._present.all(axis=1), slam._ids, -1)))  # the newest lies ahead of the robot
    free = int(np.flatnonzero(slam._ids < 0)[0])
    before = slam._landmarks.copy()
    slam._present[slot] = np.arange(11) == 4
    _kernels.update_fastslam1(
        slam._poses[0], slam._landmarks, slam._present, slam._counts, np.array([[3.0, 0.1, 0.2]]), np.zeros((1, 6)),
        False, slam._camera, np.array([0, 1]), np.array([slot]), np.array([True]), np.array([free]), 11.34, 0.0, True,
        np.zeros((1, 11), dtype=np.int64), np.zeros((1, 11)), np.zeros(11),
    )  # fmt: skip
    changed = (slam._landmarks != before).any(axis=1)
    expected = np.zeros_like(changed)
    expected[slot, 4] = True
    expected[free] = np.arange(11) != 4
    np.testing.assert_array_equal(changed, expected)


def test_what_is_handed_out_is_the_callers() -> None:
    """Particles, weights and start poses are copies."""
    slam = filter_after(2)
    for array in (*slam.particles(), slam.weights, slam.start_pose()):
        array += 1.0
    again = filter_after(2)
    np.testing.assert_array_equal(slam.particles()[0], again.particles()[0])
    np.testing.assert_array_equal(slam.weights, again.weights)
    np.testing.assert_array_equal(slam.start_pose(), again.start_pose())


@PROPOSALS
@pytest.mark.parametrize("scheme", list(RESAMPLING))
def test_a_restored_filter_goes_on_bit_for_bit(proposal: Any, scheme: str) -> None:
    """From a snapshot, pickled or not, the same inputs give the same bytes, whatever the filter did in between."""
    slam = filter_after(5, proposal=proposal, resampling=scheme, resample_threshold=0.8)
    state = slam.get_state()
    pickled = pickle.dumps(state)
    later = inputs(12)[5:]
    for odometry, frames in later:
        slam.step(odometry, frames)
    expected = slam.get_state()
    for snapshot, restored in ((state, slam), (pickle.loads(pickled), FastSlam(3, 2))):
        restored.set_state(snapshot)
        for odometry, frames in later:
            restored.step(odometry, frames)
        assert_same(restored.get_state(), expected)


def test_the_seed_decides_everything() -> None:
    """Equal seeds give equal filters, unequal ones do not, and another filter's steps in between change nothing."""
    a, b = filter_after(0), filter_after(0)
    for odometry, frames in inputs(6):
        a.step(odometry, frames)
        filter_after(1)
        b.step(odometry, frames)
    np.testing.assert_array_equal(a.particles()[0], b.particles()[0])
    c = FastSlam(num_particles=11, seed=4, camera=a.options.camera)
    for odometry, frames in inputs(6):
        c.step(odometry, frames)
    assert np.all(a.particles()[0] != c.particles()[0])


def test_landmarks_that_no_survivor_holds_are_forgotten() -> None:
    """Ids are never used twice, and only landmarks that a particle holds are counted."""
    slam = filter_after(20, proposal="fastslam1", resample_threshold=1.0)
    held = slam._ids[slam._present.any(axis=1)]
    assert np.all(held >= 0)
    assert len(np.unique(held)) == len(held) == slam.num_landmarks
    report = slam.step([None], [Measurements([[0.0, 0.0, 2.0]], -np.eye(1, 17))])
    assert report.created[0][0] > held.max()
