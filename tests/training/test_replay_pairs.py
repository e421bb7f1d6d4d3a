import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from slam_backend.camera import ROBOT_FROM_CAMERA, StereoCamera
from training.cli import app
from training.replay_pairs import PairsConfig, align_pairs, load_pairs
from training.stereo_scenes import WALL, Scene, wall_pose

CAMERA = StereoCamera()
SENSOR = """T_BS:
  data: [1.0, 0.0, 0.0, {x},
         0.0, 1.0, 0.0, 0.0,
         0.0, 0.0, 1.0, 0.0,
         0.0, 0.0, 0.0, 1.0]
resolution: [320, 240]
intrinsics: [320.0, 320.0, 159.5, 119.5]
distortion_coefficients: [0.0, 0.0, 0.0, 0.0]
"""


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two rendered pairs of a wall from places 0.6 m and 17 degrees apart, written as EuRoC's are."""
    folder, rng = tmp_path_factory.mktemp("room"), np.random.default_rng(1)
    scene = Scene(WALL, CAMERA, 3)
    rows = ["# image qw qx qy qz px py pz"]
    for number, pose in enumerate((wall_pose(6.0, 2.5, 0.0), wall_pose(6.1, 2.6, 0.3))):
        view = scene.look(pose, rng)
        cv2.imwrite(str(folder / f"left_img_{number}.png"), view.left)
        cv2.imwrite(str(folder / f"right_img_{number}.png"), view.right)
        turn = Rotation.from_euler("z", pose[2]).as_matrix() @ ROBOT_FROM_CAMERA
        x, y, z, w = Rotation.from_matrix(turn).as_quat()
        rows.append(f"{number} {w} {x} {y} {z} {pose[0]} {pose[1]} 0.0")
    (folder / "poses_dev.txt").write_text("\n".join(rows) + "\n")
    (folder / "sensorLeft.yaml").write_text(SENSOR.format(x=0.0))
    (folder / "sensorRight.yaml").write_text(SENSOR.format(x=CAMERA.baseline))
    return folder


@pytest.mark.parametrize("descriptor", ["usurf", "sift", "orb"])
def test_two_places_are_aligned(room: Path, descriptor: str) -> None:
    """With any descriptor the motion between two rendered places is found to 3 cm and half a degree."""
    result = align_pairs(load_pairs(room), PairsConfig.from_mapping({"path": str(room), "descriptor": descriptor}))
    assert result.true_deg == pytest.approx(np.degrees(0.3), abs=1e-6)
    assert 0.5 < result.true_m < 1.0
    assert result.motion is not None
    assert result.error_m < 0.03
    assert result.error_deg < 0.5


def test_the_command_compares_descriptors(room: Path, tmp_path: Path) -> None:
    """`vslam replay stereo` writes a row for each descriptor, and a picture of the matches."""
    done = CliRunner().invoke(app, ["replay", "stereo", "--path", str(room), "--out", str(tmp_path / "run")])
    assert done.exit_code == 0, done.output
    rows = json.loads((tmp_path / "run" / "metrics.json").read_text())["alignments"]
    assert set(rows) == {"usurf", "sift", "orb"}
    assert all(row["inliers"] > 20 for row in rows.values())
    picture = cv2.imread(str(tmp_path / "run" / "matches.png"))
    assert picture.shape == (480, 320, 3)
    assert (picture[:, :, 0] != picture[:, :, 1]).any()


def test_without_poses_there_are_no_errors(room: Path) -> None:
    """Where no poses are known a motion is found all the same, and its error is not."""
    poses = (room / "poses_dev.txt").read_text()
    (room / "poses_dev.txt").unlink()
    try:
        result = align_pairs(load_pairs(room), PairsConfig(path=str(room)))
        assert result.motion is not None
        assert np.isnan(result.error_m)
        (room / "poses_dev.txt").write_text("0 1 0 0 0 1 2\n")
        with pytest.raises(ValueError, match=r"path: expected poses_dev\.txt with two rows of 8 numbers"):
            load_pairs(room)
    finally:
        (room / "poses_dev.txt").write_text(poses)


def test_missing_files_are_named(room: Path, tmp_path: Path) -> None:
    """A missing folder, image or calibration is refused."""
    with pytest.raises(ValueError, match="path: expected a folder with two stereo pairs, got no such folder"):
        load_pairs(tmp_path / "none")
    with pytest.raises(ValueError, match="path: expected an image file, got no such file"):
        load_pairs(tmp_path)
    with pytest.raises(ValueError, match="descriptor: expected one of"):
        PairsConfig.from_mapping({"path": str(room), "descriptor": "surf"})
