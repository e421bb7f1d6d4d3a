"""The circle world of the SLAM tutorial, and mistakes in the set-up of its logs."""

from typing import Literal, NamedTuple

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.geometry import compose, inverse, transform_points
from slam_backend.models.measurements import Measurements
from slam_backend.models.odometry import OdometryModel

Mistake = Literal[
    "none", "mirrored x", "sign of turns", "odometry in degrees", "points in centimetres", "odometry in centimetres",
    "scale", "frozen odometry", "measurement noise", "odometry noise",
]  # fmt: skip
MOTION = OdometryModel(sigma_along=0.05, sigma_turn=0.05)
STEPS, MOVE = 300, np.array([0.2, 0.0, 0.05])  # along a circle of 4 m radius, amid one of landmarks
POINT_NOISE, TOO_NOISY, WRONG_BASELINE = 0.01, 30.0, 1.2


class CircleLog(NamedTuple):
    """Log of a robot: odometry (T, 3) [m, m, rad], measurements and their landmarks (n,)."""

    odometry: FloatArray
    measurements: list[Measurements]
    identities: list[IntArray]


def circle_log(mistake: Mistake, seed: int) -> CircleLog:
    """Return a log in the circle world of the tutorial with a mistake."""
    rng = np.random.default_rng(seed)
    angles = np.linspace(0.0, 2.0 * np.pi, 30, endpoint=False)
    landmarks = np.column_stack([6.0 * np.cos(angles), 6.0 * np.sin(angles) + 4.0])
    looks = rng.normal(size=(30, 64)) / 8.0
    pose, odometry, frames, names = np.zeros(3), np.zeros((STEPS, 3)), [], []
    noise = POINT_NOISE * (TOO_NOISY if mistake == "measurement noise" else 1.0)
    for step in range(STEPS):
        if step:
            odometry[step] = MOVE * rng.normal(1.02, 0.03, 3)
            pose = compose(pose, MOVE)
        body = transform_points(inverse(pose), landmarks)
        near = np.flatnonzero((body[:, 0] > 0.5) & (np.abs(body[:, 1]) < body[:, 0]) & (np.hypot(*body.T) < 6.0))
        points = np.column_stack([-body[near, 1], np.zeros(len(near)), body[near, 0]])
        points = _wrong_points(points + rng.normal(0.0, noise, points.shape), mistake)
        described = (looks[near] + rng.normal(0.0, 0.02, (len(near), 64))).astype(np.float32)
        frames.append(Measurements(points, described, np.tile(POINT_NOISE**2 * np.eye(3), (len(near), 1, 1))))
        names.append(near)
    if mistake == "odometry noise":
        odometry[1:] += rng.normal(0.0, 1.0, (STEPS - 1, 3)) * TOO_NOISY * np.sqrt(MOTION.variances(odometry[1:]))
    return CircleLog(_wrong_odometry(odometry, mistake), frames, names)


def _wrong_points(points: FloatArray, mistake: Mistake) -> FloatArray:
    """Return points (n, 3), camera frame, with a mistake."""
    factors = {"points in centimetres": 100.0, "scale": WRONG_BASELINE}
    return points * factors.get(mistake, 1.0) * ([1.0, 1.0, -1.0] if mistake == "mirrored x" else 1.0)


def _wrong_odometry(odometry: FloatArray, mistake: Mistake) -> FloatArray:
    """Return odometry (T, 3) with a mistake."""
    factors = {
        "sign of turns": (1.0, 1.0, -1.0), "odometry in degrees": (1.0, 1.0, 180.0 / np.pi),
        "odometry in centimetres": (100.0, 100.0, 1.0), "frozen odometry": (0.0, 0.0, 0.0),
    }  # fmt: skip
    return odometry * factors.get(mistake, (1.0, 1.0, 1.0))
