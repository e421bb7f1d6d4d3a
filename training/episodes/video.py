"""Video of an episode that plays in every browser: H.264, 4:2:0 colour, index at the front."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import cv2
import imageio_ffmpeg
import numpy as np
from numpy.typing import NDArray

from slam_backend.core.files import check_writable, move_file, resolved
from slam_backend.core.validation import argument_error, check_float, check_int
from slam_backend.team.reports import MergeEvent
from vslam_env.rendering import MergeFlash, Scene
from vslam_env.rendering.merge_effect import FLASH_TICKS
from vslam_env.sensors import RenderedFrame

FPS = 25
SLOWEST_FPS = 5
LONGEST_S = 20.0
SHORTEST_S = 12.0  # minimum duration; short episodes are slowed down
# Constant rate factor; larger values give smaller files. 23 is the default of x264, 26 still shows single dots.
QUALITY = 26

NEAR, FAR = (213, 94, 0), (0, 114, 178)  # RGB colours of points at 1 m and 8 m
DEPTHS = (1.0, 8.0)  # [m]


@dataclass(frozen=True, slots=True)
class Pace:
    """Frame rate of a video relative to the steps of an episode."""

    stride: int  # Every `stride`-th step is a frame
    fps: int  # Frames per second of video
    speedup: float  # Simulated seconds per second of video


def choose_pace(num_steps: int, step_s: float) -> Pace:
    """Choose a pace for which an episode of `num_steps` steps of `step_s` [s] takes at most `LONGEST_S`.

    >>> choose_pace(2000, 0.1)
    Pace(stride=4, fps=25, speedup=10.0)
    """
    check_int("num_steps", num_steps, 1, "An episode has at least one step.")
    check_float("step_s", step_s, "Give the duration of a step in seconds.", above=0.0)
    stride = max(1, math.ceil(num_steps / (FPS * LONGEST_S)))
    fps = min(FPS, max(SLOWEST_FPS, math.ceil(num_steps / stride / SHORTEST_S)))
    return Pace(stride, fps, stride * step_s * fps)


def with_video_time_merges(scene: Scene, events: Iterable[MergeEvent], speedup: float) -> Scene:
    """Scale the ages of merge effects to video time, so that they last equally long for the viewer.

    Args:
        events: Events of the team; their `step` counts ticks, as `scene.tick` does.
        speedup: Simulated seconds per second of video.
    """
    ages = [(math.floor((scene.tick - event.step) / speedup), event) for event in events if event.kind == "merge"]
    flashes = tuple(MergeFlash(age, e.robots_a, e.robots_b) for age, e in ages if 0 <= age < FLASH_TICKS)
    return replace(scene, merges=flashes)


class VideoWriter:
    """Video file that appears under its name only when complete; a context manager.

    The file is also completed if the block raises, with the frames until then. A video without frames, or one that the
    encoder could not write, leaves no file.

    Raises:
        ValueError: If the suffix is wrong, the folder is missing, the file cannot be written, or a number is out of
            range.
    """

    def __init__(self, path: Path, size: tuple[int, int], fps: int = FPS) -> None:
        if path.suffix != ".mp4" or not path.parent.is_dir():
            raise argument_error(
                "path", "a file name ending in .mp4 in a folder that exists", Path(path), "Change the path."
            )
        for name, length in zip(("size[0]", "size[1]"), size, strict=True):
            if check_int(name, length, 2, "Give the size of the picture in pixels.") % 2:
                raise argument_error(name, "an even number", length, "Add one pixel.")
        check_int("fps", fps, 1, "Use at least one frame per second.")
        check_writable(path, "path")
        self._path, self._size = path, size
        self._partial = resolved(path).with_name(f".{path.stem}.partial.mp4")
        self._frames = 0
        self._sink: Any = imageio_ffmpeg.write_frames(
            self._partial,
            size,
            fps=fps,
            codec="libx264",
            pix_fmt_in="rgb24",
            pix_fmt_out="yuv420p",
            macro_block_size=2,
            quality=None,
            ffmpeg_log_level="quiet",  # write errors are detected when the video is closed
            output_params=["-crf", str(QUALITY), "-preset", "veryfast", "-movflags", "+faststart"],
        )
        self._sink.send(None)

    def add(self, frame: NDArray[np.uint8]) -> None:
        """Append a frame (height, width, 3) uint8, RGB."""
        width, height = self._size
        if frame.shape != (height, width, 3) or frame.dtype != np.uint8:
            got = f"shape {frame.shape} of {frame.dtype}"
            raise argument_error(
                "frame", f"an array of shape ({height}, {width}, 3) of uint8", got, "Draw frames of this size."
            )
        try:
            self._sink.send(np.ascontiguousarray(frame))
        except (OSError, StopIteration) as error:
            raise self._unwritten() from error
        self._frames += 1

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._sink.close()
        try:
            if self._frames:
                self._check_whole()
                move_file(self._partial, self._path)
        finally:
            self._partial.unlink(missing_ok=True)

    def _check_whole(self) -> None:
        """Refuse an incomplete file: the encoder does not report write errors."""
        try:
            count, _ = imageio_ffmpeg.count_frames_and_secs(self._partial)
        except (OSError, RuntimeError) as error:
            raise self._unwritten() from error
        if count != self._frames:
            raise self._unwritten()

    def _unwritten(self) -> ValueError:
        """Return the error for a video that the encoder could not write."""
        text = "The encoder stopped. Free disk space, or run without a video."
        return argument_error("path", "a file that can be written", Path(self._path), text)


def with_camera_images(picture: NDArray[np.uint8], frame: Any, width: int) -> NDArray[np.uint8]:
    """Return a picture (H, W + width, 3) with the two camera images of a robot on the right.

    Args:
        frame: Image pair, an `RenderedFrame`; for other values the area stays empty.
    """
    height = picture.shape[0]
    panel = np.full((height, width, 3), 24, dtype=np.uint8)
    if isinstance(frame, RenderedFrame):
        tall = min(height // 2, round(width * frame.left.shape[0] / frame.left.shape[1]))
        wide = round(tall * frame.left.shape[1] / frame.left.shape[0])
        for row, image in enumerate((draw_camera_image(frame, (wide, tall)), _large(frame.right, (wide, tall)))):
            panel[row * tall : (row + 1) * tall, :wide] = image
    return np.concatenate([picture, panel], axis=1)


def draw_camera_image(frame: RenderedFrame, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Return the left image (h, w, 3) with circles at measured corners, coloured by depth, and their disparities."""
    picture = _large(frame.left, size)
    scale = size[0] / frame.left.shape[1]
    depths = frame.measurements.points[:, 2]
    shares = np.clip((np.log(depths) - np.log(DEPTHS[0])) / np.log(DEPTHS[1] / DEPTHS[0]), 0.0, 1.0)
    for (column, row, disparity), share in zip(frame.seen.pixels.tolist(), shares.tolist(), strict=True):
        colour = tuple(round(near + share * (far - near)) for near, far in zip(NEAR, FAR, strict=True))
        x, y = (round(16.0 * (scale * (value + 0.5) - 0.5)) for value in (column, row))
        cv2.line(picture, (x, y), (x - round(16.0 * scale * disparity), y), colour, 1, cv2.LINE_AA, 4)
        cv2.circle(picture, (x, y), 4 * 16, colour, 2, cv2.LINE_AA, 4)
    return picture


def _large(image: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """Return a grey image as RGB at another size."""
    larger = cv2.resize(image, size, interpolation=cv2.INTER_LINEAR)
    return np.asarray(cv2.cvtColor(larger, cv2.COLOR_GRAY2RGB), dtype=np.uint8)
