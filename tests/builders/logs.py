"""Logs of other formats, small and whole."""

from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import savemat

from slam_backend.models.camera import ROBOT_FROM_CAMERA
from slam_backend.readers.calibration import CameraCalibration
from slam_backend.readers.kitti import ABSENT

FILES = {
    "Barcodes.dat": "# Subject #    Barcode #\n  1  5\n  2  14\n  7  81\n  6  63\n  9  70\n",
    "Landmark_Groundtruth.dat": "6  0.5  -4.0  0.1  0.2\n7  1.5  2.5  0.1  0.2\n9  -3.0  0.25  0.1  0.2\n",
    "Robot2_Odometry.dat": "# t v w\n100.0 0.5 0.0\n101.0 0.5 0.2\n102.0 0.0 0.0\n",
    "Robot2_Measurement.dat": "100.1 63 2.0 0.1\n100.1 5 1.0 0.0\n100.9 99 1.0 0.0\n101.5 70 3.0 -0.2\n",
    "Robot2_Groundtruth.dat": "99.0 0 0 0.5\n103.0 1 0 0.5\n103.0 1 0 0.5\n",
    "Robot4_Odometry.dat": "100.5 0.1 0.0\r\n101.5 0.1 0.0\r\n",
    "Robot4_Measurement.dat": "",
}
SCANS = [[[4.0, 7.0], [np.pi / 2, 0.5], [0.3, 0.4]], [], [[2.0], [3.0], [0.2]]]  # ranges, bearings, diameters
SIGMAS: dict[str, Any] = {"sigma_range": 0.1, "sigma_bearing": 0.02}
DRIVEN = np.array([[10.0, 0.5, 0.3], [11.0, 0.4, -0.2], [12.0, 0.0, 0.0]])
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
FOCAL, CENTRE, BASELINE, MOUNT = 700.0, (600.0, 180.0), 0.5, (1.1, -0.3, 0.7)
FRAMES, TRACKS = 5, 3
POINTS = np.array([[1.0, -0.5, 8.0], [-2.0, 1.0, 12.0], [0.5, 0.0, 400.0]])  # camera frame; the last one is too far


def write_mrclam(folder: Path) -> None:
    """Write a log of two robots and three landmarks."""
    for name, text in FILES.items():
        (folder / name).write_text(text, newline="")


def write_victoria(folder: Path, **changes: Any) -> None:
    """Write a log of 2 s with three scans and four fixes; `changes` replace variables, None leaves one out."""
    cells = np.empty(len(SCANS), dtype=object)
    cells[:] = [np.array(scan, dtype=np.float64) if scan else np.empty((0, 0)) for scan in SCANS]
    files: dict[str, dict[str, Any]] = {
        "aa3_dr.mat": {
            "time": np.arange(1000, 3000, 25, dtype=np.int32)[:, None],
            "speed": np.full((80, 1), 2.0),
            "steering": np.full((80, 1), 0.1),
        },
        "VictoriaParkSinSincronizar.mat": {"TLsr": np.array([[1.1, 1.6, 2.1]]), "zt": cells[None]},
        "aa3_gpsx.mat": {
            "timeGps": np.array([[900], [1200], [1400], [2000]], dtype=np.int32),
            "Lo_m": np.arange(4.0)[:, None],
            "La_m": np.arange(4.0)[:, None] - 7.0,
        },
    }
    for file, variables in files.items():
        content = {name: changes.get(name, value) for name, value in variables.items()}
        savemat(folder / file, {name: value for name, value in content.items() if value is not None})


def eye_at(x: float, turn: float = 0.0) -> CameraCalibration:
    """Return an eye that looks along z, at `x` to the right, turned about its axis."""
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    pose[0, 3] = x
    return CameraCalibration(
        320, 240, np.array([[300.0, 0.0, 159.5], [0.0, 300.0, 119.5], [0.0, 0.0, 1.0]]), np.zeros(4), pose
    )


def kitti_content(**changes: Any) -> dict[str, Any]:
    """Return an archive of a camera that looks ahead at three points from one place; `changes` replace arrays."""
    features = np.full((4, TRACKS, FRAMES), ABSENT)
    left = CENTRE[0] + FOCAL * POINTS[:, 0] / POINTS[:, 2]
    row = CENTRE[1] + FOCAL * POINTS[:, 1] / POINTS[:, 2]
    features[:, :, 1] = [left, row, left - FOCAL * BASELINE / POINTS[:, 2], row]
    features[:, 1:, 3] = features[:, 1:, 1]
    camera_from_unit = np.eye(4)
    camera_from_unit[:3, :3] = ROBOT_FROM_CAMERA.T
    camera_from_unit[:3, 3] = MOUNT
    content = {
        "time_stamps": 100.0 + 0.1 * np.arange(FRAMES)[None],
        "features": features,
        "linear_velocity": np.tile([[10.0], [0.5], [0.0]], FRAMES),
        "rotational_velocity": np.tile([[0.0], [0.0], [0.3]], FRAMES),
        "K": np.array([[FOCAL, 0.0, CENTRE[0]], [0.0, FOCAL, CENTRE[1]], [0.0, 0.0, 1.0]]),
        "b": np.array(BASELINE),
        "cam_T_imu": camera_from_unit,
    }
    return {name: value for name, value in (content | changes).items() if value is not None}


def write_kitti(folder: Path, **changes: Any) -> Path:
    """Write such an archive into a folder, and return its path."""
    np.savez(folder / "drive.npz", **kitti_content(**changes))
    return folder / "drive.npz"
