"""Evaluation of the front end on the real images in a folder.

Supported are a pair with known disparities and a chessboard rig (OpenCV's samples), planar pairs with homographies,
and stereo pairs with the calibration of their rig.
"""

import time
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from slam_backend.core.image_files import read_grey_image
from slam_backend.core.text_files import parse_numbers, read_text
from slam_backend.core.validation import Float32Array, FloatArray, argument_error
from slam_backend.frontend import (
    DESCRIPTOR_TYPES,
    MATCH_CHECKS,
    CornerOptions,
    FrontEndOptions,
    StereoFrontEnd,
    harris_corners,
)
from slam_backend.frontend.descriptors import describe_points, nearest
from slam_backend.frontend.images import Image
from slam_backend.models.camera import StereoCamera
from slam_backend.readers.calibration import CameraCalibration, Rectifier
from slam_backend.readers.stereo_files import load_rig
from studies.front_end.rendered import Disparities

Kind = Literal["checks", "chessboard", "planar", "rig"]
WAYS = (*DESCRIPTOR_TYPES, "sift_own", "orb_own")  # of matching planar pairs
ALOE_SPAN = 3740.0 * 0.16  # focal length [px] times baseline [m] of the Middlebury rig of 2006
ALOE_DISPARITIES = (15.0, 260.0)
BOARD = (9, 6)  # inner corners of the chessboard
MODEL = "_model.txt"  # suffix of the homography of a planar pair
SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".ppm", ".tif", ".tiff")
LAYOUTS = (
    ("left*", "right*"), ("image_0/*", "image_1/*"), ("image_l/*", "image_r/*"), ("cam0/*", "cam1/*"),
    ("cam0/data/*", "cam1/data/*"), ("*_l.*", "*_r.*"), ("*L.*", "*R.*"),
)  # fmt: skip
CALIBRATIONS = ("calib.txt", "sensorLeft.yaml,sensorRight.yaml", "cam0/sensor.yaml,cam1/sensor.yaml")
MOST_PAIRS = 10  # maximum number of measured pairs of a rig
LEAST_DISPARITY, LARGEST_DISPARITY = 1.0, 0.25  # [px]; share of the width
EXPECTED = (
    "pairs with a model file: NAMEA, NAMEB and NAME_model.txt (a homography), or left and right images with calib.txt "
    "or two sensor.yaml"
)
PLANAR_CORNERS, PLANAR_TOLERANCE = 1000, 4.0  # tolerance in the first image [px]
FARTHEST_SQUARES = 60.0  # maximum distance of points [squares]


def find_images(folder: Path) -> list[tuple[Kind, Path]]:
    """Return what can be measured in a folder and its subfolders: kind, and folder or, of a planar pair, model file.

    Args:
        folder: Folder with some of OpenCV's samples, planar pairs `NAMEA`, `NAMEB` with their homography
            `NAME_model.txt`, or stereo pairs in one of `LAYOUTS` with one of `CALIBRATIONS`.
    """
    found: list[tuple[Kind, Path]] = []
    for place in (folder, *_folders_in(folder)):
        found += [("checks", place)] if (place / "aloeGT.png").is_file() else []
        found += [("chessboard", place)] if (place / "left01.jpg").is_file() and not _calibration(place) else []
        found += [("planar", model) for model in sorted(place.glob(f"*{MODEL}"))]
        rigs = (place, *(_folders_in(place) if place != folder else ()))
        found += [("rig", rig) for rig in rigs if _calibration(rig)]
    return found


def _folders_in(folder: Path) -> list[Path]:
    """Return the subfolders of a folder, sorted."""
    return sorted(below for below in folder.iterdir() if below.is_dir())


def measure_rig(folder: Path, descriptor: Any) -> dict[str, Any]:
    """Measure stereo pairs of a calibrated rig: matches after each match check, depths, and times.

    Args:
        folder: Folder in one of `LAYOUTS`, with one of `CALIBRATIONS`; at most `MOST_PAIRS` of its pairs are measured,
            evenly chosen.

    Returns:
        `pairs`, their number; means over the pairs of `matches`, of the matches after each check, by its name, of
        `points`, of the median depth `depth_m` (None without points), and the time of a pair `ms`.

    Raises:
        ValueError: If there are no such images, or the calibration is invalid.
    """
    left, right = _eyes(folder)
    chosen = np.unique(np.linspace(0, len(left) - 1, min(len(left), MOST_PAIRS)).round().astype(int))
    pairs = [(read_grey_image(left[n]), read_grey_image(right[n])) for n in chosen]
    height, width = pairs[0][0].shape
    rig = load_rig(folder, _calibration(folder), (width, height))
    span = rig.pair.focal_px * rig.pair.baseline
    camera = rig.pair.camera(width, height, max_range=span / LEAST_DISPARITY)
    rectified = [rig.rectify(*pair) for pair in pairs]
    nearest_m = span / (LARGEST_DISPARITY * width)
    options = FrontEndOptions(descriptor=descriptor, nearest=nearest_m, corners=CornerOptions(most=1500))
    eye = StereoFrontEnd(camera, options, rig.pair.centre_px)
    eye.measure(*rectified[0])  # loads and compiles before the timing
    began = time.perf_counter()
    frames = [eye.measure(*pair) for pair in rectified]
    spent = 1e3 * (time.perf_counter() - began) / len(frames)
    kept = [np.cumprod(frame.matches.passed, axis=0).sum(axis=1) for frame in frames]
    depths = np.concatenate([frame.measurements.points[:, 2] for frame in frames])
    return {
        "pairs": len(frames), "matches": float(np.mean([frame.matches.passed.shape[1] for frame in frames])),
        **dict(zip(MATCH_CHECKS, np.mean(kept, axis=0).tolist(), strict=True)),
        "points": float(np.mean([len(frame.measurements) for frame in frames])),
        "depth_m": float(np.median(depths)) if len(depths) else None, "ms": spent,
    }  # fmt: skip


def _calibration(folder: Path) -> str:
    """Return the calibration of the rig in a folder, "" if there is none."""
    for names in CALIBRATIONS:
        if all((folder / name).is_file() for name in names.split(",")):
            return names
    return ""


def _eyes(folder: Path) -> tuple[list[Path], list[Path]]:
    """Return the images of the left and of the right camera."""
    for layout in LAYOUTS:
        left, right = (
            sorted(file for file in folder.glob(names) if file.suffix.lower() in SUFFIXES) for names in layout
        )
        if left and len(left) == len(right):
            return left, right
    got = f"a folder with {_calibration(folder)} alone"
    expected = "as many left as right images, " + ", ".join(f"{one} and {other}" for one, other in LAYOUTS[:4])
    raise argument_error("real", expected, got, f"Check {str(folder)!r}.")


@lru_cache(maxsize=1)
def aloe_disparities(folder: Path, descriptor: Any) -> Disparities:
    """Measure the aloe pair, whose true disparities are whole pixels."""
    left, right = (read_grey_image(folder / f"aloe{eye}.jpg") for eye in "LR")
    true = read_grey_image(folder / "aloeGT.png").astype(np.float64)
    height, width = left.shape
    nearest_m, farthest = ALOE_SPAN / ALOE_DISPARITIES[1], ALOE_SPAN / ALOE_DISPARITIES[0]
    camera = StereoCamera(focal_px=3740.0, baseline=0.16, width=width, height=height, max_range=farthest)
    options = FrontEndOptions(descriptor=descriptor, nearest=nearest_m, corners=CornerOptions(most=1500))
    matches = StereoFrontEnd(camera, options).match(left, right)
    columns, rows = np.rint(matches.corners.T).astype(int)
    known = true[rows, columns] > 0.0
    truth = true[rows, columns][known]
    return Disparities(
        matches.corner_disparity[known] - truth, matches.disparity[known] - truth, matches.passed[:, known]
    )


def chessboard(folder: Path) -> dict[str, Any]:
    """Calibrate the chessboard rig, rectify its pairs, and measure the board.

    Returns:
        Number of pairs; reprojection error of the calibration [px]; points of the front end on the board; their median
        distance, in squares and as a share of the depth, from the plane of the board's corners, which OpenCV detects in
        both images; and the share of points within a twentieth of a square.
    """
    images, left_points, right_points = [], [], []
    for number in (1, 2, 3, 4, 5, 6, 7, 8, 9, 11, 12, 13, 14):
        pair = [read_grey_image(folder / f"{eye}{number:02d}.jpg") for eye in ("left", "right")]
        found = [_board(image) for image in pair]
        if found[0] is not None and found[1] is not None:
            images.append(pair)
            left_points.append(found[0])
            right_points.append(found[1])
    if len(images) < 5:
        raise argument_error(
            "path", "five or more pairs of a chessboard", f"a folder with {len(images)}", "Check the folder."
        )
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
    left_eye = CameraCalibration(width, height, stereo[1], np.ravel(stereo[2])[:5], np.eye(4))
    right_eye = CameraCalibration(width, height, stereo[3], np.ravel(stereo[4])[:5], left_from_right)
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
        "pairs": len(away), "calibration_px": float(stereo[0]), "points": len(distances),
        "median_squares": float(np.median(distances)), "within_20th": float((distances < 0.05).mean()),
        "median_percent_of_depth": float(100.0 * np.median(distances / depth)),
    }  # fmt: skip


def match_planar(file: Path, way: str) -> dict[str, Any]:
    """Match a planar pair.

    A match is a mutual nearest descriptor; it is right if the homography maps it within 4 px.

    Args:
        file: `NAME_model.txt`, the homography from image `NAMEB` to the `NAMEA` in the same folder.
        way: Entry of `WAYS`: upright descriptors of Harris corners, or OpenCV's SIFT and ORB with their own keypoints
            and rotations.

    Returns:
        Numbers of `matches` and `right` ones.

    Raises:
        ValueError: If the file has no 3 x 3 homography, or an image is missing.
    """
    model, name = _homography(file), file.name.removesuffix(MODEL)
    a, b = (read_grey_image(_image(file.parent, f"{name}{side}")) for side in "AB")
    (at_a, described_a), (at_b, described_b) = (_described(image, way) for image in (a, b))
    if not len(at_a) or not len(at_b):
        return {"matches": 0, "right": 0}
    there, _ = nearest(described_b, described_a)
    back, _ = nearest(described_a, described_b)
    matched = np.flatnonzero(back[there] == np.arange(len(there)))
    lifted = np.column_stack([at_b[matched], np.ones(len(matched))]) @ model.T
    errors = np.hypot(*(lifted[:, :2] / lifted[:, 2:] - at_a[there[matched]]).T)
    return {"matches": len(matched), "right": int((errors <= PLANAR_TOLERANCE).sum())}


def _homography(file: Path) -> FloatArray:
    """Return the homography (3, 3) from a file of nine numbers."""
    text = read_text(file, "real", "a file of a homography")
    numbers = np.array(parse_numbers(text.replace(",", " ").split()) or [])
    if numbers.shape != (9,) or not np.isfinite(numbers).all() or abs(np.linalg.det(numbers.reshape(3, 3))) == 0.0:
        raise argument_error(
            "real", f"{file.name} with a 3 x 3 homography", "a different one", f"Correct {str(file)!r}."
        )
    return numbers.reshape(3, 3)


def _image(folder: Path, stem: str) -> Path:
    """Return the image with a given name and any supported suffix."""
    found = [folder / f"{stem}{suffix}" for suffix in SUFFIXES if (folder / f"{stem}{suffix}").is_file()]
    if not found:
        raise argument_error("real", f"an image {stem}.png, .jpg, ...", "no such file", f"Add it to {str(folder)!r}.")
    return found[0]


def _described(image: Image, way: str) -> tuple[FloatArray, Float32Array]:
    """Return points (n, 2) [px] and unit descriptors of an image."""
    if way in DESCRIPTOR_TYPES:
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
    """Return the inner corners (54, 1, 2) [px] of the chessboard at subpixel accuracy; None if it is not found."""
    found, corners = cv2.findChessboardCorners(image, BOARD)
    if not found:
        return None
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.01)
    return np.asarray(cv2.cornerSubPix(image, corners, (5, 5), (-1, -1), criteria), dtype=np.float32)
