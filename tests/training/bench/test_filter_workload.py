"""Workload of the filter benchmark: full maps, random measurements, equal shares of the robots."""

from typing import Any

import numpy as np
import pytest

from slam_backend.geometry import inverse, transform_points
from training.bench.speed.filter import filled_filter
from training.bench.speed.workload import FilterLoad, LoadWorld

SMALL: dict[str, Any] = {"particles": 7, "landmarks": 60, "measurements": 11}


@pytest.mark.parametrize("proposal", ["fastslam1", "fastslam2"])
def test_every_particle_has_an_accurate_full_map(proposal: str) -> None:
    """After the mapping all particles have all landmarks, measured three times, within a few standard deviations."""
    world = LoadWorld(FilterLoad(proposal=proposal, robots=2, **SMALL))  # type: ignore[arg-type]
    slam, ids = filled_filter(world)
    held = slam.map()
    assert sorted(ids) == held.ids.tolist()
    assert slam.num_landmarks == slam.map_size == len(world.landmarks)
    assert (held.counts == 3).all()
    errors = held.means[np.argsort(np.argsort(ids))] - world.landmarks
    covariances = held.covariances[np.argsort(np.argsort(ids))]
    nees = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariances), errors)
    assert 2.0 < nees.mean() < 4.0  # 3 +- 0.32 is one standard deviation


@pytest.mark.parametrize("robots", [1, 2, 3])
def test_robots_share_the_measurements(robots: int) -> None:
    """There are B measurements in each step for any K, with shares equal up to one, and no landmark twice."""
    world = LoadWorld(FilterLoad(robots=robots, **SMALL))
    for step in world.course(20):
        shares = [len(frame) for frame in step.frames if frame is not None]
        assert sum(shares) == 11
        assert max(shares) - min(shares) <= 1
        assert all(len(set(names)) == len(names) for names in step.names)


def test_measured_landmarks_are_uniformly_random() -> None:
    """Over many steps all landmarks in view are measured about equally often."""
    world = LoadWorld(FilterLoad(**SMALL))
    names = np.concatenate([step.names[0] for step in world.course(600)])
    counts = np.bincount(names, minlength=60)
    assert counts.min() > 0.7 * counts.mean()  # a binomial's standard deviation is 9 %
    assert counts.max() < 1.3 * counts.mean()


def test_true_noise_is_the_assumed_one() -> None:
    """Odometry and pixels have the noise of the filter's models."""
    world = LoadWorld(FilterLoad(**SMALL))
    camera = world.load.options.camera
    pose, moves, pixels = np.zeros(3), [], []
    for time, step in enumerate(world.course(400)):
        before, pose = pose, world.true_pose(0, time + 1)
        move = transform_points(inverse(before), pose[None, :2])[0]
        assert step.odometry[0] is not None
        assert step.frames[0] is not None
        reading = step.odometry[0]
        sigmas = world.load.options.motion.sigmas(np.array([*move, pose[2] - before[2]]))
        moves.append((reading - [*move, pose[2] - before[2]]) / sigmas)
        true = camera.camera_from_robot(transform_points(inverse(pose), world.landmarks[step.names[0]]))
        pixels.append(camera.project(step.frames[0].points) - camera.project(true))
    assert np.std(moves, axis=0) == pytest.approx(1.0, abs=0.15)
    scatter = np.std(np.concatenate(pixels), axis=0)
    assert scatter == pytest.approx([camera.sigma_px, camera.sigma_px, camera.sigma_disparity_px], rel=0.05)


@pytest.mark.parametrize("lookalikes", [1, 3])
def test_classes_of_similar_landmarks_have_the_requested_size(lookalikes: int) -> None:
    """The descriptor gate of a landmark contains exactly its similar landmarks, noise included."""
    load = FilterLoad(lookalikes=lookalikes, **SMALL)
    world = LoadWorld(load)
    (step,) = world.course(1)
    assert step.frames[0] is not None
    distances = np.linalg.norm(step.frames[0].descriptors[:, None] - world.descriptors[None], axis=2)
    assert ((distances < load.options.descriptor_gate).sum(axis=1) == lookalikes).all()
    assert np.linalg.norm(world.descriptors, axis=1) == pytest.approx(1.0)


def test_same_seed_same_load() -> None:
    """A load repeats bit by bit, and another seed gives another load."""
    first, second, other = ([*LoadWorld(FilterLoad(seed=seed, **SMALL)).course(3)] for seed in (5, 5, 6))
    for one, two, three in zip(first, second, other, strict=True):
        assert one.frames[0] is not None
        assert two.frames[0] is not None
        assert three.frames[0] is not None
        assert one.frames[0].points.tobytes() == two.frames[0].points.tobytes()
        assert one.frames[0].points.tobytes() != three.frames[0].points.tobytes()


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"particles": 0}, "particles: expected an int >= 1, got 0"),
        ({"robots": 3, "measurements": 2}, "measurements: expected an int >= 3, got 2"),
        ({"landmarks": 20}, "landmarks: expected an int >= 22, got 20"),
        ({"lookalikes": 0}, "lookalikes: expected an int >= 1, got 0"),
        ({"proposal": "ekf"}, "proposal: expected one of 'fastslam2', 'fastslam1', got 'ekf'"),
        ({"seed": -1}, "seed: expected an int >= 0, got -1"),
    ],
)
def test_impossible_loads_are_refused(changed: dict[str, Any], message: str) -> None:
    """The error names the number."""
    with pytest.raises(ValueError, match=message):
        FilterLoad(**(SMALL | changed))
