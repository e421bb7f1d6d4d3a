"""Logs of other formats: what files say, in the units of the project, and what they must not say."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from builders.images import draw_boxes
from builders.logs import DRIVEN, EUROC, KITTI, SIGMAS, eye_at, write_victoria

from slam_backend.frontend import StereoFrontEnd
from slam_backend.geometry import compose, inverse, transform_points
from slam_backend.models.camera import StereoCamera
from slam_backend.readers import integrate_commands, range_bearing_steps, read_csv
from slam_backend.readers.calibration import Rectifier, load_euroc_camera, load_kitti_calibration
from slam_backend.readers.victoria import (
    ENCODER,
    SENSOR,
    WHEELBASE,
    TreeNoise,
    axle_velocities,
    load_victoria,
    to_filter_steps,
)
from slam_backend.trajectory import Trajectory, dead_reckoning


def test_files_become_arrays_in_seconds_metres_and_radians(tmp_path: Path) -> None:
    """Milliseconds become seconds, and bearings from the right hand side become such from straight ahead."""
    write_victoria(tmp_path)
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
    write_victoria(tmp_path, TLsr=np.array([[1.6, 1.1, 1.6]]), timeGps=stamps)
    log = load_victoria(tmp_path)
    assert log.scan_times.tolist() == [1.1, 1.6]
    assert [len(scan) for scan in log.scans] == [0, 2]
    assert log.gps is not None
    assert log.gps[:, 1].tolist() == [0.0, 2.0, 1.0, 3.0]
    told = "VictoriaParkSinSincronizar.mat (1 row, up to 0.500 s back), aa3_gpsx.mat (1 row, up to 0.050 s back)."
    assert log.notes == (f"Sorted by time: {told}",)


def test_a_log_without_gps_is_read(tmp_path: Path) -> None:
    """Without its file there are no fixes."""
    write_victoria(tmp_path)
    (tmp_path / "aa3_gpsx.mat").unlink()
    log = load_victoria(tmp_path)
    assert log.gps is None
    assert log.notes == ()


def test_a_duration_keeps_the_beginning(tmp_path: Path) -> None:
    """Controls and scans after it are dropped; one before the first scan is refused."""
    write_victoria(tmp_path)
    log = load_victoria(tmp_path, duration=0.7)
    assert log.scan_times.tolist() == [1.1, 1.6]
    assert log.controls[-1, 0] <= 1.7
    with pytest.raises(ValueError, match=r"duration: expected long enough for a scan, got 0\.05"):
        load_victoria(tmp_path, duration=0.05)


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


def test_trees_have_the_range_and_bearing_of_the_laser(tmp_path: Path) -> None:
    """A reading, put through the camera model at the laser's place, is at its range and bearing from the laser."""
    write_victoria(tmp_path)
    readings = to_filter_steps(load_victoria(tmp_path))
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
    write_victoria(tmp_path)
    frame = to_filter_steps(load_victoria(tmp_path), TreeNoise(range=0.3, bearing=0.02, height=0.5)).measurements[0]
    assert frame is not None
    assert frame.covariances is not None
    np.testing.assert_allclose(np.diag(frame.covariances[0]), [(4.0 * 0.02) ** 2, 0.5**2, 0.3**2], rtol=1e-9)


def _sighting(time: float, landmark: tuple[float, float]) -> tuple[float, float, float]:
    pose = integrate_commands(DRIVEN, [time])[0]
    x, y = transform_points(inverse(pose), np.array([landmark]))[0]
    return time, float(np.hypot(x, y)), float(np.arctan2(y, x))


def test_exact_readings_give_exact_landmarks() -> None:
    """From the steps' own dead reckoning every point leads to its landmark, at whatever time it was seen."""
    stand = {"left": (4.0, 3.0), "right": (5.0, -2.0)}
    names = ["right", "left", "left", "right"]
    seen = [_sighting(time, stand[name]) for time, name in zip((10.1, 10.7, 11.3, 12.2), names, strict=True)]
    steps = range_bearing_steps(DRIVEN, seen, names, **SIGMAS, dt=0.5)
    assert steps.times.tolist() == [10.0, 10.5, 11.0, 11.5, 12.0]
    assert steps.names.tolist() == ["left", "right"]
    np.testing.assert_allclose(
        dead_reckoning(np.zeros(3), steps.odometry[1:]), integrate_commands(DRIVEN, steps.times), atol=1e-12
    )
    found = [k for k, frame in enumerate(steps.measurements) if frame is not None]
    assert found == [0, 1, 3, 4]
    path = dead_reckoning(np.zeros(3), steps.odometry[1:])
    for k, name in zip(found, names, strict=True):
        frame = steps.measurements[k]
        assert frame is not None
        assert frame.descriptors.tolist() == [[float(name == "left"), float(name == "right")]]
        place = compose(path[k], [frame.points[0, 2], -frame.points[0, 0], 0.0])[:2]
        np.testing.assert_allclose(place, stand[name], atol=1e-9)


def test_covariances_lie_along_and_across_the_ray() -> None:
    """Ahead, the range's variance is along Z, the bearing's across it, the height's along Y; each may be its own."""
    seen = [(10.0, 2.0, 0.0), (10.5, 4.0, 0.0)]
    standing = [[10.0, 0.0, 0.0], [11.0, 0.0, 0.0]]
    steps = range_bearing_steps(standing, seen, sigma_range=[0.1, 0.3], sigma_bearing=0.02, sigma_height=0.5, dt=0.5)
    for frame, spread, distance in zip(steps.measurements, (0.1, 0.3), (2.0, 4.0), strict=False):
        assert frame is not None
        assert frame.covariances is not None
        expected = np.diag([(distance * 0.02) ** 2, 0.25, spread**2])
        np.testing.assert_allclose(frame.covariances[0], expected, atol=1e-12)


def test_without_identities_all_descriptors_are_equal() -> None:
    """Every sighting of a step is kept, under one descriptor."""
    seen = [(10.0, 2.0, 0.0), (10.0, 2.0, 0.1), (10.0, 3.0, 0.0)]
    steps = range_bearing_steps(DRIVEN, seen, **SIGMAS)
    assert steps.names.tolist() == []
    frame = steps.measurements[0]
    assert frame is not None
    assert frame.descriptors.tolist() == [[1.0]] * 3


@pytest.mark.parametrize(
    ("velocities", "ranges", "note"),
    [
        ([1.0, 1.0, 1.0], 2.0, ""), ([1.0, 300.0, 1.0], 2.0, "Median speed 150: check that it is in metres"),
        ([1.0, 0.3, 40.0], 2.0, "Median turn rate 8: check that it is in radians per second."),
        ([1.0, 1.0, 1.0], 2e3, "Median range 2000: check that it is in metres."),
        ([60.0, 1.0, 1.0], 2.0, "1 gap of more than 1.5 s between velocities, up to 2.0 s: the robot is assumed"),
    ],
)  # fmt: skip
def test_implausible_units_are_noted(velocities: list[float], ranges: float, note: str) -> None:
    """Quantities that hardly are in their unit are named, but steps are made: the robot may be that fast."""
    driven = np.array([[10.0, 0.5, 0.2], [11.0, 0.5, 0.2], [12.0, 0.5, 0.0]]) * [1.0, *velocities[1:]]
    driven[1:, 0] += velocities[0] > 1.0
    steps = range_bearing_steps(driven, [(10.0, ranges, 0.0), (12.0, ranges, 0.1)], **SIGMAS)
    assert len(steps.notes) == bool(note)
    assert all(line.startswith(note) for line in steps.notes)


def test_rare_sightings_are_noted() -> None:
    """Sightings far apart may be the sensor's, or times in milliseconds with quick odometry."""
    driven = np.column_stack([np.arange(0.0, 300.0), np.ones(300), np.zeros(300)])
    seen = [(0.0, 1.0, 0.0), (100.0, 1.0, 0.0), (250.0, 1.0, 0.0)]
    expected = "Median time between sightings 125: check that it is in seconds."
    assert range_bearing_steps(driven, seen, **SIGMAS).notes == (expected,)


def test_a_landmark_twice_in_a_frame_is_noted() -> None:
    """Sightings of one landmark at one time are counted, and the first of them named; at other times they are usual."""
    seen = [(10.0, 2.0, 0.0), (10.0, 2.5, 0.1), (10.0, 2.0, 0.4), (10.1, 2.0, 0.0), (11.0, 2.0, 0.0), (11.0, 2.0, 0.0)]
    steps = range_bearing_steps(DRIVEN, seen, ["a", "b", "b", "a", "c", "c"], **SIGMAS)
    expected = (
        "2 sightings of a landmark that its frame has already, of which only the first counts: see b at 10.000 s."
    )
    assert steps.notes == (expected,)
    assert range_bearing_steps(DRIVEN, seen, **SIGMAS).notes == ()


@pytest.mark.parametrize("dt", [0.1, 0.25, 0.3, 0.7, 5.0])
def test_a_truth_of_the_whole_log_is_known_at_all_steps(dt: float) -> None:
    """No step is later than the log, nor earlier by a step than its end."""
    driven = np.column_stack([np.linspace(10.0, 12.0, 21), np.ones(21), np.zeros(21)])
    steps = range_bearing_steps(driven, [(10.0, 2.0, 0.0)], **SIGMAS, dt=dt)
    assert 12.0 - dt < steps.times[-1] <= 12.0
    truth = Trajectory(driven[:, 0], integrate_commands(driven, driven[:, 0]))
    np.testing.assert_allclose(truth.at(steps.times), integrate_commands(driven, steps.times), atol=1e-9)


def test_rows_a_little_back_in_time_are_sorted() -> None:
    """Rows out of order give the steps of rows in order; identities and deviations stay with their sightings."""
    names, seen = [3, 1, 2], [_sighting(t, (4.0, 1.0)) for t in (10.2, 10.6, 11.1)]
    usual = range_bearing_steps(DRIVEN, seen, names, sigma_range=[0.1, 0.2, 0.3], sigma_bearing=0.02, dt=0.2)
    swapped = range_bearing_steps(
        DRIVEN, [seen[1], seen[0], seen[2]], [1, 3, 2], sigma_range=[0.2, 0.1, 0.3], sigma_bearing=0.02, dt=0.2
    )
    assert swapped.notes == ("Sorted by time: sightings (1 row, up to 0.400 s back).",)
    assert usual.notes == ()
    for one, other in zip(usual.measurements, swapped.measurements, strict=True):
        assert (one is None) == (other is None)
        if one is not None and other is not None:
            for name in ("points", "descriptors", "covariances"):
                assert np.array_equal(getattr(one, name), getattr(other, name))


def _file(folder: Path, text: str) -> Path:
    (folder / "log.csv").write_text(text, encoding="utf-8")
    return folder / "log.csv"


def test_columns_come_in_the_order_asked_for(tmp_path: Path) -> None:
    """Columns are found by name; others, empty lines and comments are skipped, blanks around entries do not count."""
    file = _file(tmp_path, "\ufeff# time, name ,x,junk\n1.5, a b ,2,zzz\n\n# no row\n2.5,c,-3e-1,\n")
    table = read_csv(file, ("x", "time"), labels=("name",))
    assert table.numbers.tolist() == [[2.0, 1.5], [-0.3, 2.5]]
    assert table.labels.tolist() == [["a b"], ["c"]]


@pytest.mark.parametrize(
    "text",
    [
        "sep=;\ntime;v\n1;2\n", '"sep=;"\ntime;v\n1;2\n', "# of a robot\n# time in s\n\ntime,v\n1,2\n",
        '# it\'s "so"\ntime,v,note\n1,2,"a, b\n# c"\n', '"time", "v"\n"1", "2"\n', "SEP=;\ntime;v;w\n1;2;0,5\n",
        '# old, names\n# time, v\n1,2\n', "time,v,\n1,2,\n",
    ],
)  # fmt: skip
def test_tables_of_other_programs_are_read(text: str, tmp_path: Path) -> None:
    """Excel's line `sep=`, comments above the names, quotes and line breaks within them leave the numbers alone."""
    assert read_csv(_file(tmp_path, text), ("time", "v")).numbers.tolist() == [[1.0, 2.0]]


@pytest.mark.parametrize("sign", [",", ";", "\t"])
def test_delimiters_are_found(sign: str, tmp_path: Path) -> None:
    """Commas, semicolons and tabs delimit, as the first line shows; labels may be none, and quoted."""
    file = _file(tmp_path, f'time{sign}v\n1{sign}"2"\n')
    assert read_csv(file, ("time", "v")).numbers.tolist() == [[1.0, 2.0]]
    assert read_csv(file, ("v",), delimiter=sign).labels.shape == (1, 0)


def test_kitti_files_give_focal_length_centre_and_baseline(tmp_path: Path) -> None:
    """The baseline is the last column of the right projection over the focal length; names of rows do not matter."""
    for text in (KITTI, KITTI.replace("P0: ", "").replace("P1: ", "")):
        (tmp_path / "calib.txt").write_text(text)
        pair = load_kitti_calibration(tmp_path / "calib.txt")
        assert (pair.focal_px, pair.baseline) == (700.0, 0.5)
        assert pair.centre_px.tolist() == [600.0, 180.0]
    camera = pair.camera(1200, 400, max_range=50.0)
    assert (camera.width, camera.max_range, camera.baseline) == (1200, 50.0, 0.5)


def test_euroc_files_are_read_with_their_remarks(tmp_path: Path) -> None:
    """Lists may run over lines and have remarks between; all numbers are where they belong."""
    (tmp_path / "sensor.yaml").write_text(EUROC)
    eye = load_euroc_camera(tmp_path / "sensor.yaml")
    assert (eye.width, eye.height) == (640, 400)
    assert eye.matrix.tolist() == [[400.5, 0.0, 320.25], [0.0, 401.0, 199.0], [0.0, 0.0, 1.0]]
    assert eye.distortion.tolist() == [-0.3, 0.07, 2e-4, 1.8e-5]
    assert eye.body_from_camera[:3, 3].tolist() == [0.1, 0.2, 0.3]
    assert eye.body_from_camera[1].tolist() == [1.0, 0.0, 0.0, 0.2]


def test_a_rolled_camera_is_rectified() -> None:
    """Rows of a rectified pair agree, and depths are right, though one eye was mounted with a roll of 3 degrees."""
    depth, baseline, roll = 2.0, 0.1, np.radians(3.0)
    left, straight = draw_boxes(320, 240, 0.0), draw_boxes(320, 240, 300.0 * baseline / depth)
    about = cv2.getRotationMatrix2D((159.5, 119.5), np.degrees(roll), 1.0)
    rolled = cv2.warpAffine(straight, about, (320, 240))
    rectifier = Rectifier(eye_at(0.0), eye_at(baseline, roll))
    assert rectifier.pair.baseline == pytest.approx(baseline)
    images = rectifier.rectify(left, rolled)
    points = StereoFrontEnd(rectifier.camera, centre_px=rectifier.pair.centre_px).measure(*images).measurements.points
    body = points @ rectifier.body_from_camera[:3, :3].T + rectifier.body_from_camera[:3, 3]
    assert len(points) > 30
    assert np.median(np.abs(body[:, 2] - depth)) < 0.02
