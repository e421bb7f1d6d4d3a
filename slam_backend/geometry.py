"""Rigid motions of the plane: poses (x, y, theta) as arrays, theta in [-pi, pi), `p_a = R(theta) p_b + t`."""

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from slam_backend.core.jit import jit
from slam_backend.core.validation import FloatArray

ONE = (3,)  # shape of a single pose


def wrap_angle(angle: ArrayLike) -> Any:
    """Map angles to [-pi, pi) [rad], elementwise.

    >>> float(wrap_angle(np.pi)) == -np.pi
    True
    """
    return (np.asarray(angle, dtype=np.float64) + np.pi) % (2.0 * np.pi) - np.pi


def cosine_sine(angles: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return cosines and sines (...) of angles (...) [rad] by the C library: numpy's depend on the processor."""
    flat = angles.ravel().tolist()
    cos, sin = np.array([math.cos(angle) for angle in flat]), np.array([math.sin(angle) for angle in flat])
    return cos.reshape(angles.shape), sin.reshape(angles.shape)


def rotation(theta: ArrayLike) -> FloatArray:
    """Return the rotation matrices (..., 2, 2) of angles (...) [rad]."""
    theta = np.asarray(theta, dtype=np.float64)
    c, s = np.cos(theta), np.sin(theta)
    result = np.empty((*theta.shape, 2, 2))
    result[..., 0, 0] = result[..., 1, 1] = c
    result[..., 0, 1], result[..., 1, 0] = -s, s
    return result


def compose(a_from_b: ArrayLike, b_from_c: ArrayLike) -> FloatArray:
    """Chain two motions: `a_from_c`.

    Args:
        a_from_b: (..., 3) float64 [m, m, rad]. Pose of b in a.
        b_from_c: (..., 3) float64 [m, m, rad]. Pose of c in b; shapes broadcast.

    Returns:
        (..., 3) pose of c in a.

    >>> compose([1.0, 0.0, np.pi / 2], [2.0, 0.0, 0.0]).round(6).tolist()
    [1.0, 2.0, 1.570796]
    """
    a, b = np.asarray(a_from_b, dtype=np.float64), np.asarray(b_from_c, dtype=np.float64)
    if a.shape == b.shape == ONE:
        return _compose_one(a.tolist(), b.tolist())
    shape = a.shape
    if b.shape != shape:
        shape = b.shape if a.shape == ONE else a.shape if b.shape == ONE else np.broadcast_shapes(a.shape, b.shape)
        a, b = _stretched(a, shape), _stretched(b, shape)
    result = np.empty(shape)
    _compose_rows(_rows(a), _rows(b), result.reshape(-1, 3))
    return result


def inverse(a_from_b: ArrayLike) -> FloatArray:
    """Invert a motion: return the pose (..., 3) [m, m, rad] of a in b from the pose (..., 3) of b in a."""
    a = np.asarray(a_from_b, dtype=np.float64)
    if a.shape == ONE:
        return _inverse_one(a.tolist())
    result = np.empty(a.shape)
    _invert_rows(_rows(a), result.reshape(-1, 3))
    return result


# Steps of an environment mostly need single poses, for which plain floats take half the time of a kernel.


def _compose_one(a: list[float], b: list[float]) -> FloatArray:
    """Chain two motions (3,) like `compose`, without the cost of arrays."""
    c, s = math.cos(a[2]), math.sin(a[2])
    x, y = a[0] + c * b[0] - s * b[1], a[1] + s * b[0] + c * b[1]
    return np.array([x, y, (a[2] + b[2] + math.pi) % (2.0 * math.pi) - math.pi])


def _inverse_one(a: list[float]) -> FloatArray:
    """Turn one motion (3,) around, as `inverse` does, without the cost of arrays."""
    c, s = math.cos(a[2]), math.sin(a[2])
    return np.array([-c * a[0] - s * a[1], s * a[0] - c * a[1], (math.pi - a[2]) % (2.0 * math.pi) - math.pi])


def _rows(poses: FloatArray) -> FloatArray:
    """Return poses (..., 3) as rows (n, 3) in the layout for which kernels are compiled."""
    rows = np.ascontiguousarray(poses).reshape(-1, 3)
    return rows if rows.flags.writeable else rows.copy()


def _stretched(poses: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Return poses broadcast to a shape, as a copy."""
    if poses.shape == shape:
        return poses
    stretched = np.empty(shape)
    stretched[...] = poses
    return stretched


@jit
def _compose_rows(a: FloatArray, b: FloatArray, result: FloatArray) -> None:
    """Chain motions (n, 3) row by row, like `compose`."""
    for i in range(len(a)):
        c, s = math.cos(a[i, 2]), math.sin(a[i, 2])
        result[i, 0] = a[i, 0] + c * b[i, 0] - s * b[i, 1]
        result[i, 1] = a[i, 1] + s * b[i, 0] + c * b[i, 1]
        result[i, 2] = (a[i, 2] + b[i, 2] + math.pi) % (2.0 * math.pi) - math.pi


@jit
def _invert_rows(a: FloatArray, result: FloatArray) -> None:
    """Invert motions (n, 3) row by row, like `inverse`."""
    for i in range(len(a)):
        c, s = math.cos(a[i, 2]), math.sin(a[i, 2])
        result[i, 0] = -c * a[i, 0] - s * a[i, 1]
        result[i, 1] = s * a[i, 0] - c * a[i, 1]
        result[i, 2] = (math.pi - a[i, 2]) % (2.0 * math.pi) - math.pi


def between(w_from_a: ArrayLike, w_from_b: ArrayLike) -> FloatArray:
    """Return the pose of b relative to a, the reading of ideal odometry between two poses.

    Args:
        w_from_a: (..., 3) float64 [m, m, rad]. Pose of a.
        w_from_b: (..., 3) float64 [m, m, rad]. Pose of b, same frame.

    Returns:
        (..., 3) float64 [m, m, rad], frame a.
    """
    return compose(inverse(w_from_a), w_from_b)


def transform_points(a_from_b: ArrayLike, points_b: ArrayLike) -> FloatArray:
    """Transform points from frame b to frame a; heights, if any, stay.

    Args:
        a_from_b: (3,) float64 [m, m, rad]. One pose.
        points_b: (..., 2) or (..., 3) float64 [m].

    Returns:
        A new array of the same shape, in frame a.
    """
    pose = np.asarray(a_from_b, dtype=np.float64)
    points = np.array(points_b, dtype=np.float64)
    x, y = points[..., 0].copy(), points[..., 1].copy()
    c, s = np.cos(pose[2]), np.sin(pose[2])
    points[..., 0] = c * x - s * y + pose[0]
    points[..., 1] = s * x + c * y + pose[1]
    return points


def rotate_covariances(theta: float, covariances: FloatArray) -> FloatArray:
    """Rotate covariances of points about the vertical: R Sigma R^T (Eq. 16 as `docs/reference/errata.md` corrects it).

    Args:
        theta: Angle [rad].
        covariances: (..., 3, 3) float64 [m^2].

    Returns:
        A new array of the same shape.
    """
    c, s, result = math.cos(theta), math.sin(theta), np.array(covariances, dtype=np.float64, order="C")
    for both in (result, result.swapaxes(-1, -2)):  # R Sigma, then (R Sigma) R^T
        x, y = both[..., 0, :].copy(), both[..., 1, :].copy()
        both[..., 0, :], both[..., 1, :] = c * x - s * y, s * x + c * y
    return result
