import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.models.camera import ROBOT_FROM_CAMERA, StereoCamera
from studies.front_end.scenes import WALL, Scene, wall_pose
from training.cli import app
from training.experiments.config import Descriptor
from training.replay.config import ImagesConfig
from training.replay.stereo_pairs import align_pairs, load_pairs

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
    """Two rendered pairs of a wall from places 0.6 m and 17 degrees apart, in EuRoC's format."""
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
def test_two_places_are_aligned(room: Path, descriptor: Descriptor) -> None:
    """With any descriptor the transform between two rendered places is accurate to 3 cm and half a degree."""
    result = align_pairs(load_pairs(room), descriptor)
    assert result.true_deg == pytest.approx(np.degrees(0.3), abs=1e-6)
    assert 0.5 < result.true_m < 1.0
    assert result.motion is not None
    assert result.error_m < 0.03
    assert result.error_deg < 0.5


def test_the_command_compares_descriptors(room: Path, tmp_path: Path) -> None:
    """`vslam replay stereo` writes a row for each descriptor, and a picture of the matches."""
    done = CliRunner().invoke(app, ["replay", "stereo", "--path", str(room), "--out", str(tmp_path / "run")])
    assert done.exit_code == 0, done.output
    rows = json.loads((tmp_path / "run" / "metrics.json").read_text())["tables"]["motion"]
    assert [row["descriptor"] for row in rows] == ["usurf", "sift", "orb"]
    assert all(row["inliers"] > 20 for row in rows)
    picture = cv2.imread(str(tmp_path / "run" / "matches.png"))
    assert picture.shape == (480, 320, 3)
    assert (picture[:, :, 0] != picture[:, :, 1]).any()


def test_without_poses_there_are_no_errors(room: Path) -> None:
    """Without true poses there is a transform, but no error."""
    poses = (room / "poses_dev.txt").read_text()
    (room / "poses_dev.txt").unlink()
    try:
        result = align_pairs(load_pairs(room), "usurf")
        assert result.motion is not None
        assert np.isnan(result.error_m)
        (room / "poses_dev.txt").write_text("# nothing\n")
        with pytest.raises(ValueError, match=r"path: expected poses_dev\.txt with two poses, got a file of 0"):
            load_pairs(room)
        (room / "poses_dev.txt").write_text("0 1 0 0 0 1 2\n")
        with pytest.raises(
            ValueError, match=r"path: expected 8 or 12 finite numbers, got .*Correct line 1 of .*poses_dev\.txt"
        ):
            load_pairs(room)
    finally:
        (room / "poses_dev.txt").write_text(poses)


def test_missing_files_are_named(room: Path, tmp_path: Path) -> None:
    """A missing folder, image or calibration is refused."""
    with pytest.raises(ValueError, match="path: expected a folder with two stereo pairs, got no such folder"):
        load_pairs(tmp_path / "none")
    with pytest.raises(
        ValueError, match=r"path: expected an image file, got .* It does not exist: name yours with --left"
    ):
        load_pairs(tmp_path)
    with pytest.raises(ValueError, match="descriptor: expected one of"):
        ImagesConfig.from_mapping({"path": str(room), "descriptor": "surf"})


def test_other_file_names_are_options(room: Path, tmp_path: Path) -> None:
    """The same images with other names and folders give the same alignment; the run repeats from its config."""
    names = {"left_img_0.png": "cam0/2.png", "left_img_1.png": "cam0/10.png", "right_img_0.png": "cam1/a.png"}
    names |= {"right_img_1.png": "cam1/b.png", "sensorLeft.yaml": "l.yaml", "sensorRight.yaml": "r.yaml"}
    other = tmp_path / "other"
    for eye in ("cam0", "cam1"):
        (other / eye).mkdir(parents=True)
    for name, new in (names | {"poses_dev.txt": "truth.txt"}).items():
        (other / new).write_bytes((room / name).read_bytes())
    options = ["--left", "cam0/*.png", "--right", "cam1/a.png, cam1/b.png", "--calibration", "l.yaml,r.yaml"]
    for out, arguments in (
        ("usual", ["--path", str(room)]),
        ("other", ["--path", str(other), *options, "--truth", str(other / "truth.txt")]),
        ("again", ["--config", str(tmp_path / "run-other")]),
    ):
        done = CliRunner().invoke(app, ["replay", "stereo", *arguments, "--out", str(tmp_path / f"run-{out}")])
        assert done.exit_code == 0, done.output
    found = [json.loads((tmp_path / f"run-{out}" / "metrics.json").read_text()) for out in ("usual", "other", "again")]
    assert found[0]["trials"] == found[1]["trials"] == found[2]["trials"]
    usurf = found[0]["trials"][0]
    assert (usurf["descriptor"], usurf["error_m"] < 0.03) == ("usurf", True)
    for place in (0, 1):
        landmarks = LandmarkMap.load(tmp_path / "run-other" / f"map_{place}.npz")
        assert len(landmarks) == usurf[f"points_{place}"]
        assert landmarks.means[:, 0].min() > 1.0  # in front of the camera


def test_rectified_pairs_need_one_file(room: Path, tmp_path: Path) -> None:
    """KITTI's calibration and poses work for two pairs, too, with the left camera as the body."""
    focal, middle = CAMERA.focal_px, f"{0.5 * (CAMERA.width - 1)} {{}} 0 {CAMERA.focal_px} {0.5 * (CAMERA.height - 1)}"
    rows = [f"{focal} 0 {middle.format(shift)} 0 0 0 1 0\n" for shift in (0.0, -focal * CAMERA.baseline)]
    (tmp_path / "calib.txt").write_text("".join(rows))
    log = load_pairs(room)
    assert log.poses is not None
    poses = [" ".join(map(str, pose[:3].ravel())) for pose in log.poses]
    (tmp_path / "poses.txt").write_text("\n".join(poses) + "\n")
    calibration, truth = str(tmp_path / "calib.txt"), str(tmp_path / "poses.txt")
    config = ImagesConfig(path=str(room), calibration=calibration, truth=truth)
    result = align_pairs(load_pairs(room, config.files), "usurf")
    assert result.true_deg == pytest.approx(np.degrees(0.3), abs=1e-6)
    assert result.error_m < 0.03
    assert result.error_deg < 0.5


def test_missing_poses_are_reported(room: Path, tmp_path: Path) -> None:
    """Without poses there are no columns of errors."""
    for file in room.iterdir():
        if file.name != "poses_dev.txt":
            (tmp_path / file.name).write_bytes(file.read_bytes())
    done = CliRunner().invoke(app, ["replay", "stereo", "--path", str(tmp_path), "--out", str(tmp_path / "run")])
    assert done.exit_code == 0, done.output
    assert "Errors: no ground truth in this folder." in done.output
    assert "error (m)" not in done.output


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--left", "left_img_0.png"), "path: expected two or more pairs of images, got a folder with 1 "),
        (("--right", "none*.png"), "It does not exist: name yours with --right."),
        (("--calibration", "none.yaml,none.yaml"), "calibration: expected a file of a calibration, got no such file"),
        (("--calibration", "a,b,c"), "calibration: expected one file or two, got 'a,b,c'"),
        (("--truth", "none.txt"), "truth: expected a file of true poses, got no such file"),
        (("--times", "times.txt"), "times: expected a drive of three pairs or more, got a folder with two pairs"),
    ],
)
def test_missing_files_and_their_options_are_named(
    options: tuple[str, ...], message: str, room: Path, refusal: Any
) -> None:
    """The error gives the missing file, and the option for another name."""
    assert message in refusal("replay", "stereo", "--path", str(room), *options)
