"""Reader of KITTI's odometry benchmark: rectified stereo images, calibration and optional true poses."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slam_backend.core.files import checked_path
from slam_backend.core.image_files import read_grey_image
from slam_backend.core.short_repr import short_repr
from slam_backend.core.text_files import data_lines, existing_file, line_error, parse_numbers, read_text
from slam_backend.core.validation import FloatArray, argument_error, check_float
from slam_backend.frontend.images import Image
from slam_backend.readers.calibration import Rectified, RectifiedPair, Rectifier, load_kitti_calibration
from slam_backend.readers.kitti import read_truth
from slam_backend.trajectory import Trajectory

CAMERA_FOLDERS = (("image_0", "image_1"), ("image_l", "image_r"))  # folders of the left and the right camera
PERIOD = 0.1  # [s] between frames without given times: KITTI's cameras run at 10 Hz
MOST_PERIOD = 5.0  # [s] between frames; above it times are milliseconds or nanoseconds


@short_repr
@dataclass(frozen=True, slots=True, eq=False)
class KittiImages:
    """Stereo images of a drive.

    Attributes:
        times: (T,) float64 [s]. Strictly increasing times.
        left: T files of the left camera.
        right: T files of the right camera.
        pair: Calibration of the rectified images.
        width: Width of the images [px].
        height: Height of the images [px].
        truth: Poses of the left camera in the plane of its first pose, x ahead, y left; None if unknown.
        rig: Rectification of the images; None: already rectified.
    """

    times: FloatArray
    left: tuple[Path, ...]
    right: tuple[Path, ...]
    pair: RectifiedPair
    width: int
    height: int
    truth: Trajectory | None
    rig: Rectifier | Rectified | None = None

    def images(self, frame: int) -> tuple[Image, Image]:
        """Read the left and the right image of a frame, rectified.

        Raises:
            ValueError: If a file is not an image, or has another size than the others.
        """
        pair = read_grey_image(self.left[frame]), read_grey_image(self.right[frame])
        return pair if self.rig is None else self.rig.rectify(*pair)


def is_image_folder(path: str | Path) -> bool:
    """Return whether a folder has stereo images for `load_kitti_images`."""
    return _eyes(Path(path)) is not None


def load_kitti_images(path: str | Path, truth: str | Path | None = None, duration: float | None = None) -> KittiImages:
    """Read a folder with `image_0` and `image_1` (or `image_l` and `image_r`), `calib.txt` and optional `poses.txt`.

    Args:
        path: Folder of the drive. Times of the frames are in `times.txt` [s], or 0.1 s apart.
        truth: File of the true poses; None: `poses.txt` of the folder, if any.
        duration: Length of the log [s]. None: the whole log.

    Raises:
        ValueError: If a file is missing or cannot be read, or the images of the two cameras have different names.
    """
    folder = checked_path(path)
    folders = _eyes(folder)
    if folders is None:
        names = " or ".join(f"{left} and {right}" for left, right in CAMERA_FOLDERS)
        raise argument_error("path", f"a folder with {names}", "a different one", f"Check {str(folder)!r}.")
    left, right = (sorted(place.glob("*.png")) for place in folders)
    if [file.name for file in left] != [file.name for file in right] or len(left) < 2:
        got = f"a pair of folders with {len(left)} and {len(right)}"
        raise argument_error(
            "path", "two or more images with the same names of both cameras", got, f"Check {str(folder)!r}."
        )
    times = read_times(folder / "times.txt" if (folder / "times.txt").is_file() else None, len(left))
    keep = len(times)
    if duration is not None:
        end = times[0] + check_float("duration", duration, "Give seconds.", above=0.0)
        keep = max(2, int(np.searchsorted(times, end, side="right")))
    file = folder / "poses.txt" if truth is None else existing_file(truth, "truth", "a file of true poses")
    height, width = read_grey_image(left[0]).shape
    return KittiImages(
        times=times[:keep],
        left=tuple(left[:keep]),
        right=tuple(right[:keep]),
        pair=load_kitti_calibration(folder / "calib.txt"),
        width=width,
        height=height,
        truth=read_truth(file, times) if file.is_file() else None,
    )


def _eyes(folder: Path) -> tuple[Path, Path] | None:
    """Return the folders of the left and the right images, or None."""
    for left, right in CAMERA_FOLDERS:
        if (folder / left).is_dir() and (folder / right).is_dir():
            return folder / left, folder / right
    return None


def read_times(file: Path | None, count: int) -> FloatArray:
    """Return the times (count,) [s] of the images; without a file they are `PERIOD` apart.

    Raises:
        ValueError: If the file has fewer numbers, they do not increase strictly, or they are not seconds.
    """
    if file is None:
        return np.arange(count, dtype=np.float64) * PERIOD
    times: list[float] = []
    for number, line in data_lines(read_text(file, kind="a file of times")):
        found = parse_numbers(line.split())
        if found is None or not np.isfinite(found).all() or (np.diff([*times[-1:], *found]) <= 0.0).any():
            raise line_error("path", "rising times in seconds", line, file, number)
        times += found
    if len(times) < count:
        expected, hint = f"{file.name} with {count} times, one for each image", f"Check {str(file)!r}."
        raise argument_error("path", expected, f"a file of {len(times)}", hint)
    if (usual := float(np.median(np.diff(times)))) > MOST_PERIOD:
        raise argument_error("path", f"{file.name} in seconds", f"a median of {usual:g} s", f"Correct {str(file)!r}.")
    return np.array(times[:count])
