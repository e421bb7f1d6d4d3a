"""The replay of stereo images of a drive: front end, visual odometry and filter, in the plane.

Odometry and filter must not use the same noise twice: the features of a frame are dealt out in turn, one to the visual
odometry, one to the filter.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray, check_choice, check_float
from slam_backend.fastslam.existence import ExistenceModel
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.options import FilterOptions
from slam_backend.fastslam.reports import StepReport
from slam_backend.frontend import DESCRIPTORS, KINDS, CornerOptions, FrontEndOptions, StereoFrame, StereoFrontEnd
from slam_backend.frontend.odometry import camera_motion
from slam_backend.models.camera import StereoCamera
from slam_backend.models.measurements import Measurements
from slam_backend.models.odometry import OdometryModel
from slam_backend.readers.kitti_images import KittiImages, load_kitti_images
from slam_backend.readers.stereo_files import StereoFiles, load_stereo_images
from training.experiments.config import PlainConfig
from training.replay.config import REJUVENATE_EVERY, check_common
from training.replay.kitti import mean_drift
from training.replay.single_robot import (
    PLANAR_GATE,
    OneReplay,
    PositionScore,
    end_errors,
    metrics_of,
    path_length,
    replay_one,
    score_paths,
)

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
        left: Images of the left eye, as `StereoFiles` has it; None: the folder is laid out as KITTI's.
        right: Images of the right eye, as `left`.
        calibration: Calibration of the rig, as above.
        times: File of the seconds of the frames, or None for that of the folder.
        truth: File of the true poses, or None for that of the folder.
        duration: Seconds to replay [s], or None for all.
        particles: Of the filter.
        estimator: Its proposal.
        rejuvenate_every: Steps of the log after which particles are drawn anew from smoothed paths, as `FilterOptions`
            has it; 0: never.
        seed: Of all random draws.
        descriptor: "usurf", "sift" or "orb".
        max_range: Points farther than this are dropped [m].
        sigma_px: Standard deviation of a feature's column that the filter assumes [px]; it covers the car's pitch and
            roll, which a plane does not know.
        sigma_disparity_px: Likewise of its disparity [px].
    """

    path: str
    left: str | None = None
    right: str | None = None
    calibration: str | None = None
    times: str | None = None
    truth: str | None = None
    duration: float | None = None
    particles: int = 100
    estimator: Literal["fastslam2", "fastslam1"] = "fastslam2"
    rejuvenate_every: int = REJUVENATE_EVERY
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

    def load(self) -> KittiImages:
        """Read the drive.

        Raises:
            ValueError: If a file is missing or cannot be read.
        """
        if self.left is None or self.right is None or self.calibration is None:
            return load_kitti_images(self.path, self.truth, self.duration)
        names = {"left": self.left, "right": self.right, "calibration": self.calibration}
        return load_stereo_images(self.path, StereoFiles(**names, times=self.times, truth=self.truth), self.duration)

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
    options = FilterOptions(
        num_particles=config.particles,
        camera=config.camera(log, config.sigma_px, config.sigma_disparity_px),
        motion=ODOMETRY,
        proposal=config.estimator,
        rejuvenate_every=config.rejuvenate_every or None,
        position_gate=PLANAR_GATE,
        descriptor_gate=KINDS[config.descriptor].gate,
        # A street repeats itself: many look-alikes at once would be taken for a lost pose.
        recovery_position=0.0,
        existence=ExistenceModel(detection=0.6),
    )
    filter_seed, sample_seed = np.random.SeedSequence(config.seed).spawn(2)
    slam = FastSlam.from_options(1, options, filter_seed)
    eye = _Eye(log, config, np.random.default_rng(sample_seed))
    steps = map(eye.look, range(len(log.times)))
    replay = replay_one(slam, log.times, steps, on_step, on_report=eye.remember)
    return ImagesReplay(
        replay=replay,
        odometry_inliers=eye.inliers,
        features=eye.features,
        front_end_seconds=eye.seconds,
        last=eye.frame,
        last_ids=eye.ids,
        heights=eye.heights,
    )


class _Eye:
    """Front end and visual odometry of a drive, frame by frame; attributes as in `ImagesReplay`."""

    frame: StereoFrame
    ids: IntArray

    def __init__(self, log: KittiImages, config: ImagesConfig, rng: np.random.Generator) -> None:
        self._log, self._rng, self._gate = log, rng, KINDS[config.descriptor].gate
        self._camera = config.camera(log, ODOMETRY_SIGMA, ODOMETRY_SIGMA_DISPARITY)
        seen = FrontEndOptions(descriptor=config.descriptor, corners=CornerOptions(most=CORNERS), nearest=NEAREST)
        self._front_end = StereoFrontEnd(self._camera, seen, log.pair.centre_px)
        self._before: Measurements | None = None
        self._motion = np.zeros(3)
        self.inliers, self.features = (np.zeros(len(log.times), np.int64) for _ in range(2))
        self.seconds = 0.0
        self.heights: dict[int, float] = {}

    def look(self, step: int) -> tuple[FloatArray, Measurements]:
        """Return the motion since the frame before (3,) [m, m, rad], and what the filter is given of this one."""
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
        level[:, 1] = 0.0  # a plane knows no rows; see `slam_backend.readers.kitti`
        return self._motion, Measurements(level, descriptors[::2])

    def remember(self, report: StepReport) -> None:
        """Keep which landmarks the frame's points are of, and how high these are."""
        self.ids = report.associations[0]
        self.heights |= zip(self.ids.tolist(), (-self.frame.measurements.points[::2, 1]).tolist(), strict=True)


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
        drifts: Mean errors of the motions over segments, of the estimate and of the visual odometry; see `mean_drift`.
    """

    truth: FloatArray
    length: float
    estimate: PositionScore
    odometry: PositionScore
    end_error: float
    odometry_end_error: float
    drifts: tuple[float, float]


def score_images(result: OneReplay, log: KittiImages) -> ImagesScore | None:
    """Score a replay against the true path; None if that is not known."""
    if log.truth is None:
        return None
    truth = log.truth.poses[: len(result.times)]
    paths = (result.path, result.reckoned)
    scores = score_paths(paths, truth)
    ends, drifts = end_errors(paths, truth), (mean_drift(paths[0], truth), mean_drift(paths[1], truth))
    return ImagesScore(truth, path_length(truth), scores[0], scores[1], ends[0], ends[1], drifts)


def summarise_images(result: ImagesReplay, scored: ImagesScore | None) -> dict[str, Any]:
    """Return the content of `metrics.json`; what cannot be known is NaN, as are errors of the map."""
    nan, one = float("nan"), result.replay
    own = {
        "true_path_m": scored.length if scored else nan,
        "end_error_m": scored.end_error if scored else nan,
        "end_error_percent": 100.0 * scored.end_error / scored.length if scored else nan,
        "visual_odometry_end_error_m": scored.odometry_end_error if scored else nan,
        "mean_drift": scored.drifts[0] if scored else nan,
        "visual_odometry_mean_drift": scored.drifts[1] if scored else nan,
    }
    return metrics_of(
        one,
        (scored.estimate, scored.odometry) if scored else None,
        own,
        landmarks_seen_three_times=int((one.landmarks.counts >= 3).sum()),
        features_per_frame=float(result.features.mean()),
        odometry_inliers_per_frame=float(result.odometry_inliers[1:].mean()),
    )
