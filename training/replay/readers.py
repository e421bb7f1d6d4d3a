"""Readers of public logs: MR.CLAM, Victoria Park and tracked features of KITTI, and of bags of ROS, each as a `Log`.

Each returns the log at a path; further arguments have the names of the options of its command.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from slam_backend.core.validation import FloatArray
from slam_backend.geometry import between, transform_points
from slam_backend.maps.alignment import AlignmentOptions
from slam_backend.models.camera import ROBOT_FROM_CAMERA, StereoCamera
from slam_backend.models.measurements import Measurements
from slam_backend.models.odometry import OdometryModel
from slam_backend.readers import bags, kitti, mrclam, victoria
from slam_backend.team.merge_scheduler import AttemptOptions
from training.replay.config import BAG_SENSOR, MRCLAM_DRIVE, MRCLAM_MOTION, VICTORIA_MOTION
from training.replay.core import Replay
from training.replay.log import Log, RobotLog, Source
from training.replay.metrics import PathScore, most_seen, travelled
from training.replay.truth_check import wrong_landmark_notes

# A planar measurement has two degrees of freedom: 99.9 % of correct matches have a smaller squared Mahalanobis
# distance.
PLANAR_GATE = 13.8

# MR.CLAM. Given identities: barcodes cannot be confused, so that the gate only rejects gross errors; a barcode never
# creates a second landmark. Hidden identities: all landmarks have the same descriptor, and the gate has two degrees of
# freedom, since all measurements are planar; only measurements far beyond it create landmarks. With one to three
# similar landmarks in view, most of them contradict a correct pose too easily to widen it.
GATES: dict[str, dict[str, Any]] = {
    "given": {"position_gate": 1e4, "new_landmark_gate": 1e6},
    "hidden": {"position_gate": PLANAR_GATE, "new_landmark_gate": 40.0, "recovery_position": 0.0},
}
# Bags. Descriptors have the usual gates.
KNOWN_BY: dict[str, dict[str, Any]] = {"identities": GATES["given"], "positions": GATES["hidden"], "descriptors": {}}
MOTION = OdometryModel(**MRCLAM_MOTION)
# Early maps of these robots are deformed by tenths of a metre: inliers need not fit closely, but almost all landmarks
# must be inliers. On two logs and four seeds, merges with 12 of the 15 landmarks had errors up to 24 degrees, with 14
# at most 4.
POSITION_FLOOR = 0.3
LANDMARKS_NOT_SHARED = 1
MAX_SIGMA_HEADING = 0.05

# Victoria Park. Trees are metres apart: a measurement within 1.5 m of a known tree, or not far beyond its gate, is not
# a new one. The density of clutter is one unmapped object in 10 m x 10 m x the 1 m that a planar sensor does not
# resolve. Trees within 25 m of a measurement, as first measured, are candidates for data association. By default,
# contradicting trees widen the pose at once. Here bushes and pedestrians contradict the map now and then, while the
# odometry is good: the pose is not widened.
TREES = {
    "position_gate": PLANAR_GATE, "new_landmark_gate": 40.0, "new_landmark_radius": 1.5, "new_landmark_density": 0.01,
    "recovery_position": 0.0, "descriptor_gate": 25.0,
    "descriptor_sigma": 1e6,  # standard deviation of the descriptors [m]: they do not affect weights
}  # fmt: skip

# KITTI. The number of a track is its descriptor, so that tracks are never confused. Unlike given identities, this keeps
# the gate active: tracks on other cars are rejected, and a rejected track never creates a second landmark. Points on
# other cars can outnumber static ones: contradicting tracks do not widen the pose.
TRACKS = {
    "position_gate": PLANAR_GATE, "new_landmark_gate": 1e9, "recovery_position": 0.0, "descriptor_gate": 0.5,
}  # fmt: skip
LOOP_AFTER = 100.0  # path length before a place counts as revisited [m]
LOOP_WITHIN = 10.0  # maximum distance between two poses at one place [m]


def read_mrclam(
    path: str | Path, *, robots: tuple[int, ...] | None = None, duration: float | None = None, truth: str | None = None,
    identities: Literal["given", "hidden"] = "given", alone: bool = False, dt: float = mrclam.STEP,
    drive: mrclam.Drive | None = None, motion: OdometryModel = MOTION, sensor: mrclam.SightingNoise | None = None,
) -> Log:  # fmt: skip
    """Return an MR.CLAM log: robots with unknown starts among landmarks with barcodes.

    The default odometry noise was calibrated on data sets 7 and 4: their results are not those of unseen logs.
    """
    log = mrclam.load_mrclam(path, robots, duration, truth)
    steps = mrclam.to_filter_steps(log, dt, sensor, mrclam.Drive(**MRCLAM_DRIVE) if drive is None else drive)
    given = identities == "given"
    readings = [
        RobotLog(
            odometry=own.odometry, measurements=own.measurements if given else list(map(_alike, own.measurements)),
            identities=list(map(_barcodes, own.measurements)), truth=robot.truth, reckoned=own.reckoned,
            number=robot.robot,
        )
        for robot, own in zip(log.robots, steps.robots, strict=True)
    ]  # fmt: skip
    alignment = AlignmentOptions(
        position_floor=POSITION_FLOOR, min_inliers=max(3, len(log.subjects) - LANDMARKS_NOT_SHARED),
        max_sigma_heading=MAX_SIGMA_HEADING,
    )  # fmt: skip
    return Log(
        times=steps.times, robots=readings, landmarks=log.positions, options={"motion": motion, **GATES[identities]},
        team={"alignment": alignment, "attempts": AttemptOptions(new_candidates=1)}, alone=alone, identified=given,
        notes=log.notes, source=_Barcodes(log),
    )  # fmt: skip


class _Barcodes(Source):
    """MR.CLAM, whose true landmarks may contradict the maps."""

    def __init__(self, log: mrclam.MrclamLog) -> None:
        self._log = log

    def complete(self, metrics: dict[str, Any], result: Replay, score: PathScore | None) -> list[str]:
        """Add notes about true landmarks that contradict all others, in most of the groups' maps."""
        if self._log.positions is None:
            return []
        maps = []
        for own, claims in ((result.maps[group[0]], result.claims[group[0]]) for group in result.groups):
            named, rows = most_seen(own, claims)
            maps.append(dict(zip(named.tolist(), own.means[rows], strict=True)))
        notes = list(wrong_landmark_notes(self._log.positions, maps, self._log.subjects.tolist()))
        metrics["notes"] = [*metrics["notes"], *notes]
        return notes


def _alike(frame: Measurements | None) -> Measurements | None:
    """Return the measurements with the same descriptor for all: only positions identify landmarks."""
    return frame and Measurements(frame.points, np.ones((len(frame), 1), dtype=np.float32), frame.covariances)


def _barcodes(frame: Measurements | None) -> Any:
    """Return the row in `MrclamLog.positions` of each measured landmark; None if there are none."""
    return None if frame is None else frame.descriptors.argmax(axis=1)


def read_victoria(
    path: str | Path, *, duration: float | None = None, motion: OdometryModel | None = None,
    sensor: victoria.TreeNoise | None = None,
) -> Log:  # fmt: skip
    """Return the Victoria Park log: unlabelled trees, matched by position, with GPS as ground truth.

    Poses are of the rear axle; the fixes are of the antenna beside the laser.
    """
    log = victoria.load_victoria(path, duration)
    steps = victoria.to_filter_steps(log, sensor)
    motion = OdometryModel(**VICTORIA_MOTION) if motion is None else motion
    return Log(
        times=steps.times,
        robots=[RobotLog(odometry=steps.odometry, measurements=steps.measurements, truth=log.gps)],
        options={"camera": StereoCamera(mount=victoria.SENSOR), "motion": motion, **TREES},
        mount=(*victoria.SENSOR[:2], 0.0), title="Victoria Park", notes=log.notes, source=Park(),
    )  # fmt: skip


class Park(Source):
    """Victoria Park, where all trees have the same appearance."""

    def describe(self, frame: Measurements, predicted_pose: Callable[[], FloatArray]) -> Measurements:
        """Return the measurements with each tree's position as its descriptor.

        A filter compares a measurement with all landmarks of similar descriptors, which is expensive in a park full of
        trees; positions as descriptors limit this to the neighbourhood, without any weight.
        """
        ahead = frame.points @ ROBOT_FROM_CAMERA.T + np.array(victoria.SENSOR)
        places = transform_points(predicted_pose(), ahead)[:, :2].astype(np.float32)
        return Measurements(frame.points, places, frame.covariances)

    def complete(self, metrics: dict[str, Any], result: Replay, score: PathScore | None) -> list[str]:
        """Add the distances to the fixes after the fit of the whole path; some fixes are outliers."""
        often = metrics["landmarks_seen_ten_times"] = int(np.count_nonzero(result.maps[0].counts >= 10))
        lines, metrics["gps"] = [f"Trees seen at least ten times: {often}."], None
        if score is not None:
            errors = score.scores[0].errors
            gps = metrics["gps"] = {
                "fixes": len(score.truth), "rms_m": score.scores[0].aligned, "median_m": float(np.median(errors)),
                "percentile_95_m": float(np.quantile(errors, 0.95)), "worst_m": float(errors.max()),
            }  # fmt: skip
            lines.insert(0, (
                f"At {gps['fixes']} GPS fixes: median {gps['median_m']:.2f} m, 95 % within "
                f"{gps['percentile_95_m']:.2f} m, worst {gps['worst_m']:.1f} m."
            ))  # fmt: skip
        return lines


def read_kitti(
    path: str | Path, *, duration: float | None = None, truth: str | None = None, sigma_px: float = 1.0,
    sigma_disparity_px: float = 0.5,
) -> Log:  # fmt: skip
    """Return a drive of KITTI in the plane, with tracked stereo features as landmarks.

    Poses are of the inertial unit, true ones of the left camera.
    """
    log = kitti.load_kitti(path, truth, duration)
    camera = kitti.make_camera(log, sigma_px, sigma_disparity_px)
    steps = kitti.to_filter_steps(log, camera)
    return Log(
        times=steps.times,
        robots=[RobotLog(odometry=steps.odometry, measurements=steps.measurements, truth=log.truth)],
        options={"camera": camera, "motion": kitti.motion_noise(log), **TRACKS}, mount=(*log.mount[:2], 0.0),
        title="KITTI, tracked stereo features in the plane", source=_Drive(),
    )  # fmt: skip


class _Drive(Source):
    """KITTI, where a car may return to a place."""

    def complete(self, metrics: dict[str, Any], result: Replay, score: PathScore | None) -> list[str]:
        """Add the error [m] of the estimated motion between the first and the second visit of a place."""
        loop = None if score is None else find_loop(score.truth)
        metrics["robots"][0]["loop_error_m"] = float("nan")
        if score is None or loop is None:
            return []
        motions = [between(path[loop[0]], path[loop[1]]) for path in (score.at_truth[0], score.truth)]
        error = metrics["robots"][0]["loop_error_m"] = float(np.hypot(*(motions[0] - motions[1])[:2]))
        seconds = [float(result.times[step] - result.times[0]) for step in loop]
        return [
            f"The robot returned at {seconds[1]:.0f} s to its place of {seconds[0]:.0f} s; relative error: "
            f"{error:.2f} m. Ended tracks are not matched again, so there is no loop closure."
        ]


def read_bag(
    path: str | Path, *, odometry: Sequence[str], landmarks: Sequence[str], truth: Sequence[str] | None = None,
    camera: str | None = None, base: Sequence[str] | None = None, tag_frames: str = "tag*", alone: bool = False,
    dt: float = 0.25, motion: OdometryModel | None = None, sensor: mrclam.SightingNoise | None = None,
) -> Log:  # fmt: skip
    """Return a bag of ROS 1 or ROS 2: a robot for each topic of odometry, several as a team with unknown starts."""
    sensor = mrclam.SightingNoise(**BAG_SENSOR) if sensor is None else sensor
    steps = bags.load_bag(path, odometry, landmarks, truth, camera, base, tag_frames, dt, sensor)
    given = steps.kind == "identities"
    robots = [
        RobotLog(
            odometry=own.odometry, measurements=own.measurements,
            identities=list(map(_barcodes, own.measurements)) if given else None, truth=own.truth, number=number,
        )
        for number, own in enumerate(steps.robots, start=1)
    ]  # fmt: skip
    options: dict[str, Any] = {"motion": OdometryModel() if motion is None else motion, **KNOWN_BY[steps.kind]}
    if steps.camera is not None:
        options["camera"] = steps.camera
    return Log(
        times=steps.times, robots=robots, options=options, alone=alone, identified=given, title="Bag",
        notes=steps.notes,
    )  # fmt: skip


def find_loop(truth: FloatArray) -> tuple[int, int] | None:
    """Return the steps (earlier, later) of the closest revisit in (n, 3) poses; None if the car never returned."""
    driven = travelled(truth)
    apart = np.hypot(*(truth[:, None, :2] - truth[None, :, :2]).transpose(2, 0, 1))
    apart[driven[None, :] - driven[:, None] < LOOP_AFTER] = np.inf
    earlier, later = np.unravel_index(int(np.argmin(apart)), apart.shape)
    return (int(earlier), int(later)) if apart[earlier, later] <= LOOP_WITHIN else None
