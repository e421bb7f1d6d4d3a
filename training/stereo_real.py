"""The front end on real images: a pair with known disparities, a chessboard rig, and planar pairs with homographies."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from slam_backend.camera import StereoCamera
from slam_backend.errors import Float32Array, FloatArray, bad_argument
from slam_backend.frontend import KINDS, CornerOptions, FrontEndOptions, StereoFrontEnd, harris_corners
from slam_backend.frontend.descriptors import describe_points, nearest
from slam_backend.frontend.images import Image
from slam_backend.readers.calibration import Eye, Rectifier
from slam_backend.readers.kitti_images import read_grey
from training.stereo_quality import guard_rows

ALOE_SPAN = 3740.0 * 0.16  # focal length [px] times baseline [m] of the Middlebury rig of 2006
ALOE_DISPARITIES = (15.0, 260.0)
BOARD = (9, 6)  # inner corners of the chessboard
PLANAR_PAIRS = ("BruggeTower", "LePoint1", "WhiteBoard", "adam", "boat")
PLANAR_CORNERS, PLANAR_TOLERANCE = 1000, 4.0  # px in the first image
FARTHEST_SQUARES = 60.0  # points farther than this are dropped [squares]


def aloe_rows(folder: Path, descriptor: Any) -> list[dict[str, Any]]:
    """Return errors before and after each guard on the aloe pair, whose disparities are known to whole pixels.

    Args:
        folder: With `aloeL.jpg`, `aloeR.jpg` and `aloeGT.png`.
        descriptor: Key of `KINDS`.
    """
    left, right = (read_grey(folder / f"aloe{eye}.jpg") for eye in "LR")
    true = read_grey(folder / "aloeGT.png").astype(np.float64)
    height, width = left.shape
    nearest_m, farthest = ALOE_SPAN / ALOE_DISPARITIES[1], ALOE_SPAN / ALOE_DISPARITIES[0]
    camera = StereoCamera(focal_px=3740.0, baseline=0.16, width=width, height=height, max_range=farthest)
    options = FrontEndOptions(descriptor=descriptor, nearest=nearest_m, corners=CornerOptions(most=1500))
    matches = StereoFrontEnd(camera, options).match(left, right)
    columns, rows = np.rint(matches.corners.T).astype(int)
    known = true[rows, columns] > 0.0
    truth = true[rows, columns][known]
    by_corners, by_patches = matches.corner_disparity[known] - truth, matches.disparity[known] - truth
    return guard_rows(by_corners, by_patches, matches.passed[:, known])


def chessboard(folder: Path) -> dict[str, Any]:
    """Calibrate the chessboard rig, rectify its pairs, and measure the board.

    Returns:
        Pairs; the reprojection error of the calibration [px]; points of the front end on the board; their distance
        from the plane of the board's corners, as OpenCV's search for a chessboard finds them in both images: median in
        squares and as a share of the depth, and the share of the points within a twentieth of a square.
    """
    images, left_points, right_points = [], [], []
    for number in (1, 2, 3, 4, 5, 6, 7, 8, 9, 11, 12, 13, 14):
        pair = [read_grey(folder / f"{eye}{number:02d}.jpg") for eye in ("left", "right")]
        found = [_board(image) for image in pair]
        if found[0] is not None and found[1] is not None:
            images.append(pair)
            left_points.append(found[0])
            right_points.append(found[1])
    if len(images) < 5:
        raise bad_argument("path", "five or more pairs of a chessboard", f"a folder with {len(images)}", "Check it.")
    grid = np.zeros((BOARD[0] * BOARD[1], 3), np.float32)
    grid[:, :2] = np.mgrid[: BOARD[0], : BOARD[1]].T.reshape(-1, 2)
    height, width = images[0][0].shape
    grids = [grid] * len(images)
    single: Any = [
        cv2.calibrateCamera(grids, points, (width, height), None, None) for points in (left_points, right_points)
    ]
    stereo: Any = cv2.stereoCalibrate(
        grids, left_points, right_points, single[0][1], single[0][2], single[1][1], single[1][2], (width, height)
    )
    left_from_right = np.eye(4)
    left_from_right[:3, :3] = stereo[5].T
    left_from_right[:3, 3] = -stereo[5].T @ np.ravel(stereo[6])
    left_eye = Eye(width, height, stereo[1], np.ravel(stereo[2])[:5], np.eye(4))
    right_eye = Eye(width, height, stereo[3], np.ravel(stereo[4])[:5], left_from_right)
    rectifier = Rectifier(left_eye, right_eye)
    camera = rectifier.pair.camera(width, height, max_range=FARTHEST_SQUARES)
    options = FrontEndOptions(nearest=5.0, corners=CornerOptions(most=600))
    front_end = StereoFrontEnd(camera, options, rectifier.pair.centre_px)
    away, depths = [], []
    for raw in images:
        rectified = rectifier.rectify(*raw)
        corners, others = _board(rectified[0]), _board(rectified[1])
        if corners is None or others is None:
            continue
        frame = front_end.measure(*rectified)
        hull = cv2.convexHull(corners)
        on_board = [cv2.pointPolygonTest(hull, (float(u), float(v)), False) >= 0 for u, v in frame.pixels[:, :2]]
        points = frame.measurements.points[np.array(on_board, dtype=bool)]
        if len(points) < 10:
            continue
        here, there = corners.reshape(-1, 2), others.reshape(-1, 2)
        centre = rectifier.pair.centre_px
        board = camera.triangulate(np.column_stack([here - centre, here[:, 0] - there[:, 0]]).astype(np.float64))
        middle = board.mean(axis=0)
        normal = np.linalg.svd(board - middle)[2][2]
        away.append(np.abs((points - middle) @ normal))
        depths.append(points[:, 2])
    distances, depth = np.concatenate(away), np.concatenate(depths)
    return {
        "pairs": len(away),
        "calibration_px": float(stereo[0]),
        "points": len(distances),
        "median_squares": float(np.median(distances)),
        "within_20th": float((distances < 0.05).mean()),
        "median_percent_of_depth": float(100.0 * np.median(distances / depth)),
    }


def planar_scores(folder: Path) -> list[dict[str, Any]]:
    """Return matching scores on planar pairs with known homographies.

    Descriptors of Harris corners, upright, by u-SURF, SIFT and ORB; and OpenCV's SIFT and ORB with their own keypoints
    and rotations beside them. A match is a mutual nearest descriptor; it is right if the homography takes it within
    4 px. Score: right ones among the matches.
    """
    rows = []
    for name in PLANAR_PAIRS:
        suffix = ".jpg" if name == "WhiteBoard" else ".png"
        a, b = (read_grey(folder / f"{name}{side}{suffix}") for side in "AB")
        model = np.loadtxt(folder / f"{name}_model.txt").reshape(3, 3)
        for way in (*KINDS, "sift_own", "orb_own"):
            (at_a, described_a), (at_b, described_b) = (_described(image, way) for image in (a, b))
            there, _ = nearest(described_b, described_a)
            back, _ = nearest(described_a, described_b)
            matched = np.flatnonzero(back[there] == np.arange(len(there)))
            lifted = np.column_stack([at_b[matched], np.ones(len(matched))]) @ model.T
            errors = np.hypot(*(lifted[:, :2] / lifted[:, 2:] - at_a[there[matched]]).T)
            right = int((errors <= PLANAR_TOLERANCE).sum())
            rows.append({"pair": name, "way": way, "matches": len(matched), "right": right})
    return rows


def _described(image: Image, way: str) -> tuple[FloatArray, Float32Array]:
    """Return points (n, 2) [px] and unit descriptors of an image."""
    if way in KINDS:
        points = harris_corners(image, CornerOptions(most=PLANAR_CORNERS)).points
        described = describe_points(image, points, np.full(len(points), 2.3), way)
        known = described.any(axis=1)
        return points[known], described[known]
    maker: Any = cv2.SIFT.create(PLANAR_CORNERS) if way == "sift_own" else cv2.ORB.create(PLANAR_CORNERS)
    keypoints, found = maker.detectAndCompute(image, None)
    points = np.array([keypoint.pt for keypoint in keypoints], dtype=np.float64).reshape(-1, 2)
    if way == "orb_own":
        return points, ((2.0 * np.unpackbits(found, axis=1) - 1.0) / 16.0).astype(np.float32)
    return points, (found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-9)).astype(np.float32)


def _board(image: Image) -> Float32Array | None:
    """Return the inner corners (54, 1, 2) [px] of the chessboard, to a fraction of a pixel; None if it is not found."""
    found, corners = cv2.findChessboardCorners(image, BOARD)
    if not found:
        return None
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.01)
    return np.asarray(cv2.cornerSubPix(image, corners, (5, 5), (-1, -1), criteria), dtype=np.float32)
