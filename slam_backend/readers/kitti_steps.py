"""A KITTI drive becomes steps in the plane: motion between frames, and what each frame shows at the camera's height."""

from dataclasses import dataclass

import numpy as np

from slam_backend.camera import ROBOT_FROM_CAMERA, StereoCamera
from slam_backend.errors import FloatArray, IntArray
from slam_backend.measurements import Measurements
from slam_backend.motion import OdometryModel
from slam_backend.readers.kitti import KittiLog

DIGITS = 32  # a track's number is written with three digits of this base: a descriptor that is its own and no other's
MAD = 1.4826  # median absolute deviation to standard deviation of a Gaussian
DEPTHS_KNOWN_TO = 0.2  # share; nearer to infinity a Gaussian point says nothing true


@dataclass(frozen=True, slots=True, eq=False)
class KittiSteps:
    """A drive as steps at the times of its frames.

    Attributes:
        times: (T,) float64 [s].
        odometry: (T, 3) float64 [m, m, rad]. Motion of the inertial unit since the step before; the first is 0.
        measurements: T entries; None where no track is near enough. All points lie at the camera's height; descriptors
            are those of `track_descriptors`.
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


def steps(log: KittiLog, camera: StereoCamera) -> KittiSteps:
    """Turn a drive into planar odometry and measurements.

    The filter's robot moves in the plane while a car pitches and rolls by degrees, which moves rows of the image by
    tens of pixels and columns hardly at all. So rows are not used: a feature is taken to be at the camera's height, in
    the direction of its column and at the depth of its disparity. Features farther than `camera.max_range` are dropped.

    Args:
        log: What `load_kitti` returned.
        camera: Of `make_camera`.
    """
    odometry = planar_motion(log)
    odometry.setflags(write=False)
    seen = zip(log.tracks, log.pixels, strict=True)
    return KittiSteps(log.times, odometry, tuple(_frame(log, camera, *frame) for frame in seen))


def planar_motion(log: KittiLog) -> FloatArray:
    """Return the motions (T, 3) [m, m, rad] since the frame before at the velocities of that frame."""
    duration = np.diff(log.times)
    moved = log.velocities[:-1, :2] * duration[:, None]
    turn = log.velocities[:-1, 5] * duration
    c, s = np.cos(0.5 * turn), np.sin(0.5 * turn)
    motion = np.stack([c * moved[:, 0] - s * moved[:, 1], s * moved[:, 0] + c * moved[:, 1], turn], axis=-1)
    return np.concatenate([np.zeros((1, 3)), motion])


def motion_noise(log: KittiLog) -> OdometryModel:
    """Return the noise of `planar_motion` as the log itself shows it.

    Velocities of this extract carry white noise, about 0.5 m/s and 0.05 rad/s in `0027.npz`; a car's own velocity
    hardly bends within three frames. The second differences of white noise of variance v have the variance 6 v.
    To it comes 1 % of the distance and 2 % of the turn, a usual unit's scale error.
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
    """Return descriptors (n, 3) float64 of tracks (n,): digits, so that any two differ by at least 1.

    >>> track_descriptors(np.array([5, 32, 1025])).tolist()
    [[5.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, 1.0]]
    """
    return np.stack([tracks % DIGITS, tracks // DIGITS % DIGITS, tracks // DIGITS**2], axis=-1).astype(np.float64)


def _frame(log: KittiLog, camera: StereoCamera, tracks: IntArray, pixels: FloatArray) -> Measurements | None:
    """Return what is near enough to be known of tracks (n,) with pixels (n, 4), all at the height of the camera."""
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
