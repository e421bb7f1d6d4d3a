"""Reader of tracked stereo features and velocities of a KITTI drive.

The archive, of UCSD's course ECE 276A, is an extract of KITTI raw data (Geiger et al., IJRR 2013) with features tracked
from frame to frame, so that a track's number is a landmark's identity. A track that ends is never resumed.

In frames with new features, 91 of the 1,106 frames of `0027.npz`, the archive repeats the pixels of all old tracks from
the previous frame although the car moved. The tracker continues from that pixel, which now shows another point of the
world. The reader therefore starts a new track there.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slam_backend.core.array_files import read_arrays
from slam_backend.core.files import checked_path
from slam_backend.core.short_repr import short_repr
from slam_backend.core.text_files import data_lines, existing_file, line_error, parse_numbers, read_text
from slam_backend.core.validation import FloatArray, IntArray, argument_error, check_float
from slam_backend.models.camera import ROBOT_FROM_CAMERA, StereoCamera
from slam_backend.models.measurements import Measurements
from slam_backend.models.odometry import OdometryModel
from slam_backend.trajectory import Trajectory

KEYS = ("time_stamps", "features", "linear_velocity", "rotational_velocity", "K", "b", "cam_T_imu")
ABSENT = -1.0  # pixels of a track in frames that do not show it


@short_repr
@dataclass(frozen=True, slots=True, eq=False)
class KittiLog:
    """Log of a car with a stereo pair and an inertial unit. The arrays are read-only.

    Attributes:
        times: (T,) float64 [s]. Times of the frames, strictly increasing.
        velocities: (T, 6) float64 [m/s, rad/s]. Linear, then angular velocity, axes of the unit: ahead, left, up.
        tracks: T arrays (n,) int64. Numbers of the tracks in each frame: rows of the archive, and higher numbers for
            the continuation of a repeated track, see `number_tracks`.
        pixels: T arrays (n, 4) float64 [px]. Columns and rows of the tracks in the left image, then in the right one.
        focal_px: Focal length [px]; pixels are square.
        centre_px: (2,) float64 [px]. Column and row of the optical axis.
        baseline: Distance between the two cameras [m].
        unit_from_camera: (3, 3) float64. Rotation from the camera's axes (right, down, ahead) to the unit's.
        mount: (3,) float64 [m]. Position of the left camera, axes of the unit.
        truth: Poses of the left camera in the plane of its first pose, x ahead, y left; None if unknown.
    """

    times: FloatArray
    velocities: FloatArray
    tracks: tuple[IntArray, ...]
    pixels: tuple[FloatArray, ...]
    focal_px: float
    centre_px: FloatArray
    baseline: float
    unit_from_camera: FloatArray
    mount: FloatArray
    truth: Trajectory | None


def load_kitti(path: str | Path, truth: str | Path | None = None, duration: float | None = None) -> KittiLog:
    """Read an archive such as `0027.npz`.

    The translation in `cam_T_imu` is interpreted as the camera's position in the axes of the unit, (1.14, -0.31,
    0.73) m in `0027.npz`: this agrees with the mounting on KITTI's cars and with the motion in turns. In the sense of
    the name the camera would be behind the unit.

    Args:
        path: Archive, or a folder with a single archive.
        truth: File of the true poses, one per frame: rows of a 3 x 4 matrix, optionally after a time. None: the only
            file in the folder `poses` beside the archive, if any.
        duration: Length of the log [s]. None: the whole log.

    Raises:
        ValueError: If a file is missing or cannot be read, an array is missing or has a wrong shape or impossible
            numbers, or times go back; the message names the file.
    """
    file = _find(checked_path(path))
    content = _read(file)
    times = np.asarray(content["time_stamps"], dtype=np.float64).ravel()
    _check(file, "time_stamps", len(times) > 1 and bool((np.diff(times) > 0.0).all()), "two or more rising times")
    end = times[-1] if duration is None else times[0] + check_float("duration", duration, "Give seconds.", above=0.0)
    count = len(times)
    features = content["features"]
    shaped = features.ndim == 3 and features.shape[0] == 4 and features.shape[2] == count
    _check(file, "features", shaped, f"an array (4, n, {count}), four pixels of each track in each frame")
    for name in ("linear_velocity", "rotational_velocity"):
        _check(file, name, content[name].shape == (3, count), f"an array (3, {count})")
    intrinsics, baseline, camera = content["K"], content["b"], content["cam_T_imu"]
    square = intrinsics.shape == (3, 3) and np.isclose(intrinsics[0, 0], intrinsics[1, 1], rtol=0.01)
    _check(file, "K", square and intrinsics[0, 0] > 0.0, "a 3 x 3 matrix of square pixels")
    _check(file, "b", baseline.size == 1 and float(baseline.ravel()[0]) > 0.0, "a positive distance")
    rigid = camera.shape == (4, 4) and np.allclose(camera[:3, :3] @ camera[:3, :3].T, np.eye(3), atol=1e-3)
    _check(file, "cam_T_imu", rigid, "a 4 x 4 rigid motion")
    keep = int(np.searchsorted(times, end, side="right"))
    shown = [np.flatnonzero((features[:, :, k] != ABSENT).all(axis=0)) for k in range(keep)]
    tracks = number_tracks(features, shown)
    velocities = np.concatenate([content["linear_velocity"], content["rotational_velocity"]]).T[:keep].copy()
    pixels = [features[:, rows, k].T.copy() for k, rows in enumerate(shown)]
    for array in (times, velocities, *tracks, *pixels):
        array.setflags(write=False)
    return KittiLog(
        times=times[:keep],
        velocities=velocities,
        tracks=tuple(tracks),
        pixels=tuple(pixels),
        focal_px=float(intrinsics[0, 0]),
        centre_px=intrinsics[:2, 2].copy(),
        baseline=float(baseline.ravel()[0]),
        unit_from_camera=camera[:3, :3].T.copy(),
        mount=camera[:3, 3].copy(),
        truth=None if (poses := _find_truth(file, truth)) is None else read_truth(poses, times),
    )


def number_tracks(features: FloatArray, shown: Sequence[IntArray]) -> list[IntArray]:
    """Return the numbers of the tracks in each frame, with new numbers for repeated ones.

    Tracks are repeated in a frame that starts new ones and has all tracks shared with the previous frame at exactly the
    same pixels.

    Args:
        features: (4, m, T) float64 [px]. Pixels of each track in each frame.
        shown: Tracks (n,) in each frame.
    """
    numbers, free = np.arange(features.shape[1]), features.shape[1]
    result: list[IntArray] = []
    for frame, rows in enumerate(shown):
        old = np.intersect1d(shown[frame - 1], rows) if frame else rows
        if 0 < len(old) < len(rows) and np.array_equal(features[:, old, frame - 1], features[:, old, frame]):
            numbers[old] = np.arange(free, free + len(old))
            free += len(old)
        result.append(numbers[rows])
    return result


def _find(path: Path) -> Path:
    """Return the archive at a path, or the only one in a folder."""
    found = sorted(path.glob("*.npz")) if path.is_dir() else [path]
    if len(found) != 1 or not found[0].is_file():
        got = f"a folder with {len(found)} archives" if path.is_dir() else "no such file"
        expected = "an archive (.npz) of KITTI features, or a folder with one"
        raise argument_error("path", expected, got, f"Check {str(path)!r}.")
    return found[0]


def _find_truth(file: Path, truth: str | Path | None) -> Path | None:
    """Return the file of true poses, if any."""
    if truth is None:
        found = sorted((file.parent / "poses").glob("*.txt"))
        return found[0] if len(found) == 1 else None
    return existing_file(truth, "truth", "a file of true poses")


def _read(file: Path) -> dict[str, FloatArray]:
    """Return the arrays of the archive, all with finite numbers."""
    try:
        archive = read_arrays(file, KEYS)
        missing = [key for key in KEYS if key not in archive]
        content = {} if missing else {key: np.asarray(archive[key], dtype=np.float64) for key in KEYS}
    except ValueError as error:
        raise argument_error("path", "a numpy archive", "a broken file", f"Get {str(file)!r} again.") from error
    if missing:
        expected = f"{file.name} with the arrays {', '.join(KEYS)}"
        raise argument_error("path", expected, f"no array {missing[0]!r}", f"Get {str(file)!r} again.")
    for key, values in content.items():
        _check(file, key, bool(np.isfinite(values).all()), "finite numbers")
    return content


def read_truth(file: Path, times: FloatArray) -> Trajectory:
    """Return the true path in the plane: KITTI's z is ahead, its x to the right; the heading is that of the z axis.

    Args:
        file: File with one row per frame of a 3 x 4 matrix, optionally after a time; later frames may be missing.
        times: (T,) float64 [s]. Times of the frames.

    Raises:
        ValueError: If the file has another format.
    """
    rows: list[list[float]] = []
    for number, line in data_lines(read_text(file, "truth", "a file of true poses")):
        row = parse_numbers(line.split())
        if row is None or len(row) not in (12, 13) or not np.isfinite(row).all():
            raise line_error("truth", "12 finite numbers, or 13 with a time", line, file, number)
        rows.append(row[-12:])
    if not 1 < len(rows) <= len(times):
        expected = f"{file.name} with a row for each of {len(times)} frames"
        raise argument_error("truth", expected, f"a file of {len(rows)}", f"Check {str(file)!r}.")
    matrices = np.array(rows).reshape(-1, 3, 4)
    heading = np.arctan2(-matrices[:, 0, 2], matrices[:, 2, 2])
    return Trajectory(times[: len(rows)], np.stack([matrices[:, 2, 3], -matrices[:, 0, 3], heading], axis=-1))


def _check(file: Path, key: str, fine: bool, expected: str) -> None:
    """Raise unless an entry of a file is valid."""
    if not fine:
        hint = f"Get {str(file)!r} again."
        raise argument_error("path", f"{file.name} with {expected} in {key!r}", "a different one", hint)


DIGITS = 32  # base of the three digits of a track's number that form its unique descriptor
MAD = 1.4826  # ratio of standard deviation to median absolute deviation of a Gaussian
DEPTHS_KNOWN_TO = 0.2  # largest relative error of depths; beyond it the error of a point is not Gaussian


@short_repr
@dataclass(frozen=True, slots=True, eq=False)
class KittiSteps:
    """Drive as steps at the times of its frames.

    Attributes:
        times: (T,) float64 [s].
        odometry: (T, 3) float64 [m, m, rad]. Motion of the inertial unit since the previous step; the first is zero.
        measurements: T entries; None for a frame without near tracks. All points are at the camera's height, with
            descriptors from `track_descriptors`.
    """

    times: FloatArray
    odometry: FloatArray
    measurements: tuple[Measurements | None, ...]


def make_camera(log: KittiLog, sigma_px: float, sigma_disparity_px: float) -> StereoCamera:
    """Return the log's stereo pair with the given standard deviations [px], at its place on the car."""
    width, height = (int(np.ceil(2.0 * value)) for value in log.centre_px)
    return StereoCamera(
        focal_px=log.focal_px,
        baseline=log.baseline,
        width=width,
        height=height,
        max_range=log.focal_px * log.baseline * DEPTHS_KNOWN_TO / sigma_disparity_px,
        mount=(float(log.mount[0]), float(log.mount[1]), float(log.mount[2])),
        sigma_px=sigma_px,
        sigma_disparity_px=sigma_disparity_px,
    )


def to_filter_steps(log: KittiLog, camera: StereoCamera) -> KittiSteps:
    """Convert a drive to planar odometry and measurements.

    The filter assumes planar motion, while a car pitches and rolls by degrees, which shifts image rows by tens of
    pixels and columns hardly at all. Therefore rows are ignored: a feature is placed at the camera's height, in the
    direction of its column and at the depth of its disparity. Features farther than `camera.max_range` are dropped.

    Args:
        log: Log from `load_kitti`.
        camera: Camera from `make_camera`.
    """
    odometry = planar_motion(log)
    odometry.setflags(write=False)
    seen = zip(log.tracks, log.pixels, strict=True)
    return KittiSteps(log.times, odometry, tuple(_frame(log, camera, *frame) for frame in seen))


def planar_motion(log: KittiLog) -> FloatArray:
    """Return the motions (T, 3) [m, m, rad] since the previous frame at that frame's velocities."""
    duration = np.diff(log.times)
    moved = log.velocities[:-1, :2] * duration[:, None]
    turn = log.velocities[:-1, 5] * duration
    c, s = np.cos(0.5 * turn), np.sin(0.5 * turn)
    motion = np.stack([c * moved[:, 0] - s * moved[:, 1], s * moved[:, 0] + c * moved[:, 1], turn], axis=-1)
    return np.concatenate([np.zeros((1, 3)), motion])


def motion_noise(log: KittiLog) -> OdometryModel:
    """Return the noise of `planar_motion`, estimated from the log.

    Velocities of this extract have white noise, about 0.5 m/s and 0.05 rad/s in `0027.npz`, while a car's true velocity
    is nearly linear over three frames. The second differences of white noise of variance v have the variance 6 v. A
    typical scale error of 1 % of the distance and 2 % of the turn is added.
    """
    second = np.diff(log.velocities, n=2, axis=0)[:, [0, 1, 5]]
    white = MAD * np.median(np.abs(second), axis=0) / np.sqrt(6.0) if len(second) else np.zeros(3)
    dt = float(np.median(np.diff(log.times)))
    return OdometryModel(
        sigma_along=0.01,
        sigma_across=0.01,
        sigma_heading=1e-3,
        sigma_turn=0.02,
        floor_position=max(float(white[:2].max()) * dt, 1e-3),
        floor_heading=max(float(white[2]) * dt, 1e-4),
    )


def track_descriptors(tracks: IntArray) -> FloatArray:
    """Return descriptors (n, 3) float64 of tracks (n,): digits, with a distance of at least 1 between any two.

    >>> track_descriptors(np.array([5, 32, 1025])).tolist()
    [[5.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, 1.0]]
    """
    return np.stack([tracks % DIGITS, tracks // DIGITS % DIGITS, tracks // DIGITS**2], axis=-1).astype(np.float64)


def _frame(log: KittiLog, camera: StereoCamera, tracks: IntArray, pixels: FloatArray) -> Measurements | None:
    """Return the points of near tracks among (n,) with pixels (n, 4), all at the height of the camera."""
    disparity = pixels[:, 0] - pixels[:, 2]
    near = disparity * camera.max_range >= camera.focal_px * camera.baseline
    if not near.any():
        return None
    pixels, disparity = pixels[near], disparity[near]
    row = 0.5 * (pixels[:, 1] + pixels[:, 3])
    centred = np.stack([pixels[:, 0] - log.centre_px[0], row - log.centre_px[1], disparity], axis=-1)
    points = camera.triangulate(centred) @ (ROBOT_FROM_CAMERA.T @ log.unit_from_camera).T
    points[:, 1] = 0.0
    return Measurements(points, track_descriptors(tracks[near]).astype(np.float32))
