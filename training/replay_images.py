"""The replay of stereo images of a drive: front end, visual odometry and filter, in the plane.

Odometry and filter must not use the same noise twice: the features of a frame are dealt out in turn, one to the visual
odometry, one to the filter.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from slam_backend.camera import StereoCamera
from slam_backend.errors import FloatArray, IntArray, check_choice, check_float
from slam_backend.existence import ExistenceModel
from slam_backend.filter import FastSlam
from slam_backend.filter_options import FilterOptions
from slam_backend.frontend import DESCRIPTORS, KINDS, CornerOptions, FrontEndOptions, StereoFrame, StereoFrontEnd
from slam_backend.frontend.odometry import camera_motion
from slam_backend.geometry import compose, inverse
from slam_backend.measurements import Measurements
from slam_backend.motion import OdometryModel
from slam_backend.readers.kitti_images import KittiImages
from slam_backend.trajectory import dead_reckoning
from training.plain_config import PlainConfig
from training.replay_config import check_common
from training.replay_one import PLANAR_GATE, OneReplay, PositionScore, score_positions

CORNERS = 2500  # of an image of KITTI's size, spread over it
NEAREST = 3.0  # [m] nothing of interest is nearer to a car's cameras
# What a visual odometry of half of the features was off by, per metre and per frame, on the drive that came with the
# first 51 frames of KITTI 06: 1.6 cm along, 0.9 cm across, 0.0009 rad at 1.2 m a frame.
ODOMETRY = OdometryModel(
    sigma_along=0.01, sigma_across=0.005, sigma_heading=0.001, sigma_turn=0.02, floor_position=0.005, floor_heading=5e-4
)
ODOMETRY_SIGMA, ODOMETRY_SIGMA_DISPARITY = 0.5, 0.3  # [px] of features within two frames


@dataclass(frozen=True, slots=True, kw_only=True)
class ImagesConfig(PlainConfig):
    """All that decides a replay of images.

    Attributes:
        path: Folder of the drive.
        truth: File of the true poses, or None for that of the folder.
        duration: Seconds to replay [s], or None for all.
        particles: Of the filter.
        estimator: Its proposal.
        rejuvenate_every: Steps of the log after which particles are drawn anew from smoothed paths, as `FilterOptions`
            has it; None: never.
        seed: Of all random draws.
        descriptor: "usurf", "sift" or "orb".
        max_range: Points farther than this are dropped [m].
        sigma_px: Standard deviation of a feature's column that the filter assumes [px]; it covers the car's pitch and
            roll, which a plane does not know.
        sigma_disparity_px: Likewise of its disparity [px].
    """

    path: str
    truth: str | None = None
    duration: float | None = None
    particles: int = 100
    estimator: Literal["fastslam2", "fastslam1"] = "fastslam2"
    rejuvenate_every: int | None = None
    seed: int = 0
    descriptor: Literal["usurf", "sift", "orb"] = "usurf"
    max_range: float = 40.0
    sigma_px: float = 2.0
    sigma_disparity_px: float = 0.5

    def __post_init__(self) -> None:
        check_common(self.particles, self.estimator, self.seed, self.duration, self.rejuvenate_every)
        check_choice("descriptor", self.descriptor, DESCRIPTORS)
        check_float("max_range", self.max_range, "Give metres.", above=NEAREST)
        for name in ("sigma_px", "sigma_disparity_px"):
            check_float(name, getattr(self, name), "Give pixels.", above=0.0)

    def camera(self, log: KittiImages, sigma_px: float, sigma_disparity_px: float) -> StereoCamera:
        """Return the drive's camera with these standard deviations [px]."""
        sigmas = {"sigma_px": sigma_px, "sigma_disparity_px": sigma_disparity_px}
        return log.pair.camera(log.width, log.height, max_range=self.max_range, **sigmas)


@dataclass(frozen=True, slots=True, eq=False)
class ImagesReplay:
    """What came of a drive's images.

    Attributes:
        replay: What the filter estimated; poses are those of the left camera.
        odometry_inliers: (T,) int64. Pairs of features that agreed with each motion; 0 for the first, and where the
            motion before was taken to go on.
        features: (T,) int64. Points that the front end measured.
        front_end_seconds: What front end and visual odometry took for all frames [s].
        last: What the front end made of the last frame.
        last_ids: (n,) int64. Landmarks behind those of its points that the filter got; -1 = refused.
        heights: How far above the camera each landmark was last seen, by its id [m]; the filter knows none.
    """

    replay: OneReplay
    odometry_inliers: IntArray
    features: IntArray
    front_end_seconds: float
    last: StereoFrame
    last_ids: IntArray
    heights: dict[int, float]


def replay_images(
    log: KittiImages, config: ImagesConfig, on_step: Callable[[float], None] = lambda done: None
) -> ImagesReplay:
    """Let front end, visual odometry and filter live through a drive.

    Args:
        log: What `load_kitti_images` returned.
        config: Assumptions and sizes.
        on_step: Called after each frame with the share of the drive that is done, in (0, 1].
    """
    gate = KINDS[config.descriptor].gate
    near = config.camera(log, ODOMETRY_SIGMA, ODOMETRY_SIGMA_DISPARITY)
    seen = FrontEndOptions(descriptor=config.descriptor, corners=CornerOptions(most=CORNERS), nearest=NEAREST)
    eye = StereoFrontEnd(near, seen, log.pair.centre_px)
    assumed = config.camera(log, config.sigma_px, config.sigma_disparity_px)
    options = FilterOptions(
        num_particles=config.particles,
        camera=assumed,
        motion=ODOMETRY,
        proposal=config.estimator,
        rejuvenate_every=config.rejuvenate_every,
        position_gate=PLANAR_GATE,
        descriptor_gate=gate,
        # A street repeats itself: many look-alikes at once would be taken for a lost pose.
        recovery_position=0.0,
        existence=ExistenceModel(detection=0.6),
    )
    filter_seed, sample_seed = np.random.SeedSequence(config.seed).spawn(2)
    slam, rng = FastSlam.from_options(1, options, filter_seed), np.random.default_rng(sample_seed)
    count = len(log.times)
    odometry, inliers, features = np.zeros((count, 3)), np.zeros(count, np.int64), np.zeros(count, np.int64)
    path = np.zeros((count, 3))
    matched, created, rejected, filter_seconds, eye_seconds = 0, 0, 0, 0.0, 0.0
    before: Measurements | None = None
    heights: dict[int, float] = {}
    for step in range(count):
        images = log.images(step)
        begin = time.perf_counter()
        frame = eye.measure(*images)
        points, descriptors = frame.measurements.points, frame.measurements.descriptors
        own = Measurements(points[1::2], descriptors[1::2])
        if before is not None:
            moved = camera_motion(before, own, near, gate, rng)
            odometry[step] = odometry[step - 1] if moved is None else moved.planar
            inliers[step] = 0 if moved is None else int(moved.inliers.sum())
        before, features[step] = own, len(points)
        eye_seconds += time.perf_counter() - begin
        begin = time.perf_counter()
        level = points[::2].copy()
        level[:, 1] = 0.0  # a plane knows no rows; see `slam_backend.readers.kitti_steps`
        report = slam.step([odometry[step] if step else None], [Measurements(level, descriptors[::2])])
        path[step] = slam.pose().mean
        heights |= zip(report.associations[0].tolist(), (-points[::2, 1]).tolist(), strict=True)
        filter_seconds += time.perf_counter() - begin
        matched, created = matched + report.num_matched, created + report.num_new
        rejected += report.num_rejected
        on_step((step + 1) / count)
    return ImagesReplay(
        replay=OneReplay(
            times=log.times,
            path=path,
            reckoned=dead_reckoning(np.zeros(3), odometry[1:]),
            landmarks=slam.map(),
            matched=matched,
            created=created,
            rejected=rejected,
            seconds=filter_seconds,
        ),
        odometry_inliers=inliers,
        features=features,
        front_end_seconds=eye_seconds,
        last=frame,
        last_ids=report.associations[0],
        heights=heights,
    )


@dataclass(frozen=True, slots=True, eq=False)
class ImagesScore:
    """Paths of the left camera against the true one, in the plane.

    Attributes:
        truth: (n, 3) float64 [m, m, rad]. At the first n frames.
        length: Of the true path [m].
        estimate: Score of the estimate.
        odometry: Score of the visual odometry alone.
        end_error: Distance at the last known pose, from the true start, no fit [m].
        odometry_end_error: Likewise of the visual odometry [m].
    """

    truth: FloatArray
    length: float
    estimate: PositionScore
    odometry: PositionScore
    end_error: float
    odometry_end_error: float


def score_images(result: OneReplay, log: KittiImages) -> ImagesScore | None:
    """Score a replay against the true path; None if that is not known."""
    if log.truth is None:
        return None
    truth = log.truth.poses[: len(result.times)]
    scores, ends = [], []
    for path in (result.path, result.reckoned):
        start = compose(truth[0], inverse(path[0]))
        scores.append(score_positions(path[: len(truth), :2], truth[:, :2], start))
        ends.append(float(np.hypot(*(compose(start, path[len(truth) - 1]) - truth[-1])[:2])))
    length = float(np.hypot(*np.diff(truth[:, :2], axis=0).T).sum())
    return ImagesScore(truth, length, scores[0], scores[1], ends[0], ends[1])


def summarise_images(result: ImagesReplay, scored: ImagesScore | None) -> dict[str, Any]:
    """Return the content of `metrics.json`; what cannot be known is NaN, as are errors of the map."""
    nan, one = float("nan"), result.replay
    return {
        "robots": [
            {
                "ate_aligned_m": scored.estimate.aligned if scored else nan,
                "ate_start_m": scored.estimate.start if scored else nan,
                "dead_reckoning_ate_aligned_m": scored.odometry.aligned if scored else nan,
                "dead_reckoning_ate_start_m": scored.odometry.start if scored else nan,
                "map_rmse_m": nan,
                "map_recall": nan,
                "map_precision": nan,
                "map_error": nan,
                "path_m": float(np.hypot(*np.diff(one.path[:, :2], axis=0).T).sum()),
                "true_path_m": scored.length if scored else nan,
                "end_error_m": scored.end_error if scored else nan,
                "end_error_percent": 100.0 * scored.end_error / scored.length if scored else nan,
                "visual_odometry_end_error_m": scored.odometry_end_error if scored else nan,
            }
        ],
        "landmarks": len(one.landmarks),
        "landmarks_seen_three_times": int((one.landmarks.counts >= 3).sum()),
        "features_per_frame": float(result.features.mean()),
        "odometry_inliers_per_frame": float(result.odometry_inliers[1:].mean()),
        "measurements": {"matched": one.matched, "created": one.created, "rejected": one.rejected},
        "merges": [],
        "groups": [[1]],
        "coverage": nan,
        "duration_s": float(one.times[-1] - one.times[0]),
    }
