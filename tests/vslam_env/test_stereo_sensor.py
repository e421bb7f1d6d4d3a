from typing import Any

import numpy as np
import pytest

from slam_backend.frontend import FrontEndOptions
from slam_backend.geometry import transform_points
from slam_backend.metrics import gospa, map_error
from slam_backend.models.camera import StereoCamera
from vslam_env.sensors.stereo.sensor import EyeFrame, StereoSensor, StereoSensorConfig
from vslam_env.world import FreeSpace, World

ROOM = World("room", [[0, 0, 7, 0], [7, 0, 7, 5], [7, 5, 0, 5], [0, 5, 0, 0], [2.5, 2.0, 2.5, 3.0]])
POSES = np.array([[1.0, 1.2, 0.3], [5.0, 3.6, -2.0]])


@pytest.fixture(scope="module")
def sensor() -> StereoSensor:
    """Two robots' eyes in a room."""
    return StereoSensor(StereoSensorConfig(), ROOM, FreeSpace(ROOM, 0.2), np.random.default_rng(7))


def test_measured_points_lie_at_their_true_landmarks(sensor: StereoSensor) -> None:
    """A point that is claimed lies, in the world, where its landmark does, but for what stereo errs in depth."""
    rng, away, claimed, total = np.random.default_rng(1), [], 0, 0
    for heading in np.arange(-3.0, 3.0, 0.4):
        poses = POSES + np.array([0.0, 0.0, heading])
        for pose, frame in zip(poses, sensor.measure(poses, rng).of_each(), strict=True):
            points = sensor.config.camera.robot_from_camera(frame.measurements.points)
            world = np.column_stack([transform_points(pose, points[:, :2]), points[:, 2]])
            known = frame.true_ids >= 0
            true = sensor.landmarks.positions[frame.true_ids[known]]
            depth = frame.measurements.points[known, 2]
            away.append(np.linalg.norm(world[known] - true, axis=1) / (0.03 + 0.01 * depth**2))
            claimed, total = claimed + int(known.sum()), total + len(known)
    ratios = np.concatenate(away)
    assert total > 250
    assert claimed > 0.8 * total
    assert np.median(ratios) < 0.5
    assert ratios.max() < 6.0
    assert (ratios > 3.0).mean() < 0.01


def test_frames_hold_what_was_seen(sensor: StereoSensor) -> None:
    """Frames carry both images and what the front end found; measurements are at most as many as asked for."""
    frames = sensor.measure(POSES, np.random.default_rng(2)).of_each()
    assert all(isinstance(frame, EyeFrame) for frame in frames)
    for frame in frames:
        assert isinstance(frame, EyeFrame)
        assert frame.left.shape == frame.right.shape == (240, 320)
        assert 5 < len(frame.measurements) <= 20
        assert len(frame.true_ids) == len(frame.measurements) == len(frame.seen.pixels)
        assert frame.measurements.covariances is None


def test_visible_landmarks_are_those_that_are_measured(sensor: StereoSensor) -> None:
    """Of the measured landmarks nearly all are visible ones, and nothing behind a robot is."""
    visible, frames = sensor.visible(POSES), sensor.measure(POSES, np.random.default_rng(8)).of_each()
    assert visible.shape == (2, len(sensor.landmarks))
    measured = np.concatenate([visible[robot, f.true_ids[f.true_ids >= 0]] for robot, f in enumerate(frames)])
    assert measured.mean() > 0.8
    ahead = np.array([np.cos(POSES[0, 2]), np.sin(POSES[0, 2])])
    behind = (sensor.landmarks.positions[:, :2] - POSES[0, :2]) @ ahead < 0.0
    assert behind.any()
    assert not visible[0, behind].any()


def test_the_same_draws_give_the_same_images(sensor: StereoSensor) -> None:
    """Images depend on the poses and the generator alone, not on what was taken before."""
    one = sensor.measure(POSES, np.random.default_rng(3)).of_each()
    sensor.measure(POSES[::-1], np.random.default_rng(4))
    two = sensor.measure(POSES, np.random.default_rng(3)).of_each()
    for first, second in zip(one, two, strict=True):
        assert isinstance(first, EyeFrame)
        assert isinstance(second, EyeFrame)
        np.testing.assert_array_equal(first.left, second.left)
        np.testing.assert_array_equal(first.measurements.points, second.measurements.points)
        np.testing.assert_array_equal(first.true_ids, second.true_ids)


def test_true_landmarks_lie_on_faces_that_robots_can_look_at(sensor: StereoSensor) -> None:
    """Landmarks are on their walls, between floor and ceiling, and face the inside of the room."""
    marks, paint = sensor.landmarks, sensor.config.textures
    walls = ROOM.walls[marks.walls]
    edge = walls[:, 2:] - walls[:, :2]
    away = marks.positions[:, :2] - walls[:, :2]
    assert np.abs(edge[:, 0] * away[:, 1] - edge[:, 1] * away[:, 0]).max() < 1e-9
    assert paint.floor < marks.positions[:, 2].min()
    assert marks.positions[:, 2].max() < paint.ceiling
    assert FreeSpace(ROOM, 0.2).contains(marks.positions[:, :2] + 0.12 * marks.normals).all()
    assert set(marks.walls.tolist()) == {0, 1, 2, 3, 4}
    assert len(marks) > 100


def test_map_error_agrees_with_gospa_by_assignment(sensor: StereoSensor) -> None:
    """Where true landmarks lie more than 2 c apart, claims and optimal assignment give one map error."""
    rng, cutoff = np.random.default_rng(5), 0.2
    chosen: list[int] = []
    for row in rng.permutation(len(sensor.landmarks)).tolist():
        position = sensor.landmarks.positions
        if all(np.linalg.norm(position[row] - position[other]) > 2.0 * cutoff for other in chosen):
            chosen.append(row)
    true = sensor.landmarks.positions[chosen]
    held = rng.permutation(len(true))[: len(true) // 2]
    directions = rng.normal(size=(len(held), 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    means = true[held] + rng.uniform(0.0, 0.9 * cutoff, (len(held), 1)) * directions
    by_claims = map_error(means, held, true, cutoff)
    by_assignment = gospa(means, true, cutoff)
    assert by_claims == pytest.approx(by_assignment.error)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"camera": 1}, "stereo.camera: expected a StereoCamera"),
        ({"front_end": None}, "stereo.front_end: expected a FrontEndOptions"),
        ({"tolerance": 0.0}, "stereo.tolerance: expected a finite number > 0"),
    ],
)
def test_impossible_options_are_refused(change: dict[str, Any], message: str) -> None:
    """The error names the option."""
    with pytest.raises(ValueError, match=message):
        StereoSensorConfig(**change)


def test_other_descriptors_and_sizes_can_be_had() -> None:
    """A sensor with SIFT and larger images measures in its own way."""
    camera = StereoCamera(focal_px=400.0, width=400, height=300)
    config = StereoSensorConfig(camera=camera, front_end=FrontEndOptions(descriptor="sift"))
    other = StereoSensor(config, ROOM, FreeSpace(ROOM, 0.2), np.random.default_rng(7))
    frame = other.measure(POSES[:1], np.random.default_rng(1)).of_each()[0]
    assert frame.measurements.descriptors.shape[1] == 128
    assert len(frame.measurements) > 20
