"""All readers of text take byte order marks, UTF-16 and any ends of lines; TUM files may be rounded."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders.comparison import assert_same
from builders.logs import EUROC, FILES, KITTI, write_kitti, write_mrclam

from slam_backend.readers import read_csv
from slam_backend.readers.calibration import load_euroc_camera, load_kitti_calibration
from slam_backend.readers.kitti import load_kitti
from slam_backend.readers.kitti_images import read_times
from slam_backend.readers.mrclam import load_mrclam
from slam_backend.trajectory import Trajectory

TUM = "# t\n0.5 1 2 0 0 0 0 1\n1.5 1 3 0 0 0 0.6 0.8\n"
POSES = "".join(f"1 0 0 0.25 0 1 0 0 0 0 1 {ahead}\n" for ahead in (0.0, 0.5))
READERS: dict[str, tuple[str, Callable[[Path], Any]]] = {  # text, and what a reader makes of a file with it
    "TUM": (TUM, Trajectory.load_tum),
    "CSV": ("time,v\n1,2\n3,4\n", lambda file: read_csv(file, ("v", "time"))),
    "KITTI poses": (POSES, lambda file: load_kitti(write_kitti(file.parent), file).truth),
    "KITTI times": ("0.5 0.75\n1.5\n", lambda file: read_times(file, 3)),
    "KITTI calibration": (KITTI, load_kitti_calibration),
    "EuRoC calibration": (EUROC, load_euroc_camera),
}
FORMS: dict[str, Callable[[str], bytes]] = {
    "mark": lambda text: text.encode("utf-8-sig"),
    "UTF-16": lambda text: text.encode("utf-16"),
    "CRLF": lambda text: text.replace("\n", "\r\n").encode(),
    "CR": lambda text: text.replace("\n", "\r").encode(),
}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("reader", READERS)
def test_a_file_is_the_same_in_any_form(reader: str, form: str, tmp_path: Path) -> None:
    """What is read depends neither on the encoding, nor on a byte order mark, nor on the ends of lines."""
    (text, read), file = READERS[reader], tmp_path / "file.txt"
    file.write_text(text)
    expected = read(file)
    file.write_bytes(FORMS[form](text))
    assert_same(read(file), expected)


@pytest.mark.parametrize("form", FORMS)
def test_an_mrclam_log_is_the_same_in_any_form(form: str, tmp_path: Path) -> None:
    """The same holds for the files of a log together."""
    write_mrclam(tmp_path)
    expected = load_mrclam(tmp_path)
    for name, text in FILES.items():
        (tmp_path / name).write_bytes(FORMS[form](text.replace("\r\n", "\n")))
    assert_same(load_mrclam(tmp_path), expected)


def test_tum_files_may_be_rounded_to_four_decimals(tmp_path: Path) -> None:
    """Headings of quaternions with four decimals are read to 2e-4 rad, with tilts of one unit in the last decimal."""
    headings = np.random.default_rng(0).uniform(-np.pi, np.pi, 200)
    rows = [
        f"{time} 1 2 0 {tilt:.4f} {-tilt:.4f} {np.sin(0.5 * heading):.4f} {np.cos(0.5 * heading):.4f}\n"
        for time, (heading, tilt) in enumerate(zip(headings, np.linspace(-1e-4, 1e-4, 200), strict=True))
    ]
    (tmp_path / "path.txt").write_text("".join(rows))
    found = Trajectory.load_tum(tmp_path / "path.txt").poses[:, 2]
    assert np.abs(np.angle(np.exp(1j * (found - headings)))).max() < 2e-4
