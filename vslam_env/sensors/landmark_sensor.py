"""Landmark sensor: noisy measurements of the landmarks in view of each camera."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from slam_backend.core.read_only import as_read_only
from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import (
    BoolArray,
    FloatArray,
    IntArray,
    check_array,
    check_float,
    check_int,
    check_kind,
)
from slam_backend.models.camera import StereoCamera
from slam_backend.models.measurements import Measurements, TeamMeasurements
from slam_backend.state import INT64, Array, Record, with_state
from vslam_env.sensors._landmark_kernels import BEYOND, FARTHEST, NEAREST_FALSE_POINT, measure
from vslam_env.world._kernels import detect
from vslam_env.world.spec import Landmarks
from vslam_env.world.visibility import (
    as_coordinate_rows,
    group_bounds,
    landmark_geometry,
    view_limits,
    visible_landmarks,
)

MAX_POINTS = 10_000  # limit per frame


@short_repr
@dataclass(frozen=True, slots=True, kw_only=True)
class LandmarkSensorConfig:
    """True noise and limits of the cameras; the assumed noise is part of `BeliefConfig`.

    Attributes:
        camera: Field of view, range and true noise.
        max_measurements: Largest number of measurements per frame (B).
        detection_probability: Probability that a visible landmark is detected, in [0, 1].
        false_points: Expected number of false points per frame.
        descriptor_noise: Root mean square length of the noise added to a descriptor before normalisation.
        max_incidence: Largest angle between line of sight and face normal at which landmarks are visible [rad].
    """

    camera: StereoCamera = field(default_factory=StereoCamera)
    max_measurements: int = 5
    detection_probability: float = 0.9
    false_points: float = 0.02
    descriptor_noise: float = 0.17
    max_incidence: float = float(np.radians(60.0))

    def __post_init__(self) -> None:
        check_kind("sensor.camera", self.camera, StereoCamera)
        check_int("sensor.max_measurements", self.max_measurements, 1, "Report at least one point a frame.", MAX_POINTS)
        check_float(
            "sensor.detection_probability", self.detection_probability, "Give a share.", at_least=0.0, at_most=1.0
        )
        hint = "Give points per frame."
        check_float("sensor.false_points", self.false_points, hint, at_least=0.0, at_most=MAX_POINTS)
        check_float("sensor.descriptor_noise", self.descriptor_noise, "Give an L2 length.", at_least=0.0, at_most=1e6)
        check_float("sensor.max_incidence", self.max_incidence, "Give radians.", above=0.0, at_most=np.pi / 2)

    @property
    def farthest(self) -> float:
        """Largest measured distance from the camera [m]; farther points are discarded."""
        return min(FARTHEST, BEYOND * self.camera.max_range)


@short_repr
class SensorFrame(NamedTuple):
    """Measurements of one camera in one tick, with the true association.

    Attributes:
        measurements: Measurements of n points in random order, camera frame; without covariances.
        true_ids: (n,) int64. True landmark of each point; -1 for a false point.
    """

    measurements: Measurements
    true_ids: IntArray


@short_repr
@with_state(
    measurements=Record(TeamMeasurements), padded_ids=Array(INT64, "K *", -1, "WORLD", constant=True)
)  # fmt: skip
class TeamSensorFrames(NamedTuple):
    """The frames of all robots in one tick.

    Attributes:
        measurements: Measurements of the team.
        padded_ids: (K, B) int64. True landmarks of each robot's points, -1 for a false point. Entries beyond a robot's
            points are arbitrary but valid indices.
    """

    measurements: TeamMeasurements
    padded_ids: IntArray

    @property
    def true_ids(self) -> list[IntArray]:
        """Copies of the true landmarks of each robot's points."""
        ends = self.measurements.offsets.tolist()
        return [
            row[: end - begin].copy() for row, begin, end in zip(self.padded_ids, [0, *ends[:-1]], ends, strict=True)
        ]

    def per_robot(self) -> list[SensorFrame]:
        """Return the frame of each robot."""
        return list(map(SensorFrame, self.measurements.per_robot(), self.true_ids))


def padded(true_ids: Sequence[IntArray]) -> IntArray:
    """Return the true landmarks (n_i,) of the points of K robots as one array (K, B), -1 beyond a robot's points."""
    rows = np.full((len(true_ids), max(map(len, true_ids))), -1)
    for row, ids in zip(rows, true_ids, strict=True):
        row[: len(ids)] = ids
    return rows


class LandmarkSensor:
    """Cameras of all robots that measure the landmarks of one world.

    Args:
        config: True noise and limits.
        walls: (S, 4) float64 [m], world frame. Wall segments.
        landmarks: Landmarks on these walls.
        robot_radius: Radius of the robots, which occlude landmarks [m].

    Attributes:
        config: True noise and limits.
        robot_radius: Radius of the robots [m].
    """

    def __init__(
        self, config: LandmarkSensorConfig, walls: FloatArray, landmarks: Landmarks, robot_radius: float = 0.2
    ) -> None:
        self.config = config
        self._walls = as_read_only(check_array("walls", walls, (None, 4), "Give rows x1 y1 x2 y2 in metres."))
        self._landmarks = landmarks
        descriptors = landmarks.descriptors.astype(np.float64)
        self._points = as_read_only(np.hstack([landmarks.positions, descriptors]))
        self.robot_radius = check_float("robot_radius", robot_radius, "Give metres.", at_least=0.0)
        camera = config.camera
        lens = camera.focal_px, camera.baseline, camera.sigma_px, camera.sigma_disparity_px
        self._optics = as_read_only(np.array([*camera.mount, *lens, config.farthest, config.descriptor_noise]))
        self._view = view_limits(camera, config.max_incidence)
        self._sight = (
            landmark_geometry(landmarks),
            group_bounds(landmarks),
            landmarks.walls,
            as_coordinate_rows(self._walls),
            self.robot_radius,
            self._view,
        )
        self._frame_shape = config.max_measurements, self._points.shape[1]
        self._no_false_points = np.empty((0, self._points.shape[1]))
        # Descriptors of false points resemble those of landmarks: a common part and an individual part.
        common = descriptors.mean(axis=0) if len(landmarks) else np.zeros(descriptors.shape[1])
        self._common = as_read_only(common)
        self._own_share = np.sqrt(max(0.0, 1.0 - float(self._common @ self._common)))

    def visible(self, poses: FloatArray) -> BoolArray:
        """Return which landmarks are visible (K, N) from poses (K, 3) [m, m, rad], world frame."""
        return visible_landmarks(poses, self._landmarks, self._walls, self.robot_radius, self._view)

    def measure(self, poses: FloatArray, rng: np.random.Generator) -> TeamSensorFrames:
        """Take a frame with each robot's camera.

        Visible landmarks are detected independently. A frame has at most B points: its false points and a uniform
        sample of the detected landmarks.

        Args:
            poses: (K, 3) float64 [m, m, rad], world frame. True poses.
            rng: Source of the draws.

        Returns:
            One frame per robot, with its points in random order.
        """
        config, robots, (most, size) = self.config, len(poses), self._frame_shape
        num_false = rng.poisson(config.false_points, robots)
        keys = rng.random((len(poses), len(self._points)))
        ids, ends = np.empty((robots, most), np.int64), np.empty(robots, np.int64)
        ids.fill(-1)
        total, extra = detect(poses, self._sight, keys, config.detection_probability, num_false, ids, ends)
        made_up = self._no_false_points
        if extra:
            total += extra
            made_up = self._sample_clutter(extra, rng)
            shuffle_clutter(num_false, rng.random(total), ids, ends)
        noise = rng.standard_normal((total, size))
        points, descriptors = np.empty((total, 3)), np.empty((total, size - 3), np.float32)
        count = measure(ids, ends, poses, self._points, made_up, noise, self._optics, points, descriptors)
        if count < total:
            points, descriptors = points[:count], descriptors[:count]
        return TeamSensorFrames(TeamMeasurements(points, descriptors, ends), ids)

    def _sample_clutter(self, count: int, rng: np.random.Generator) -> FloatArray:
        """Draw false points and their descriptors (count, 3 + d)."""
        places, looks = rng.random((3, count)), rng.standard_normal((count, len(self._common)))
        return false_points(places, looks, self._common, self._own_share, self._view)


def false_points(
    places: FloatArray, looks: FloatArray, common: FloatArray, own_share: float, view: FloatArray
) -> FloatArray:
    """Return points that are no landmarks: uniform in the image and in depth, unit descriptors like the others'.

    Args:
        places: (3, m) float64, uniform in [0, 1).
        looks: (m, d) float64, standard normal.
        common: (d,) float64. Common part of all descriptors.
        own_share: Length of the part that each descriptor has alone.
        view: (7,) float64. See `view_limits`.

    Returns:
        (m, 3 + d) float64. Points [m], camera frame, and descriptors.
    """
    max_range, across, upright = view[3:6].tolist()
    right, down = (2.0 * places[0] - 1.0) * across, (2.0 * places[1] - 1.0) * upright
    farthest = max_range / np.sqrt(right * right + down * down + 1.0)
    ahead = np.maximum(min(NEAREST_FALSE_POINT, max_range), places[2] * farthest)
    descriptors = looks * (own_share / np.sqrt((looks**2).sum(axis=1, keepdims=True))) + common
    descriptors *= 1.0 / np.sqrt((descriptors**2).sum(axis=1, keepdims=True))
    return np.column_stack([right * ahead, down * ahead, ahead, descriptors])


def shuffle_clutter(num_false: IntArray, keys: FloatArray, ids: IntArray, counts: IntArray) -> None:
    """Insert the false points of each robot among its landmarks in random order.

    Args:
        num_false: (K,) int64. Number of false points of each robot.
        keys: (n,) float64, uniform. Sort keys of each robot's landmarks, then of its false points.
        ids: (K, B) int64. Detected landmarks of each robot; changed to landmarks, and -1 - j for false point j, in
            ascending order of keys.
        counts: (K,) int64. Number of detected landmarks of each robot; changed to the number of points.
    """
    begin, next_false = 0, -1
    for row, num_true, more in zip(ids, counts.tolist(), num_false.tolist(), strict=True):
        points = [*row[:num_true].tolist(), *range(next_false, next_false - more, -1)]
        keys_of_robot = keys[begin : begin + len(points)].tolist()
        row[: len(points)] = [point for _, point in sorted(zip(keys_of_robot, points, strict=True), key=itemgetter(0))]
        begin, next_false = begin + len(points), next_false - more
    counts += num_false
