from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from slam_backend.geometry import compose
from slam_backend.models.camera import StereoCamera
from slam_backend.readers.conversions import integrate_commands
from slam_backend.readers.victoria import ENCODER, SENSOR, WHEELBASE, TreeNoise, axle_velocities, load_victoria, steps

SCANS = [[[4.0, 7.0], [np.pi / 2, 0.5], [0.3, 0.4]], [], [[2.0], [3.0], [0.2]]]  # ranges, bearings, diameters


def _write(folder: Path, **changes: Any) -> None:
    """Write a log of 2 s with three scans and four fixes; `changes` replace variables, None leaves one out."""
    cells = np.empty(len(SCANS), dtype=object)
    cells[:] = [np.array(scan, dtype=np.float64) if scan else np.empty((0, 0)) for scan in SCANS]
    files: dict[str, dict[str, Any]] = {
        "aa3_dr.mat": {
            "time": np.arange(1000, 3000, 25, dtype=np.int32)[:, None],
            "speed": np.full((80, 1), 2.0),
            "steering": np.full((80, 1), 0.1),
        },
        "VictoriaParkSinSincronizar.mat": {"TLsr": np.array([[1.1, 1.6, 2.1]]), "zt": cells[None]},
        "aa3_gpsx.mat": {
            "timeGps": np.array([[900], [1200], [1400], [2000]], dtype=np.int32),
            "Lo_m": np.arange(4.0)[:, None],
            "La_m": np.arange(4.0)[:, None] - 7.0,
        },
    }
    for file, variables in files.items():
        content = {name: changes.get(name, value) for name, value in variables.items()}
        savemat(folder / file, {name: value for name, value in content.items() if value is not None})


def test_files_become_arrays_in_seconds_metres_and_radians(tmp_path: Path) -> None:
    """Milliseconds become seconds, and bearings from the right hand side become such from straight ahead."""
    _write(tmp_path)
    log = load_victoria(tmp_path)
    assert log.controls[1].tolist() == [1.025, 2.0, 0.1]
    assert log.scan_times.tolist() == [1.1, 1.6, 2.1]
    assert [len(scan) for scan in log.scans] == [2, 0, 1]
    np.testing.assert_allclose(log.scans[0], [[4.0, 0.0, 0.3], [7.0, 0.5 - np.pi / 2, 0.4]])
    assert log.gps is not None
    assert log.gps[2].tolist() == [1.4, 2.0, -5.0]
    assert not log.scans[0].flags.writeable


def test_entries_a_little_back_in_time_are_sorted(tmp_path: Path) -> None:
    """Scans come with their trees; of scans at one time the first counts; one line says what was sorted."""
    stamps = np.array([[900], [1200], [1150], [2000]])
    _write(tmp_path, TLsr=np.array([[1.6, 1.1, 1.6]]), timeGps=stamps)
    log = load_victoria(tmp_path)
    assert log.scan_times.tolist() == [1.1, 1.6]
    assert [len(scan) for scan in log.scans] == [0, 2]
    assert log.gps is not None
    assert log.gps[:, 1].tolist() == [0.0, 2.0, 1.0, 3.0]
    told = "VictoriaParkSinSincronizar.mat (1 row, up to 0.500 s back), aa3_gpsx.mat (1 row, up to 0.050 s back)."
    assert log.notes == (f"Sorted by time: {told}",)


def test_a_log_without_gps_is_read(tmp_path: Path) -> None:
    """Without its file there are no fixes."""
    _write(tmp_path)
    (tmp_path / "aa3_gpsx.mat").unlink()
    log = load_victoria(tmp_path)
    assert log.gps is None
    assert log.notes == ()


def test_a_duration_keeps_the_beginning(tmp_path: Path) -> None:
    """Controls and scans after it are dropped; one before the first scan is refused."""
    _write(tmp_path)
    log = load_victoria(tmp_path, duration=0.7)
    assert log.scan_times.tolist() == [1.1, 1.6]
    assert log.controls[-1, 0] <= 1.7
    with pytest.raises(ValueError, match=r"duration: expected long enough for a scan, got 0\.05"):
        load_victoria(tmp_path, duration=0.05)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"steering": None}, r"aa3_dr\.mat with variables time, speed, steering, got no variable 'steering'"),
        ({"zt": None}, r"Sincronizar\.mat with variables TLsr, zt, got no variable 'zt'"),
        ({"speed": np.zeros((79, 1))}, "as many values of each variable, got '80 time, 79 speed, 80 steering'"),
        ({"speed": np.full((80, 1), np.nan)}, "finite numbers, got NaN or infinity in speed"),
        ({"speed": np.zeros((8, 10))}, r"a row or column of numbers speed, got an array float64 \(8, 10\)"),
        ({"steering": np.full((80, 1), 1.4)}, r"steering angles within \+-1 rad, got a larger one"),
        (
            {"TLsr": np.array([[2.1, 1.05, 2.2]])},
            r"TLsr that go back by at most 1 s, got a time 1\.050 s after 2\.100 s",
        ),
        ({"timeGps": np.array([[9000], [5], [6], [7]])}, "times timeGps that go back by at most 1 s"),
        ({"TLsr": np.array([[1.1, 1.6]])}, "a cell array zt with one cell for each of 2 times, got a different one"),
        ({"zt": np.zeros((1, 3))}, "a cell array zt with one cell for each of 3 times, got a different one"),
    ],
)
def test_broken_contents_are_named(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    """Missing, ragged, impossible and backward variables are refused by file and name."""
    _write(tmp_path, **changes)
    with pytest.raises(ValueError, match=message):
        load_victoria(tmp_path)


@pytest.mark.parametrize(
    ("scan", "message"),
    [
        ([[1.0], [1.0]], r"rows of range, bearing and diameter in each cell of zt, got an array float64 \(2, 1\)"),
        ([[-1.0], [1.0], [0.1]], "ranges > 0 and diameters >= 0 in zt, got a row that is not in cell 1"),
        ([[1.0], [3.5], [0.1]], "bearings from 0 to pi in zt, got a bearing outside in cell 1"),
    ],
)
def test_broken_trees_are_named(tmp_path: Path, scan: list[list[float]], message: str) -> None:
    """A scan of another shape, or with impossible trees, is refused by its number."""
    cells = np.empty((1, 3), dtype=object)
    cells[0] = [np.array(SCANS[0]), np.array(scan), np.empty((0, 0))]
    _write(tmp_path, zt=cells)
    with pytest.raises(ValueError, match=message):
        load_victoria(tmp_path)


@pytest.mark.parametrize("name", ["aa3_dr.mat", "VictoriaParkSinSincronizar.mat", "aa3_gpsx.mat"])
def test_a_file_cut_anywhere_is_refused(tmp_path: Path, name: str) -> None:
    """Wherever a download stopped, the error is one of ours and names the file."""
    _write(tmp_path)
    whole = (tmp_path / name).read_bytes()
    for length in range(0, len(whole) - 8, 7):  # savemat pads the last variable with up to 7 bytes
        (tmp_path / name).write_bytes(whole[:length])
        with pytest.raises(ValueError, match=rf"^path: expected {name} with "):
            load_victoria(tmp_path)


def test_missing_and_damaged_files_are_named(tmp_path: Path) -> None:
    """No folder, no file, and a file that is cut or no MATLAB file at all."""
    with pytest.raises(ValueError, match="path: expected a folder of the Victoria Park log, got no such folder"):
        load_victoria(tmp_path / "none")
    with pytest.raises(ValueError, match=r"path: expected a folder with aa3_dr\.mat, got no such file"):
        load_victoria(tmp_path)
    _write(tmp_path)
    whole = (tmp_path / "aa3_dr.mat").read_bytes()
    for content in (b"", b"no such thing" * 30, whole[: len(whole) // 2]):
        (tmp_path / "aa3_dr.mat").write_bytes(content)
        with pytest.raises(ValueError, match=r"aa3_dr\.mat with a MATLAB file of version 5 to 7\.2, got a broken file"):
            load_victoria(tmp_path)


@pytest.mark.parametrize("steering", [-0.4, -0.1, 0.2, 0.5])
def test_the_vehicle_turns_about_a_point_on_its_rear_axle(steering: float) -> None:
    """Under constant steering the axle's middle runs on a circle of radius L / tan(alpha), its left wheel H inside."""
    controls = np.array([[0.0, 3.0, steering], [9.0, 3.0, steering]])
    velocities = axle_velocities(controls)
    radius = WHEELBASE / np.tan(steering)
    assert velocities[0, 1] / velocities[0, 2] == pytest.approx(radius)
    assert velocities[0, 2] * (radius - ENCODER) == pytest.approx(3.0)
    poses = integrate_commands(velocities, np.linspace(0.0, 1.0, 11))
    np.testing.assert_allclose(np.hypot(poses[:, 0], poses[:, 1] - radius), abs(radius))


def test_trees_stand_where_the_laser_saw_them(tmp_path: Path) -> None:
    """A reading, put through the camera model at the laser's place, is at its range and bearing from the laser."""
    _write(tmp_path)
    readings = steps(load_victoria(tmp_path))
    assert readings.measurements[1] is None
    frame = readings.measurements[0]
    assert frame is not None
    seen = StereoCamera(mount=SENSOR).robot_from_camera(frame.points) - np.array(SENSOR)
    np.testing.assert_allclose(np.hypot(seen[:, 0], seen[:, 1]), [4.0, 7.0])
    np.testing.assert_allclose(np.arctan2(seen[:, 1], seen[:, 0]), [0.0, 0.5 - np.pi / 2], atol=1e-12)
    poses = integrate_commands(axle_velocities(load_victoria(tmp_path).controls), readings.times)
    np.testing.assert_allclose(compose(poses[0], readings.odometry[1]), poses[1], atol=1e-12)


def test_noise_points_along_and_across_the_ray(tmp_path: Path) -> None:
    """Straight ahead, depth has the deviation of the range, and the side that of the bearing times the range."""
    _write(tmp_path)
    frame = steps(load_victoria(tmp_path), TreeNoise(range=0.3, bearing=0.02, height=0.5)).measurements[0]
    assert frame is not None
    assert frame.covariances is not None
    np.testing.assert_allclose(np.diag(frame.covariances[0]), [(4.0 * 0.02) ** 2, 0.5**2, 0.3**2], rtol=1e-9)
    with pytest.raises(ValueError, match=r"sensor\.bearing: expected a finite number > 0, got 0\.0"):
        TreeNoise(bearing=0.0)
