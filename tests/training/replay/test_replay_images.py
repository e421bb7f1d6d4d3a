import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.readers.kitti_images import is_image_folder, load_kitti_images
from slam_backend.readers.stereo_files import StereoFiles, load_stereo_images
from slam_backend.trajectory import Trajectory
from training.cli import app
from training.replay.config import ImagesConfig
from training.replay.core import replay_log
from training.replay.image_figures import expected_pixels
from training.replay.metrics import score_path
from training.replay.stereo_images import CameraDrive, read_images
from training.replay.stereo_pairs import align_pairs, load_pairs

FOCAL, BASELINE, WIDTH, HEIGHT, STEP = 300.0, 0.5, 400, 240, 0.4


def _wall(rng: np.random.Generator) -> np.ndarray:
    """Return a texture of boxes, 1600 x 1000 texels of 1 cm."""
    wall = np.full((1000, 1600), 128, np.uint8)
    for _ in range(900):
        x, y = rng.integers(0, 1560), rng.integers(0, 960)
        wall[y : y + rng.integers(12, 60), x : x + rng.integers(12, 60)] = rng.integers(10, 245)
    return wall


def _view(wall: np.ndarray, depth: float, shift: float) -> np.ndarray:
    """Return the image of a wall that is `depth` ahead, with its middle `shift` to the left of the camera."""
    texels_per_pixel = 100.0 * depth / FOCAL
    left = 800.0 + 100.0 * shift - 0.5 * WIDTH * texels_per_pixel
    top = 500.0 - 0.5 * HEIGHT * texels_per_pixel
    # pixel centres: texture = left + (column + 0.5) * scale - 0.5
    matrix = np.array(
        [[texels_per_pixel, 0.0, left + 0.5 * texels_per_pixel - 0.5],
         [0.0, texels_per_pixel, top + 0.5 * texels_per_pixel - 0.5]]
    )  # fmt: skip
    smooth = cv2.GaussianBlur(wall, (0, 0), 0.5 * texels_per_pixel)
    return cv2.warpAffine(smooth, matrix, (WIDTH, HEIGHT), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Camera that drives straight towards a wall 9 m ahead, 0.4 m per frame."""
    folder = tmp_path_factory.mktemp("drive")
    wall = _wall(np.random.default_rng(1))
    for eye in ("image_0", "image_1"):
        (folder / eye).mkdir()
    poses = []
    for frame in range(6):
        depth = 9.0 - STEP * frame
        cv2.imwrite(str(folder / "image_0" / f"{frame:06d}.png"), _view(wall, depth, 0.0))
        cv2.imwrite(str(folder / "image_1" / f"{frame:06d}.png"), _view(wall, depth, BASELINE))
        poses.append(f"1 0 0 0 0 1 0 0 0 0 1 {STEP * frame}")
    (folder / "poses.txt").write_text("\n".join(poses) + "\n")
    middle = f"{FOCAL} 0 {0.5 * (WIDTH - 1)} {{}} 0 {FOCAL} {0.5 * (HEIGHT - 1)} 0 0 0 1 0"
    rows = [middle.format(0.0), middle.format(-FOCAL * BASELINE)]
    (folder / "calib.txt").write_text("\n".join(rows) + "\n")
    return folder


def test_a_drive_towards_a_wall_is_estimated(drive: Path) -> None:
    """Visual odometry and filter estimate the path to 3 %; they use different features."""
    log = read_images(drive, max_range=12.0)
    result = replay_log(log, ImagesConfig(path=str(drive), particles=30))
    score = score_path(result, log)
    assert score is not None
    assert score.length == pytest.approx(5 * STEP)
    for path in score.at_truth:
        assert np.hypot(*(path[-1] - score.truth[-1])[:2]) < 0.03 * score.length
    eye = log.source
    assert isinstance(eye, CameraDrive)
    assert eye.odometry_inliers[1:].min() > 20
    assert len(eye.ids) == -(-eye.features[-1] // 2)
    assert set(eye.heights) >= set(result.maps[0].ids.tolist())


def test_the_command_accepts_a_folder_of_images(drive: Path, tmp_path: Path) -> None:
    """`vslam replay kitti` detects images, and writes pictures, paths and metrics."""
    arguments = ["replay", "kitti", "--path", str(drive), "--particles", "10", "--out", str(tmp_path / "run")]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.output
    assert "Odometry: visual" in done.output
    assert "assumed planar" in " ".join(done.output.split())
    for name in ("frame.png", "replay.png", "metrics.json", "config.toml"):
        assert (tmp_path / "run" / name).stat().st_size > 0
    assert (cv2.imread(str(tmp_path / "run" / "frame.png")) != 0).any()


def test_drives_of_any_layout_are_replayed(drive: Path, tmp_path: Path) -> None:
    """`vslam replay stereo` with file names replays three or more pairs as `vslam replay kitti` does."""
    (tmp_path / "stamps.txt").write_text("\n".join(str(5.0 + 0.1 * i) for i in range(6)))
    few = ["--path", str(drive), "--particles", "10"]
    names = [
        "--left", "image_0/*.png", "--right", "image_1/*.png", "--calibration", "calib.txt", "--truth", "poses.txt",
    ]  # fmt: skip
    stamps = ["--times", str(tmp_path / "stamps.txt")]
    for out, arguments in (
        ("kitti", ["kitti", *few]),
        ("stereo", ["stereo", *few, "--max-range", "40", *names, *stamps]),
        ("again", ["stereo", "--config", str(tmp_path / "stereo")]),
    ):
        done = CliRunner().invoke(app, ["replay", *arguments, "--out", str(tmp_path / out)])
        assert done.exit_code == 0, done.output
    found = [json.loads((tmp_path / out / "metrics.json").read_text()) for out in ("kitti", "stereo", "again")]
    assert found[0]["robots"] == found[1]["robots"] == found[2]["robots"]
    assert Trajectory.load_tum(tmp_path / "stereo" / "estimate.tum").times[0] == 5.0
    assert len(LandmarkMap.load(tmp_path / "stereo" / "map_1.npz")) == found[0]["landmarks"]


def test_raw_images_of_a_drive_are_rectified(drive: Path) -> None:
    """Two calibrations of raw cameras suffice for a drive, too."""
    eye = "T_BS:\n  data: [1.0, 0.0, 0.0, {x}, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]\n"
    eye += (
        f"resolution: [{WIDTH}, {HEIGHT}]\nintrinsics: [{FOCAL}, {FOCAL}, {0.5 * (WIDTH - 1)}, {0.5 * (HEIGHT - 1)}]\n"
    )
    eye += "distortion_coefficients: [0.0, 0.0, 0.0, 0.0]\n"
    for name, x in (("l.yaml", 0.0), ("r.yaml", BASELINE)):
        (drive / name).write_text(eye.replace("{x}", str(x)))
    files = StereoFiles(left="image_0/*.png", right="image_1/*.png", calibration="l.yaml,r.yaml", truth="poses.txt")
    log = load_stereo_images(drive, files, duration=0.35)
    assert len(log.left) == 4
    assert log.pair.baseline == pytest.approx(BASELINE)
    raw = load_kitti_images(drive).images(2)
    for found, expected in zip(log.images(2), raw, strict=True):
        assert np.abs(found.astype(float) - expected).mean() < 1.0


def test_times_and_duration(drive: Path) -> None:
    """Frames are 0.1 s apart by default; a duration keeps the frames within it."""
    log = load_kitti_images(drive)
    np.testing.assert_allclose(log.times, 0.1 * np.arange(6))
    assert len(load_kitti_images(drive, duration=0.25).left) == 3
    (drive / "times.txt").write_text(" ".join(str(0.2 * i) for i in range(6)))
    try:
        assert load_kitti_images(drive).times[-1] == pytest.approx(1.0)
        (drive / "times.txt").write_text("0 1 2")
        with pytest.raises(
            ValueError, match=r"path: expected times\.txt with 6 times, one for each image, got a file of 3"
        ):
            load_kitti_images(drive)
        (drive / "times.txt").write_text("0 100 200 300 400 500\n")
        with pytest.raises(ValueError, match=r"path: expected times\.txt in seconds, got a median of 100 s"):
            load_kitti_images(drive)
        (drive / "times.txt").write_text("0 1 2\n3\n3 4\n")
        with pytest.raises(
            ValueError, match=r"path: expected rising times .*got '3 4'\. Correct line 3 of .*times\.txt"
        ):
            load_kitti_images(drive)
    finally:
        (drive / "times.txt").unlink()


def test_invalid_folders_are_refused(tmp_path: Path) -> None:
    """Missing cameras, different images in both, invalid images, and a missing calibration are refused."""
    assert not is_image_folder(tmp_path)
    with pytest.raises(ValueError, match="path: expected a folder with image_0 and image_1 or image_l and image_r"):
        load_kitti_images(tmp_path)
    for eye, names in (("image_l", ("0", "1")), ("image_r", ("0", "2"))):
        (tmp_path / eye).mkdir()
        for name in names:
            (tmp_path / eye / f"{name}.png").write_bytes(b"none")
    assert is_image_folder(tmp_path)
    with pytest.raises(ValueError, match="path: expected two or more images with the same names of both cameras"):
        load_kitti_images(tmp_path)
    (tmp_path / "image_r" / "2.png").rename(tmp_path / "image_r" / "1.png")
    with pytest.raises(ValueError, match=r"path: expected an image file, got '.*0\.png'"):
        load_kitti_images(tmp_path)
    for file in tmp_path.glob("image_*/*.png"):
        cv2.imwrite(str(file), np.zeros((20, 30), np.uint8))
    with pytest.raises(ValueError, match="calibration: expected a file of a calibration"):
        load_kitti_images(tmp_path)
    with pytest.raises(ValueError, match=r"truth: expected a file of true poses, got no such file"):
        load_kitti_images(tmp_path, tmp_path / "none.txt")


def test_landmarks_are_projected_into_a_level_camera() -> None:
    """A landmark ahead is on the axis, one to the left at a smaller column, one above at a smaller row."""
    landmarks = np.array([[5.0, 0.0, 0.0], [5.0, 1.0, 0.0], [5.0, 0.0, 1.0], [-5.0, 0.0, 0.0], [50.0, 0.0, 0.0]])
    ahead = landmarks + np.array([1.0, 0.0, 0.0])
    pixels = expected_pixels(ahead, np.array([1.0, 0.0, 0.0]), 100.0, np.array([60.0, 40.0]), 20.0)
    np.testing.assert_allclose(pixels, [[60.0, 40.0], [40.0, 40.0], [60.0, 20.0]])


@pytest.mark.slow
def test_real_rooms_are_aligned(data_dir: Path) -> None:
    """On EuRoC's pairs u-SURF has errors within 0.06 m and 2.1 degrees, like SIFT, for views 38 degrees apart."""
    log = load_pairs(data_dir / "euroc_pairs")
    result = align_pairs(log, "usurf", seed=100)
    assert result.motion is not None
    assert result.motion.inliers.sum() > 150
    assert result.true_deg == pytest.approx(37.54, abs=0.01)
    assert result.error_m <= 0.06
    assert result.error_deg <= 2.1


@pytest.mark.slow
def test_real_streets_are_replayed(data_dir: Path) -> None:
    """On half of KITTI's snippet the final error is within 3 % of the path."""
    folder = data_dir / "kitti_stereo" / "KITTI_sequence_1"
    log = read_images(folder, duration=2.5, seed=100)
    score = score_path(replay_log(log, ImagesConfig(path=str(folder), particles=50)), log)
    assert score is not None
    assert score.length > 25.0
    assert np.hypot(*(score.at_truth[0][-1] - score.truth[-1])[:2]) < 0.03 * score.length
