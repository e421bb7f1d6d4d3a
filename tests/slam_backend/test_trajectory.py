import contextlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slam_backend.geometry import compose, wrap_angle
from slam_backend.trajectory import Trajectory, dead_reckoning


def test_interpolation_takes_the_shorter_arc() -> None:
    """Between headings of 170 and -170 degrees lies 180, not 0."""
    path = Trajectory([0.0, 1.0], [[0.0, 0.0, np.deg2rad(170.0)], [2.0, 4.0, np.deg2rad(-170.0)]])
    np.testing.assert_allclose(path.at(0.5), [1.0, 2.0, -np.pi], atol=1e-12)
    np.testing.assert_allclose(path.at(0.75)[2], np.deg2rad(-175.0))


def test_interpolation_passes_through_its_poses() -> None:
    """At a recorded time the recorded pose comes back, whatever the shape of the question."""
    times, poses = np.array([1.0, 1.5, 4.0, 4.1]), np.arange(12.0).reshape(4, 3) / 4.0
    path = Trajectory(times, poses)
    expected = np.column_stack([poses[:, :2], wrap_angle(poses[:, 2])])
    np.testing.assert_allclose(path.at(times), expected, atol=1e-12)
    assert path.at(times.reshape(2, 2)).shape == (2, 2, 3)
    assert Trajectory([3.0], [[1.0, 2.0, 0.5]]).at([3.0]).tolist() == [[1.0, 2.0, 0.5]]


@pytest.mark.parametrize("time", [0.99, 4.2, float("nan")])
def test_nothing_is_extrapolated(time: float) -> None:
    """A time outside the recorded range is an error that names the range."""
    path = Trajectory([1.0, 4.0], np.zeros((2, 3)))
    with pytest.raises(ValueError, match=r"times: expected times from 1.000000 s to 4.000000 s, got .*Cut the times"):
        path.at([2.0, time])


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


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0 1 2 3\n", r"8 finite numbers .* got '0 1 2 3'.*line 1"),
        ("0 0 0 0 0 0 0 1\n1 0 x 0 0 0 0 1\n", "got '1 0 x 0 0 0 0 1'.*line 2"),
        ("0 0 nan 0 0 0 0 1\n", "8 finite numbers"),
        ("0 0 0 0 0 0 0 0\n", "a unit quaternion"),
        ("0 0 0 0 0.6 0 0 0.8\n", "a rotation about the vertical"),
        ("1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "strictly increasing times"),
        ("# nothing\n", "at least one time"),
    ],
)
def test_malformed_tum_files_are_refused(tmp_path: Path, text: str, message: str) -> None:
    """Each kind of wrong line gives one error that shows the line and where it stands."""
    file = tmp_path / "path.txt"
    file.write_text(text)
    with pytest.raises(ValueError, match=message):
        Trajectory.load_tum(file)


def test_a_missing_tum_file_is_named(tmp_path: Path) -> None:
    """A missing file is a clear error with its path."""
    with pytest.raises(ValueError, match=r"no such file. Check the path .*gone.txt"):
        Trajectory.load_tum(tmp_path / "gone.txt")


@given(text=st.text(alphabet="0123456789 .-e#\nx", max_size=60))
def test_no_text_breaks_the_tum_parser(text: str, tmp_path_factory: pytest.TempPathFactory) -> None:
    """Whatever the file holds, the parser returns a trajectory or raises ValueError."""
    file = tmp_path_factory.mktemp("fuzz") / "path.txt"
    file.write_text(text)
    with contextlib.suppress(ValueError):
        assert len(Trajectory.load_tum(file)) >= 1


def test_trajectories_refuse_bad_input() -> None:
    """Times that stand still, shapes that disagree and missing numbers are refused."""
    with pytest.raises(ValueError, match=r"strictly increasing times, got .* at index 2"):
        Trajectory([0.0, 1.0, 1.0], np.zeros((3, 3)))
    with pytest.raises(ValueError, match=r"poses: expected an array of shape \(2, 3\)"):
        Trajectory([0.0, 1.0], np.zeros((3, 3)))
    with pytest.raises(ValueError, match="poses: expected finite numbers"):
        Trajectory([0.0], [[0.0, np.nan, 0.0]])


def test_dead_reckoning_composes_step_by_step() -> None:
    """The closed form equals composing one reading after the other."""
    rng = np.random.default_rng(4)
    start, odometry = np.array([3.0, -1.0, 2.5]), rng.normal(size=(11, 3))
    poses = [start]
    for motion in odometry:
        poses.append(compose(poses[-1], motion))
    np.testing.assert_allclose(dead_reckoning(start, odometry), poses, atol=1e-12)
    assert dead_reckoning(start, np.empty((0, 3))).shape == (1, 3)
    with pytest.raises(ValueError, match=r"odometry: expected an array of shape \(n, 3\)"):
        dead_reckoning(start, np.zeros((4, 2)))
