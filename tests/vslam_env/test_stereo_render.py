from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from slam_backend.frontend import StereoFrontEnd
from slam_backend.models.camera import StereoCamera
from vslam_env.sensors.stereo.cameras import ImagingConfig, StereoEye
from vslam_env.sensors.stereo.textures import STYLES, TextureConfig, draw_textures

CAMERA = StereoCamera(focal_px=80.0, baseline=0.12, width=90, height=60, mount=(0.1, -0.05, 0.2))
# A room of 5 x 4 m with a wall in it; one wall of the room runs the other way round.
WALLS = np.array([[0, 0, 5, 0], [5, 0, 5, 4], [0, 4, 5, 4], [0, 4, 0, 0], [3, 1.5, 3.4, 2.6]], dtype=float)
COARSE = TextureConfig(texel=0.03)
POSES = np.array([[1.0, 1.2, 0.3], [2.6, 2.9, -1.0]])


@pytest.fixture(scope="module")
def eye() -> StereoEye:
    """An eye in a textured room with another robot."""
    return StereoEye(CAMERA, ImagingConfig(), WALLS, draw_textures(WALLS, np.random.default_rng(3), COARSE))


def _plain(eye: StereoEye, poses: np.ndarray, robot: int, shift: float, fine: int) -> np.ndarray:
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
def test_it_agrees_with_following_many_rays(eye: StereoEye, shift: float) -> None:
    """A rendered image is the mean over rays through each pixel, for both eyes, with walls and a robot in view."""
    plain = _plain(eye, POSES, 0, shift, 5)
    rendered = eye.radiance(POSES, 0, shift).T
    errors = np.abs(rendered - plain)
    # Columns that cross a vertical edge, and edges of robots, are only sampled; the rays themselves are a sample too.
    assert np.median(errors) < 1.0
    assert (errors > 12.0).mean() < 0.03
    assert abs((rendered - plain).mean()) < 0.3


def test_columns_know_what_they_see(eye: StereoEye) -> None:
    """Traced rays meet the wall, face and depth that a rendered column shows; a robot is told from a wall."""
    columns = np.arange(0.0, 90.0, 0.5)
    traced = eye.trace(POSES, 0, columns)
    assert {-2, 4, 1} <= set(traced.walls.tolist())
    on_wall = traced.walls >= 0
    ahead = np.array([np.cos(0.3), np.sin(0.3)])
    left = np.array([-np.sin(0.3), np.cos(0.3)])
    place = POSES[0, :2] + 0.1 * ahead - 0.05 * left
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
    eye = StereoEye(CAMERA, ImagingConfig(), walls, textures)
    image = eye.radiance(np.array([[5.0, 0.0, 0.0]]), 0)
    distance = 20.0 - 5.1
    top, bottom = (29.5 - (z - 0.2) / distance * 80.0 for z in (1.2, -0.9))
    rows = image[2:-2, int(np.ceil(top + 0.5)) : int(np.floor(bottom + 0.5))]
    side = 0.5 * 85.0 / 80.0 * distance
    picture = textures.picture(0).astype(float)  # seen from its left side, from the end of the wall to its beginning
    u0, u1 = ((8.0 + 0.05 * -1.0 + s) / 16.0 * picture.shape[1] for s in (-side, side))
    assert rows.mean() == pytest.approx(picture[:, int(u0) : int(u1)].mean(), abs=1.5)


def test_front_end_measures_what_was_rendered() -> None:
    """Disparities of rendered pairs are f b / Z to less than a tenth of a pixel, and hardly any is off by a pixel."""
    camera = StereoCamera(mount=(0.0, 0.0, 0.1))
    eye = StereoEye(camera, ImagingConfig(), WALLS, draw_textures(WALLS, np.random.default_rng(5)))
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


def test_noise_is_that_of_the_configuration(eye: StereoEye) -> None:
    """Pixels scatter by the stated deviation, independently in both eyes, about the exposed grey levels."""
    imaging = ImagingConfig(noise=3.0, gain_sigma=0.0, eye_gain_sigma=0.0)
    camera = StereoEye(CAMERA, imaging, WALLS, eye.textures)
    rng = np.random.default_rng(4)
    clean = [camera.radiance(POSES, 0, shift).T for shift in (0.0, CAMERA.baseline)]
    pairs = [camera.take(POSES, 0, rng) for _ in range(30)]
    noise = np.array([[image.astype(float) - own for image, own in zip(pair, clean, strict=True)] for pair in pairs])
    assert noise.std() == pytest.approx(np.sqrt(9.0 + 1.0 / 12.0), rel=0.02)
    assert abs(noise.mean()) < 0.03
    assert abs(np.corrcoef(noise[:, 0].ravel(), noise[:, 1].ravel())[0, 1]) < 0.01
    assert np.abs(noise).max() < 3.46 * 3.0 + 0.6
    quiet = StereoEye(CAMERA, ImagingConfig(noise=0.0, gain_sigma=0.0, eye_gain_sigma=0.0), WALLS, eye.textures)
    np.testing.assert_array_equal(quiet.take(POSES, 0, rng)[0], np.floor(clean[0] + 0.5).astype(np.uint8))


def test_exposure_and_blur_do_what_they_say(eye: StereoEye) -> None:
    """A gain scales the image, and blur makes it smoother without changing its mean."""
    still = {"noise": 0.0, "gain_sigma": 0.0, "eye_gain_sigma": 0.0}
    gains = []
    for seed in range(40):
        varying = StereoEye(CAMERA, ImagingConfig(**(still | {"gain_sigma": 0.1})), WALLS, eye.textures)
        image = varying.take(POSES, 0, np.random.default_rng(seed))[0].astype(float)
        gains.append(np.median(image / eye.radiance(POSES, 0).T))
    assert np.std(gains) == pytest.approx(0.1, rel=0.35)
    blurred = StereoEye(CAMERA, ImagingConfig(**(still | {"blur_px": 1.5})), WALLS, eye.textures).radiance(POSES, 0)
    sharp = eye.radiance(POSES, 0)
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
    """A folder of images replaces the drawings; one without images is refused."""
    photograph = np.random.default_rng(2).integers(0, 256, (70, 200), dtype=np.uint8)  # as tall as a face: 70 texels
    cv2.imwrite(str(tmp_path / "one.png"), photograph)
    config = TextureConfig(texel=0.03, images=str(tmp_path))
    picture = draw_textures(WALLS, np.random.default_rng(1), config).picture(0)
    assert picture.shape == (70, 167)
    doubled = np.concatenate([photograph, photograph], axis=1)
    shifts = [k for k in range(200) if np.array_equal(doubled[:, k : k + 167], picture)]
    assert len(shifts) == 1
    with pytest.raises(ValueError, match=r"textures\.images: expected a folder with images"):
        draw_textures(WALLS, np.random.default_rng(1), TextureConfig(images=str(tmp_path / "none")))


@pytest.mark.parametrize(
    ("kind", "change", "message"),
    [
        (TextureConfig, {"style": "wallpaper"}, "textures.style: expected one of 'distinct'"),
        (TextureConfig, {"texel": 1.0}, "textures.texel: expected .* <= 0.1, got 1.0"),
        (TextureConfig, {"ceiling": -1.0}, "textures.ceiling: expected a finite number >= -0.8"),
        (TextureConfig, {"images": 3}, "textures.images: expected a folder as a string, or None, got 3"),
        (ImagingConfig, {"noise": -1.0}, "imaging.noise: expected a finite number >= 0"),
        (ImagingConfig, {"parts": 0}, "imaging.parts: expected an int >= 1"),
    ],
)
def test_impossible_options_are_refused(kind: Any, change: dict[str, Any], message: str) -> None:
    """The error names the option."""
    with pytest.raises(ValueError, match=message):
        kind(**change)
