import subprocess
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest

from slam_backend.maps.alignment import Alignment
from slam_backend.team.reports import MergeEvent
from training.episodes.video import LONGEST_S, VideoWriter, choose_pace, with_video_time_merges
from vslam_env.rendering import Scene

SIZE = (98, 62)


def frames(count: int) -> list[np.ndarray]:
    """Return grey frames of increasing brightness."""
    return [np.full((SIZE[1], SIZE[0], 3), 10 + 20 * k, np.uint8) for k in range(count)]


def read_back(path: Path) -> tuple[str, np.ndarray]:
    """Return ffmpeg's description of a video and its frames (n, height, width, 3)."""
    arguments = ["-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    done = subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), *arguments], capture_output=True, check=True)
    return done.stderr.decode(), np.frombuffer(done.stdout, np.uint8).reshape(-1, SIZE[1], SIZE[0], 3)


def test_videos_play_in_browsers_and_have_all_frames(tmp_path: Path) -> None:
    """The file is H.264 in 4:2:0 colour with its index in front, and decodes to nearly the same frames."""
    path = tmp_path / "video.mp4"
    with VideoWriter(path, SIZE, fps=5) as video:
        for frame in frames(7):
            video.add(frame)
    description, got = read_back(path)
    for word in ("Video: h264", "yuv420p", "98x62", "5 fps"):
        assert word in description
    content = path.read_bytes()
    assert content.index(b"moov") < content.index(b"mdat")
    assert len(got) == 7
    for wanted, frame in zip(frames(7), got, strict=True):
        assert np.abs(frame.astype(int) - wanted).mean() < 3.0


def test_an_interrupted_video_has_the_earlier_frames(tmp_path: Path) -> None:
    """An exception in the block leaves a valid, shorter video and no other file."""
    path = tmp_path / "video.mp4"

    def interrupted() -> None:
        with VideoWriter(path, SIZE, fps=5) as video:
            for frame in frames(3):
                video.add(frame)
            raise KeyboardInterrupt("stop")

    with pytest.raises(KeyboardInterrupt, match="stop"):
        interrupted()
    assert len(read_back(path)[1]) == 3
    assert [file.name for file in tmp_path.iterdir()] == ["video.mp4"]


def test_a_video_without_frames_leaves_no_file(tmp_path: Path) -> None:
    """Without frames no file is left behind."""
    with VideoWriter(tmp_path / "video.mp4", SIZE):
        pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "size", "fps", "message"),
    [
        ("video.avi", (98, 62), 5, r"path: expected a file name ending in \.mp4"),
        ("no/video.mp4", (98, 62), 5, "path: expected .* in a folder that exists"),
        ("video.mp4", (97, 62), 5, r"size\[0\]: expected an even number, got 97"),
        ("video.mp4", (98, 0), 5, r"size\[1\]: expected an int >= 2, got 0"),
        ("video.mp4", (98, 62), 0, "fps: expected an int >= 1, got 0"),
    ],
)
def test_bad_arguments_are_named(tmp_path: Path, name: str, size: tuple[int, int], fps: int, message: str) -> None:
    """Each bad argument is refused before a process is started."""
    with pytest.raises(ValueError, match=message):
        VideoWriter(tmp_path / name, size, fps)


def test_a_frame_of_another_size_is_refused(tmp_path: Path) -> None:
    """A frame must have the size of the video."""
    with VideoWriter(tmp_path / "video.mp4", SIZE) as video, pytest.raises(ValueError, match="frame: expected"):
        video.add(np.zeros((SIZE[0], SIZE[1], 3), np.uint8))


@pytest.mark.parametrize("num_steps", [1, 7, 240, 499, 501, 2500, 12345])
def test_videos_have_a_maximum_duration(num_steps: int) -> None:
    """For any length of an episode, the video is below the limit, with the stated speed-up."""
    pace = choose_pace(num_steps, 0.1)
    shown = -(-num_steps // pace.stride)
    assert shown / pace.fps <= LONGEST_S
    assert pace.speedup == pytest.approx(num_steps * 0.1 / (num_steps / pace.stride / pace.fps))


def test_merge_effects_last_in_video_time() -> None:
    """A merge 100 ticks ago is 10 ticks old at ten-fold speed; attempts, future and faded merges do not flash."""
    nothing = np.zeros((0, 4))
    scene = Scene(nothing, np.zeros((0, 3)), (), 300, 30.0, 0.2, (), (), 0.0)
    refused = Alignment.refused("too few candidates")
    events = [
        MergeEvent(step, kind, (0,), (1, 2), refused)
        for step, kind in ((10, "merge"), (200, "merge"), (250, "attempt"), (301, "merge"))
    ]
    (flash,) = with_video_time_merges(scene, events, 10.0).merges
    assert (flash.age_ticks, flash.robots_a, flash.robots_b) == (10, (0,), (1, 2))
