"""Quality of stereo measurements on rendered pairs: disparities, match checks, repeated views, and retrieval."""

from functools import lru_cache
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.frontend import MATCH_CHECKS, FrontEndOptions, StereoFrontEnd
from slam_backend.geometry import rotation
from slam_backend.models.camera import StereoCamera
from studies.front_end.scenes import WALL, Named, Scene, office_views, wall_pose
from vslam_env.sensors.stereo.ground_truth import TextureCorners
from vslam_env.sensors.stereo.textures import TextureConfig
from vslam_env.world import make_world

ANGLES_DEG = (0.0, 15.0, 30.0, 45.0, 60.0)
RATIOS = (1.0, 1.25, 1.5, 2.0)
DISTANCE = 2.5  # distance of the reference views [m]
PLACES = tuple(np.arange(2.5, 12.0, 1.0).tolist())  # positions along the wall [m]
OUTLIER_PX = 1.0
GATE = 16.27  # 99.9 % of chi-square with 3 degrees of freedom
CHECKS = ("all matches", *MATCH_CHECKS)


class Disparities(NamedTuple):
    """Errors of the disparities of n matches.

    Attributes:
        by_corners: (n,) float64 [px]. Errors of the disparities from corner columns.
        by_patches: (n,) float64 [px]. Errors of the disparities from patches, defined for matches that pass the patch
            check.
        passed: (5, n) bool. Results of the checks, as in `StereoMatches`.
    """

    by_corners: FloatArray
    by_patches: FloatArray
    passed: BoolArray

    def after(self, check: str) -> dict[str, Any]:
        """Return number and quality of the matches that pass all checks up to a given one."""
        place = CHECKS.index(check)
        kept = self.passed[:place].all(axis=0)
        errors = (self.by_corners if place <= CHECKS.index("mutual") else self.by_patches)[kept]
        inlying = np.abs(errors) <= OUTLIER_PX
        row: dict[str, Any] = {"matches": len(errors)}
        if inlying.any():
            inliers = errors[inlying]
            row |= {
                "outlier_share": float(1.0 - inlying.mean()), "rms_px": float(np.sqrt(np.mean(inliers**2))),
                "median_px": float(np.median(np.abs(inliers))), "bias_px": float(inliers.mean()),
            }  # fmt: skip
        return row


@lru_cache(maxsize=1)
def office_disparities(descriptor: Any, views: int, seed: int) -> Disparities:
    """Measure rendered pairs at random poses in an office."""
    rng, camera = np.random.default_rng(seed), StereoCamera()
    scene = Scene(make_world("office", np.random.default_rng(seed)), camera, seed)
    front_end = StereoFrontEnd(camera, FrontEndOptions(descriptor=descriptor))
    found = []
    for view in office_views(scene, views, rng):
        matches = front_end.measure(view.left, view.right).matches
        depths = scene.eye.trace(view.pose[None], 0, matches.corners[:, 0]).depths
        true = camera.focal_px * camera.baseline / depths
        found.append((matches.corner_disparity - true, matches.disparity - true, matches.passed))
    return Disparities(*(np.concatenate(each, axis=-1) for each in zip(*found, strict=True)))


class WallMap(NamedTuple):
    """Landmarks that cameras at ten places see frontally on a wall, from 2.5 m."""

    scene: Scene
    front_end: StereoFrontEnd
    corners: TextureCorners
    names: IntArray  # (n,) int64. True landmarks.
    descriptors: FloatArray  # (n, d) float32. Descriptors of these.

    def seen(self, distance: float, angle: float, rng: np.random.Generator) -> list[Named]:
        """Return the views of all places from a distance [m] and an angle [rad]."""
        poses = [wall_pose(along, distance, angle) for along in PLACES]
        return [self.scene.named(self.scene.look(pose, rng), self.front_end, self.corners) for pose in poses]


@lru_cache(maxsize=1)
def map_wall(descriptor: Any, window: float | None, style: str, seed: int) -> WallMap:
    """Map a wall, with descriptor windows of a constant physical size [m] (None: of a constant size in the image)."""
    camera = StereoCamera()
    scene = Scene(WALL, camera, seed, TextureConfig(style=style))
    front_end = StereoFrontEnd(camera, FrontEndOptions(descriptor=descriptor, window=window))
    empty = WallMap(scene, front_end, scene.corners(front_end), np.zeros(0, np.int64), np.zeros((0, 0)))
    views = empty.seen(DISTANCE, 0.0, np.random.default_rng(seed))
    names = np.concatenate([view.names for view in views])
    described = np.concatenate([view.frame.measurements.descriptors for view in views])
    return empty._replace(names=names[names >= 0], descriptors=described[names >= 0])


def retrieve(known: WallMap, gate: float, angle_deg: float, ratio: float, seed: int) -> dict[str, Any]:
    """Measure how well landmarks of a wall are retrieved by descriptor from another angle and distance.

    Queries count if their true landmark is in the map.

    Returns:
        `queries`, their number; `recall`: share whose nearest descriptor in the map is of the right landmark;
        `precision`: share of right landmarks among the nearest ones within the gate; `accepted`: share within the gate.
    """
    right: list[BoolArray] = []
    near: list[BoolArray] = []
    for view in known.seen(DISTANCE * ratio, np.radians(angle_deg), np.random.default_rng(seed + 1)):
        asked = np.isin(view.names, known.names)
        if asked.any():
            squares = 2.0 - 2.0 * view.frame.measurements.descriptors[asked] @ known.descriptors.T
            best = squares.argmin(axis=1)
            right.append(known.names[best] == view.names[asked])
            near.append(squares.min(axis=1) <= gate * gate)
    if not right:
        return {"queries": 0}
    fine, within = np.concatenate(right), np.concatenate(near)
    return {
        "queries": len(fine), "recall": float(fine.mean()), "accepted": float(within.mean()),
        "precision": float(fine[within].mean()) if within.any() else None,
    }  # fmt: skip


def repeat_views(seed: int, scale: float) -> dict[str, Any]:
    """Measure landmarks of the wall from several places; return the consistency of their differences.

    Args:
        scale: Factor of the assumed camera noise over the default one.

    Returns:
        Number of `pairs` of views; `anees` (divided by 3, ideal 1) over the pairs whose difference is `within` the
        99.9 % gate, and the share of these.
    """
    rng, camera = np.random.default_rng(seed), StereoCamera()
    scene = Scene(WALL, camera, seed)
    front_end = StereoFrontEnd(camera)
    corners = scene.corners(front_end)
    views = [(2.0, 0.0), (2.5, 0.35), (3.5, -0.3), (4.5, 0.1)]
    poses = [wall_pose(along, distance, angle) for along in PLACES[::2] for distance, angle in views]
    looks = [(pose, scene.named(scene.look(pose, rng), front_end, corners)) for pose in poses]
    values = []
    for (pose_b, b), (pose_a, a) in combinations(looks, 2):
        shared, rows_a, rows_b = np.intersect1d(a.names, b.names, return_indices=True)
        rows_a, rows_b = rows_a[shared >= 0], rows_b[shared >= 0]
        away = a.world[rows_a] - b.world[rows_b]
        spread = _world_covariances(a, pose_a, camera)[rows_a] + _world_covariances(b, pose_b, camera)[rows_b]
        values.append(np.einsum("ni,ni->n", away, np.linalg.solve(spread, away[..., None])[..., 0]))
    squares = np.concatenate(values) / scale**2
    within = squares <= GATE
    return {"pairs": len(squares), "within": float(within.mean()), "anees": float(squares[within].mean() / 3.0)}


def _world_covariances(view: Named, pose: FloatArray, camera: StereoCamera) -> FloatArray:
    """Return the covariances (n, 3, 3) [m^2], world frame, of a view's points by the camera model."""
    axes = np.zeros((3, 3))  # robot axes from camera axes, then the heading
    axes[:2, :2] = rotation(pose[2])
    axes[2, 2] = 1.0
    turn = axes @ np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    return np.asarray(turn @ camera.covariance(view.frame.measurements.points) @ turn.T)
