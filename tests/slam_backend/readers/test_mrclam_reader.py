from pathlib import Path

import numpy as np
import pytest
from builders.logs import write_mrclam
from hypothesis import given
from hypothesis import strategies as st

from slam_backend.geometry import between, compose
from slam_backend.metrics import ate
from slam_backend.models.camera import StereoCamera
from slam_backend.readers.conversions import HOLD, integrate_commands
from slam_backend.readers.mrclam import MrclamLog, MrclamRobot, SightingNoise, load_mrclam, to_filter_steps
from slam_backend.trajectory import dead_reckoning


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A log of two robots and three landmarks."""
    write_mrclam(tmp_path)
    return tmp_path


def test_log_agrees_with_the_files(folder: Path) -> None:
    """Landmarks are sorted by subject; sightings of robots and of unknown barcodes are left out."""
    log = load_mrclam(folder)
    assert [own.robot for own in log.robots] == [2, 4]
    assert log.subjects.tolist() == [6, 7, 9]
    assert log.positions.tolist() == [[0.5, -4.0], [1.5, 2.5], [-3.0, 0.25]]
    assert log.robots[0].commands.shape == (3, 3)
    assert log.robots[0].sightings.tolist() == [[100.1, 6.0, 2.0, 0.1], [101.5, 9.0, 3.0, -0.2]]
    assert log.robots[1].sightings.shape == (0, 4)
    assert log.robots[0].truth is not None
    assert len(log.robots[0].truth) == 2  # the repeated stamp is dropped
    assert log.robots[1].truth is None
    with pytest.raises(ValueError, match="read-only"):
        log.positions[0, 0] = 1.0


def test_duration_counts_from_the_earliest_command(folder: Path) -> None:
    """Readings later than the duration are dropped; a robot that has not started keeps its first command."""
    log = load_mrclam(folder, robots=(4, 2), duration=0.4)
    assert [own.robot for own in log.robots] == [4, 2]
    assert [len(own.commands) for own in log.robots] == [1, 1]
    assert log.robots[1].sightings[:, 1].tolist() == [6.0]


def test_rows_a_little_back_in_time_are_sorted(folder: Path) -> None:
    """Rows of all files are put in order of time, those of one time as in the file, and one line says which."""
    swapped = "100.0 0.5 0.0\n101.0 0.5 0.2\n100.9 0.4 0.1\n101.0 0.0 0.3\n"
    (folder / "Robot2_Odometry.dat").write_text(swapped)
    (folder / "Robot2_Measurement.dat").write_text("100.2 63 2.0 0.1\n100.1 63 2.1 0.1\n100.1 81 1.0 0.0\n")
    (folder / "Robot2_Groundtruth.dat").write_text("100.0 0 0 0.5\n100.5 1 0 0\n100.4 2 0 0\n100.5 3 0 0\n")
    log = load_mrclam(folder)
    own = log.robots[0]
    assert own.commands[:, 0].tolist() == [100.0, 100.9, 101.0, 101.0]
    assert own.commands[-1].tolist() == [101.0, 0.0, 0.3]  # holds from then on
    assert own.sightings[:, :3].tolist() == [[100.1, 6.0, 2.1], [100.1, 7.0, 1.0], [100.2, 6.0, 2.0]]
    assert own.truth is not None
    assert own.truth.poses[:, 0].tolist() == [0.0, 2.0, 1.0]  # the first of two poses of one time
    assert log.notes == (
        "Sorted by time: Robot2_Odometry.dat (1 row, up to 0.100 s back), Robot2_Measurement.dat (2 rows, up to 0.100 s"
        " back), Robot2_Groundtruth.dat (1 row, up to 0.100 s back).",
    )


def test_a_log_without_truth_is_read(folder: Path) -> None:
    """Without files of the truth positions and poses are None; a log in order has no notes."""
    assert load_mrclam(folder).notes == ()
    for file in folder.glob("*Groundtruth.dat"):
        file.unlink()
    log = load_mrclam(folder)
    assert log.positions is None
    assert all(robot.truth is None for robot in log.robots)
    assert log.subjects.tolist() == [6, 7, 9]


def test_readings_after_the_odometry_are_pointed_out(folder: Path) -> None:
    """True poses or sightings that do not overlap the odometry in time get a line each."""
    (folder / "Robot2_Groundtruth.dat").write_text("999.0 0 0 0.5\n")
    (folder / "Robot2_Measurement.dat").write_text("200.0 63 2.0 0.1\n")
    notes = load_mrclam(folder, (2,)).notes
    assert [note.split(" (")[0] for note in notes] == [
        "Robot 2: no overlap of its sightings",
        "Robot 2: no overlap of its true poses",
    ]


rows = st.lists(
    st.tuples(st.floats(0.01, 2.0), st.floats(-0.5, 0.5), st.floats(-1.0, 1.0)), min_size=1, max_size=7
)  # (seconds since the command before, v, omega)


def _commands(drawn: list[tuple[float, float, float]]) -> np.ndarray:
    table = np.array(drawn)
    table[:, 0] = np.cumsum(table[:, 0])
    return table


@given(rows, st.lists(st.floats(0.0, 20.0), min_size=2, max_size=6))
def test_odometry_adds_up_whatever_the_steps(drawn: list[tuple[float, float, float]], times: list[float]) -> None:
    """Motions between any times, chained, lead where the whole motion leads."""
    commands, times = _commands(drawn), sorted(times)
    path = integrate_commands(commands, times)
    chained = dead_reckoning(path[0], between(path[:-1], path[1:]))
    np.testing.assert_allclose(between(chained[-1], path[-1]), 0.0, atol=1e-9)


@given(rows, st.floats(0.0, 15.0))
def test_arcs_are_those_of_many_small_steps(drawn: list[tuple[float, float, float]], time: float) -> None:
    """The closed-form arc equals Euler's method in the limit; a command holds no longer than `HOLD`."""
    commands = _commands(drawn)
    moments = np.linspace(0.0, time, 20_001)
    middle = 0.5 * (moments[1:] + moments[:-1])
    row = np.searchsorted(commands[:, 0], middle, side="right") - 1
    active = (row >= 0) & (middle - commands[np.maximum(row, 0), 0] < HOLD)
    v = np.where(active, commands[np.maximum(row, 0), 1], 0.0) * np.diff(moments)
    w = np.where(active, commands[np.maximum(row, 0), 2], 0.0) * np.diff(moments)
    heading = np.cumsum(w) - 0.5 * w
    euler = [np.sum(v * np.cos(heading)), np.sum(v * np.sin(heading)), np.sum(w)]
    error = between(integrate_commands(commands, [time])[0], euler)
    np.testing.assert_allclose(error, 0.0, atol=2e-2)  # at each command one small step is cut anywhere


def _log(sightings: list[tuple[float, int, float, float]], commands: list[list[float]]) -> MrclamLog:
    robot = MrclamRobot(3, np.array(commands), np.array(sightings).reshape(-1, 4), None)
    return MrclamLog((robot,), np.array([6, 7, 9]), np.zeros((3, 2)))


def test_sightings_become_points_of_the_camera() -> None:
    """Zc = r cos b, Xc = -r sin b, Yc = 0, so that the camera model puts the landmark where it stands."""
    frame = (
        to_filter_steps(_log([(0.0, 7, 2.0, 0.5), (0.0, 9, 3.0, -0.25)], [[0.0, 0.0, 0.0]])).robots[0].measurements[0]
    )
    assert frame is not None
    np.testing.assert_allclose(frame.points[0], [-2.0 * np.sin(0.5), 0.0, 2.0 * np.cos(0.5)], atol=1e-12)
    robot = StereoCamera().robot_from_camera(frame.points)
    np.testing.assert_allclose(robot[1], [3.0 * np.cos(0.25), -3.0 * np.sin(0.25), 0.0], atol=1e-12)
    assert frame.descriptors.tolist() == [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]


def test_covariance_is_that_of_drawn_sightings() -> None:
    """The Jacobian carries range and bearing noise to the camera frame: 200,000 draws agree within 3 %."""
    noise = SightingNoise(range_floor=0.03, range_share=0.01, bearing=0.015, height=0.05)
    frame = to_filter_steps(_log([(0.0, 7, 4.0, 0.6)], [[0.0, 0.0, 0.0]]), noise=noise).robots[0].measurements[0]
    assert frame is not None
    assert frame.covariances is not None
    rng = np.random.default_rng(5)
    r = 4.0 + np.hypot(0.03, 0.04) * rng.standard_normal(200_000)
    b = 0.6 + 0.015 * rng.standard_normal(200_000)
    drawn = np.stack([-r * np.sin(b), 0.05 * rng.standard_normal(200_000), r * np.cos(b)])
    np.testing.assert_allclose(frame.covariances[0], np.cov(drawn), atol=0.03 * np.cov(drawn).max())


def test_a_sighting_is_moved_to_its_step_by_the_odometry() -> None:
    """A landmark seen between two steps is where the robot of the nearest step would have seen it."""
    commands = [[0.0, 0.5, 0.8], [1.0, 0.5, 0.8]]
    landmark = np.array([3.0, 1.0])
    seen = []
    for time in (0.31, 0.62, 1.44):
        pose = integrate_commands(commands, [time])[0]
        relative = between(pose, [*landmark, 0.0])[:2]
        seen.append((time, 7, float(np.hypot(*relative)), float(np.arctan2(relative[1], relative[0]))))
    log = _log(seen, commands)
    readings = to_filter_steps(log, dt=0.5)
    found = [k for k, frame in enumerate(readings.robots[0].measurements) if frame is not None]
    assert found == [1, 3]  # the first two share a step, where one landmark counts once
    path = dead_reckoning(np.zeros(3), readings.robots[0].odometry[1:])
    for k in found:
        frame = readings.robots[0].measurements[k]
        assert frame is not None
        point = compose(path[k], [frame.points[0, 2], -frame.points[0, 0], 0.0])[:2]
        np.testing.assert_allclose(point, landmark, atol=1e-9)


def test_the_first_of_two_sightings_of_a_landmark_in_a_step_counts() -> None:
    """Repeated sightings in a step are not independent: the earliest is kept, other landmarks stay."""
    log = _log([(0.0, 7, 2.0, 0.0), (0.05, 7, 2.5, 0.0), (0.05, 6, 1.0, 0.0)], [[0.0, 0.0, 0.0]])
    frame = to_filter_steps(log, dt=0.2).robots[0].measurements[0]
    assert frame is not None
    assert frame.points[:, 2].tolist() == [1.0, 2.0]


@pytest.mark.slow
def test_dead_reckoning_of_the_real_log_has_the_known_errors(data_dir: Path) -> None:
    """From the true start poses the five robots' odometry is off by 4.0, 2.0, 2.9, 3.0 and 2.9 m RMS."""
    log = load_mrclam(data_dir / "mrclam" / "MRCLAM_Dataset7")
    assert [len(own.sightings) for own in log.robots] == [2578, 3818, 4425, 1822, 3424]
    readings = to_filter_steps(log)
    errors = []
    for own, stepped in zip(log.robots, readings.robots, strict=True):
        assert own.truth is not None
        known = readings.times <= own.truth.times[-1]
        true = own.truth.at(readings.times[known])
        path = dead_reckoning(true[0], stepped.odometry[1:])[known]
        errors.append(ate(path, true).start)
    np.testing.assert_allclose(errors, [4.09, 2.05, 3.02, 2.90, 2.98], atol=0.16)
