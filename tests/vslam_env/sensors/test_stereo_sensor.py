"""Rendered eyes: their images, what is measured in them, and environments whose robots see with them."""

import dataclasses
import hashlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from builders.comparison import digest
from builders.environments import MEETING, SMALL_STEREO, small_env, turning

from slam_backend.frontend import FrontEndOptions, StereoFrontEnd
from slam_backend.geometry import transform_points
from slam_backend.models.camera import StereoCamera
from vslam_env import ExplorationEnv
from vslam_env.belief.belief import motion_without_smoother
from vslam_env.presets import preset_config, stereo_belief
from vslam_env.sensors.stereo.cameras import ImagingConfig, StereoRenderer
from vslam_env.sensors.stereo.sensor import RenderedFrame, StereoSensor, StereoSensorConfig
from vslam_env.sensors.stereo.textures import STYLES, TextureConfig, draw_textures
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
        for pose, frame in zip(poses, sensor.measure(poses, rng).per_robot(), strict=True):
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
    frames = sensor.measure(POSES, np.random.default_rng(2)).per_robot()
    assert all(isinstance(frame, RenderedFrame) for frame in frames)
    for frame in frames:
        assert isinstance(frame, RenderedFrame)
        assert frame.left.shape == frame.right.shape == (240, 320)
        assert 5 < len(frame.measurements) <= 20
        assert len(frame.true_ids) == len(frame.measurements) == len(frame.seen.pixels)
        assert frame.measurements.covariances is None


def test_visible_landmarks_are_those_that_are_measured(sensor: StereoSensor) -> None:
    """Of the measured landmarks nearly all are visible ones, and nothing behind a robot is."""
    visible, frames = sensor.visible(POSES), sensor.measure(POSES, np.random.default_rng(8)).per_robot()
    assert visible.shape == (2, len(sensor.landmarks))
    measured = np.concatenate([visible[robot, f.true_ids[f.true_ids >= 0]] for robot, f in enumerate(frames)])
    assert measured.mean() > 0.8
    ahead = np.array([np.cos(POSES[0, 2]), np.sin(POSES[0, 2])])
    behind = (sensor.landmarks.positions[:, :2] - POSES[0, :2]) @ ahead < 0.0
    assert behind.any()
    assert not visible[0, behind].any()


def test_the_same_draws_give_the_same_images(sensor: StereoSensor) -> None:
    """Images depend on the poses and the generator alone, not on what was taken before."""
    one = sensor.measure(POSES, np.random.default_rng(3)).per_robot()
    sensor.measure(POSES[::-1], np.random.default_rng(4))
    two = sensor.measure(POSES, np.random.default_rng(3)).per_robot()
    for first, second in zip(one, two, strict=True):
        assert isinstance(first, RenderedFrame)
        assert isinstance(second, RenderedFrame)
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


def test_other_descriptors_and_sizes_can_be_had() -> None:
    """A sensor with SIFT and larger images measures in its own way."""
    camera = StereoCamera(focal_px=400.0, width=400, height=300)
    config = StereoSensorConfig(camera=camera, front_end=FrontEndOptions(descriptor="sift"))
    other = StereoSensor(config, ROOM, FreeSpace(ROOM, 0.2), np.random.default_rng(7))
    frame = other.measure(POSES[:1], np.random.default_rng(1)).per_robot()[0]
    assert frame.measurements.descriptors.shape[1] == 128
    assert len(frame.measurements) > 20


# pettingzoo.test imports connect_four in a way that pettingzoo itself deprecates
pytestmark = pytest.mark.filterwarnings("ignore:The old environment creation API:DeprecationWarning")


def _env(**changes: Any) -> ExplorationEnv:
    """Return the small room with small rendered eyes."""
    config = preset_config("standard", "stereo").replace(stereo=SMALL_STEREO)
    config = dataclasses.replace(config, belief=stereo_belief(config.stereo, config.belief))
    return small_env(config=config, **changes)


def _run(env: ExplorationEnv, steps: int) -> str:
    total = hashlib.sha256()
    for _ in range(steps):
        digest(env.step(turning(env.agents)), total)
    return total.hexdigest()


def test_the_same_seed_gives_the_same_bytes() -> None:
    """All that 25 steps return repeats with the seed, goes on from a snapshot, and differs with another seed."""
    digests = []
    for seed in (3, 3, 4):
        env = _env()
        env.reset(seed=seed)
        _run(env, 5)
        twin = env.clone()
        digests.append(_run(env, 20))
        assert _run(twin, 20) == digests[-1]
    assert digests[0] == digests[1]
    assert digests[0] != digests[2]


def test_robots_that_see_build_maps_of_the_walls() -> None:
    """In half a turn the robots map texture corners to a few centimetres; frames hold the images they came from."""
    env = _env()
    env.reset(seed=5, options={"start_poses": MEETING})
    for _ in range(38):
        _, _, _, _, infos = env.step(turning(env.agents))
    for agent, frame in zip(env.agents, env.episode.frames, strict=True):
        assert isinstance(frame, RenderedFrame)
        assert frame.left.shape == (120, 160)
        assert len(env.belief(agent).map) > 20
        assert infos[agent]["map_rmse"] < 0.25
        assert infos[agent]["map_precision"] > 0.3
        assert infos[agent]["pose_error"] < 0.2
    assert isinstance(env.episode.scenario.sensor, StereoSensor)
    assert len(env.true_landmarks) > 100


def test_the_filter_assumes_the_camera_that_the_robot_has() -> None:
    """The stereo preset gives filters the eyes' optics, a life cycle for landmarks, and the eyes' limit."""
    config = preset_config("standard", "stereo")
    assumed, eyes = config.belief.filter, config.stereo
    for name in ("focal_px", "baseline", "width", "height", "max_range"):
        assert getattr(assumed.camera, name) == getattr(eyes.camera, name)
    assert assumed.existence is not None
    assert assumed.existence.frame_limit == eyes.front_end.max_measurements
    odometry = preset_config("hard").belief.filter.motion
    assert preset_config("hard", "stereo").belief.filter.motion == motion_without_smoother(odometry)
    assert motion_without_smoother(odometry).sigma_along == odometry.sigma_along
    assert motion_without_smoother(odometry).sigma_across > odometry.sigma_across  # there is no smoother
    assert preset_config("standard").belief.filter.existence is None


def test_images_can_be_observed() -> None:
    """An image observation is a copy of the robot's last left image, inside its space; the rest is as without.

    So is the image of its readings.
    """
    plain, seeing = _env(), _env(observe_images=True)
    expected, _ = plain.reset(seed=6)
    observed, _ = seeing.reset(seed=6)
    for _ in range(3):
        for agent, frame, reading in zip(seeing.agents, seeing.episode.frames, seeing.readings, strict=True):
            assert isinstance(frame, RenderedFrame)
            assert reading.image is not None
            assert seeing.observation_space(agent).contains(observed[agent])
            image = observed[agent]["image"]
            np.testing.assert_array_equal(image[:, :, 0], frame.left)
            np.testing.assert_array_equal(reading.image, frame.left)
            image[:] = reading.image[:] = 0
            assert frame.left.any()
            assert set(observed[agent]) == {*expected[agent], "image"}
            np.testing.assert_array_equal(observed[agent]["pose"], expected[agent]["pose"])
        expected, observed = (env.step(turning(env.agents))[0] for env in (plain, seeing))
    for refused in ({"sensor": "landmark"}, {"observation_type": "flat"}):
        with pytest.raises(ValueError, match="observe_images: expected False unless images are rendered"):
            _env(observe_images=True, **refused)


def test_textures_follow_the_world_seed() -> None:
    """A world seed fixes walls and what is painted on them, whatever the seed of the rest."""
    pictures = []
    for seed in (1, 2):
        env = _env()
        env.reset(seed=seed, options={"world_seed": 9})
        sensor = env.episode.scenario.sensor
        assert isinstance(sensor, StereoSensor)
        pictures.append(np.array(sensor.textures.sums))
    np.testing.assert_array_equal(*pictures)


CAMERA = StereoCamera(focal_px=80.0, baseline=0.12, width=90, height=60, mount=(0.1, -0.05, 0.2))
# A room of 5 x 4 m with a wall in it; one wall of the room runs the other way round.
WALLS = np.array([[0, 0, 5, 0], [5, 0, 5, 4], [0, 4, 5, 4], [0, 4, 0, 0], [3, 1.5, 3.4, 2.6]], dtype=float)
COARSE = TextureConfig(texel=0.03)
VIEWS = np.array([[1.0, 1.2, 0.3], [2.6, 2.9, -1.0]])


@pytest.fixture(scope="module")
def eye() -> StereoRenderer:
    """An eye in a textured room with another robot."""
    return StereoRenderer(CAMERA, ImagingConfig(), WALLS, draw_textures(WALLS, np.random.default_rng(3), COARSE))


def _plain(eye: StereoRenderer, poses: np.ndarray, robot: int, shift: float, fine: int) -> np.ndarray:
    """Return the image (H, W) as the mean over `fine` x `fine` rays a pixel, each followed by itself."""
    paint, camera = eye.textures.config, CAMERA
    pictures = [eye.textures.picture(face) for face in range(2 * len(WALLS))]
    heading = poses[robot, 2]
    ahead = np.array([np.cos(heading), np.sin(heading)])
    left = np.array([-np.sin(heading), np.cos(heading)])
    place = poses[robot, :2] + camera.mount[0] * ahead + (camera.mount[1] - shift) * left
    offsets = (np.arange(fine) + 0.5) / fine - 0.5
    image = np.zeros((camera.height, camera.width))
    for column in range(camera.width):
        for offset in offsets:
            ray = ahead - (column + offset - 0.5 * (camera.width - 1)) / camera.focal_px * left
            depth, level = np.inf, None
            for wall, (x1, y1, x2, y2) in enumerate(WALLS):
                edge = np.array([x2 - x1, y2 - y1])
                matrix = np.column_stack([ray, -edge])
                if abs(np.linalg.det(matrix)) < 1e-12:
                    continue
                t, u = np.linalg.solve(matrix, np.array([x1, y1]) - place)
                if 0.0 < t < depth and 0.0 <= u <= 1.0:
                    to_eye = place - np.array([x1, y1])
                    face = 2 * wall + (0 if edge[0] * to_eye[1] - edge[1] * to_eye[0] > 0.0 else 1)
                    depth, level = t, (face, u)
            for other in np.delete(poses[:, :2], robot, axis=0):
                to = other - place
                length = np.linalg.norm(ray)
                middle = to @ ray / length
                inside = 0.2**2 - (to @ to - middle**2)
                if inside > 0.0 and 0.0 < (middle - np.sqrt(inside)) / length < depth:
                    depth, level = (middle - np.sqrt(inside)) / length, np.sqrt(inside) / 0.2
            for row in range(camera.height):
                for down in offsets:
                    z = camera.mount[2] - (row + down - 0.5 * (camera.height - 1)) / camera.focal_px * depth
                    if z > paint.ceiling or (z > 0.3 and not isinstance(level, tuple)):
                        value = 205.0
                    elif z < paint.floor:
                        value = 60.0
                    elif isinstance(level, tuple):
                        picture = pictures[level[0]]
                        across = min(int(level[1] * picture.shape[1]), picture.shape[1] - 1)
                        height = (paint.ceiling - paint.floor) / len(picture)
                        value = float(picture[min(int((paint.ceiling - z) / height), len(picture) - 1), across])
                    else:
                        value = 45.0 * (1.0 + float(level or 0.0))
                    image[row, column] += value / fine**2
    return image


@pytest.mark.parametrize("shift", [0.0, CAMERA.baseline])
def test_it_agrees_with_following_many_rays(eye: StereoRenderer, shift: float) -> None:
    """A rendered image is the mean over rays through each pixel, for both eyes, with walls and a robot in view."""
    plain = _plain(eye, VIEWS, 0, shift, 5)
    rendered = eye.radiance(VIEWS, 0, shift).T
    errors = np.abs(rendered - plain)
    # Columns that cross a vertical edge, and edges of robots, are only sampled; the rays themselves are a sample too.
    assert np.median(errors) < 1.0
    assert (errors > 12.0).mean() < 0.03
    assert abs((rendered - plain).mean()) < 0.3


def test_columns_report_wall_face_and_depth(eye: StereoRenderer) -> None:
    """Traced rays meet the wall, face and depth that a rendered column shows; a robot is distinguished from a wall."""
    columns = np.arange(0.0, 90.0, 0.5)
    traced = eye.trace(VIEWS, 0, columns)
    assert {-2, 4, 1} <= set(traced.walls.tolist())
    on_wall = traced.walls >= 0
    ahead = np.array([np.cos(0.3), np.sin(0.3)])
    left = np.array([-np.sin(0.3), np.cos(0.3)])
    place = VIEWS[0, :2] + 0.1 * ahead - 0.05 * left
    rays = ahead - ((columns[on_wall] - 44.5) / 80.0)[:, None] * left
    hits = place + traced.depths[on_wall, None] * rays
    walls = WALLS[traced.walls[on_wall]]
    along = walls[:, :2] + traced.along[on_wall, None] * (walls[:, 2:] - walls[:, :2])
    np.testing.assert_allclose(hits, along, atol=1e-9)
    edge, to_eye = walls[:, 2:] - walls[:, :2], place - walls[:, :2]
    right_face = edge[:, 0] * to_eye[:, 1] - edge[:, 1] * to_eye[:, 0] < 0.0
    np.testing.assert_array_equal(traced.sides[on_wall] == 1, right_face)
    assert right_face.any()
    assert not right_face.all()


def test_means_over_boxes_survive_distance() -> None:
    """The mean grey of a far wall is that of its texture: nothing is skipped, whatever the distance."""
    walls = np.array([[20.0, -8.0, 20.0, 8.0]])
    textures = draw_textures(walls, np.random.default_rng(1), TextureConfig(texel=0.005, polygons=20.0))
    eye = StereoRenderer(CAMERA, ImagingConfig(), walls, textures)
    image = eye.radiance(np.array([[5.0, 0.0, 0.0]]), 0)
    distance = 20.0 - 5.1
    top, bottom = (29.5 - (z - 0.2) / distance * 80.0 for z in (1.2, -0.9))
    rows = image[2:-2, int(np.ceil(top + 0.5)) : int(np.floor(bottom + 0.5))]
    side = 0.5 * 85.0 / 80.0 * distance
    picture = textures.picture(0).astype(float)  # seen from its left side, from the end of the wall to its beginning
    u0, u1 = ((8.0 + 0.05 * -1.0 + s) / 16.0 * picture.shape[1] for s in (-side, side))
    assert rows.mean() == pytest.approx(picture[:, int(u0) : int(u1)].mean(), abs=1.5)


def test_measured_disparities_agree_with_the_rendered_depth() -> None:
    """Disparities of rendered pairs are f b / Z to less than a tenth of a pixel, and hardly any is off by a pixel."""
    camera = StereoCamera(mount=(0.0, 0.0, 0.1))
    eye = StereoRenderer(camera, ImagingConfig(), WALLS, draw_textures(WALLS, np.random.default_rng(5)))
    front_end, rng, errors = StereoFrontEnd(camera), np.random.default_rng(6), []
    for pose in ([1.0, 1.2, 0.3], [2.6, 2.9, -1.0], [4.4, 0.6, 2.5], [0.6, 3.3, -0.6]):
        poses = np.array([pose])
        pixels = front_end.measure(*eye.take(poses, 0, rng)).pixels
        depths = eye.trace(poses, 0, pixels[:, 0]).depths
        errors.append(pixels[:, 2] - camera.focal_px * camera.baseline / depths)
    together = np.abs(np.concatenate(errors))
    assert len(together) > 150
    assert np.median(together) < 0.06
    assert (together > 1.0).mean() < 0.04


def test_noise_is_that_of_the_configuration(eye: StereoRenderer) -> None:
    """Pixels scatter by the stated deviation, independently in both eyes, about the exposed grey levels."""
    imaging = ImagingConfig(noise=3.0, gain_sigma=0.0, eye_gain_sigma=0.0)
    camera = StereoRenderer(CAMERA, imaging, WALLS, eye.textures)
    rng = np.random.default_rng(4)
    clean = [camera.radiance(VIEWS, 0, shift).T for shift in (0.0, CAMERA.baseline)]
    pairs = [camera.take(VIEWS, 0, rng) for _ in range(30)]
    noise = np.array([[image.astype(float) - own for image, own in zip(pair, clean, strict=True)] for pair in pairs])
    assert noise.std() == pytest.approx(np.sqrt(9.0 + 1.0 / 12.0), rel=0.02)
    assert abs(noise.mean()) < 0.03
    assert abs(np.corrcoef(noise[:, 0].ravel(), noise[:, 1].ravel())[0, 1]) < 0.01
    assert np.abs(noise).max() < 3.46 * 3.0 + 0.6
    quiet = StereoRenderer(CAMERA, ImagingConfig(noise=0.0, gain_sigma=0.0, eye_gain_sigma=0.0), WALLS, eye.textures)
    np.testing.assert_array_equal(quiet.take(VIEWS, 0, rng)[0], np.floor(clean[0] + 0.5).astype(np.uint8))


def test_exposure_and_blur_have_the_stated_effect(eye: StereoRenderer) -> None:
    """A gain scales the image, and blur makes it smoother without changing its mean."""
    still = {"noise": 0.0, "gain_sigma": 0.0, "eye_gain_sigma": 0.0}
    gains = []
    for seed in range(40):
        varying = StereoRenderer(CAMERA, ImagingConfig(**(still | {"gain_sigma": 0.1})), WALLS, eye.textures)
        image = varying.take(VIEWS, 0, np.random.default_rng(seed))[0].astype(float)
        gains.append(np.median(image / eye.radiance(VIEWS, 0).T))
    assert np.std(gains) == pytest.approx(0.1, rel=0.35)
    blurred = StereoRenderer(CAMERA, ImagingConfig(**(still | {"blur_px": 1.5})), WALLS, eye.textures).radiance(
        VIEWS, 0
    )
    sharp = eye.radiance(VIEWS, 0)
    assert np.abs(np.diff(blurred, axis=0)).mean() < 0.7 * np.abs(np.diff(sharp, axis=0)).mean()
    assert blurred.mean() == pytest.approx(sharp.mean(), abs=1.0)


@pytest.mark.parametrize("style", STYLES)
def test_styles_differ_as_they_promise(style: str) -> None:
    """Sums give back a picture with contrast; alike bricks repeat, all other walls and faces are their own."""
    textures = draw_textures(WALLS, np.random.default_rng(1), TextureConfig(style=style))
    pictures = [textures.picture(face) for face in (0, 1, 4)]
    assert all(picture.shape == (210, 500) and picture.std() > 3.0 for picture in pictures)
    alike = style == "bricks_alike"
    for one, other in ((0, 1), (0, 2)):
        assert np.array_equal(pictures[one], pictures[other]) == alike
    again = draw_textures(WALLS, np.random.default_rng(1), TextureConfig(style=style))
    np.testing.assert_array_equal(textures.sums, again.sums)


def test_a_wall_looks_the_same_whatever_the_others_are() -> None:
    """One stream per wall: another wall more, or a longer one, changes no other picture."""
    longer = np.vstack([WALLS, [[1.0, 1.0, 1.0, 2.0]]])
    longer[1, 3] = 6.0
    one, other = (draw_textures(walls, np.random.default_rng(1), COARSE) for walls in (WALLS, longer))
    for face in (0, 1, 4, 9):
        np.testing.assert_array_equal(one.picture(face), other.picture(face))
    assert one.picture(2).shape != other.picture(2).shape


def test_photographs_cover_walls(tmp_path: Path) -> None:
    """A folder of images replaces the drawings."""
    photograph = np.random.default_rng(2).integers(0, 256, (70, 200), dtype=np.uint8)  # as tall as a face: 70 texels
    cv2.imwrite(str(tmp_path / "one.png"), photograph)
    config = TextureConfig(texel=0.03, images=str(tmp_path))
    picture = draw_textures(WALLS, np.random.default_rng(1), config).picture(0)
    assert picture.shape == (70, 167)
    doubled = np.concatenate([photograph, photograph], axis=1)
    shifts = [k for k in range(200) if np.array_equal(doubled[:, k : k + 167], picture)]
    assert len(shifts) == 1
    (tmp_path / "two.png").write_bytes((tmp_path / "one.png").read_bytes()[:200])
    with pytest.raises(ValueError, match=r"textures\.images: expected an intact image file, got .*two\.png"):
        draw_textures(WALLS, np.random.default_rng(1), config)
