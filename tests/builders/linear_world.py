"""A linear-Gaussian world: headings known, positions noisy, points measured with given covariances.

There the posterior is known in closed form: it is that of a Kalman filter over the robot's position and all landmarks.
"""

from dataclasses import dataclass

import numpy as np

from slam_backend.core.validation import FloatArray
from slam_backend.geometry import compose
from slam_backend.models.camera import ROBOT_FROM_CAMERA, StereoCamera
from slam_backend.models.measurements import Measurements
from slam_backend.models.odometry import OdometryModel

CAMERA = StereoCamera(mount=(0.1, -0.05, 0.2))
MOTION = OdometryModel(
    sigma_along=0.1, sigma_across=0.06, sigma_heading=0.0, sigma_turn=0.0, floor_position=0.01, floor_heading=0.0
)
LANDMARKS = np.array([[4.0, 1.0, 0.5], [3.0, -2.0, -0.3], [-2.0, 2.5, 0.1]])
MOVE = np.array([0.4, 0.1, 0.5])


def turn(theta: float) -> FloatArray:
    """Return the 3 x 3 rotation by theta about the vertical."""
    c, s = np.cos(theta), np.sin(theta)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def measure(
    rng: np.random.Generator, pose: FloatArray, landmarks: FloatArray, sigma: float
) -> tuple[Measurements, FloatArray]:
    """Measure landmarks (n, 3) from `pose` with covariances drawn at random, of size `sigma` [m].

    Returns:
        The frame, and the covariances (n, 3, 3) in robot axes.
    """
    n = len(landmarks)
    roots = sigma * (np.eye(3) + rng.uniform(-0.4, 0.4, (n, 3, 3)))
    exact = CAMERA.camera_from_robot((landmarks - [pose[0], pose[1], 0.0]) @ turn(pose[2]))
    points = exact + np.einsum("nij,nj->ni", roots, rng.standard_normal((n, 3)))
    covariances = roots @ roots.transpose(0, 2, 1)
    looks = np.eye(n, 5, dtype=np.float32)
    return Measurements(points, looks, covariances), ROBOT_FROM_CAMERA @ covariances @ ROBOT_FROM_CAMERA.T


@dataclass(frozen=True)
class LinearRun:
    """What one robot read, from the origin on, and the truth.

    Attributes:
        odometry: Noisy motions (T, 3); the first frame is taken before them.
        frames: T + 1 frames of all landmarks.
        noises: Noise covariances (n, 3, 3), robot axes.
        poses: True poses (T + 1, 3).
    """

    odometry: FloatArray
    frames: list[Measurements]
    noises: list[FloatArray]
    poses: FloatArray


def simulate(seed: int, steps: int, sigma: float, num_landmarks: int = 3) -> LinearRun:
    """Drive a robot through the world."""
    rng = np.random.default_rng(seed)
    poses, odometry = [np.zeros(3)], []
    for _ in range(steps):
        odometry.append(MOVE.copy())
        poses.append(compose(poses[-1], MOVE + rng.standard_normal(3) * MOTION.sigmas(MOVE)))
    seen = [measure(rng, pose, LANDMARKS[:num_landmarks], sigma) for pose in poses]
    return LinearRun(np.array(odometry), [frame for frame, _ in seen], [noise for _, noise in seen], np.array(poses))


def kalman_filter(run: LinearRun) -> tuple[FloatArray, FloatArray]:
    """Return mean (2 + 3 n,) and covariance of (x, y, landmarks) after a run: the exact posterior."""
    n = len(run.frames[0])
    mean, covariance = np.zeros(2 + 3 * n), np.zeros((2 + 3 * n,) * 2)
    theta = 0.0
    for t, frame in enumerate(run.frames):
        if t:
            to_map = turn(theta)[:2, :2]
            mean[:2] += to_map @ run.odometry[t - 1, :2]
            covariance[:2, :2] += to_map @ np.diag(MOTION.sigmas(run.odometry[t - 1])[:2] ** 2) @ to_map.T
            theta += run.odometry[t - 1, 2]
        for i in range(n):
            rows = slice(2 + 3 * i, 5 + 3 * i)
            seen = turn(theta) @ CAMERA.robot_from_camera(frame.points[i])  # landmark minus position, map axes
            noise = turn(theta) @ run.noises[t][i] @ turn(theta).T
            if t == 0:
                mean[rows], covariance[rows, rows] = seen, noise  # the start is the origin, exactly
                continue
            h = np.zeros((3, len(mean)))
            h[:, rows], h[:2, :2] = np.eye(3), -np.eye(2)
            innovation = h @ covariance @ h.T + noise
            gain = np.linalg.solve(innovation, h @ covariance).T
            mean = mean + gain @ (seen - h @ mean)
            keep = np.eye(len(mean)) - gain @ h
            covariance = keep @ covariance @ keep.T + gain @ noise @ gain.T
    return mean, covariance
