"""What cameras can see, and which landmarks they do."""

import math

import numpy as np

from slam_backend.core.read_only import as_read_only
from slam_backend.core.validation import BoolArray, FloatArray
from slam_backend.models.camera import StereoCamera
from vslam_env.world._kernels import EPSILON, detect
from vslam_env.world.spec import Landmarks


def view_limits(camera: StereoCamera, max_incidence: float) -> FloatArray:
    """Return where a camera is and what it can see in the order that kernels expect it.

    Args:
        camera: The robots'.
        max_incidence: Between the line of sight and a face's normal [rad]; more oblique faces show nothing.

    Returns:
        (7,) float64, read-only: its place in the robot frame [m], its range [m], tangents of half its fields of view
        across and upright, cosine of `max_incidence`.
    """
    tangents = np.tan(camera.half_fov), np.tan(camera.half_vertical_fov)
    return as_read_only(np.array([*camera.mount, camera.max_range, *tangents, np.cos(max_incidence)]))


def landmark_geometry(landmarks: Landmarks) -> FloatArray:
    """Return positions [m] and normals of landmarks (5, N), world frame, by rows as kernels expect them; read-only."""
    return as_read_only(np.vstack([landmarks.positions.T, landmarks.normals.T]))


def as_coordinate_rows(walls: FloatArray) -> FloatArray:
    """Return walls (S, 4) [m] as rows (4, S) of coordinates, as kernels expect them; read-only."""
    return as_read_only(walls.T.copy())


def ray_fan(angles: FloatArray) -> tuple[FloatArray, float]:
    """Return unit vectors (2, R) at angles (R,) [rad], read-only, and the tangent of the wedge that holds them all.

    The tangent is 0, for all round, where the wedge is nearly a half plane or wider.
    """
    rays = np.array([[math.cos(angle) for angle in angles], [math.sin(angle) for angle in angles]])
    widest = float(np.abs(angles).max())
    return as_read_only(rays), math.tan(widest) + EPSILON if widest < 1.5 else 0.0


def visible_landmarks(
    poses: FloatArray, landmarks: Landmarks, walls: FloatArray, robot_radius: float, view: FloatArray
) -> BoolArray:
    """Tell which landmarks (K, N) the cameras of robots at `poses` (K, 3) [m, m, rad], world frame, see.

    Args:
        poses: True ones.
        landmarks: N of them.
        walls: (S, 4) float64 [m], world frame.
        robot_radius: Robots hide what stands behind them [m].
        view: From `view_limits`.
    """
    shape = len(poses), len(landmarks)
    sight = landmark_geometry(landmarks), landmarks.walls, as_coordinate_rows(walls), robot_radius, view
    chosen, counts, seen = np.empty(shape, np.int64), np.empty(len(poses), np.int64), np.zeros(shape, np.bool_)
    detect(poses, sight, np.zeros(shape), 1.0, np.zeros(len(poses), np.int64), chosen, counts)
    for row, names, count in zip(seen, chosen, counts, strict=True):
        row[names[:count]] = True
    return seen
