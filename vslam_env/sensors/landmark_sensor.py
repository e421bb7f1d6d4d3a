"""The landmark sensor: true poses become noisy measurements of the landmarks that each camera sees."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from slam_backend.camera import StereoCamera
from slam_backend.errors import BoolArray, FloatArray, IntArray, bad_argument, check_array, check_float, check_int
from slam_backend.measurements import Measurements, TeamMeasurements
from vslam_env.sensors._landmark_kernels import measure
from vslam_env.world.sight_kernels import detect
from vslam_env.world.spec import Landmarks
from vslam_env.world.visibility import view_limits, visible_landmarks

NEAREST_FALSE_POINT = 0.5  # [m]


@dataclass(frozen=True, slots=True, kw_only=True)
class LandmarkSensorConfig:
    """How well cameras see, in truth; what a filter assumes is set elsewhere.

    Attributes:
        camera: Its field of view, range and true noise.
        max_measurements: At most so many measurements a frame (B).
        detection_probability: Of a visible landmark, in [0, 1].
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
            raise bad_argument("sensor.camera", "a StereoCamera", self.camera, "Build one with StereoCamera(...).")
        check_int("sensor.max_measurements", self.max_measurements, 1, "Report at least one point a frame.")
        check_float(
            "sensor.detection_probability", self.detection_probability, "Give a share.", at_least=0.0, at_most=1.0
        )
        check_float("sensor.false_points", self.false_points, "Give points per frame.", at_least=0.0)
        check_float("sensor.descriptor_noise", self.descriptor_noise, "Give an L2 length.", at_least=0.0)
        check_float("sensor.max_incidence", self.max_incidence, "Give radians.", above=0.0, at_most=np.pi / 2)


class Frame(NamedTuple):
    """What one camera reports in one tick, and, for the simulator's books, what it was.

    Attributes:
        measurements: n points in random order, camera frame; without covariances.
        true_ids: (n,) int64. Index of the landmark behind each point; -1 for a false point.
    """

    measurements: Measurements
    true_ids: IntArray


class Frames(NamedTuple):
    """The frames of all robots in one tick.

    Attributes:
        measurements: In one piece.
        true_ids: Per robot as of its `Frame`.
    """

    measurements: TeamMeasurements
    true_ids: Sequence[IntArray]

    def of_each(self) -> list[Frame]:
        """Return the frame of each robot."""
        return list(map(Frame, self.measurements.of_each(), self.true_ids))


class LandmarkSensor:
    """Measures the landmarks of one world with the cameras of all robots.

    Args:
        config: How well.
        walls: (S, 4) float64 [m], world frame.
        landmarks: On these walls.
        robot_radius: Robots hide what stands behind them [m].
    """

    def __init__(
        self, config: LandmarkSensorConfig, walls: FloatArray, landmarks: Landmarks, robot_radius: float = 0.2
    ) -> None:
        self.config = config
        self._walls = check_array("walls", walls, (None, 4), "Give rows x1 y1 x2 y2 in metres.")
        self._landmarks, self._places = landmarks, landmarks.positions.T.copy()
        descriptors = landmarks.descriptors.astype(np.float64)
        self._points = np.hstack([landmarks.positions, descriptors])
        self._robot_radius = check_float("robot_radius", robot_radius, "Give metres.", at_least=0.0)
        camera = config.camera
        lens = camera.focal_px, camera.baseline, camera.sigma_px, camera.sigma_disparity_px
        self._optics = np.array([*camera.mount, *lens])
        self._view = view_limits(camera, config.max_incidence)
        self._no_false_points = np.empty((0, self._points.shape[1]))
        # False points look like landmarks of this world: the common part of all descriptors and a part of their own.
        self._common = descriptors.mean(axis=0) if len(landmarks) else np.zeros(descriptors.shape[1])
        self._own_share = np.sqrt(max(0.0, 1.0 - float(self._common @ self._common)))

    def visible(self, poses: FloatArray) -> BoolArray:
        """Tell which landmarks (K, N) the robots at `poses` (K, 3) [m, m, rad], world frame, can see."""
        return visible_landmarks(poses, self._landmarks, self._walls, self._robot_radius, self._view)

    def measure(self, poses: FloatArray, rng: np.random.Generator) -> Frames:
        """Take a frame with each robot's camera.

        Each visible landmark is detected independently. False points take their places among the at most B points;
        the others are drawn uniformly from the detected landmarks.

        Args:
            poses: (K, 3) float64 [m, m, rad], world frame. True poses.
            rng: Source of the draws.

        Returns:
            One frame of each robot. Nothing in the order of its points tells anything about them.
        """
        config, marks = self.config, self._landmarks
        robots, most, size = len(poses), config.max_measurements, self._points.shape[1]
        num_false = rng.poisson(config.false_points, robots)
        keys = rng.random((robots, len(self._points)))
        ids, counts = np.empty(robots * most, np.int64), np.empty(robots, np.int64)
        total, extra = detect(
            poses, self._places, marks.normals, marks.walls, self._walls, self._robot_radius, self._view,
            keys, config.detection_probability, num_false, most, ids, counts,
        )  # fmt: skip
        false_points = self._no_false_points
        if extra:
            false_points = np.hstack([self._false_points(extra, rng), self._false_descriptors(extra, rng)])
            ids = np.concatenate([ids[:total], -1 - np.arange(extra)])
            total += extra
            ids = ids[_mixed(counts.tolist(), num_false.tolist(), rng.random(total).tolist())]
            counts += num_false
        noise = rng.standard_normal((total, size))
        points, looks = np.empty((total, 3)), np.empty((total, size - 3), np.float32)
        truth = ids, counts, poses, self._points, false_points
        measure(*truth, noise, self._optics, config.descriptor_noise, points, looks)
        ends = counts.tolist()  # they are added up now
        if ends[-1] < total:
            points, looks = points[: ends[-1]], looks[: ends[-1]]
        true_ids = [ids[begin:end] for begin, end in pairwise((0, *ends))]
        return Frames(TeamMeasurements.trusted(points, looks, counts), true_ids)

    def _false_points(self, count: int, rng: np.random.Generator) -> FloatArray:
        """Draw points (count, 3) [m], camera frame, in the view: uniform in the image and in depth."""
        camera = self.config.camera
        right, down, depth = rng.uniform(-1.0, 1.0, count), rng.uniform(-1.0, 1.0, count), rng.random(count)
        across, upright = self._view[4:6]
        rays = np.stack([right * across, down * upright, np.ones(count)], axis=1)
        farthest = camera.max_range / np.linalg.norm(rays, axis=1)
        nearest = min(NEAREST_FALSE_POINT, camera.max_range)
        return np.asarray(rays * np.maximum(nearest, depth * farthest)[:, None])

    def _false_descriptors(self, count: int, rng: np.random.Generator) -> FloatArray:
        """Draw unit descriptors (count, d) of things never seen before that look like this world's landmarks."""
        own = rng.standard_normal((count, len(self._common)))
        own *= self._own_share / np.linalg.norm(own, axis=1, keepdims=True)
        descriptors = self._common + own
        return np.asarray(descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True))


def _mixed(num_true: list[int], num_false: list[int], keys: list[float]) -> list[int]:
    """Return the rows of each robot's points in random order, when false ones stand behind all true ones.

    Args:
        num_true: Per robot.
        num_false: Per robot.
        keys: Random numbers, as many as points: each robot's points are ordered by its share of them.

    >>> _mixed([2, 1], [0, 2], [0.9, 0.1, 0.5, 0.3, 0.4])
    [1, 0, 3, 4, 2]
    """
    order: list[int] = []
    true, false = 0, sum(num_true)
    for real, made_up in zip(num_true, num_false, strict=True):
        rows = [*range(true, true + real), *range(false, false + made_up)]
        own = keys[len(order) : len(order) + len(rows)]
        order += [row for _, row in sorted(zip(own, rows, strict=True))]
        true, false = true + real, false + made_up
    return order
