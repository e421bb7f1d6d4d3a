"""Visibility of landmarks from cameras."""

import math

import numpy as np

from slam_backend.core.read_only import as_read_only
from slam_backend.core.validation import BoolArray, FloatArray
from slam_backend.models.camera import StereoCamera
from vslam_env.world._kernels import EPSILON, GROUP, detect
from vslam_env.world.spec import Landmarks


def view_limits(camera: StereoCamera, max_incidence: float) -> FloatArray:
    """Return position and limits of view of a camera for the kernels.

    Args:
        camera: Camera of the robots.
        max_incidence: Largest angle between line of sight and face normal at which landmarks are visible [rad].

    Returns:
        (7,) float64, read-only. Position in the robot frame [m], range [m], tangents of half the horizontal and
        vertical field of view, cosine of `max_incidence`.
    """
    tangents = np.tan(camera.half_fov), np.tan(camera.half_vertical_fov)
    return as_read_only(np.array([*camera.mount, camera.max_range, *tangents, np.cos(max_incidence)]))


def landmark_geometry(landmarks: Landmarks) -> FloatArray:
    """Return positions [m] and normals of landmarks as coordinate rows (5, N), world frame; read-only."""
    return as_read_only(np.vstack([landmarks.positions.T, landmarks.normals.T]))


def group_bounds(landmarks: Landmarks) -> FloatArray:
    """Return the bounds x, y, x, y [m] of each `GROUP` successive landmarks (n, 4), world frame; read-only."""
    firsts, places = np.arange(0, len(landmarks), GROUP), landmarks.positions[:, :2]
    if not len(firsts):
        return as_read_only(np.empty((0, 4)))
    return as_read_only(np.hstack([np.minimum.reduceat(places, firsts), np.maximum.reduceat(places, firsts)]))


def as_coordinate_rows(walls: FloatArray) -> FloatArray:
    """Return walls (S, 4) [m] as coordinate rows (4, S); read-only."""
    return as_read_only(walls.T.copy())


def ray_fan(angles: FloatArray) -> tuple[FloatArray, float]:
    """Return unit vectors (2, R) at angles (R,) [rad], read-only, and the tangent of half the wedge around them.

    A tangent of 0 stands for all directions, if the wedge is nearly a half plane or wider.
    """
    rays = np.array([[math.cos(angle) for angle in angles], [math.sin(angle) for angle in angles]])
    widest = float(np.abs(angles).max())
    return as_read_only(rays), math.tan(widest) + EPSILON if widest < 1.5 else 0.0


def visible_landmarks(
    poses: FloatArray, landmarks: Landmarks, walls: FloatArray, robot_radius: float, view: FloatArray
) -> BoolArray:
    """Return which landmarks are visible (K, N) bool from the cameras of K robots.

    Args:
        poses: (K, 3) float64 [m, m, rad], world frame. True poses.
        landmarks: N landmarks.
        walls: (S, 4) float64 [m], world frame. Wall segments.
        robot_radius: Radius of the robots, which occlude landmarks [m].
        view: Limits of view from `view_limits`.
    """
    shape = len(poses), len(landmarks)
    marks, bounds = landmark_geometry(landmarks), group_bounds(landmarks)
    sight = marks, bounds, landmarks.walls, as_coordinate_rows(walls), robot_radius, view
    chosen, counts, seen = np.empty(shape, np.int64), np.empty(len(poses), np.int64), np.zeros(shape, np.bool_)
    detect(poses, sight, np.zeros(shape), 1.0, np.zeros(len(poses), np.int64), chosen, counts)
    for row, landmarks_seen, count in zip(seen, chosen, counts, strict=True):
        row[landmarks_seen[:count]] = True
    return seen
