"""The landmark sensor: true poses become noisy measurements of the landmarks that each camera sees."""

from dataclasses import dataclass, field
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from slam_backend.core.read_only import as_read_only
from slam_backend.core.validation import (
    BoolArray,
    FloatArray,
    IntArray,
    argument_error,
    check_array,
    check_float,
    check_int,
)
from slam_backend.models.camera import StereoCamera
from slam_backend.models.measurements import Measurements, TeamMeasurements
from vslam_env.sensors._landmark_kernels import BEYOND, FARTHEST, measure, sample_clutter
from vslam_env.world._kernels import detect
from vslam_env.world.spec import Landmarks
from vslam_env.world.visibility import as_coordinate_rows, landmark_geometry, view_limits, visible_landmarks

MAX_POINTS = 10_000  # of a frame; time ends before


@dataclass(frozen=True, slots=True, kw_only=True)
class LandmarkSensorConfig:
    """How well cameras see, in truth; what a filter assumes is set elsewhere.

    Attributes:
        camera: Field of view, range and true noise.
        max_measurements: At most so many measurements a frame (B).
        detection_probability: Probability that a visible landmark is detected, in [0, 1].
        false_points: Expected number of points per frame that are no landmark.
        descriptor_noise: Root mean square length of the noise added to a descriptor before it is normalised again.
        max_incidence: A face seen at a larger angle to its normal shows no landmarks [rad].
    """

    camera: StereoCamera = field(default_factory=StereoCamera)
    max_measurements: int = 5
    detection_probability: float = 0.9
    false_points: float = 0.02
    descriptor_noise: float = 0.17
    max_incidence: float = float(np.radians(60.0))

    def __post_init__(self) -> None:
        if not isinstance(self.camera, StereoCamera):
            raise argument_error("sensor.camera", "a StereoCamera", self.camera, "Build one with StereoCamera(...).")
        check_int("sensor.max_measurements", self.max_measurements, 1, "Report at least one point a frame.", MAX_POINTS)
        check_float(
            "sensor.detection_probability", self.detection_probability, "Give a share.", at_least=0.0, at_most=1.0
        )
        cure = "Give points per frame."
        check_float("sensor.false_points", self.false_points, cure, at_least=0.0, at_most=MAX_POINTS)
        check_float("sensor.descriptor_noise", self.descriptor_noise, "Give an L2 length.", at_least=0.0, at_most=1e6)
        check_float("sensor.max_incidence", self.max_incidence, "Give radians.", above=0.0, at_most=np.pi / 2)

    @property
    def farthest(self) -> float:
        """No point is reported whose measured place is farther from the camera [m], whatever its noise."""
        return min(FARTHEST, BEYOND * self.camera.max_range)


class SensorFrame(NamedTuple):
    """What one camera reports in one tick, and, for the simulator's books, what it was.

    Attributes:
        measurements: n points in random order, camera frame; without covariances.
        true_ids: (n,) int64. Index of the landmark behind each point; -1 for a false point.
    """

    measurements: Measurements
    true_ids: IntArray


class TeamSensorFrames(NamedTuple):
    """The frames of all robots in one tick.

    Attributes:
        measurements: In one piece.
        names: (K, B) int64. In each row the landmarks behind a robot's points, -1 for a false point. What follows them
            means nothing, but names no other landmarks.
    """

    measurements: TeamMeasurements
    names: IntArray

    @property
    def true_ids(self) -> list[IntArray]:
        """Per robot as of its `Frame`. Copies: the books go by `names`."""
        ends = self.measurements.offsets.tolist()
        return [row[: end - begin].copy() for row, begin, end in zip(self.names, [0, *ends[:-1]], ends, strict=True)]

    def per_robot(self) -> list[SensorFrame]:
        """Return the frame of each robot."""
        return list(map(SensorFrame, self.measurements.per_robot(), self.true_ids))


class LandmarkSensor:
    """Measures the landmarks of one world with the cameras of all robots.

    Args:
        config: How well.
        walls: (S, 4) float64 [m], world frame.
        landmarks: On these walls.
        robot_radius: Robots hide what stands behind them [m].

    Attributes:
        config: Configuration of the sensor.
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
            landmarks.walls,
            as_coordinate_rows(self._walls),
            self.robot_radius,
            self._view,
        )
        self._frame_shape = config.max_measurements, self._points.shape[1]
        self._no_false_points = np.empty((0, self._points.shape[1]))
        # False points look like landmarks of this world: the common part of all descriptors and a part of their own.
        common = descriptors.mean(axis=0) if len(landmarks) else np.zeros(descriptors.shape[1])
        self._common = as_read_only(common)
        self._own_share = np.sqrt(max(0.0, 1.0 - float(self._common @ self._common)))

    def visible(self, poses: FloatArray) -> BoolArray:
        """Tell which landmarks (K, N) the robots at `poses` (K, 3) [m, m, rad], world frame, can see."""
        return visible_landmarks(poses, self._landmarks, self._walls, self.robot_radius, self._view)

    def measure(self, poses: FloatArray, rng: np.random.Generator) -> TeamSensorFrames:
        """Take a frame with each robot's camera.

        Each visible landmark is detected independently. False points take their places among the at most B points;
        the others are drawn uniformly from the detected landmarks.

        Args:
            poses: (K, 3) float64 [m, m, rad], world frame. True poses.
            rng: Source of the draws.

        Returns:
            One frame of each robot. Nothing in the order of its points tells anything about them.
        """
        config, robots, (most, size) = self.config, len(poses), self._frame_shape
        num_false = rng.poisson(config.false_points, robots)
        keys = rng.random((robots, len(self._points)))
        ids, ends = np.full((robots, most), -1), np.empty(robots, np.int64)
        total, extra = detect(poses, self._sight, keys, config.detection_probability, num_false, ids, ends)
        false_points = self._no_false_points
        if extra:
            total += extra
            false_points = self._sample_clutter(extra, rng)
            shuffle_clutter(num_false, rng.random(total), ids, ends)
        noise = rng.standard_normal((total, size))
        points, looks = np.empty((total, 3)), np.empty((total, size - 3), np.float32)
        kept = measure(ids, ends, poses, self._points, false_points, noise, self._optics, points, looks)
        if kept < total:
            points, looks = points[:kept], looks[:kept]
        return TeamSensorFrames(TeamMeasurements(points, looks, ends), ids)

    def _sample_clutter(self, count: int, rng: np.random.Generator) -> FloatArray:
        """Draw points that are no landmarks, and descriptors of them (count, 3 + d)."""
        size = len(self._common)
        places, looks = rng.random((3, count)), rng.standard_normal((count, size))
        points = np.empty((count, 3 + size))
        sample_clutter(places, looks, self._common, self._own_share, self._view, points)
        return points


def shuffle_clutter(num_false: IntArray, keys: FloatArray, ids: IntArray, counts: IntArray) -> None:
    """Put the false points of each robot among its landmarks, in random order.

    Args:
        num_false: (K,) int64. Number of false points that each robot reports.
        keys: (n,) float64, uniform. Keys of each robot's landmarks, then of its false points.
        ids: (K, B) int64. In each row the landmarks that a robot reports; changed to landmarks, and -1 - j for false
            point j, by rising keys.
        counts: (K,) int64. Number of landmarks that each robot reports; changed to the number of points.
    """
    begin, next_false = 0, -1
    for row, num_true, more in zip(ids, counts.tolist(), num_false.tolist(), strict=True):
        names = [*row[:num_true].tolist(), *range(next_false, next_false - more, -1)]
        own = keys[begin : begin + len(names)].tolist()
        row[: len(names)] = [name for _, name in sorted(zip(own, names, strict=True), key=itemgetter(0))]
        begin, next_false = begin + len(names), next_false - more
    counts += num_false
