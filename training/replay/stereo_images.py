"""Reader of stereo images of a drive in the plane: front end and visual odometry, frame by frame.

Odometry and filter must not use the same noise twice: the features of a frame alternate between the visual odometry
and the filter.
"""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from slam_backend.core.validation import IntArray
from slam_backend.fastslam.existence import ExistenceModel
from slam_backend.frontend import DESCRIPTOR_TYPES, CornerOptions, FrontEndOptions, StereoFrame, StereoFrontEnd
from slam_backend.frontend.odometry import camera_motion
from slam_backend.models.measurements import Measurements
from slam_backend.models.odometry import OdometryModel
from slam_backend.readers.kitti_images import KittiImages, load_kitti_images
from slam_backend.readers.stereo_files import StereoFiles, load_stereo_images
from slam_backend.team.reports import TeamReport
from training.experiments.config import Descriptor
from training.replay.config import NEAREST
from training.replay.core import Replay
from training.replay.image_figures import draw_frame, expected_pixels
from training.replay.log import Log, RobotLog, Source, Step
from training.replay.metrics import PathScore
from training.replay.readers import PLANAR_GATE

CORNERS = 2500  # number of corners in an image of KITTI's size
# Errors of a visual odometry from half of the features, per metre and per frame, on the drive of the first 51 frames
# of KITTI 06: 1.6 cm along, 0.9 cm across, 0.0009 rad at 1.2 m per frame.
ODOMETRY = OdometryModel(
    sigma_along=0.01, sigma_across=0.005, sigma_heading=0.001, sigma_turn=0.02, floor_position=0.005, floor_heading=5e-4
)
ODOMETRY_SIGMA, ODOMETRY_SIGMA_DISPARITY = 0.5, 0.3  # noise of features between two frames [px]
REACH = 30.0  # [m] of landmarks that the picture of the last frame predicts


def read_images(
    path: str | Path, *, left: str | None = None, right: str | None = None, calibration: str | None = None,
    times: str | None = None, truth: str | None = None, duration: float | None = None, max_range: float = 40.0,
    descriptor: Descriptor = "usurf", sigma_px: float = 2.0, sigma_disparity_px: float = 0.5, seed: int = 0,
) -> Log:  # fmt: skip
    """Return a drive; its images are read during the replay. Poses are of the left camera.

    Without file names the folder has KITTI's layout.

    Raises:
        ValueError: If a file is missing or cannot be read.
    """
    if left is None or right is None or calibration is None:
        images = load_kitti_images(path, truth, duration)
    else:
        files = StereoFiles(left=left, right=right, calibration=calibration, times=times, truth=truth)
        images = load_stereo_images(path, files, duration)
    sigmas = {"sigma_px": sigma_px, "sigma_disparity_px": sigma_disparity_px}
    options = {
        "camera": images.pair.camera(images.width, images.height, max_range=max_range, **sigmas), "motion": ODOMETRY,
        "position_gate": PLANAR_GATE, "descriptor_gate": DESCRIPTOR_TYPES[descriptor].gate,
        # Streets are repetitive: many similar points at once would be mistaken for a lost pose.
        "recovery_position": 0.0, "existence": ExistenceModel(detection=0.6),
    }  # fmt: skip
    filter_seed, sample_seed = np.random.SeedSequence(seed).spawn(2)
    eye = CameraDrive(images, descriptor, max_range, np.random.default_rng(sample_seed))
    return Log(
        times=images.times, robots=[RobotLog(odometry=None, measurements=eye, truth=images.truth)], options=options,
        seed=filter_seed, title="stereo images in the plane", source=eye,
    )  # fmt: skip


class CameraDrive(Source):
    """Front end and visual odometry of a drive, frame by frame.

    Attributes:
        odometry_inliers: (T,) int64. Inlier features of each motion; 0 for the first frame, and where the motion was
            extrapolated from the previous one.
        features: (T,) int64. Numbers of points measured by the front end.
        seconds: Computing time of front end and visual odometry [s].
        frame: Last frame, as measured by the front end.
        ids: (n,) int64. Landmark ids of its points that the filter used; -1 = rejected.
        heights: Last measured height of each landmark above the camera, by id [m]; the filter has no heights.
    """

    frame: StereoFrame
    ids: IntArray

    def __init__(self, images: KittiImages, descriptor: Descriptor, max_range: float, rng: np.random.Generator) -> None:
        self._images, self._rng, self._gate = images, rng, DESCRIPTOR_TYPES[descriptor].gate
        sigmas = {"sigma_px": ODOMETRY_SIGMA, "sigma_disparity_px": ODOMETRY_SIGMA_DISPARITY}
        self._camera = images.pair.camera(images.width, images.height, max_range=max_range, **sigmas)
        seen = FrontEndOptions(descriptor=descriptor, corners=CornerOptions(most=CORNERS), nearest=NEAREST)
        self._front_end = StereoFrontEnd(self._camera, seen, images.pair.centre_px)
        self.odometry_inliers, self.features = (np.zeros(len(images.times), np.int64) for _ in range(2))
        self.seconds = 0.0
        self.heights: dict[int, float] = {}

    def __iter__(self) -> Iterator[Step]:
        """Yield the motion since the previous frame (3,) [m, m, rad], and the frame's measurements for the filter."""
        motion, before = np.zeros(3), None
        for step in range(len(self._images.times)):
            images = self._images.images(step)
            begin = time.perf_counter()
            self.frame = self._front_end.measure(*images)
            points, descriptors = self.frame.measurements.points, self.frame.measurements.descriptors
            own = Measurements(points[1::2], descriptors[1::2])
            if before is not None:
                moved = camera_motion(before, own, self._camera, self._gate, self._rng)
                if moved is not None:
                    motion, self.odometry_inliers[step] = moved.planar, int(moved.inliers.sum())
            before, self.features[step] = own, len(points)
            self.seconds += time.perf_counter() - begin
            level = points[::2].copy()
            level[:, 1] = 0.0  # a planar model has no rows; see `slam_backend.readers.kitti`
            yield motion, Measurements(level, descriptors[::2])

    def observe(self, report: TeamReport) -> None:
        """Record the landmarks of the frame's points, and their heights."""
        self.ids = report.associations[0]
        self.heights |= zip(self.ids.tolist(), (-self.frame.measurements.points[::2, 1]).tolist(), strict=True)

    def complete(self, metrics: dict[str, Any], result: Replay, score: PathScore | None) -> list[str]:
        """Add the errors of the visual odometry, and numbers of features."""
        row = metrics["robots"][0]
        row |= {f"visual_odometry_{end}": row[f"dead_reckoning_{end}"] for end in ("end_error_m", "mean_drift")}
        metrics["landmarks_seen_three_times"] = int((result.maps[0].counts >= 3).sum())
        features = metrics["features_per_frame"] = float(self.features.mean())
        inliers = metrics["odometry_inliers_per_frame"] = float(self.odometry_inliers[1:].mean())
        return [
            f"Odometry: visual, from half of the {features:.0f} features per frame ({inliers:.0f} inliers); the filter "
            f"uses the other half. Motion is assumed planar. Front end and odometry took "
            f"{1e3 * self.seconds / len(self.features):.0f} ms per frame."
        ]

    def draw(self, folder: Path, result: Replay) -> None:
        """Draw the last frame, with its data associations and the landmarks that were seen three times."""
        landmarks, pair = result.maps[0], self._images.pair
        often = landmarks.subset(landmarks.counts >= 3)
        means = often.means.copy()
        means[:, 2] = [self.heights[name] for name in often.ids.tolist()]
        expected = expected_pixels(means, result.paths[0, -1], pair.focal_px, pair.centre_px, REACH)
        counts = dict(zip(landmarks.ids.tolist(), landmarks.counts.tolist(), strict=True))
        image = self._images.images(len(self._images.times) - 1)[0]
        draw_frame(folder / "frame.png", image, self.frame.pixels[::2], self.ids, counts, expected)
