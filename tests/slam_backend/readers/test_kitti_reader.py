"""The KITTI reader, and trajectories."""

from pathlib import Path

import numpy as np
import pytest
from builders.logs import BASELINE, FOCAL, FRAMES, MOUNT, write_kitti
from hypothesis import given
from hypothesis import strategies as st

from slam_backend.geometry import compose, wrap_angle
from slam_backend.readers.kitti import (
    ABSENT,
    load_kitti,
    make_camera,
    motion_noise,
    planar_motion,
    to_filter_steps,
    track_descriptors,
)
from slam_backend.trajectory import Trajectory, dead_reckoning


def test_frames_hold_the_tracks_they_show(tmp_path: Path) -> None:
    """Absent tracks are left out, the others keep their numbers and four pixels, and there is no truth."""
    log = load_kitti(write_kitti(tmp_path))
    assert [rows.tolist() for rows in log.tracks] == [[], [0, 1, 2], [], [1, 2], []]
    np.testing.assert_allclose(log.pixels[1][0], [687.5, 136.25, 643.75, 136.25])
    assert log.velocities[0].tolist() == [10.0, 0.5, 0.0, 0.0, 0.0, 0.3]
    assert log.truth is None
    assert len(load_kitti(tmp_path, duration=0.15).times) == 2


def test_tracks_repeated_at_the_same_pixels_are_new_tracks(tmp_path: Path) -> None:
    """Only where others begin and all stand, to the last bit; if one moves, or none begins, all keep their numbers."""
    features = np.full((4, 4, FRAMES), ABSENT)
    features[:, :2, :] = 100.0 + np.arange(FRAMES)
    features[:, 2, 2:] = 200.0 + np.arange(2, FRAMES)
    features[:, :2, 2] = features[:, :2, 1]  # the third begins, the others are held
    features[:, :3, 3] = features[:, :3, 2]  # all stand still, and none begins
    features[:, 3, 4] = 300.0
    features[:, :2, 4] = features[:, :2, 3]  # the fourth begins, and two stand still, but the third moves
    log = load_kitti(write_kitti(tmp_path, features=features))
    assert [rows.tolist() for rows in log.tracks] == [[0, 1], [0, 1], [4, 5, 2], [4, 5, 2], [4, 5, 2, 3]]
    features[:, 2, 4] = features[:, 2, 3]
    log = load_kitti(write_kitti(tmp_path, features=features))
    assert log.tracks[4].tolist() == [6, 7, 8, 3]
    np.testing.assert_array_equal(log.pixels[4], features[:, :, 4].T)


def test_true_poses_are_flattened(tmp_path: Path) -> None:
    """Ahead in the image is x, right is -y; a turn to the left is positive. Rows may begin with a time."""
    write_kitti(tmp_path)
    (tmp_path / "poses").mkdir()
    turn = np.array([[np.cos(0.2), 0.0, -np.sin(0.2)], [0.0, 1.0, 0.0], [np.sin(0.2), 0.0, np.cos(0.2)]])
    first, second = np.eye(3, 4), np.column_stack([turn, [-3.0, 0.1, 9.0]])
    file = tmp_path / "poses" / "00.txt"
    for stamps in ([], [0.1]):
        file.write_text("".join(" ".join(map(str, [*stamps, *m.ravel()])) + "\n" for m in (first, second)))
        truth = load_kitti(tmp_path).truth
        assert truth is not None
        np.testing.assert_allclose(truth.poses, [[0.0, 0.0, 0.0], [9.0, 3.0, 0.2]], atol=1e-12)
        np.testing.assert_allclose(truth.times, [100.0, 100.1])


def test_features_become_points_at_the_height_of_the_camera(tmp_path: Path) -> None:
    """Column and disparity give the point in the plane, the row is not used, and far features are dropped."""
    log = load_kitti(write_kitti(tmp_path))
    camera = make_camera(log, 1.0, 0.5)
    frames = to_filter_steps(log, camera).measurements
    assert frames[0] is None
    assert frames[1] is not None
    np.testing.assert_allclose(frames[1].points, [[1.0, 0.0, 8.0], [-2.0, 0.0, 12.0]], atol=1e-9)
    np.testing.assert_array_equal(frames[1].descriptors, track_descriptors(np.array([0, 1])))
    assert camera.mount == pytest.approx(MOUNT)
    assert camera.max_range == pytest.approx(FOCAL * BASELINE * 0.2 / 0.5)


def test_tracks_have_descriptors_of_their_own() -> None:
    """Any two of 5,000 tracks differ by at least 1."""
    found = track_descriptors(np.arange(5000))
    assert len(np.unique(found, axis=0)) == 5000
    assert np.array_equal(found, np.rint(found))


def test_constant_velocities_run_on_a_circle(tmp_path: Path) -> None:
    """Chained motions at constant velocities keep the distance from the centre of the turn."""
    log = load_kitti(write_kitti(tmp_path))
    path = dead_reckoning(np.zeros(3), planar_motion(log)[1:])
    centre = compose(np.zeros(3), np.array([-0.5 / 0.3, 10.0 / 0.3, 0.0]))[:2]
    np.testing.assert_allclose(np.hypot(*(path[:, :2] - centre).T), np.hypot(10.0, 0.5) / 0.3, rtol=1e-4)
    assert path[-1, 2] == pytest.approx(0.3 * 0.4)


def test_white_noise_of_velocities_is_found(tmp_path: Path) -> None:
    """From 4,000 noisy velocities of a car that changes speed, the deviations of their noise are found to 5 %."""
    rng, count = np.random.default_rng(3), 4000
    smooth = 8.0 + 3.0 * np.sin(0.01 * np.arange(count))
    linear = np.stack([smooth, np.zeros(count), np.zeros(count)]) + 0.4 * rng.standard_normal((3, count))
    log = load_kitti(
        write_kitti(
            tmp_path,
            time_stamps=0.1 * np.arange(count),
            features=np.full((4, 1, count), ABSENT),
            linear_velocity=linear,
            rotational_velocity=0.03 * rng.standard_normal((3, count)),
        )
    )
    noise = motion_noise(log)
    assert noise.floor_position == pytest.approx(0.4 * 0.1, rel=0.05)
    assert noise.floor_heading == pytest.approx(0.03 * 0.1, rel=0.05)


def test_interpolation_takes_the_shorter_arc() -> None:
    """Between headings of 170 and -170 degrees lies 180, not 0."""
    path = Trajectory([0.0, 1.0], [[0.0, 0.0, np.deg2rad(170.0)], [2.0, 4.0, np.deg2rad(-170.0)]])
    np.testing.assert_allclose(path.at(0.5), [1.0, 2.0, -np.pi], atol=1e-12)
    np.testing.assert_allclose(path.at(0.75)[2], np.deg2rad(-175.0))


def test_the_ends_of_a_trajectory_hold_for_one_interval() -> None:
    """An end applies beyond it for one usual interval, at most a quarter of a second; later times are refused."""
    for times, reach in (([0.0, 0.1, 0.2], 0.1), ([0.0, 2.0, 4.0], 0.25), ([3.0], 0.0)):
        path = Trajectory(times, [[time, 1.0, 0.5] for time in times])
        begin, end = times[0], times[-1]
        outside = path.at([begin - 0.99 * reach, end + 0.99 * reach])
        np.testing.assert_allclose(outside, [[begin, 1.0, 0.5], [end, 1.0, 0.5]])
        for wrong in (begin - reach - 0.01, end + reach + 0.01, np.nan):
            with pytest.raises(ValueError, match="times: expected times from"):
                path.at(wrong)


def test_interpolation_passes_through_its_poses() -> None:
    """At a recorded time the recorded pose comes back, whatever the shape of the question."""
    times, poses = np.array([1.0, 1.5, 4.0, 4.1]), np.arange(12.0).reshape(4, 3) / 4.0
    path = Trajectory(times, poses)
    expected = np.column_stack([poses[:, :2], wrap_angle(poses[:, 2])])
    np.testing.assert_allclose(path.at(times), expected, atol=1e-12)
    assert path.at(times.reshape(2, 2)).shape == (2, 2, 3)
    assert Trajectory([3.0], [[1.0, 2.0, 0.5]]).at([3.0]).tolist() == [[1.0, 2.0, 0.5]]


floats = st.floats(-1e4, 1e4)


@given(rows=st.lists(st.tuples(st.floats(0.0, 1e9), floats, floats, st.floats(-3.14, 3.14)), min_size=1, max_size=6))
def test_tum_files_keep_every_digit(rows: list[tuple[float, ...]], tmp_path_factory: pytest.TempPathFactory) -> None:
    """Saved times and positions come back bit for bit, headings to rounding."""
    table = np.array(rows)[np.unique(np.array(rows)[:, 0], return_index=True)[1]]
    path = Trajectory(table[:, 0], table[:, 1:])
    file = tmp_path_factory.mktemp("tum") / "path.txt"
    path.save_tum(file)
    again = Trajectory.load_tum(file)
    np.testing.assert_array_equal(again.times, path.times)
    np.testing.assert_array_equal(again.poses[:, :2], path.poses[:, :2])
    np.testing.assert_allclose(again.poses[:, 2], path.poses[:, 2], atol=1e-15, rtol=0.0)


def test_tum_lines_are_the_published_format(tmp_path: Path) -> None:
    """A line is `time tx ty tz qx qy qz qw`; comments and empty lines are skipped."""
    file = tmp_path / "path.txt"
    Trajectory([0.5], [[1.0, -2.0, np.pi / 2]]).save_tum(file)
    header, line = file.read_text().splitlines()
    assert header.startswith("#")
    np.testing.assert_allclose([float(w) for w in line.split()], [0.5, 1, -2, 0, 0, 0, 0.5**0.5, 0.5**0.5])
    file.write_text(f"# a comment\n\n{line}\n")
    np.testing.assert_allclose(Trajectory.load_tum(file).poses, [[1.0, -2.0, np.pi / 2]])


def test_dead_reckoning_composes_step_by_step() -> None:
    """The closed form equals composing one reading after the other."""
    rng = np.random.default_rng(4)
    start, odometry = np.array([3.0, -1.0, 2.5]), rng.normal(size=(11, 3))
    poses = [start]
    for motion in odometry:
        poses.append(compose(poses[-1], motion))
    np.testing.assert_allclose(dead_reckoning(start, odometry), poses, atol=1e-12)
    assert dead_reckoning(start, np.empty((0, 3))).shape == (1, 3)
