"""Particles that descend from one ancestor begin alike, and each goes its own way: none writes what another holds."""

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from filter_contents import dense
from stereo_world import StereoWorld

from slam_backend.fastslam.filter import FastSlam
from slam_backend.geometry import compose
from slam_backend.models.camera import StereoCamera
from slam_backend.models.measurements import Measurements
from slam_backend.models.odometry import OdometryModel
from slam_backend.resampling import RESAMPLING

MOVE = np.array([0.25, 0.02, 0.3])
NOISY = OdometryModel(sigma_along=0.2, sigma_heading=0.1)


def bits_by_landmark(slam: FastSlam) -> dict[int, list[tuple[int, bytes]]]:
    """Return, by landmark and particle, its count and all bytes of its estimate; zeros where it is not held."""
    ids, means, covariances, counts = dense(slam)
    values = np.concatenate([means, covariances], axis=1).transpose(0, 2, 1) * (counts > 0)[:, :, None]
    return {
        int(name): [(int(count), row.tobytes()) for count, row in zip(counts[i], values[i], strict=True)]
        for i, name in enumerate(ids)
    }


def without_resampling(slam: FastSlam) -> FastSlam:
    """Return a copy of the filter that resamples no more."""
    twin = FastSlam()
    twin.set_state(slam.get_state() | {"options": replace(slam.options, resample_threshold=0.0)})
    return twin


@pytest.mark.parametrize("scheme", list(RESAMPLING))
@pytest.mark.parametrize("proposal", ["fastslam2", "fastslam1"])
def test_what_one_particle_writes_no_other_sees(proposal: Any, scheme: str) -> None:
    """After resamplings a step changes a landmark exactly in the particles that matched it, in each on its own.

    A measurement that is off by about the gate is matched by some of the particles only.
    """
    world = StereoWorld(np.random.default_rng(1), camera=StereoCamera(sigma_px=4.0, sigma_disparity_px=1.0))
    slam = FastSlam(1, 33, world.camera, NOISY, proposal, scheme, resample_threshold=1.0, recovery_position=0.0)
    pose, parted, disputed = np.zeros(3), 0, 0
    for _ in range(12):
        pose = compose(pose, MOVE)
        odometry = MOVE + world.rng.standard_normal(3) * NOISY.sigmas(MOVE)
        assert slam.step([odometry], [world.measure(pose, world.visible(pose))]).resampled
        before = bits_by_landmark(slam)
        ahead = world.measure(compose(pose, MOVE), world.visible(pose)[:1])
        for offset in (-0.2, -0.1, 0.0, 0.1, 0.2):
            twin = without_resampling(slam)
            twin.step([MOVE], [Measurements(ahead.points * (1.0 + offset), ahead.descriptors)])
            after = bits_by_landmark(twin)
            for name, were in before.items():
                matched = [now[0] != was[0] for was, now in zip(were, after[name], strict=True)]
                assert [now != was for was, now in zip(were, after[name], strict=True)] == matched
                disputed += 0 < sum(matched) < len(matched)
                copies = Counter(were[m] for m in np.flatnonzero(matched))
                results = {(were[m], after[name][m]) for m in np.flatnonzero(matched)}
                assert len(results) == sum(matched), "each has its own pose, and none its twin's update"
                parted += sum(count for count in copies.values() if count > 1)
        assert bits_by_landmark(slam) == before, "the copies stepped, not the filter itself"
    assert parted > 100, "many that were equal, byte by byte, were updated apart"
    assert disputed > 2, "it happened that some matched and some did not"


@pytest.mark.parametrize("scheme", list(RESAMPLING))
def test_particles_that_are_drawn_keep_their_place(scheme: str) -> None:
    """Resampling copies survivors into the places of the dead, by ascending parent, and moves nobody else."""
    world = StereoWorld(np.random.default_rng(2))
    slam = FastSlam(1, 19, world.camera, NOISY, "fastslam1", scheme, resample_threshold=1.0)
    pose, copies = np.zeros(3), 0
    for _ in range(10):
        pose = compose(pose, MOVE)
        odometry = MOVE + world.rng.standard_normal(3) * NOISY.sigmas(MOVE)
        frame = world.measure(pose, world.visible(pose))
        twin = without_resampling(slam)
        twin.step([odometry], [frame])
        slam.step([odometry], [frame])
        rows = [tuple(row) for row in twin.particles()[0]]
        parents = np.array([rows.index(tuple(row)) for row in slam.particles()[0]])
        places = np.arange(19)
        survivors = np.unique(parents)
        np.testing.assert_array_equal(parents[survivors], survivors)
        filled = parents[~np.isin(places, survivors)]
        np.testing.assert_array_equal(filled, np.sort(filled))
        copies += len(filled)
    assert copies > 30
