"""Quality of stereo measurements on rendered pairs: disparities, match checks, repeated views, and retrieval."""

from typing import Any

import numpy as np

from slam_backend.core.validation import FloatArray
from slam_backend.frontend import DESCRIPTOR_TYPES, MATCH_CHECKS, FrontEndOptions, StereoFrontEnd
from slam_backend.geometry import rotation
from slam_backend.models.camera import StereoCamera
from training.bench.stereo.scenes import WALL, Named, Scene, office_views, wall_pose
from vslam_env.sensors.stereo.textures import TextureConfig
from vslam_env.world import make_world

ANGLES_DEG = (0.0, 15.0, 30.0, 45.0, 60.0)
RATIOS = (1.0, 1.25, 1.5, 2.0)
DISTANCE = 2.5  # distance of the reference views [m]
PLACES = tuple(np.arange(2.5, 12.0, 1.0).tolist())  # positions along the wall [m]
OUTLIER_PX = 1.0


def quality_row(descriptor: Any, views: int, seed: int) -> dict[str, Any]:
    """Measure rendered pairs at random poses in an office: disparities before and after each match check."""
    rng, camera = np.random.default_rng(seed), StereoCamera()
    scene = Scene(make_world("office", np.random.default_rng(seed)), camera, seed)
    front_end = StereoFrontEnd(camera, FrontEndOptions(descriptor=descriptor))
    by_corners, by_patches, passed, counts = [], [], [], []
    for view in office_views(scene, views, rng):
        frame = front_end.measure(view.left, view.right)
        matches = frame.matches
        depths = scene.eye.trace(view.pose[None], 0, matches.corners[:, 0]).depths
        true = camera.focal_px * camera.baseline / depths
        by_corners.append(matches.corner_disparity - true)
        by_patches.append(matches.disparity - true)
        passed.append(matches.passed)
        counts.append(len(frame.measurements))
    return {
        "descriptor": descriptor, "landmarks_per_frame": float(np.mean(counts)),
        "guards": guard_rows(np.concatenate(by_corners), np.concatenate(by_patches), np.concatenate(passed, axis=1)),
    }  # fmt: skip


def guard_rows(by_corners: FloatArray, by_patches: FloatArray, passed: Any) -> list[dict[str, Any]]:
    """Return the number and the quality of the matches that remain after each match check.

    Args:
        by_corners: (n,) float64 [px]. Errors of the disparities from corner columns.
        by_patches: (n,) float64 [px]. Errors of the disparities from patches, defined for matches that pass the patch
            check.
        passed: (5, n) bool. Results of the checks, as in `StereoMatches`.
    """
    kept = np.ones(passed.shape[1], dtype=np.bool_)
    rows = [_errors("all matches", by_corners)]
    for name, fine in zip(MATCH_CHECKS, passed, strict=True):
        kept &= fine
        rows.append(_errors(f"+ {name}", (by_corners if name == "mutual" else by_patches)[kept]))
    return rows


def _errors(name: str, errors: FloatArray) -> dict[str, Any]:
    inlying = np.abs(errors) <= OUTLIER_PX
    inliers = errors[inlying]
    return {
        "name": name, "matches": len(errors), "outliers": float(1.0 - inlying.mean()) if len(errors) else float("nan"),
        "rms_px": float(np.sqrt(np.mean(inliers**2))) if len(inliers) else float("nan"),
        "median_px": float(np.median(np.abs(inliers))) if len(inliers) else float("nan"),
        "bias_px": float(inliers.mean()) if len(inliers) else float("nan"),
    }  # fmt: skip


def retrieval(descriptor: Any, window: float | None, style: str, seed: int) -> dict[str, Any]:
    """Measure how well landmarks of a wall are retrieved by descriptor from other angles and distances.

    The map contains the points that cameras at ten places see frontally from 2.5 m. Queries count if their true
    landmark is in the map. Recall: the nearest descriptor in the map is of the right landmark. Precision: share of
    right landmarks among the nearest ones within the gate.

    Args:
        window: Constant physical size of the descriptor window [m]; None: constant size in the image.
    """
    rng, camera = np.random.default_rng(seed), StereoCamera()
    scene = Scene(WALL, camera, seed, TextureConfig(style=style))
    front_end = StereoFrontEnd(camera, FrontEndOptions(descriptor=descriptor, window=window))
    corners = scene.corners(front_end)

    def seen(distance: float, angle: float) -> list[Named]:
        poses = [wall_pose(along, distance, angle) for along in PLACES]
        return [scene.named(scene.look(pose, rng), front_end, corners) for pose in poses]

    known = seen(DISTANCE, 0.0)
    names = np.concatenate([view.names for view in known])
    described = np.concatenate([view.frame.measurements.descriptors for view in known])[names >= 0]
    names = names[names >= 0]
    gate = DESCRIPTOR_TYPES[descriptor].gate

    def score(distance: float, angle: float) -> dict[str, Any]:
        right, accepted, accepted_right, total = 0, 0, 0, 0
        for view in seen(distance, angle):
            asked = np.isin(view.names, names)
            if not asked.any():
                continue
            queries = view.frame.measurements.descriptors[asked]
            squares = 2.0 - 2.0 * queries @ described.T
            best = squares.argmin(axis=1)
            fine = names[best] == view.names[asked]
            near = squares[np.arange(len(best)), best] <= gate * gate
            right, total = right + int(fine.sum()), total + len(fine)
            accepted, accepted_right = accepted + int(near.sum()), accepted_right + int((fine & near).sum())
        nan = float("nan")
        return {
            "queries": total, "recall": right / total if total else nan,
            "precision": accepted_right / accepted if accepted else nan, "accepted": accepted / total if total else nan,
        }  # fmt: skip

    return {
        "descriptor": descriptor, "window": window, "style": style, "map": len(names),
        "angles": {f"{angle:g}": score(DISTANCE, np.radians(angle)) for angle in ANGLES_DEG},
        "ratios": {f"{ratio:g}": score(DISTANCE * ratio, 0.0) for ratio in RATIOS},
    }  # fmt: skip


def second_looks(seed: int) -> dict[str, Any]:
    """Measure landmarks of the wall from several places; return the consistency of their differences.

    Returns:
        Number of pairs of views; ANEES (divided by 3, ideal 1) over the pairs whose difference is within the 99.9 %
        gate, and the share of these, for the default camera noise and for twice this noise.
    """
    rng, camera = np.random.default_rng(seed), StereoCamera()
    scene = Scene(WALL, camera, seed)
    front_end = StereoFrontEnd(camera)
    corners = scene.corners(front_end)
    views = [(2.0, 0.0), (2.5, 0.35), (3.5, -0.3), (4.5, 0.1)]
    poses = [wall_pose(along, distance, angle) for along in PLACES[::2] for distance, angle in views]
    looks = [(pose, scene.named(scene.look(pose, rng), front_end, corners)) for pose in poses]
    result: dict[str, Any] = {}
    for scale in (1.0, 2.0):
        values = []
        for i, (pose_a, a) in enumerate(looks):
            for pose_b, b in looks[:i]:
                shared, rows_a, rows_b = np.intersect1d(a.names, b.names, return_indices=True)
                rows_a, rows_b = rows_a[shared >= 0], rows_b[shared >= 0]
                away = a.world[rows_a] - b.world[rows_b]
                spread = scale**2 * (_world_covariances(a, pose_a, camera)[rows_a])
                spread = spread + scale**2 * (_world_covariances(b, pose_b, camera)[rows_b])
                values.append(np.einsum("ni,ni->n", away, np.linalg.solve(spread, away[..., None])[..., 0]))
        squares = np.concatenate(values)
        within = squares <= 16.27  # 99.9 % of chi-square with 3 degrees of freedom
        result[f"{scale:g}"] = {
            "pairs": len(squares), "within": float(within.mean()), "anees": float(squares[within].mean() / 3.0),
        }  # fmt: skip
    return result


def _world_covariances(view: Named, pose: FloatArray, camera: StereoCamera) -> FloatArray:
    """Return the covariances (n, 3, 3) [m^2], world frame, of a view's points by the camera model."""
    axes = np.zeros((3, 3))  # robot axes from camera axes, then the heading
    axes[:2, :2] = rotation(pose[2])
    axes[2, 2] = 1.0
    turn = axes @ np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    return np.asarray(turn @ camera.covariance(view.frame.measurements.points) @ turn.T)
