"""Files and tables of logs that are not what they should be: refused by file, line, column or name, in one form."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders.logs import (
    DRIVEN,
    EUROC,
    KITTI,
    SCANS,
    SIGMAS,
    eye_at,
    write_kitti,
    write_mrclam,
    write_victoria,
)
from builders.refusals import FORM
from hypothesis import given
from hypothesis import strategies as st

from slam_backend.readers import range_bearing_steps, read_csv
from slam_backend.readers.calibration import CameraCalibration, Rectifier, load_euroc_camera, load_kitti_calibration
from slam_backend.readers.kitti import load_kitti
from slam_backend.readers.mrclam import load_mrclam
from slam_backend.readers.mrclam import to_filter_steps as mrclam_steps
from slam_backend.readers.victoria import load_victoria
from slam_backend.trajectory import Trajectory

Read = Callable[[Path], Any]  # of a folder that is empty before


def mrclam(name: str = "", text: str | None = None, **arguments: Any) -> Read:
    """Return a reader of an MRCLAM log of which one file holds a text, or is missing."""

    def read(folder: Path) -> Any:
        write_mrclam(folder)
        if text is not None:
            (folder / name).write_text(text)
        elif name:
            (folder / name).unlink()
        return load_mrclam(folder, **arguments)

    return read


def victoria(**changes: Any) -> Read:
    """Return a reader of a log of Victoria Park in which some variables are others."""
    return lambda folder: (write_victoria(folder, **changes), load_victoria(folder))


def trees(*scan: list[float]) -> Read:
    """Return a reader of a log of Victoria Park whose second scan is this."""
    cells = np.empty((1, 3), dtype=object)
    cells[0] = [np.array(SCANS[0]), np.array(scan), np.empty((0, 0))]
    return victoria(zt=cells)


def kitti(**changes: Any) -> Read:
    """Return a reader of a KITTI archive in which some arrays are others."""
    return lambda folder: load_kitti(write_kitti(folder, **changes))


def holding(name: str, content: str | bytes, load: Callable[..., Any], *arguments: Any, **more: Any) -> Read:
    """Return a reader of a file that holds this."""

    def read(folder: Path) -> Any:
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
        return load(folder / name, *arguments, **more)

    return read


def within(name: str, load: Callable[..., Any], *arguments: Any) -> Read:
    """Return a reader of a path in a folder where nothing is."""
    return lambda folder: load(folder / name, *arguments)


def euroc(before: str, after: str) -> Read:
    """Return a reader of a calibration of EuRoC in which a text is another."""
    return holding("sensor.yaml", EUROC.replace(before, after), load_euroc_camera)


def table(**changes: Any) -> Read:
    """Return a call with readings of range and bearing of which some are others."""
    arguments: dict[str, Any] = {"velocities": DRIVEN, "sightings": [[10.0, 1.0, 0.0]], **SIGMAS} | changes
    return lambda _: range_bearing_steps(**arguments)


def two_archives(folder: Path) -> Any:
    """Read a folder of two archives, one of them cut."""
    (folder / "other.npz").write_bytes(write_kitti(folder).read_bytes()[:300])
    return load_kitti(folder)


def poses_of(text: str) -> Read:
    """Return a reader of a KITTI archive with a file of true poses."""

    def read(folder: Path) -> Any:
        (folder / "poses").mkdir()
        (folder / "poses" / "00.txt").write_text(text)
        return load_kitti(write_kitti(folder).parent)

    return read


ROW = "1 0 0 0 0 1 0 0 0 0 1 0"
ODOMETRY, SEEN, CODES = "Robot2_Odometry.dat", "Robot2_Measurement.dat", "Barcodes.dat"
IMAGES = np.zeros((240, 320), np.uint8), np.zeros((100, 320), np.uint8)
WIDE = CameraCalibration(640, 240, eye_at(0.1).matrix, np.zeros(4), eye_at(0.1).body_from_camera)


def csv(text: str | bytes, **more: Any) -> Read:
    """Return a reader of a table of two columns."""
    return holding("log.csv", text, read_csv, ("time", "v"), **more)


CASES: dict[str, list[tuple[Read, str]]] = {
    "MRCLAM": [
        (within("none", load_mrclam), r"a folder.*got no such folder\. Check '.*none'"),
        (load_mrclam, r"got no odometry of any robot\. Check '.*Robot1_Odometry\.dat'"),
        (mrclam(CODES), r"a file of the MR\.CLAM log, got no such file\. Check '.*Barcodes\.dat'"),
        (mrclam(SEEN), r"got no such file\. Check '.*Robot2_Measurement\.dat'"),
        (mrclam(CODES, "# nothing\n"), r"rows \(subject barcode\), got no rows\. .*Barcodes\.dat is empty"),
        (mrclam(CODES, "1 5\n\n6 6.5\n"), r"a whole barcode, got '6 6\.5'\. Correct line 3 of .*Barcodes\.dat"),
        (mrclam(ODOMETRY, "1 2\n"), r"3 numbers \(time velocity angular_velocity\), got '1 2'\. .*line 1"),
        (mrclam(ODOMETRY, "1 2 3\n1 2 x\n"), r"got '1 2 x'\. Correct line 2"),
        (mrclam(ODOMETRY, "1 2 3\n2 nan 0\n"), r"finite numbers, got '2 nan 0'\. Correct line 2"),
        (mrclam(ODOMETRY, "1 2 inf\n"), r"finite numbers, got '1 2 inf'"),
        (mrclam(ODOMETRY, "2 0 0\n3 0 0\n1 0 0\n"), r"at most 1 s before that of a line above, got '1 0 0'\. .*3"),
        (mrclam(ODOMETRY, "100.0 0 0\n102.0 0 0\n101.4 0 0\n100.9 0 0\n"), r"above, got '100\.9 0 0'\. .*line 4"),
        (mrclam(SEEN, "9.0 63 2.0 0.1\n9.1 63 2.0 0.1\n"), r"since its first odometry .* from 9\.000 to 9\.1"),
        (mrclam(ODOMETRY, "1_0 0 0\n"), "got '1_0 0 0'"),
        (mrclam(SEEN, "1 63 0.0 0.1\n"), r"a range > 0, got '1 63 0\.0 0\.1'"),
        (mrclam(SEEN, "\x00\x01binary"), r"4 numbers \(time barcode range bearing\)"),
        (mrclam(SEEN, "101.0 63 2.0 7.0\n"), r"a bearing within \+-2 pi, got '101\.0 63 2\.0 7\.0'\. .*line 1"),
        (mrclam(ODOMETRY, "1e5 0 0\n1.1e5 0 0\n"), r"at most 1\.5 s apart, got a median of 10000 s\. .*Odometry\.dat"),
        (mrclam(ODOMETRY, "1.2e9 1 0\n1.2e9 1 0\n"), r"times that increase, got a time 1200000000\.000 s in all rows"),
        (mrclam("Robot2_Groundtruth.dat", "1 0 0\n"), r"4 numbers \(time x y theta\)"),
        (mrclam("Landmark_Groundtruth.dat", "6 0 0 0 0\n"), "of each landmark, got no position of subject 7"),
        *((mrclam(robots=bad), "^robots: expected different numbers") for bad in ((2, 6), (2, 2), ())),
        (mrclam(robots=(3,)), r"got no such file\. Check '.*Robot3_Odometry\.dat'"),
        *((mrclam(duration=bad), "^duration: expected a finite number > 0") for bad in (0.0, float("nan"))),
        (lambda folder: mrclam_steps(mrclam()(folder), 0.0), "^dt: expected a finite number > 0"),
        (lambda folder: mrclam_steps(mrclam()(folder), 1e-9), "^dt: expected at most 1,000,000 steps"),
    ],
    "Victoria Park": [
        (within("none", load_victoria), "a folder of the Victoria Park log, got no such folder"),
        (load_victoria, r"a folder with aa3_dr\.mat, got no such file"),
        (victoria(steering=None), r"aa3_dr\.mat with variables time, speed, steering, got no variable 'steering'"),
        (victoria(zt=None), r"Sincronizar\.mat with variables TLsr, zt, got no variable 'zt'"),
        (victoria(speed=np.zeros((79, 1))), "values of each variable, got '80 time, 79 speed, 80 steering'"),
        (victoria(speed=np.full((80, 1), np.nan)), "finite numbers, got NaN or infinity in speed"),
        (victoria(speed=np.zeros((8, 10))), r"a row or column of numbers speed, got an array float64 \(8, 10\)"),
        (victoria(steering=np.full((80, 1), 1.4)), r"steering angles within \+-1 rad, got a larger one"),
        (victoria(TLsr=np.array([[2.1, 1.05, 2.2]])), r"at most 1 s, got a time 1\.050 s after 2\.100 s"),
        (victoria(timeGps=np.array([[9000], [5], [6], [7]])), "times timeGps that go back by at most 1 s"),
        (victoria(TLsr=np.array([[1100, 1600, 2100]])), "times TLsr in seconds .* controls, 1.0 to 3.0 s, got a log"),
        (victoria(TLsr=np.array([[1.1, 1.6]])), "one cell for each of 2 times, got a different one"),
        (victoria(zt=np.zeros((1, 3))), "a cell array zt with one cell for each of 3 times, got a different one"),
        (trees([1.0], [1.0]), r"range, bearing and diameter in each cell of zt, got an array float64 \(2, 1\)"),
        (trees([-1.0], [1.0], [0.1]), "ranges > 0 and diameters >= 0 in zt, got a row that is not in cell 1"),
        (trees([1.0], [3.5], [0.1]), "bearings from 0 to pi in zt, got a bearing outside in cell 1"),
    ],
    "KITTI": [
        (load_kitti, "path: expected an archive .* or a folder with one, got a folder with 0 archives"),
        (two_archives, "got a folder with 2 archives"),
        (within("none.npz", load_kitti), "a folder with one, got no such file"),
        (holding("a.npz", b"PK no archive", load_kitti), "a numpy archive, got a broken file"),
        (kitti(b=np.array([{}], object)), "a numpy archive, got a broken file"),
        (poses_of(f"{ROW}\n4 5 6\n"), r"truth: expected 12 finite numbers, .*got '4 5 6'\. .*line 2 of .*00\.txt"),
        (poses_of(f"{ROW}\n"), r"truth: expected 00\.txt with a row for each of 5 frames, got a file of 1"),
        (lambda folder: load_kitti(write_kitti(folder), folder / "none.txt"), "of true poses, got no such file"),
        (kitti(b=None), "path: expected drive.npz with the arrays .*, got no array 'b'"),
        (kitti(b=np.array(-0.5)), "drive.npz with a positive distance in 'b'"),
        (kitti(time_stamps=np.array([[1.0, 2.0, 3.0, 2.5, 4.0]])), "two or more rising times in 'time_stamps'"),
        (kitti(features=np.zeros((4, 3, 6))), r"an array \(4, n, 5\), four pixels of each track .* in 'features'"),
        (kitti(linear_velocity=np.zeros((3, 4))), r"an array \(3, 5\) in 'linear_velocity'"),
        (kitti(rotational_velocity=np.full((3, 5), np.inf)), "finite numbers in 'rotational_velocity'"),
        (kitti(K=np.diag([700.0, 500.0, 1.0])), "a 3 x 3 matrix of square pixels in 'K'"),
        (kitti(cam_T_imu=np.ones((4, 4))), "a 4 x 4 rigid motion in 'cam_T_imu'"),
    ],
    "TUM": [
        (within("gone.txt", Trajectory.load_tum), r"a TUM trajectory file, got no such file\. Check '.*gone.txt'"),
        *((holding("path.txt", text, Trajectory.load_tum), says) for text, says in (
            ("0 1 2 3\n", r"8 finite numbers .* got '0 1 2 3'.*line 1"), ("0 0 nan 0 0 0 0 1\n", "8 finite numbers"),
            ("0 0 0 0 0 0 0 1\n1 0 x 0 0 0 0 1\n", "got '1 0 x 0 0 0 0 1'.*line 2"),
            ("0 0 0 0 0 0 0 0\n", "a unit quaternion"), ("0 0 0 0 0.6 0 0 0.8\n", "a rotation about the vertical"),
            ("0 0 0 0 0.01 0 0 0.99995\n", r"about the vertical.*Correct line 1 of .*path\.txt"),
            ("0 0 0 0 0.0002 0 0.7071 0.7071\n", "a rotation about the vertical"),
            ("# rows\n1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", r"a time after 1\.0, got '1 0 .*line 3 of .*path\.txt"),
            ("# nothing\n", "with poses, got no pose"),
        )),
    ],
    "calibrations": [
        (within("none.txt", load_kitti_calibration), r"of a calibration, got no such file\. Check '.*none\.txt'"),
        *((holding("calib.txt", text, load_kitti_calibration), says) for text, says in (
            ("", "calibration: expected calib.txt with two matrices of 12 numbers, got a file with 0"),
            (KITTI.replace("700 0 600 -350", "700 0 x -350"), "got a file with 1"),
            (KITTI.replace("-350", "350"), "a rectified pair"),
            (KITTI.replace("600 -350", "610 -350"), "a rectified pair"),
        )),
        (euroc("[400.5, 401, 320.25, 199]", "[400.5]"), "sensor.yaml with 4 numbers 'intrinsics'"),
        (euroc("resolution", "size"), "with 2 numbers 'resolution', got a list of 0"),
        (euroc("radial-tangential", "equidistant"), "the distortion model radial-tangential, got"),
        (euroc("-1.0, 0.0, 0.1", "-2.0, 0.0, 0.1"), "sensor.yaml with a rigid motion T_BS"),
        (euroc("401,", "-401,"), "^calibration.intrinsics: expected a finite number > 0"),
        (euroc("400.5,", "x,"), "^calibration: expected numbers after 'intrinsics', got "),
        (lambda _: Rectifier(eye_at(0.1), eye_at(0.0)), "^right: expected a camera to the right of the left one"),
        (lambda _: Rectifier(eye_at(0.0), WIDE), "^right: expected a camera with images of the left one's size"),
        (lambda _: Rectifier(eye_at(0.0), eye_at(0.1)).rectify(*IMAGES), r"^right: expected an image of 320 x 240 px"),
    ],
    "CSV": [
        (within("none.csv", read_csv, ("time",)), r"a CSV file, got no such file\. Check '.*none\.csv'"),
        (csv(b"time\n\xff\xfe\n"), r"in UTF-8, got a file in another encoding\. .*line 2, column 1 of .*log\.csv"),
        (csv("time,v\n1,2\n", delimiter=" "), "delimiter: expected one of"),
        (csv(""), r"log\.csv with a line of names, got no such line\. Check '.*log\.csv'"),
        (csv("# 1\n# 2\n"), r"log\.csv with a line of names, got no such line"),
        (csv("time,v\n"), r"log\.csv with rows, got no rows\. .*log\.csv ends after"),
        (csv("time,w\n1,2\n"), r"one column 'v', got a line of names 'time, w'\. Correct the line of names of .*csv"),
        (csv("time,v,v\n1,2,3\n"), "one column 'v', got a line of names 'time, v, v'"),
        (csv("time,v\n1,2\n2,fast\n"), r"a finite number in column 'v', got 'fast'\. Correct line 3 of .*log\.csv"),
        (csv("time,v\n1,nan\n"), r"a finite number in column 'v', got 'nan'\. Correct line 2"),
        (csv("time,v\ninf,1\n"), r"a finite number in column 'time', got 'inf'\. Correct line 2"),
        (csv("time,v\n1,1_0\n"), "a finite number in column 'v', got '1_0'"),
        (csv("time,v\n\n1\n"), r"an entry in column 'v', got no entry\. Correct line 3"),
        (csv("time,v\n1,\n"), r"an entry in column 'v', got no entry\. Correct line 2"),
        (csv("time;v\n0,1;0,5\n"), r"a decimal point, not a comma, in column 'time', got '0,1'\. Correct line 2"),
        (csv("time,v\n0,1,0,5\n"), r"at most 2 entries.* a row of 4\. .*line 2 of .*log\.csv: decimal commas"),
        (csv("sep=|\ntime|v\n1|2\n"), "^delimiter: expected one of"),
        (csv('time,v,w\n1,2,"a\nb"\n3,x,c\n'), r"a finite number in column 'v', got 'x'\. Correct line 4"),
        (csv('time,v\n1,2\n3,"4\n'), r"a CSV file, got a syntax error: .*Correct line 3 of .*log\.csv"),
    ],
    "range and bearing": [
        (table(velocities=np.empty((0, 3))), "^velocities: expected at least one row"),
        (table(sightings=np.empty((0, 3))), "^sightings: expected at least one row"),
        (table(velocities=[[1.0, 2.0]]), r"^velocities: expected an array of shape \(n, 3\), got shape \(1, 2\)"),
        (table(sightings=[[10.0, np.nan, 0.0]]), r"^sightings: .* got NaN or infinity at index \(0, 1\)"),
        (table(sightings=[[10.0, 0.0, 0.0]]), r"^sightings: expected ranges > 0 m, got 0\.0"),
        (table(sightings=[[12.0, 1.0, 0.0], [10.0, 1.0, 0.0]]), "by at most 1 s, got a time 10.000 s after 12"),
        (table(sightings=[[90.0, 1.0, 0.0]]), "among those of the velocities, 10.000 to 12.000 s, got a log"),
        (table(identities=[1, 2]), r"^identities: expected numbers or names of shape \(1,\), got an array of int"),
        (table(identities=[np.nan]), "^identities: expected whole numbers or names, got NaN or fractions"),
        (table(sigma_range=0.0), r"^sigma_range: expected standard deviations > 0, got 0\.0"),
        (table(sigma_bearing=[0.1, 0.1]), r"^sigma_bearing: expected an array of shape \(1,\), got shape \(2,\)"),
        (table(sightings=[[10.0, 1.0, 45.0]]), r"^sightings: expected bearings within \+-2 pi, got 45\.0"),
        (table(velocities=DRIVEN * [1e3, 1.0, 1.0]), r"^velocities: .* at most 1\.5 s apart, got a median of 1000 s"),
        (table(velocities=DRIVEN * [0.0, 1.0, 1.0]), "^velocities: expected times that increase, got a time 0.000 s"),
        (table(velocities=np.add(DRIVEN, [1.7e9, 0, 0]).astype("f4")), "^velocities: .* of float32, .* 128 s apart"),
        (table(sightings=np.float32([[1.7e9, 1.0, 0.0]])), "^sightings: .* of float32, .* are 128 s apart at 17"),
        (table(dt=0.0), "^dt: expected a finite number > 0"),
        (table(dt=1e-9), "^dt: expected at most 1,000,000 steps, got .* give all times in seconds"),
        (table(hold=-1.0), "^hold: expected a finite number > 0"),
    ],
}  # fmt: skip


@pytest.mark.parametrize("kind", CASES)
def test_broken_logs_are_refused_by_what_is_wrong_with_them(kind: str, tmp_path: Path) -> None:
    """The error names the file, and the line, the column, the variable or the argument, and ends with a cure."""
    for i, (read, says) in enumerate(CASES[kind]):
        folder = tmp_path / str(i)
        folder.mkdir()
        with pytest.raises(ValueError, match=says) as caught:
            read(folder)
        assert FORM.fullmatch(str(caught.value).rstrip()), caught.value


@pytest.mark.parametrize("name", ["aa3_dr.mat", "VictoriaParkSinSincronizar.mat", "aa3_gpsx.mat"])
def test_a_file_cut_anywhere_is_refused(tmp_path: Path, name: str) -> None:
    """Wherever a download stopped, and where there is something else, the error is one of ours and names the file."""
    write_victoria(tmp_path)
    whole = (tmp_path / name).read_bytes()
    lengths = range(0, len(whole) - 8, 7)  # savemat pads the last variable with up to 7 bytes
    for content in (b"no such thing" * 30, *(whole[:length] for length in lengths)):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=rf"^path: expected {name} with "):
            load_victoria(tmp_path)


def rows_of(noise: bytes, folder: Path) -> Iterator[np.ndarray]:
    """Yield what readers of text make of noise below good lines: arrays whose first column is the time, if any."""
    write_mrclam(folder)
    (folder / ODOMETRY).write_bytes(b"1.0 0.5 0.25\n" + noise)
    (folder / "log.csv").write_bytes(b"time,v\n" + noise)
    (folder / "path.txt").write_bytes(noise)
    for read in (
        lambda: load_mrclam(folder).robots[0].commands,
        lambda: read_csv(folder / "log.csv", ("time",), labels=("v",)).numbers,
        lambda: Trajectory.load_tum(folder / "path.txt").poses,
    ):
        try:
            yield read()
        except ValueError as error:
            assert FORM.fullmatch(str(error).rstrip())  # noqa: PT017   # either outcome is lawful


@given(st.one_of(st.binary(max_size=60), st.text("0123456789 .-e#\nx,", max_size=60).map(str.encode)))
def test_any_bytes_are_read_or_refused(tmp_path_factory: pytest.TempPathFactory, noise: bytes) -> None:
    """Whatever stands in a file, a reader returns rows of finite numbers or refuses in the project's own form."""
    for rows in rows_of(noise, tmp_path_factory.mktemp("log")):
        assert len(rows) > 0
        assert np.isfinite(rows).all()
