from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slam_backend.geometry import compose
from slam_backend.models.camera import ROBOT_FROM_CAMERA
from slam_backend.readers.kitti import (
    ABSENT,
    load_kitti,
    make_camera,
    motion_noise,
    planar_motion,
    steps,
    track_descriptors,
)
from slam_backend.trajectory import dead_reckoning

FOCAL, CENTRE, BASELINE, MOUNT = 700.0, (600.0, 180.0), 0.5, (1.1, -0.3, 0.7)
FRAMES, TRACKS = 5, 3
POINTS = np.array([[1.0, -0.5, 8.0], [-2.0, 1.0, 12.0], [0.5, 0.0, 400.0]])  # camera frame; the last one is too far


def _content(**changes: Any) -> dict[str, Any]:
    """Return an archive of a camera that looks ahead at three points from one place; `changes` replace arrays."""
    features = np.full((4, TRACKS, FRAMES), ABSENT)
    left = CENTRE[0] + FOCAL * POINTS[:, 0] / POINTS[:, 2]
    row = CENTRE[1] + FOCAL * POINTS[:, 1] / POINTS[:, 2]
    features[:, :, 1] = [left, row, left - FOCAL * BASELINE / POINTS[:, 2], row]
    features[:, 1:, 3] = features[:, 1:, 1]
    camera_from_unit = np.eye(4)
    camera_from_unit[:3, :3] = ROBOT_FROM_CAMERA.T
    camera_from_unit[:3, 3] = MOUNT
    content = {
        "time_stamps": 100.0 + 0.1 * np.arange(FRAMES)[None],
        "features": features,
        "linear_velocity": np.tile([[10.0], [0.5], [0.0]], FRAMES),
        "rotational_velocity": np.tile([[0.0], [0.0], [0.3]], FRAMES),
        "K": np.array([[FOCAL, 0.0, CENTRE[0]], [0.0, FOCAL, CENTRE[1]], [0.0, 0.0, 1.0]]),
        "b": np.array(BASELINE),
        "cam_T_imu": camera_from_unit,
    }
    return {name: value for name, value in (content | changes).items() if value is not None}


def _write(folder: Path, **changes: Any) -> Path:
    np.savez(folder / "drive.npz", **_content(**changes))
    return folder / "drive.npz"


def test_frames_hold_the_tracks_they_show(tmp_path: Path) -> None:
    """Absent tracks are left out, the others keep their numbers and four pixels, and there is no truth."""
    log = load_kitti(_write(tmp_path))
    assert [rows.tolist() for rows in log.tracks] == [[], [0, 1, 2], [], [1, 2], []]
    np.testing.assert_allclose(log.pixels[1][0], [687.5, 136.25, 643.75, 136.25])
    assert log.velocities[0].tolist() == [10.0, 0.5, 0.0, 0.0, 0.0, 0.3]
    assert log.truth is None
    assert len(load_kitti(tmp_path, duration=0.15).times) == 2


def test_tracks_that_were_held_where_they_stood_are_new_ones(tmp_path: Path) -> None:
    """Only where others begin and all stand, to the last bit; if one moves, or none begins, all keep their numbers."""
    features = np.full((4, 4, FRAMES), ABSENT)
    features[:, :2, :] = 100.0 + np.arange(FRAMES)
    features[:, 2, 2:] = 200.0 + np.arange(2, FRAMES)
    features[:, :2, 2] = features[:, :2, 1]  # the third begins, the others are held
    features[:, :3, 3] = features[:, :3, 2]  # all stand still, and none begins
    features[:, 3, 4] = 300.0
    features[:, :2, 4] = features[:, :2, 3]  # the fourth begins, and two stand still, but the third moves
    log = load_kitti(_write(tmp_path, features=features))
    assert [rows.tolist() for rows in log.tracks] == [[0, 1], [0, 1], [4, 5, 2], [4, 5, 2], [4, 5, 2, 3]]
    features[:, 2, 4] = features[:, 2, 3]
    log = load_kitti(_write(tmp_path, features=features))
    assert log.tracks[4].tolist() == [6, 7, 8, 3]
    np.testing.assert_array_equal(log.pixels[4], features[:, :, 4].T)


def test_true_poses_are_flattened(tmp_path: Path) -> None:
    """Ahead in the image is x, right is -y; a turn to the left is positive. Rows may begin with a time."""
    _write(tmp_path)
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
    file.write_text("1 2 3\n4 5 6\n")
    with pytest.raises(ValueError, match=r"truth: expected 00\.txt with rows of 12 numbers.*got an array \(2, 3\)"):
        load_kitti(tmp_path)
    with pytest.raises(ValueError, match="truth: expected a file of true poses, got no such file"):
        load_kitti(tmp_path, tmp_path / "none.txt")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"b": None}, "path: expected drive.npz with the arrays .*, got no array 'b'"),
        ({"b": np.array(-0.5)}, "drive.npz with a positive distance in 'b'"),
        ({"time_stamps": np.array([[1.0, 2.0, 3.0, 2.5, 4.0]])}, "two or more rising times in 'time_stamps'"),
        ({"features": np.zeros((4, 3, 6))}, r"an array \(4, n, 5\), four pixels of each track .* in 'features'"),
        ({"linear_velocity": np.zeros((3, 4))}, r"an array \(3, 5\) in 'linear_velocity'"),
        ({"rotational_velocity": np.full((3, 5), np.inf)}, "finite numbers in 'rotational_velocity'"),
        ({"K": np.diag([700.0, 500.0, 1.0])}, "a 3 x 3 matrix of square pixels in 'K'"),
        ({"cam_T_imu": np.ones((4, 4))}, "a 4 x 4 rigid motion in 'cam_T_imu'"),
    ],
)
def test_broken_arrays_are_named(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    """Missing, ill-shaped and impossible arrays are refused by file and name."""
    with pytest.raises(ValueError, match=message):
        load_kitti(_write(tmp_path, **changes))


def test_missing_and_damaged_archives_are_named(tmp_path: Path) -> None:
    """No archive, two of them, a cut one, and one that holds objects."""
    expected = "path: expected an archive .* or a folder with one, got "
    with pytest.raises(ValueError, match=expected + "a folder with 0 of them"):
        load_kitti(tmp_path)
    file = _write(tmp_path)
    (tmp_path / "other.npz").write_bytes(file.read_bytes()[:300])
    with pytest.raises(ValueError, match=expected + "a folder with 2 of them"):
        load_kitti(tmp_path)
    with pytest.raises(ValueError, match=expected + "no such file"):
        load_kitti(tmp_path / "none.npz")
    with pytest.raises(ValueError, match="path: expected a numpy archive, got a broken file"):
        load_kitti(tmp_path / "other.npz")
    np.savez(file, **_content(b=np.array([{"b": 1}], dtype=object)))
    with pytest.raises(ValueError, match="path: expected a numpy archive, got a broken file"):
        load_kitti(file)


def test_features_become_points_at_the_height_of_the_camera(tmp_path: Path) -> None:
    """Column and disparity give the point in the plane, the row is not used, and far features are dropped."""
    log = load_kitti(_write(tmp_path))
    camera = make_camera(log, 1.0, 0.5)
    frames = steps(log, camera).measurements
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
    log = load_kitti(_write(tmp_path))
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
        _write(
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
