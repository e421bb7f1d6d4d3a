"""Replay of stereo images of a drive in the plane: front end, visual odometry and filter.

Odometry and filter must not use the same noise twice: the features of a frame alternate between the visual odometry
and the filter.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.fastslam.existence import ExistenceModel
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.options import FilterOptions
from slam_backend.fastslam.reports import StepReport
from slam_backend.frontend import DESCRIPTOR_TYPES, CornerOptions, FrontEndOptions, StereoFrame, StereoFrontEnd
from slam_backend.frontend.odometry import camera_motion
from slam_backend.models.camera import StereoCamera
from slam_backend.models.measurements import Measurements
from slam_backend.models.odometry import OdometryModel
from slam_backend.readers.kitti_images import KittiImages, load_kitti_images
from slam_backend.readers.stereo_files import StereoFiles, load_stereo_images
from training.replay.config import NEAREST, ImagesConfig
from training.replay.kitti import DriveScore, drive_metrics, score_drive
from training.replay.single_robot import PLANAR_GATE, OneReplay, metrics_of, replay_one

CORNERS = 2500  # number of corners in an image of KITTI's size
# Errors of a visual odometry from half of the features, per metre and per frame, on the drive of the first 51 frames
# of KITTI 06: 1.6 cm along, 0.9 cm across, 0.0009 rad at 1.2 m per frame.
ODOMETRY = OdometryModel(
    sigma_along=0.01, sigma_across=0.005, sigma_heading=0.001, sigma_turn=0.02, floor_position=0.005, floor_heading=5e-4
)
ODOMETRY_SIGMA, ODOMETRY_SIGMA_DISPARITY = 0.5, 0.3  # noise of features between two frames [px]


@dataclass(frozen=True, slots=True, eq=False)
class ImagesReplay:
    """Results of a drive with images."""

    replay: OneReplay  # Estimates of the filter; poses are of the left camera
    # (T,) int64. Inlier features of each motion; 0 for the first frame, and where the motion was extrapolated from the
    # previous one.
    odometry_inliers: IntArray
    features: IntArray  # (T,) int64. Numbers of points measured by the front end.
    front_end_seconds: float  # Computing time of front end and visual odometry [s]
    last: StereoFrame  # Last frame, as measured by the front end
    last_ids: IntArray  # (n,) int64. Landmark ids of its points that the filter used; -1 = rejected.
    # Last measured height of each landmark above the camera, by id [m]; the filter has no heights
    heights: dict[int, float]


def load_images(config: ImagesConfig) -> KittiImages:
    """Read a drive.

    Raises:
        ValueError: If a file is missing or cannot be read.
    """
    if config.left is None or config.right is None or config.calibration is None:
        return load_kitti_images(config.path, config.truth, config.duration)
    names = {"left": config.left, "right": config.right, "calibration": config.calibration}
    files = StereoFiles(**names, times=config.times, truth=config.truth)
    return load_stereo_images(config.path, files, config.duration)


def make_camera(log: KittiImages, max_range: float, sigma_px: float, sigma_disparity_px: float) -> StereoCamera:
    """Return the camera of a drive with a range [m] and standard deviations [px]."""
    sigmas = {"sigma_px": sigma_px, "sigma_disparity_px": sigma_disparity_px}
    return log.pair.camera(log.width, log.height, max_range=max_range, **sigmas)


def replay_images(
    log: KittiImages, config: ImagesConfig, on_step: Callable[[float], None] = lambda done: None
) -> ImagesReplay:
    """Run front end, visual odometry and filter on a drive."""
    options = FilterOptions(
        num_particles=config.particles,
        camera=make_camera(log, config.max_range, config.sigma_px, config.sigma_disparity_px),
        motion=ODOMETRY,
        proposal=config.estimator,
        rejuvenate_every=config.rejuvenate_every or None,
        position_gate=PLANAR_GATE,
        descriptor_gate=DESCRIPTOR_TYPES[config.descriptor].gate,
        # Streets are repetitive: many similar points at once would be mistaken for a lost pose.
        recovery_position=0.0,
        existence=ExistenceModel(detection=0.6),
    )
    filter_seed, sample_seed = np.random.SeedSequence(config.seed).spawn(2)
    slam = FastSlam.from_options(1, options, filter_seed)
    eye = _StereoFrontEnd(log, config, np.random.default_rng(sample_seed))
    steps = map(eye.look, range(len(log.times)))
    replay = replay_one(slam, log.times, steps, on_step, on_report=eye.remember)
    return ImagesReplay(
        replay=replay, odometry_inliers=eye.inliers, features=eye.features, front_end_seconds=eye.seconds,
        last=eye.frame, last_ids=eye.ids, heights=eye.heights,
    )  # fmt: skip


class _StereoFrontEnd:
    """Front end and visual odometry of a drive, frame by frame; attributes as in `ImagesReplay`."""

    frame: StereoFrame
    ids: IntArray

    def __init__(self, log: KittiImages, config: ImagesConfig, rng: np.random.Generator) -> None:
        self._log, self._rng, self._gate = log, rng, DESCRIPTOR_TYPES[config.descriptor].gate
        self._camera = make_camera(log, config.max_range, ODOMETRY_SIGMA, ODOMETRY_SIGMA_DISPARITY)
        seen = FrontEndOptions(descriptor=config.descriptor, corners=CornerOptions(most=CORNERS), nearest=NEAREST)
        self._front_end = StereoFrontEnd(self._camera, seen, log.pair.centre_px)
        self._before: Measurements | None = None
        self._motion = np.zeros(3)
        self.inliers, self.features = (np.zeros(len(log.times), np.int64) for _ in range(2))
        self.seconds = 0.0
        self.heights: dict[int, float] = {}

    def look(self, step: int) -> tuple[FloatArray, Measurements]:
        """Return the motion since the previous frame (3,) [m, m, rad], and this frame's measurements for the filter."""
        images = self._log.images(step)
        begin = time.perf_counter()
        self.frame = self._front_end.measure(*images)
        points, descriptors = self.frame.measurements.points, self.frame.measurements.descriptors
        own = Measurements(points[1::2], descriptors[1::2])
        if self._before is not None:
            moved = camera_motion(self._before, own, self._camera, self._gate, self._rng)
            if moved is not None:
                self._motion, self.inliers[step] = moved.planar, int(moved.inliers.sum())
        self._before, self.features[step] = own, len(points)
        self.seconds += time.perf_counter() - begin
        level = points[::2].copy()
        level[:, 1] = 0.0  # a planar model has no rows; see `slam_backend.readers.kitti`
        return self._motion, Measurements(level, descriptors[::2])

    def remember(self, report: StepReport) -> None:
        """Record the landmarks of the frame's points, and their heights."""
        self.ids = report.associations[0]
        self.heights |= zip(self.ids.tolist(), (-self.frame.measurements.points[::2, 1]).tolist(), strict=True)


def score_images(result: OneReplay, log: KittiImages) -> DriveScore | None:
    """Score a replay against the true path; None without ground truth."""
    return None if log.truth is None else score_drive((result.path, result.reckoned), log.truth)


def summarise_images(result: ImagesReplay, scored: DriveScore | None) -> dict[str, Any]:
    """Return the content of `metrics.json`; unknown values are NaN, including errors of the map."""
    return metrics_of(
        result.replay, scored.scores if scored else None, drive_metrics(scored, "visual_odometry"),
        landmarks_seen_three_times=int((result.replay.landmarks.counts >= 3).sum()),
        features_per_frame=float(result.features.mean()),
        odometry_inliers_per_frame=float(result.odometry_inliers[1:].mean()),
    )  # fmt: skip
