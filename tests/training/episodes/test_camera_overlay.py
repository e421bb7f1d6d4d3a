from pathlib import Path

import numpy as np
from typer.testing import CliRunner

from slam_backend.models.camera import StereoCamera
from training.cli import app
from training.episodes.video import draw_camera_image, with_camera_images
from vslam_env.sensors import RenderedFrame, StereoSensor, StereoSensorConfig
from vslam_env.world import FreeSpace, World

ROOM = World("room", [[0, 0, 6, 0], [6, 0, 6, 5], [6, 5, 0, 5], [0, 5, 0, 0]])


def _frame() -> RenderedFrame:
    config = StereoSensorConfig(camera=StereoCamera(focal_px=160.0, width=160, height=120))
    sensor = StereoSensor(config, ROOM, FreeSpace(ROOM, 0.2), np.random.default_rng(1))
    frame = sensor.measure(np.array([[1.5, 2.0, 0.2]]), np.random.default_rng(2)).per_robot()[0]
    assert isinstance(frame, RenderedFrame)
    return frame


def test_camera_images_are_beside_the_map() -> None:
    """The map is unchanged; on its right are the left image above and the right image below."""
    frame, picture = _frame(), np.full((300, 400, 3), 200, np.uint8)
    together = with_camera_images(picture, frame, 160)
    assert together.shape == (300, 560, 3)
    np.testing.assert_array_equal(together[:, :400], picture)
    np.testing.assert_array_equal(together[120:240, 400:, 0], frame.right)
    assert (together[240:, 400:] == 24).all()
    assert (with_camera_images(picture, None, 160)[:, 400:] == 24).all()


def test_corners_are_drawn_where_they_were_measured() -> None:
    """Colour appears at the measured corners and along their disparities only."""
    frame = _frame()
    drawn = draw_camera_image(frame, (320, 240))
    coloured = np.abs(drawn[:, :, 0].astype(int) - drawn[:, :, 2]) > 10
    assert len(frame.seen.pixels) > 5
    near = np.zeros_like(coloured)
    for column, row, disparity in frame.seen.pixels:
        x, y = 2.0 * column + 0.5, 2.0 * row + 0.5
        around = np.hypot(np.arange(320)[None] - x, np.arange(240)[:, None] - y)
        assert coloured[(around > 2.0) & (around < 6.0)].mean() > 0.5
        near |= (around < 8.0) | (
            (np.abs(np.arange(240)[:, None] - y) < 3.0)
            & (np.arange(320)[None] > x - 2.0 * disparity - 3.0)
            & (np.arange(320)[None] < x)
        )
    assert not coloured[~near].any()


def test_a_run_with_rendered_cameras(tmp_path: Path) -> None:
    """`vslam run --sensor stereo` leaves a folder with a wider video than a run without."""
    arguments = ["run", "--sensor", "stereo", "--world", "fig5", "--robots", "1", "--max-cycles", "6"]
    done = CliRunner().invoke(app, [*arguments, "--particles", "10", "--out", str(tmp_path / "run")])
    assert done.exit_code == 0, done.output
    assert 'sensor = "stereo"' in (tmp_path / "run" / "environment.toml").read_text()
    assert (tmp_path / "run" / "video.mp4").stat().st_size > 1000
