"""Refusals of `vslam replay` for logs that are missing, damaged, or with times that go back."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import loadmat, savemat
from small_logs import write_drive, write_log, write_park

WRITERS: dict[str, Callable[[Path], None]] = {
    "mrclam": lambda folder: write_log(folder, noise=1.0), "victoria": write_park, "kitti": write_drive,
}  # fmt: skip


def _turn_back(command: str, log: Path) -> None:
    """Exchange two times of a log, more than a second apart where smaller steps back are sorted."""
    if command == "mrclam":
        file = log / "Robot5_Odometry.dat"
        lines = file.read_text().splitlines()
        lines[6], lines[86] = lines[86], lines[6]
        file.write_text("\n".join(lines))
    elif command == "victoria":
        file = log / "aa3_dr.mat"
        content = {name: values for name, values in loadmat(file).items() if not name.startswith("_")}
        content["time"][0, [6, 86]] = content["time"][0, [86, 6]]
        savemat(file, content)
    else:
        file = log / "drive.npz"
        with np.load(file) as archive:
            content = dict(archive)
        content["time_stamps"][[6, 7]] = content["time_stamps"][[7, 6]]
        np.savez(file, **content)


@pytest.mark.parametrize(
    ("command", "file", "message"),
    [
        ("mrclam", "Robot2_Measurement.dat", "path: expected 4 numbers (time barcode range bearing), got"),
        ("victoria", "VictoriaParkSinSincronizar.mat", "path: expected VictoriaParkSinSincronizar.mat with a MATLAB"),
        ("kitti", "drive.npz", "path: expected a numpy archive, got a broken file. Get"),
    ],
)
def test_truncated_files_are_refused(
    command: str, file: str, message: str, refusal: Any, tmp_path: Path,
) -> None:  # fmt: skip
    """A truncated file is refused by name, before anything is computed."""
    log = tmp_path / "log"
    log.mkdir()
    WRITERS[command](log)
    whole = (log / file).read_bytes()
    (log / file).write_bytes(whole[: len(whole) // 2])
    shown = refusal("replay", command, "--path", "log")
    assert shown.startswith(f"error {message}")
    assert file in shown


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (
            "mrclam",
            "path: expected 3 numbers (time velocity angular_velocity) with a time at most 1 s before that of a line",
        ),
        (
            "victoria",
            "path: expected aa3_dr.mat with times time that go back by at most 1 s, got a time 0.175 s after 2.150 s",
        ),
        ("kitti", "path: expected drive.npz with two or more rising times in 'time_stamps', got a different one."),
    ],
)
def test_time_that_goes_back_is_refused(command: str, message: str, refusal: Any, tmp_path: Path) -> None:
    """Two readings far out of order are refused before the replay starts, and any two frames of KITTI."""
    log = tmp_path / "log"
    log.mkdir()
    WRITERS[command](log)
    _turn_back(command, log)
    assert refusal("replay", command, "--path", "log").startswith(f"error {message}")
