from pathlib import Path

import cv2
import numpy as np
import pytest
from box_pairs import draw_boxes

from slam_backend.frontend import StereoFrontEnd
from slam_backend.readers.calibration import Eye, Rectifier, load_euroc_eye, load_kitti_calibration

KITTI = "P0: 700 0 600 0 0 700 180 0 0 0 1 0\nP1: 700 0 600 -350 0 700 180 0 0 0 1 0\n"
EUROC = """%YAML:1.0
# a camera
T_BS:
  cols: 4
  data: [0.0, -1.0, 0.0, 0.1,
         1.0, 0.0, 0.0, 0.2,   # a remark
         0.0, 0.0, 1.0, 0.3,
         0.0, 0.0, 0.0, 1.0]
resolution: [640, 400]
distortion_model: radial-tangential
intrinsics: [400.5, 401, 320.25, 199] #fu, fv, cu, cv
distortion_coefficients: [-0.3, 0.07, 2e-4, 1.8e-05]
"""


def test_kitti_files_give_focal_length_centre_and_baseline(tmp_path: Path) -> None:
    """The baseline is the last column of the right projection over the focal length; names of rows do not matter."""
    for text in (KITTI, KITTI.replace("P0: ", "").replace("P1: ", "")):
        (tmp_path / "calib.txt").write_text(text)
        pair = load_kitti_calibration(tmp_path / "calib.txt")
        assert (pair.focal_px, pair.baseline) == (700.0, 0.5)
        assert pair.centre_px.tolist() == [600.0, 180.0]
    camera = pair.camera(1200, 400, max_range=50.0)
    assert (camera.width, camera.max_range, camera.baseline) == (1200, 50.0, 0.5)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "calibration: expected calib.txt with two matrices of 12 numbers, got a file with 0"),
        (KITTI.replace("700 0 600 -350", "700 0 x -350"), "got a file with 1"),
        (KITTI.replace("-350", "350"), "calibration: expected calib.txt with a rectified pair"),
        (KITTI.replace("600 -350", "610 -350"), "calibration: expected calib.txt with a rectified pair"),
    ],
)
def test_broken_kitti_files_are_named(tmp_path: Path, text: str, message: str) -> None:
    """Missing matrices, eyes the wrong way round and eyes that differ are refused."""
    (tmp_path / "calib.txt").write_text(text)
    with pytest.raises(ValueError, match=message):
        load_kitti_calibration(tmp_path / "calib.txt")
    with pytest.raises(ValueError, match="calibration: expected a readable file of a calibration, got no such file"):
        load_kitti_calibration(tmp_path / "none.txt")


def test_euroc_files_are_read_with_their_remarks(tmp_path: Path) -> None:
    """Lists may run over lines and have remarks between; all numbers are where they belong."""
    (tmp_path / "sensor.yaml").write_text(EUROC)
    eye = load_euroc_eye(tmp_path / "sensor.yaml")
    assert (eye.width, eye.height) == (640, 400)
    assert eye.matrix.tolist() == [[400.5, 0.0, 320.25], [0.0, 401.0, 199.0], [0.0, 0.0, 1.0]]
    assert eye.distortion.tolist() == [-0.3, 0.07, 2e-4, 1.8e-5]
    assert eye.body_from_camera[:3, 3].tolist() == [0.1, 0.2, 0.3]
    assert eye.body_from_camera[1].tolist() == [1.0, 0.0, 0.0, 0.2]


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("[400.5, 401, 320.25, 199]", "[400.5]", "calibration: expected sensor.yaml with 4 numbers 'intrinsics'"),
        ("resolution", "size", "with 2 numbers 'resolution', got a list of 0"),
        ("radial-tangential", "equidistant", "calibration: expected the distortion model radial-tangential, got"),
        ("-1.0, 0.0, 0.1", "-2.0, 0.0, 0.1", "calibration: expected sensor.yaml with a rigid motion T_BS"),
        ("401,", "-401,", "calibration.intrinsics: expected a finite number > 0"),
        ("400.5,", "x,", "calibration: expected numbers after 'intrinsics', got "),
    ],
)
def test_broken_euroc_files_are_named(tmp_path: Path, before: str, after: str, message: str) -> None:
    """Missing, ill-shaped and impossible entries are refused by name."""
    (tmp_path / "sensor.yaml").write_text(EUROC.replace(before, after))
    with pytest.raises(ValueError, match=message):
        load_euroc_eye(tmp_path / "sensor.yaml")


def _eye(x: float, turn: float = 0.0) -> Eye:
    """Return an eye that looks along z, at `x` to the right, turned about its axis."""
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    pose[0, 3] = x
    return Eye(320, 240, np.array([[300.0, 0.0, 159.5], [0.0, 300.0, 119.5], [0.0, 0.0, 1.0]]), np.zeros(4), pose)


def test_a_rolled_eye_is_turned_back() -> None:
    """Rows of a rectified pair agree, and depths are right, though one eye was mounted with a roll of 3 degrees."""
    depth, baseline, roll = 2.0, 0.1, np.radians(3.0)
    left, straight = draw_boxes(320, 240, 0.0), draw_boxes(320, 240, 300.0 * baseline / depth)
    about = cv2.getRotationMatrix2D((159.5, 119.5), np.degrees(roll), 1.0)
    rolled = cv2.warpAffine(straight, about, (320, 240))
    rectifier = Rectifier(_eye(0.0), _eye(baseline, roll))
    assert rectifier.pair.baseline == pytest.approx(baseline)
    images = rectifier.rectify(left, rolled)
    points = StereoFrontEnd(rectifier.camera, centre_px=rectifier.pair.centre_px).measure(*images).measurements.points
    body = points @ rectifier.body_from_camera[:3, :3].T + rectifier.body_from_camera[:3, 3]
    assert len(points) > 30
    assert np.median(np.abs(body[:, 2] - depth)) < 0.02


def test_eyes_that_are_no_pair_are_refused() -> None:
    """Eyes the wrong way round, of different sizes, and images of other sizes are refused by name."""
    with pytest.raises(ValueError, match="right: expected an eye to the right of the left one"):
        Rectifier(_eye(0.1), _eye(0.0))
    other = _eye(0.1)
    other = Eye(640, 240, other.matrix, other.distortion, other.body_from_camera)
    with pytest.raises(ValueError, match="right: expected an eye with images of the left one's size"):
        Rectifier(_eye(0.0), other)
    images = np.zeros((240, 320), np.uint8), np.zeros((100, 320), np.uint8)
    with pytest.raises(ValueError, match=r"right: expected an image of 320 x 240 px, got shape \(100, 320\)"):
        Rectifier(_eye(0.0), _eye(0.1)).rectify(*images)
