"""Fusion of two aligned maps (Eqs. 13-17, corrected where the printed form is wrong)."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slam_backend.core.validation import FloatArray, IntArray, argument_error, check_kind
from slam_backend.geometry import rotate_covariances, rotation, transform_points
from slam_backend.maps.alignment import Alignment
from slam_backend.maps.landmark_map import LandmarkMap


def fuse_landmarks(
    mean1: ArrayLike, cov1: ArrayLike, mean2: ArrayLike, cov2: ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """Fuse two independent estimates of the same landmarks (Eqs. 13-15).

    Args:
        mean1: (..., 3) float64 [m]. First estimates (mu_1).
        cov1: (..., 3, 3) float64 [m^2], symmetric positive semi-definite (Sigma_1).
        mean2: (..., 3) float64 [m]. Second estimates, same frame (mu_2).
        cov2: (..., 3, 3) float64 [m^2]; Sigma_1 + Sigma_2 must be positive definite.

    Returns:
        Means (..., 3) and covariances (..., 3, 3), symmetric, equal to (Sigma_1^-1 + Sigma_2^-1)^-1.

    Raises:
        ValueError: If an argument is not such an array, or both estimates are exact along one direction, so that no
            weighted mean exists.

    >>> fuse_landmarks([0.0, 0.0, 0.0], np.eye(3), [3.0, 0.0, 0.0], 2.0 * np.eye(3))[0].round(12).tolist()
    [1.0, 0.0, 0.0]
    """
    mu1, mu2 = _estimate("mean1", mean1, (3,)), _estimate("mean2", mean2, (3,))
    sigma1, sigma2 = _estimate("cov1", cov1, (3, 3)), _estimate("cov2", cov2, (3, 3))
    try:
        gain = _transposed(np.linalg.solve(sigma1 + sigma2, sigma1))  # Eq. 13
    except np.linalg.LinAlgError as error:
        hint = "Give each landmark some uncertainty in every direction."
        raise argument_error("cov1 + cov2", "positive definite matrices", "a singular one", hint) from error
    mean = mu1 + (gain @ (mu2 - mu1)[..., None])[..., 0]  # Eq. 14, with mu2 - mu1: printed, it moves away from mu2
    rest = np.eye(3) - gain
    # Eq. 15, with Sigma_1 instead of mu_1, in Joseph form, which stays symmetric and positive under rounding.
    covariance = rest @ sigma1 @ _transposed(rest) + gain @ sigma2 @ _transposed(gain)
    return mean, 0.5 * (covariance + _transposed(covariance))


def _estimate(name: str, value: ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    """Return `value` as an array (..., *shape), or raise."""
    expected = f"an array of shape (..., {', '.join(map(str, shape))})"
    hint = "Give one row, or one matrix, per landmark."
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise argument_error(name, expected, value, hint) from error
    if array.shape[-len(shape) :] != shape:
        raise argument_error(name, expected, f"shape {array.shape}", hint)
    return array


def alignment_jacobian(theta: float, points_b: ArrayLike) -> FloatArray:
    """Return the Jacobian of points moved from b to a by (tx, ty, theta): J = [e_x, e_y, dR/dtheta p_b].

    Args:
        theta: Rotation of the alignment [rad].
        points_b: (..., 3) float64 [m], frame b.

    Returns:
        (..., 3, 3): rows x, y, z; columns tx, ty, theta.
    """
    points = np.asarray(points_b, dtype=np.float64)
    jacobian = np.zeros((*points.shape, 3))
    jacobian[..., 0, 0] = jacobian[..., 1, 1] = 1.0
    jacobian[..., :2, 2] = points[..., :2] @ rotation(theta + 0.5 * np.pi).T  # dR/dtheta is R turned by 90 degrees
    return jacobian


def move_covariances(alignment: Alignment, points_b: ArrayLike, covariances_b: FloatArray) -> FloatArray:
    """Return covariances of landmarks in frame a, the uncertainty of the alignment included (Eqs. 16-17).

    Args:
        alignment: Successful alignment, a from b.
        points_b: (..., 3) float64 [m], frame b.
        covariances_b: (..., 3, 3) float64 [m^2], frame b.

    Returns:
        (..., 3, 3): R Sigma R^T + J Sigma_align J^T.
    """
    jacobian = alignment_jacobian(alignment.theta, points_b)
    # Eq. 16, as R Sigma R^T because p_a = R p_b + t, plus the uncertainty of the alignment.
    moved = rotate_covariances(alignment.theta, covariances_b) + jacobian @ alignment.covariance @ _transposed(jacobian)
    return np.asarray(0.5 * (moved + _transposed(moved)))


def fuse_descriptors(
    descriptors1: NDArray[np.float32], counts1: ArrayLike, descriptors2: NDArray[np.float32], counts2: ArrayLike
) -> NDArray[np.float32]:
    """Average descriptors weighted by counts and restore their length, to keep distances comparable (Sec. 3.2).

    Args:
        descriptors1: (..., d) float32 [-].
        counts1: (...) Number of measurements of each first descriptor.
        descriptors2: (..., d) float32 [-].
        counts2: (...) Number of measurements of each second descriptor.

    Returns:
        (..., d) float32 in the direction of the weighted mean, with the weighted mean of the two lengths; the first
        descriptor if the two cancel.
    """
    one, two = np.asarray(descriptors1, dtype=np.float64), np.asarray(descriptors2, dtype=np.float64)
    n1, n2 = np.asarray(counts1, dtype=np.float64)[..., None], np.asarray(counts2, dtype=np.float64)[..., None]
    mean = (n1 * one + n2 * two) / (n1 + n2)
    length1, length2, length = (np.linalg.norm(v, axis=-1, keepdims=True) for v in (one, two, mean))
    wanted = (n1 * length1 + n2 * length2) / (n1 + n2)
    cancelled = length <= 1e-9 * wanted
    fused = np.where(cancelled, one, mean * (wanted / np.where(cancelled, 1.0, length)))
    return np.asarray(fused, dtype=np.float32)


def fuse_maps(map_a: LandmarkMap, map_b: LandmarkMap, alignment: Alignment) -> LandmarkMap:
    """Fuse map b with map a: inliers are fused, the other landmarks of b are moved and appended.

    Args:
        map_a: Map whose frame, order and ids stay.
        map_b: Other map. Fused landmarks take the id of a; the others keep theirs, or get a new one above all ids of
            both maps if a uses it already.
        alignment: Successful alignment of these two maps.

    Returns:
        A new map in a's frame: all rows of a, then the rows of b that were not fused. Counts are added.

    Raises:
        ValueError: If an argument has the wrong type, the alignment was refused, an inlier is out of range or repeated,
            or the descriptors differ in size.
    """
    check_kind("map_a", map_a, LandmarkMap), check_kind("map_b", map_b, LandmarkMap)
    check_kind("alignment", alignment, Alignment, "Give what align_maps(map_a, map_b) returned.")
    if not alignment.success:
        hint = "Fuse maps only after a successful alignment."
        raise argument_error("alignment", "a successful alignment", f"a refusal: {alignment.reason}", hint)
    if map_a.descriptors.shape[1] != map_b.descriptors.shape[1]:
        expected = f"descriptors of size {map_a.descriptors.shape[1]}, as in map_a"
        hint = "Describe the landmarks of both maps with the same front end."
        raise argument_error("map_b", expected, map_b.descriptors.shape[1], hint)
    check_inliers(alignment.inliers, len(map_a), len(map_b))
    rows_a, rows_b = alignment.inliers.T
    means_b = transform_points(alignment.transform, map_b.means)
    covariances_b = move_covariances(alignment, map_b.means, map_b.covariances)

    means, covariances = map_a.means.copy(), map_a.covariances.copy()
    means[rows_a], covariances[rows_a] = fuse_landmarks(
        means[rows_a], covariances[rows_a], means_b[rows_b], covariances_b[rows_b]
    )
    descriptors, counts = map_a.descriptors.copy(), map_a.counts.copy()
    descriptors[rows_a] = fuse_descriptors(
        descriptors[rows_a], counts[rows_a], map_b.descriptors[rows_b], map_b.counts[rows_b]
    )
    counts[rows_a] += map_b.counts[rows_b]

    added = np.setdiff1d(np.arange(len(map_b)), rows_b)
    return LandmarkMap(
        np.concatenate([means, means_b[added]]),
        np.concatenate([covariances, covariances_b[added]]),
        np.concatenate([descriptors, map_b.descriptors[added]]),
        np.concatenate([counts, map_b.counts[added]]),
        np.concatenate([map_a.ids, _fresh_ids(map_a.ids, map_b.ids, added)]),
    )


def check_inliers(inliers: IntArray, size_a: int, size_b: int) -> None:
    """Raise unless the inliers pair existing landmarks one-to-one.

    Args:
        inliers: (k, 2) int64. Rows of either map.
        size_a: Number of landmarks of the first map.
        size_b: Number of landmarks of the second map.

    Raises:
        ValueError: If a row is out of range or repeated.
    """
    outside = (inliers < 0) | (inliers >= np.array([size_a, size_b]))
    repeated = any(len(np.unique(column)) < len(column) for column in inliers.T)
    if outside.any() or repeated:
        expected = f"one-to-one pairs of rows below {size_a} and {size_b}"
        got = "an index out of range" if outside.any() else "a repeated row"
        raise argument_error("alignment.inliers", expected, got, "Fuse the two maps that were aligned.")


def _fresh_ids(ids_a: IntArray, ids_b: IntArray, added: IntArray) -> IntArray:
    """Return ids for the rows `added` of b: their own, or new ones if a uses them already."""
    ids = ids_b[added].copy()
    taken = np.isin(ids, ids_a)
    first = 1 + max(ids_a.max(initial=-1), ids_b.max(initial=-1))
    ids[taken] = first + np.arange(np.count_nonzero(taken))
    return ids


def _transposed(matrices: NDArray[Any]) -> FloatArray:
    """Swap the last two axes."""
    return np.asarray(matrices.swapaxes(-1, -2))
