from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from box_pairs import draw_boxes
from scipy.ndimage import map_coordinates

from slam_backend.core.compilation import watch_compilation
from slam_backend.frontend import (
    KINDS,
    CornerOptions,
    FrontEndOptions,
    StereoFrontEnd,
    harris_corners,
    usurf_descriptors,
)
from slam_backend.frontend._matching_kernels import match_rows, refine
from slam_backend.models.camera import StereoCamera

CAMERA = StereoCamera(focal_px=300.0, baseline=0.1, width=320, height=240, max_range=8.0)
DISPARITY = 17.3


@pytest.fixture(scope="module")
def pair() -> tuple[np.ndarray, np.ndarray]:
    """A plane parallel to the images."""
    return draw_boxes(320, 240, 0.0), draw_boxes(320, 240, DISPARITY)


def test_a_plane_is_measured_to_a_few_hundredths_of_a_pixel(pair: tuple[np.ndarray, np.ndarray]) -> None:
    """Disparities of a plane parallel to the images are those that it was drawn with; there are no outliers."""
    frame = StereoFrontEnd(CAMERA).measure(*pair)
    errors = frame.pixels[:, 2] - DISPARITY
    assert len(errors) > 40
    assert np.abs(errors).max() < 0.2
    assert np.sqrt((errors**2).mean()) < 0.05
    np.testing.assert_allclose(frame.measurements.points[:, 2], 300.0 * 0.1 / frame.pixels[:, 2])
    assert frame.measurements.covariances is None


def test_pixels_and_points_belong_together(pair: tuple[np.ndarray, np.ndarray]) -> None:
    """Points project onto their pixels about the optical axis, wherever that is."""
    for centre in ((159.5, 119.5), (140.0, 131.5)):
        frame = StereoFrontEnd(CAMERA, centre_px=centre).measure(*pair)
        again = CAMERA.project(frame.measurements.points) + np.append(centre, 0.0)
        np.testing.assert_allclose(again, frame.pixels, atol=1e-9)
    middle = StereoFrontEnd(CAMERA).measure(*pair)
    first = StereoFrontEnd(CAMERA, centre_px=(159.5, 119.5)).measure(*pair)
    np.testing.assert_array_equal(middle.measurements.points, first.measurements.points)


def test_a_slanted_plane_has_the_slope_that_it_was_drawn_with() -> None:
    """Disparities that change along a row by 4 % are followed."""
    left, right = draw_boxes(320, 240, 0.0), draw_boxes(320, 240, DISPARITY, slant=0.04)
    pixels = StereoFrontEnd(CAMERA, FrontEndOptions(nearest=0.8)).measure(left, right).pixels
    # right pixel x' shows what the left one shows at x = x' + DISPARITY + slant (x' - middle)
    true = pixels[:, 0] - (pixels[:, 0] - DISPARITY + 0.04 * 159.5) / 1.04
    assert len(pixels) > 30
    assert np.median(np.abs(pixels[:, 2] - true)) < 0.06


def test_exposure_does_not_matter(pair: tuple[np.ndarray, np.ndarray]) -> None:
    """Disparities stay where they are if the right eye sees all of it darker and with less contrast."""
    darker = np.rint(0.7 * pair[1].astype(float) + 10.0).astype(np.uint8)
    frame = StereoFrontEnd(CAMERA).measure(pair[0], darker)
    assert len(frame.measurements) > 40
    assert np.abs(frame.pixels[:, 2] - DISPARITY).max() < 0.2


@pytest.mark.parametrize("kind", ["usurf", "sift", "orb"])
def test_any_descriptor_goes_through_the_same_pipeline(pair: tuple[np.ndarray, np.ndarray], kind: Any) -> None:
    """u-SURF, SIFT and ORB give unit vectors of their length for the same points."""
    eye = StereoFrontEnd(CAMERA, FrontEndOptions(descriptor=kind))
    frame = eye.measure(*pair)
    descriptors = frame.measurements.descriptors
    assert len(descriptors) > 40
    assert descriptors.shape[1] == eye.descriptor_size == KINDS[kind].size
    np.testing.assert_allclose(np.linalg.norm(descriptors, axis=1), 1.0, atol=1e-5)
    assert np.abs(frame.pixels[:, 2] - DISPARITY).max() < 0.2


def test_a_window_of_constant_size_follows_the_distance() -> None:
    """With a window in metres, a wall seen from twice as far is described nearly as before; with one in pixels not."""
    near = draw_boxes(320, 240, 0.0)
    far = cv2.resize(near, (160, 120), interpolation=cv2.INTER_AREA)
    canvas = np.full((240, 320), 128, np.uint8)
    canvas[60:180, 80:240] = far
    x, y = np.meshgrid(np.arange(100.0, 221.0, 20.0), np.arange(80.0, 161.0, 20.0))
    points = np.column_stack([x.ravel(), y.ravel()])
    smaller = (points + 0.5) / 2.0 - 0.5 + [80.0, 60.0]
    one = usurf_descriptors(near, points, 4.0)
    same = np.linalg.norm(one - usurf_descriptors(canvas, smaller, 2.0), axis=1)
    other = np.linalg.norm(one - usurf_descriptors(canvas, smaller, 4.0), axis=1)
    assert np.median(same) < 0.15
    assert np.median(other) > 3.0 * np.median(same)


def test_the_window_option_sets_the_scale_by_depth(pair: tuple[np.ndarray, np.ndarray]) -> None:
    """A window of w metres at depth Z has the scale f w / (21 Z)."""
    frame = StereoFrontEnd(CAMERA, FrontEndOptions(window=0.4)).measure(*pair)
    scales = 300.0 * 0.4 / (21.0 * frame.measurements.points[:, 2])
    expected = usurf_descriptors(pair[0], frame.pixels[:, :2], scales)
    np.testing.assert_array_equal(frame.measurements.descriptors, expected)


def test_the_best_few_are_the_front_of_all(pair: tuple[np.ndarray, np.ndarray]) -> None:
    """`max_measurements` keeps the first of what is measured without it."""
    all_of_them = StereoFrontEnd(CAMERA).measure(*pair)
    few = StereoFrontEnd(CAMERA, FrontEndOptions(max_measurements=7)).measure(*pair)
    np.testing.assert_array_equal(few.pixels, all_of_them.pixels[:7])
    assert len({(int(u // 32), int(v // 32)) for u, v, _ in few.pixels}) == 7


def test_empty_and_saturated_images_show_nothing() -> None:
    """Images without contrast give empty measurements of the right width."""
    for left, right in ((0, 0), (255, 255), (0, 255)):
        images = [np.full((240, 320), level, np.uint8) for level in (left, right)]
        found = StereoFrontEnd(CAMERA).measure(*images).measurements
        assert found.points.shape == (0, 3)
        assert found.descriptors.shape == (0, 64)


def test_swapped_images_are_told(pair: tuple[np.ndarray, np.ndarray]) -> None:
    """A pair the wrong way round has negative disparities, and the error says so."""
    expected = "left, right: expected the left image first, got a pair with [0-9]+ points at negative disparities"
    with pytest.raises(ValueError, match=expected):
        StereoFrontEnd(CAMERA).measure(pair[1], pair[0])


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((240, 320, 3), np.uint8), "right: expected a grey image"),
        (np.zeros((240, 320)), "right: expected an image of dtype uint8, got an array of dtype float64"),
        (np.zeros((320, 240), np.uint8), r"right: expected an image of 320 x 240 px, got shape \(320, 240\)"),
    ],
)
def test_bad_images_are_named(pair: tuple[np.ndarray, np.ndarray], image: np.ndarray, message: str) -> None:
    """Colour, floats and wrong sizes are refused, and the error says which image it was."""
    with pytest.raises(ValueError, match=message):
        StereoFrontEnd(CAMERA).measure(pair[0], image)


def test_there_is_no_measuring_without_a_calibration() -> None:
    """Without a camera there are no points, and the error says where to get one."""
    with pytest.raises(ValueError, match=r"camera: expected a StereoCamera, got None. .*calibration"):
        StereoFrontEnd(None)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"descriptor": "surf"}, "front_end.descriptor: expected one of 'usurf', 'sift', 'orb'"),
        ({"corners": 100}, "front_end.corners: expected CornerOptions"),
        ({"patch_half": 16}, "front_end.patch_half: expected an int <= 15, got 16"),
        ({"window": 0.0}, "front_end.window: expected a finite number >= 1e-06"),
        ({"least_correlation": 1.5}, "front_end.least_correlation: .* <= 1"),
        ({"max_measurements": 0}, "front_end.max_measurements: expected an int >= 1"),
    ],
)
def test_impossible_options_are_refused(change: dict[str, Any], message: str) -> None:
    """The error names the option."""
    with pytest.raises(ValueError, match=message):
        FrontEndOptions(**change)


def test_read_only_images_need_no_other_kernels(pair: tuple[np.ndarray, np.ndarray]) -> None:
    """Images that cannot be written are measured by the kernels that are there, and stay as they are."""
    eye = StereoFrontEnd(CAMERA)
    expected = eye.measure(*pair)
    frozen = [image.copy() for image in pair]
    for image in frozen:
        image.setflags(write=False)
    with watch_compilation(lambda name: None) as watch:
        np.testing.assert_array_equal(eye.measure(*frozen).pixels, expected.pixels)
    assert watch.names == []


def test_matching_along_rows_is_a_nearest_neighbour_search() -> None:
    """The compiled search agrees with a plain one over all pairs."""
    rng = np.random.default_rng(5)
    left, right = rng.uniform(0.0, 60.0, (40, 2)), rng.uniform(0.0, 60.0, (33, 2))
    ours, theirs = (rng.normal(size=(n, 5)).astype(np.float32) for n in (40, 33))
    partner, mutual, square = match_rows(left, right, ours, theirs, 6.0, 2.0, 40.0, 6.0)
    squares = ((ours[:, None].astype(float) - theirs[None]) ** 2).sum(axis=2)
    shift = left[:, None, 0] - right[None, :, 0]
    allowed = (np.abs(left[:, None, 1] - right[None, :, 1]) <= 6.0) & (shift >= 2.0) & (shift <= 40.0)
    squares[~allowed] = np.inf
    best, back = squares.argmin(axis=1), squares.argmin(axis=0)
    near = squares.min(axis=1) < 6.0
    assert 5 < near.sum() < 40
    np.testing.assert_array_equal(partner, np.where(near, best, -1))
    np.testing.assert_array_equal(mutual, near & (back[best] == np.arange(40)))
    np.testing.assert_allclose(square[near], squares.min(axis=1)[near], rtol=1e-5)


def test_patches_are_laid_where_they_fit_best() -> None:
    """No place around the one that the compiled search returns has patches that are plainly more alike."""
    left, right = draw_boxes(120, 90, 0.0, seed=7, count=30), draw_boxes(120, 90, 6.4, seed=7, count=30)
    left, right = (cv2.GaussianBlur(image, (0, 0), 1.2) for image in (left, right))
    corners = harris_corners(left, CornerOptions(border=16)).points[:5]
    found = refine(left, right, corners, corners - [6.0, 0.4], 5, 20)
    assert (found[:, 4:].min(axis=1) > 0.9).sum() >= 3
    found, corners = (rows[found[:, 4:].min(axis=1) > 0.9] for rows in (found, corners))
    around = np.arange(-5.0, 6.0)

    def mismatch(image: np.ndarray, x: float, y: float, template: np.ndarray) -> float:
        rows, columns = np.meshgrid(y + around, x + around, indexing="ij")
        patch = map_coordinates(image.astype(float), [rows, columns], order=1)
        patch, template = patch - patch.mean(), template - template.mean()
        return float(((patch / np.linalg.norm(patch) - template / np.linalg.norm(template)) ** 2).sum())

    for corner, (forward, row_forward, *_, correlation, _) in zip(corners, found, strict=True):
        column, row = np.rint(corner).astype(int)
        template = left[row - 5 : row + 6, column - 5 : column + 6].astype(float)
        here = mismatch(right, column - forward, row + row_forward, template)
        assert correlation == pytest.approx(1.0 - 0.5 * here, abs=2e-3)
        for dx, dy in ((0.15, 0.0), (-0.15, 0.0), (0.0, 0.15), (0.0, -0.15)):
            assert here < mismatch(right, column - forward + dx, row + row_forward + dy, template)


def test_patches_at_the_border_are_lost_without_harm() -> None:
    """A patch that leaves an image, or has no contrast, has the correlation -1."""
    image = draw_boxes(60, 50, 0.0, count=40)
    edges = np.array([[2.0, 25.0], [57.0, 25.0], [30.0, 1.0], [30.0, 48.0], [-1.0, 25.0]])
    assert (refine(image, image, edges, edges, 5, 8)[:, 4:] == -1.0).all()
    flat = np.full_like(image, 80)
    assert (refine(flat, image, np.array([[30.0, 25.0]]), np.array([[30.0, 25.0]]), 5, 8)[:, 4:] == -1.0).all()


def test_real_disparities_are_found(data_dir: Path) -> None:
    """On the aloe pair 98 % of the points are within 2 px of the known disparity, which is rounded to whole pixels."""
    folder = data_dir / "opencv_samples"
    left, right = (cv2.imread(str(folder / f"aloe{side}.jpg"), cv2.IMREAD_GRAYSCALE) for side in "LR")
    true = cv2.imread(str(folder / "aloeGT.png"), cv2.IMREAD_GRAYSCALE).astype(float)
    camera = StereoCamera(focal_px=3740.0, baseline=0.16, width=1282, height=1110, max_range=40.0)
    options = FrontEndOptions(nearest=2.3, corners=CornerOptions(most=1000))
    pixels = StereoFrontEnd(camera, options).measure(left, right).pixels
    known = true[np.rint(pixels[:, 1]).astype(int), np.rint(pixels[:, 0]).astype(int)]
    errors = np.abs(pixels[:, 2] - known)[known > 0]
    assert len(errors) > 250
    assert (errors < 2.0).mean() > 0.98
    assert np.median(errors) < 0.5
