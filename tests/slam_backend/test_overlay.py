"""The compiled test of whether a map kept its shape agrees with the plain one."""

import numpy as np

from slam_backend.core.validation import FloatArray
from slam_backend.geometry import rotate_covariances, rotation, transform_points
from slam_backend.maps.alignment import AlignmentOptions
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.team.merge_monitor import moved_share

FITS = 10


def plain_share(old: LandmarkMap, joint: LandmarkMap, options: AlignmentOptions) -> float:
    """Return the share of landmarks beyond the gate, by matrices and ten fits whatever the set of those within it."""
    _, rows, places = np.intersect1d(old.ids, joint.ids, return_indices=True)
    if len(rows) < options.min_inliers:
        return 0.0
    points, targets = old.means[rows], joint.means[places]
    inside, outside = np.ones(len(rows)), np.zeros(len(rows), np.bool_)
    for _ in range(FITS):
        motion = rigid_motion(points, targets, inside)
        covariances = rotate_covariances(motion[2], old.covariances[rows]) + joint.covariances[places]
        residuals = targets - transform_points(motion, points)
        widened = covariances + options.position_floor**2 * np.eye(3)
        squares = np.einsum("ni,ni->n", residuals, np.linalg.solve(widened, residuals[..., None])[..., 0])
        outside = squares > options.position_gate
        inside = np.where(outside, 1e-3, 1.0)
    return float(np.mean(outside))


def rigid_motion(points: FloatArray, targets: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the planar motion (3,) that takes points (n, 3) to targets (n, 3) by weighted least squares."""
    shares = weights / weights.sum()
    here, there = shares @ points[:, :2], shares @ targets[:, :2]
    spread = ((points[:, :2] - here) * shares[:, None]).T @ (targets[:, :2] - there)
    angle = np.arctan2(spread[0, 1] - spread[1, 0], spread[0, 0] + spread[1, 1])
    return np.array([*(there - rotation(angle) @ here), angle])


def covariances(rng: np.random.Generator, count: int) -> FloatArray:
    """Return covariances (count, 3, 3) of any shape [m^2]."""
    roots = 0.1 * rng.standard_normal((count, 3, 3))
    return roots @ roots.transpose(0, 2, 1) + 1e-4 * np.eye(3)


def test_the_kernel_agrees_with_matrices() -> None:
    """Of maps bent anyhow, some landmarks lost and renumbered, the same share has moved."""
    shares = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        means = rng.uniform(-9.0, 9.0, (60, 3)) * [1.0, 1.0, 0.1]
        old = LandmarkMap(means, covariances(rng, 60), np.eye(60, 5), None, rng.permutation(60))
        bent = transform_points(rng.uniform(-3.0, 3.0, 3), means) + rng.normal(0.0, 0.2, (60, 3))
        bent[: 5 * seed, :2] += rng.uniform(0.5, 1.5, 2)
        kept = rng.permutation(60)[:40]
        joint = LandmarkMap(bent[kept], covariances(rng, 40), np.eye(40, 5), None, old.ids[kept])
        for options in (AlignmentOptions(), AlignmentOptions(position_gate=3.0), AlignmentOptions(min_inliers=41)):
            shares.append(plain_share(old, joint, options))
            assert moved_share(old, joint, options) == shares[-1]
    assert len(set(shares)) > 8
