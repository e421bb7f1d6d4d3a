"""Reader of stereo images in a folder of any layout, with their calibration."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slam_backend.core.image_files import read_grey_image
from slam_backend.core.short_repr import short_repr
from slam_backend.core.text_files import existing_file
from slam_backend.core.validation import argument_error, check_float
from slam_backend.readers.calibration import Rectified, Rectifier, load_euroc_calibration, load_kitti_calibration
from slam_backend.readers.kitti import read_truth
from slam_backend.readers.kitti_images import KittiImages, read_times

LEAST_PAIRS = 2


@short_repr
@dataclass(frozen=True, slots=True, kw_only=True)
class StereoFiles:
    """Names of the files of a stereo log, within its folder unless they are absolute paths.

    Attributes:
        left: Images of the left camera: a pattern such as `cam0/*.png`, sorted by the numbers in the names, or names
            separated by commas.
        right: Images of the right camera, in the same format and order.
        calibration: One file of the projection matrices of rectified images (KITTI's `calib.txt`), or two files
            `sensor.yaml` of EuRoC's raw cameras separated by a comma, the left one first.
        times: File of the times of the frames [s]; None: 0.1 s apart.
        truth: File of the true poses; None: unknown.
    """

    left: str = "left_img_*.png"
    right: str = "right_img_*.png"
    calibration: str = "sensorLeft.yaml,sensorRight.yaml"
    times: str | None = None
    truth: str | None = None


def find_pairs(folder: str | Path, files: StereoFiles) -> tuple[tuple[Path, ...], tuple[Path, ...]]:
    """Return the images of the left and of the right camera, the same number of each.

    Raises:
        ValueError: If the folder or an image is missing, the numbers differ, or there are fewer than two pairs.
    """
    root = Path(folder)
    if not root.is_dir():
        raise argument_error("path", "a folder with two stereo pairs", "no such folder", f"Check {str(root)!r}.")
    left, right = (_images(root, option, getattr(files, option)) for option in ("left", "right"))
    if len(left) != len(right) or len(left) < LEAST_PAIRS:
        got = f"a folder with {len(left)} {files.left!r} and {len(right)} {files.right!r}"
        raise argument_error("path", "two or more pairs of images", got, "Name them with --left and --right.")
    return left, right


def load_rig(folder: str | Path, calibration: str, size: tuple[int, int]) -> Rectifier | Rectified:
    """Read the calibration of a rig.

    Args:
        folder: Folder of the files.
        calibration: Names of the files, see `StereoFiles.calibration`.
        size: Width and height of the images [px].

    Raises:
        ValueError: If there are not one or two names, or a file is invalid.
    """
    names = _words(calibration)
    if len(names) not in (1, 2):
        hint = "Name calib.txt, or sensor.yaml of the left and of the right camera with a comma between."
        raise argument_error("calibration", "one file or two", repr(calibration), hint)
    places = [Path(folder) / name for name in names]
    if len(places) == 2:
        return load_euroc_calibration(*places)
    return Rectified(load_kitti_calibration(places[0]), *size)


def load_stereo_images(folder: str | Path, files: StereoFiles, duration: float | None = None) -> KittiImages:
    """Read a drive of stereo images, raw or rectified.

    Args:
        folder: Folder of the drive.
        files: Names of the files. `truth` has rows of a 3 x 4 matrix, as KITTI's poses.
        duration: Length of the log [s]. None: the whole log.

    Raises:
        ValueError: If a file is missing or cannot be read.
    """
    left, right = find_pairs(folder, files)
    count = len(left)
    named = None if files.times is None else existing_file(Path(folder) / files.times, "times", "a file of times")
    times = read_times(named, count)
    keep = count
    if duration is not None:
        end = times[0] + check_float("duration", duration, "Give seconds.", above=0.0)
        keep = max(LEAST_PAIRS, int(np.searchsorted(times, end, side="right")))
    height, width = read_grey_image(left[0]).shape
    rig = load_rig(folder, files.calibration, (width, height))
    poses = truth_file(folder, files)
    truth = None if poses is None else read_truth(poses, times)
    return KittiImages(times[:keep], left[:keep], right[:keep], rig.pair, width, height, truth, rig)


def truth_file(folder: str | Path, files: StereoFiles) -> Path | None:
    """Return the file of true poses, or None if none is named.

    Raises:
        ValueError: If the named file does not exist.
    """
    named = files.truth
    return None if named is None else existing_file(Path(folder) / named, "truth", "a file of true poses")


def _images(folder: Path, option: str, names: str) -> tuple[Path, ...]:
    """Return the images of a pattern, sorted by the numbers in their names, or of a list of names."""
    if any(sign in names for sign in "*?["):
        whole = Path(names)
        root, pattern = (
            (Path(whole.anchor), str(whole.relative_to(whole.anchor))) if whole.is_absolute() else (folder, names)
        )
        found = sorted((file for file in root.glob(pattern) if file.is_file()), key=_by_numbers)
    else:
        found = [folder / name for name in _words(names)]
    missing = folder / names if not found else next((file for file in found if not file.is_file()), None)
    if missing is not None:
        raise argument_error("path", "an image file", missing, f"It does not exist: name yours with --{option}.")
    return tuple(found)


def _by_numbers(file: Path) -> list[tuple[int, str]]:
    """Return a sort key that puts `img_2` before `img_10`."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"([0-9]+)", str(file))]


def _words(names: str) -> list[str]:
    """Return the names separated by commas."""
    return [name.strip() for name in names.split(",") if name.strip()]
