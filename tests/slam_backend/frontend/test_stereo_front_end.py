"""From images of two eyes to points: corners, disparities, descriptors and motions."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from builders.images import draw_boxes, paint
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from slam_backend.core.compilation.messages import watch_compilation
from slam_backend.frontend import (
    DESCRIPTOR_TYPES,
    CornerOptions,
    FrontEndOptions,
    StereoFrontEnd,
    grid_order,
    harris_corners,
    usurf_descriptors,
)
from slam_backend.frontend._matching_kernels import match_rows, refine
from slam_backend.frontend.odometry import camera_motion, match_frames
from slam_backend.geometry3d import fit_rigid, ransac_rigid, rotation_angle
from slam_backend.models.camera import StereoCamera
from slam_backend.models.measurements import Measurements

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
    assert descriptors.shape[1] == eye.descriptor_size == DESCRIPTOR_TYPES[kind].size
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


def test_a_measurement_limit_keeps_the_first_measurements(pair: tuple[np.ndarray, np.ndarray]) -> None:
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


def test_swapped_images_raise_a_hint(pair: tuple[np.ndarray, np.ndarray]) -> None:
    """A pair the wrong way round has negative disparities, and the error says so."""
    expected = "left, right: expected the left image first, got a pair with [0-9]+ points at negative disparities"
    with pytest.raises(ValueError, match=expected):
        StereoFrontEnd(CAMERA).measure(pair[1], pair[0])


def test_read_only_images_compile_no_further_kernels(pair: tuple[np.ndarray, np.ndarray]) -> None:
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


def test_corners_follow_motions_by_fractions_of_a_pixel() -> None:
    """Corners of boxes are found to a tenth of a pixel, but for an offset that all have and that lies inside."""
    rng = np.random.default_rng(1)
    grid = np.stack(np.meshgrid(np.arange(30.0, 270.0, 50.0), np.arange(30.0, 200.0, 50.0)), axis=-1).reshape(-1, 2)
    true = grid + rng.uniform(-0.5, 0.5, grid.shape)
    image = paint(320, 240, np.column_stack([true, true + 25.3]), np.full(len(true), 220.0))
    found = harris_corners(image, CornerOptions(most=400)).points
    apart = np.hypot(*(found[:, None] - true[None]).transpose(2, 0, 1))
    errors = found[apart.argmin(axis=0)] - true
    assert errors.std(axis=0).max() < 0.1
    assert (np.abs(errors.mean(axis=0) - 0.85) < 0.1).all()


def test_noise_and_flat_images_have_no_corners() -> None:
    """Camera noise of two grey levels is no corner, nor is an empty, grey or saturated image."""
    noise = np.random.default_rng(2).normal(128.0, 2.0, (120, 160))
    for image in (np.rint(noise).astype(np.uint8), *(np.full((120, 160), level, np.uint8) for level in (0, 90, 255))):
        assert len(harris_corners(image).points) == 0


def test_corners_keep_their_distances() -> None:
    """No two corners lie within the spacing of each other, none within the border, and responses are positive."""
    image = np.random.default_rng(3).integers(0, 256, (97, 131), dtype=np.uint8)
    options = CornerOptions(most=1000, spacing=5, border=9)
    points, responses = harris_corners(image, options)
    apart = np.abs(points[:, None] - points[None]).max(axis=2) + 100.0 * np.eye(len(points))
    assert len(points) > 50
    assert apart.min() > 4.0  # pixels are more than 5 apart, peaks within them less than 1 off each
    assert points.min() >= 8.0
    assert points[:, 0].max() < 131 - 8
    assert points[:, 1].max() < 97 - 8
    assert responses.min() > 0.0


def test_equal_neighbours_give_one_corner() -> None:
    """Of peaks that are exactly alike and within the spacing, the first one counts."""
    image = np.zeros((60, 60), dtype=np.uint8)
    image[28:32, 20:24] = image[28:32, 24:28] = 200  # mirrored halves of one bar
    points = harris_corners(image, CornerOptions(spacing=8)).points
    assert len(points) == 1


def test_the_order_is_that_of_ranks_within_cells() -> None:
    """`grid_order` sorts by rank within the own cell, then by quality; here checked the long way."""
    rng = np.random.default_rng(4)
    points, quality = rng.uniform(-50.0, 200.0, (70, 2)), rng.permutation(70).astype(float)
    order = grid_order(points, quality, 40.0)
    cells = [tuple(cell) for cell in np.floor(points / 40.0).astype(int)]
    ranks = [sum(cells[j] == cells[i] and quality[j] > quality[i] for j in range(70)) for i in range(70)]
    assert order.tolist() == sorted(range(70), key=lambda i: (ranks[i], -quality[i]))
    assert grid_order(np.empty((0, 2)), np.empty(0), 40.0).tolist() == []


def _motion(seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)


@pytest.mark.parametrize("seed", range(5))
def test_exact_pairs_give_the_exact_motion(seed: int) -> None:
    """Without noise the motion is found whatever the weights, also from points of a plane; it is never a reflection."""
    rng = np.random.default_rng(seed)
    turn, shift = _motion(seed)
    for flat in (1.0, 0.0):
        b = rng.normal(size=(7, 3)) * [1.0, 2.0, flat]
        found_turn, found_shift = fit_rigid(b @ turn.T + shift, b, rng.uniform(0.5, 2.0, 7))
        np.testing.assert_allclose(found_turn, turn, atol=1e-12)
        np.testing.assert_allclose(found_shift, shift, atol=1e-12)
        assert np.linalg.det(found_turn) == pytest.approx(1.0)


def test_the_motion_agrees_with_scipy_on_noisy_points() -> None:
    """About their weighted means, the rotation is that of scipy's `Rotation.align_vectors`."""
    rng = np.random.default_rng(6)
    turn, shift = _motion(6)
    b, weights = rng.normal(size=(20, 3)), rng.uniform(0.2, 3.0, 20)
    a = b @ turn.T + shift + 0.1 * rng.normal(size=(20, 3))
    found, _ = fit_rigid(a, b, weights)
    means = [np.average(points, axis=0, weights=weights) for points in (a, b)]
    oracle = Rotation.align_vectors(a - means[0], b - means[1], weights)[0].as_matrix()
    np.testing.assert_allclose(found, oracle, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_the_consensus_leaves_wrong_pairs_out(seed: int) -> None:
    """With six of ten pairs wrong, the right ones are found, and the motion to their noise."""
    rng = np.random.default_rng(seed)
    turn, shift = _motion(seed)
    b = rng.uniform(-5.0, 5.0, (100, 3))
    a = b @ turn.T + shift + 0.01 * rng.normal(size=(100, 3))
    a[40:] = rng.uniform(-5.0, 5.0, (60, 3))
    fit = ransac_rigid(a, b, 0.06, rng)
    assert fit is not None
    assert fit.inliers[:40].sum() >= 39
    assert fit.inliers[40:].sum() <= 1
    assert np.linalg.norm(fit.translation - shift) < 0.01
    assert rotation_angle(fit.rotation.T @ turn) < 0.003
    assert 0.01 < fit.rms < 0.025
    again = ransac_rigid(a, b, np.full(100, 0.06), np.random.default_rng(9))
    assert again is not None
    np.testing.assert_array_equal(again.inliers, fit.inliers)


def test_unrelated_and_too_few_points_have_no_motion() -> None:
    """Two pairs fix nothing, nor do triangles of different sides."""
    rng = np.random.default_rng(1)
    assert ransac_rigid(np.zeros((2, 3)), np.zeros((2, 3)), 0.1, rng) is None
    a = np.diag([1.0, 2.0, 3.0])
    assert ransac_rigid(a, 4.0 * a, 0.1, rng, iterations=5) is None


def test_angles_of_rotations() -> None:
    """The angle is exact where the trace alone would lose it."""
    for angle in (0.0, 1e-9, 0.3, 3.1):
        turn = Rotation.from_rotvec([0.0, 0.6 * angle, 0.8 * angle]).as_matrix()
        assert rotation_angle(turn) == pytest.approx(angle, rel=1e-9, abs=1e-15)


WIDE_CAMERA = StereoCamera(focal_px=300.0, baseline=0.2, sigma_px=0.3, sigma_disparity_px=0.2)


def _frames(seed: int, noise: float, wrong: int = 0) -> tuple[Measurements, Measurements, np.ndarray, np.ndarray]:
    """Return two frames of 60 points and the motion between; the last `wrong` ones are elsewhere in the second one."""
    rng = np.random.default_rng(seed)
    turn, shift = Rotation.from_rotvec([0.02, 0.15, -0.01]).as_matrix(), np.array([0.1, -0.03, 0.4])
    a = np.column_stack([rng.uniform(-2.0, 2.0, (60, 2)), rng.uniform(2.0, 7.0, 60)])
    b = (a - shift) @ turn
    b[60 - wrong :] += rng.uniform(0.5, 1.0, (wrong, 3))
    sigmas = noise * np.array([WIDE_CAMERA.sigma_px, WIDE_CAMERA.sigma_px, WIDE_CAMERA.sigma_disparity_px])
    seen = [
        WIDE_CAMERA.triangulate(WIDE_CAMERA.project(points) + sigmas * rng.standard_normal((60, 3)))
        for points in (a, b)
    ]
    looks = rng.standard_normal((60, 32))
    looks /= np.linalg.norm(looks, axis=1, keepdims=True)
    order = rng.permutation(60)
    return Measurements(seen[0], looks), Measurements(seen[1][order], looks[order]), turn, shift


def test_without_noise_the_motion_is_exact() -> None:
    """Points in another order, a quarter of them elsewhere: the motion comes out to rounding."""
    earlier, later, turn, shift = _frames(1, 0.0, wrong=15)
    motion = camera_motion(earlier, later, WIDE_CAMERA, 0.5, np.random.default_rng(0))
    assert motion is not None
    np.testing.assert_allclose(motion.rotation, turn, atol=1e-6)
    np.testing.assert_allclose(motion.translation, shift, atol=1e-6)
    np.testing.assert_array_equal(np.sort(motion.pairs[motion.inliers, 0]), np.arange(45))
    heading = np.arctan2(-turn[0, 2], turn[2, 2])
    np.testing.assert_allclose(motion.planar, [0.4, -0.1, heading], atol=1e-6)
    assert motion.planar[2] == pytest.approx(-0.15, abs=0.01)  # Y points down: a turn about it is one to the right


def test_reprojection_errors_give_a_better_motion_than_point_distances() -> None:
    """Weighing pixels and disparities by their noise, the motion is better than that of equally weighed points."""
    ours, theirs = [], []
    for seed in range(12):
        earlier, later, _, shift = _frames(seed, 1.0, wrong=10)
        motion = camera_motion(earlier, later, WIDE_CAMERA, 0.5, np.random.default_rng(seed))
        assert motion is not None
        pairs = motion.pairs[motion.inliers]
        _, plain = fit_rigid(earlier.points[pairs[:, 0]], later.points[pairs[:, 1]])
        ours.append(np.linalg.norm(motion.translation - shift))
        theirs.append(np.linalg.norm(plain - shift))
    assert np.mean(ours) < 0.02
    assert np.mean(ours) < 0.7 * np.mean(theirs)


def test_frames_that_share_nothing_have_no_motion() -> None:
    """Unrelated descriptors, empty frames and fewer than six pairs that agree give None."""
    earlier, later, _, _ = _frames(3, 1.0)
    assert camera_motion(earlier, later, WIDE_CAMERA, 0.01, np.random.default_rng(0)) is not None
    other = Measurements(later.points, np.roll(later.descriptors, 1, axis=1))
    assert len(match_frames(earlier, other, 0.5)) == 0
    assert camera_motion(earlier, other, WIDE_CAMERA, 0.5, np.random.default_rng(0)) is None
    nothing = Measurements.empty(32)
    assert camera_motion(nothing, later, WIDE_CAMERA, 0.5, np.random.default_rng(0)) is None
    few = Measurements(earlier.points[:5], earlier.descriptors[:5])
    assert camera_motion(few, later, WIDE_CAMERA, 0.5, np.random.default_rng(0)) is None


def test_matches_are_mutual_nearest_neighbours() -> None:
    """A pair counts if it is mutual and within the gate; checked against all distances."""
    rng = np.random.default_rng(4)
    a, b = (Measurements(rng.normal(size=(n, 3)), rng.normal(size=(n, 6))) for n in (20, 17))
    apart = np.linalg.norm(a.descriptors[:, None] - b.descriptors[None], axis=2)
    gate = float(np.median(apart.min(axis=1)))
    expected = [
        (i, int(apart[i].argmin()))
        for i in range(20)
        if apart[i].min() <= gate and apart[:, apart[i].argmin()].argmin() == i
    ]
    assert 2 < len(expected) < 20
    assert match_frames(a, b, gate).tolist() == [list(pair) for pair in expected]
