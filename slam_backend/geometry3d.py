"""Rigid motions in space between two point sets: least squares, and RANSAC with three points.

Unlike the filter's alignment (`align_maps`), which assumes planar motion, it suits hand-held and flying cameras.
"""

from typing import Any, NamedTuple

import numpy as np

from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import BoolArray, FloatArray, argument_error, check_array, check_float, check_int

MINIMAL = 3  # points of a minimal sample
THINNEST = 1e-3  # m; a triangle of smaller height does not determine the rotation about its long side


@short_repr
class RigidFit(NamedTuple):
    """A rigid motion, p_a = rotation p_b + translation.

    Attributes:
        rotation: (3, 3) float64.
        translation: (3,) float64 [m].
        inliers: (n,) bool. Mask of the pairs that agree with the motion.
        rms: Root mean square distance of the inliers [m].
    """

    rotation: FloatArray
    translation: FloatArray
    inliers: BoolArray
    rms: float

    @property
    def angle(self) -> float:
        """Angle of the rotation [rad]."""
        return rotation_angle(self.rotation)


def rotation_angle(rotation: FloatArray) -> float:
    """Return the angle [rad] of a rotation (3, 3), accurate also for small angles."""
    sine = 0.5 * np.linalg.norm(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    return float(np.arctan2(sine, 0.5 * (np.trace(rotation) - 1.0)))


def fit_rigid(points_a: Any, points_b: Any, weights: Any | None = None) -> tuple[FloatArray, FloatArray]:
    """Return the rotation (3, 3) and translation (3,) that take b to a with the smallest weighted squared error.

    Arun, Huang and Blostein (1987), "Least-Squares Fitting of Two 3-D Point Sets", IEEE PAMI 9(5), with the correction
    of reflections by Umeyama (1991).

    Args:
        points_a: (n, 3) float64 [m], n >= 3.
        points_b: (n, 3) float64 [m].
        weights: (n,) float64, positive. None: equal weights.

    Raises:
        ValueError: If shapes are wrong, or there are fewer than three points.
    """
    a, b = _checked(points_a, points_b)
    share = np.ones(len(a)) if weights is None else check_array("weights", weights, (len(a),), "Give one per pair.")
    if share.min() <= 0.0:
        raise argument_error("weights", "numbers > 0", float(share.min()), "Drop such pairs.")
    share = (share / share.sum())[:, None]
    mean_a, mean_b = (share * a).sum(axis=0), (share * b).sum(axis=0)
    u, _, vt = np.linalg.svd((share * (a - mean_a)).T @ (b - mean_b))
    mirror = np.diag([1.0, 1.0, np.linalg.det(u @ vt)])
    rotation = u @ mirror @ vt
    return rotation, mean_a - rotation @ mean_b


def ransac_rigid(
    points_a: Any,
    points_b: Any,
    tolerances: Any,
    rng: np.random.Generator,
    iterations: int = 1000,
) -> RigidFit | None:
    """Find the rigid motion with the largest consensus set of pairs by RANSAC, and fit it to this set.

    Args:
        points_a: (n, 3) float64 [m].
        points_b: (n, 3) float64 [m]. Partners of `points_a`, outliers included.
        tolerances: (n,) float64 or one number [m]. Distance within which a pair agrees.
        rng: Source of the minimal samples.
        iterations: Number of minimal samples of three pairs.

    Returns:
        The motion, fitted with the inverse squares of the tolerances as weights. None if there are fewer than three
        pairs, or no three are consistent.

    Raises:
        ValueError: If shapes or numbers are wrong.
    """
    a, b = _checked(points_a, points_b, least=0)
    check_int("iterations", iterations, 1, "1000 samples suffice for 50 % outliers.")
    limits = np.broadcast_to(np.asarray(tolerances, dtype=np.float64), (len(a),))
    for limit in limits[:1] if np.ndim(tolerances) == 0 else limits:
        check_float("tolerances", float(limit), "Give metres.", above=0.0)
    if len(a) < MINIMAL:
        return None
    samples = np.argsort(rng.random((iterations, len(a))), axis=1)[:, :MINIMAL]
    turns, shifts, fine = _fit_triples(a[samples], b[samples])
    best: BoolArray = np.zeros(len(a), dtype=np.bool_)
    for turn, shift in zip(turns[fine], shifts[fine], strict=True):
        agree = ((a - b @ turn.T - shift) ** 2).sum(axis=1) <= limits**2
        if agree.sum() > best.sum():
            best = agree
    for _ in range(3):  # until the consensus set converges
        if best.sum() < MINIMAL:
            return None
        turn, shift = fit_rigid(a[best], b[best], limits[best] ** -2.0)
        squares = ((a - b @ turn.T - shift) ** 2).sum(axis=1)
        best = squares <= limits**2
    if best.sum() < MINIMAL:
        return None
    return RigidFit(turn, shift, best, float(np.sqrt(squares[best].mean())))


def _fit_triples(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return motions (S, 3, 3), (S, 3) of triples (S, 3, 3), and the mask (S,) of non-degenerate triangles."""
    mean_a, mean_b = a.mean(axis=1, keepdims=True), b.mean(axis=1, keepdims=True)
    u, spread, vt = np.linalg.svd((a - mean_a).transpose(0, 2, 1) @ (b - mean_b))
    signs = np.ones((len(a), 3))
    signs[:, 2] = np.linalg.det(u @ vt)
    turns = (u * signs[:, None]) @ vt
    shifts = mean_a[:, 0] - (turns @ mean_b[:, 0, :, None])[:, :, 0]
    return turns, shifts, spread[:, 1] > THINNEST**2


def _checked(points_a: Any, points_b: Any, least: int = MINIMAL) -> tuple[FloatArray, FloatArray]:
    """Return two arrays (n, 3) of partners, n >= `least`."""
    a = check_array("points_a", points_a, (None, 3), "Give one row x y z per point.")
    b = check_array("points_b", points_b, (len(a), 3), "Give the partner of each point of a.")
    if len(a) < least:
        raise argument_error("points_a", f"at least {least} points", f"shape {a.shape}", "Give more points.")
    return a, b
