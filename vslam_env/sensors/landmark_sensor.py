"""The landmark sensor: true poses become noisy measurements of the landmarks that each camera sees."""

from dataclasses import dataclass, field

import numpy as np

from slam_backend._jit import jit
from slam_backend.camera import StereoCamera
from slam_backend.errors import BoolArray, FloatArray, IntArray, bad_argument, check_array, check_float, check_int
from slam_backend.measurements import Measurements
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


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """What one camera reports in one tick, and, for the simulator's books, what it was.

    Attributes:
        measurements: n points in random order, camera frame; without covariances.
        true_ids: (n,) int64. Index of the landmark behind each point; -1 for a false point.
    """

    measurements: Measurements
    true_ids: IntArray


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
        self._landmarks = landmarks
        self._descriptors = landmarks.descriptors.astype(np.float64)
        self._robot_radius = check_float("robot_radius", robot_radius, "Give metres.", at_least=0.0)
        self._mount = np.array(config.camera.mount)
        self._view = view_limits(config.camera, config.max_incidence)
        # False points look like landmarks of this world: the common part of all descriptors and a part of their own.
        self._common = self._descriptors.mean(axis=0) if len(landmarks) else np.zeros(landmarks.descriptors.shape[1])
        self._own_share = np.sqrt(max(0.0, 1.0 - float(self._common @ self._common)))

    def visible(self, poses: FloatArray) -> BoolArray:
        """Tell which landmarks (K, N) the robots at `poses` (K, 3) [m, m, rad], world frame, can see."""
        marks = self._landmarks
        return visible_landmarks(
            poses, marks.positions, marks.normals, marks.walls, self._walls, self._robot_radius, self._mount, self._view
        )

    def measure(self, poses: FloatArray, rng: np.random.Generator) -> list[Frame]:
        """Take a frame with each robot's camera.

        Each visible landmark is detected independently. False points take their places among the at most B points;
        the others are drawn uniformly from the detected landmarks.

        Args:
            poses: (K, 3) float64 [m, m, rad], world frame. True poses.
            rng: Source of the draws.

        Returns:
            One frame for each robot. Nothing in the order of its points tells anything about them.
        """
        config, camera = self.config, self.config.camera
        poses = np.ascontiguousarray(poses, dtype=np.float64)
        robots, most = len(poses), config.max_measurements
        visible = self.visible(poses)
        num_false = np.minimum(rng.poisson(config.false_points, robots), most)
        keys = rng.random(visible.shape)
        ids, counts = _choose(visible, keys, config.detection_probability, most - num_false)
        points = _camera_points(self._landmarks.positions[ids], np.repeat(poses, counts, axis=0), self._mount)
        descriptors = self._descriptors[ids]
        if num_false.any():
            at = np.repeat(np.cumsum(counts), num_false)
            ids = np.insert(ids, at, -1)
            points = np.insert(points, at, self._false_points(len(at), rng), axis=0)
            descriptors = np.insert(descriptors, at, self._false_descriptors(len(at), rng), axis=0)
            counts = counts + num_false
            robot_of = np.repeat(np.arange(robots), counts)
            order = np.lexsort((rng.random(len(ids)), robot_of))
            ids, points, descriptors = ids[order], points[order], descriptors[order]
        noise = rng.standard_normal((len(ids), 3 + descriptors.shape[1]))
        pixels = camera.project(points) + noise[:, :3] * (camera.sigma_px, camera.sigma_px, camera.sigma_disparity_px)
        descriptors = descriptors + noise[:, 3:] * (config.descriptor_noise / np.sqrt(descriptors.shape[1]))
        descriptors /= np.sqrt(np.einsum("nd,nd->n", descriptors, descriptors))[:, None]
        ends = np.cumsum(counts)
        frames = []
        for begin, end in zip(ends - counts, ends, strict=True):
            rows = slice(int(begin), int(end))
            if np.any(pixels[rows, 2] <= 0.0):  # at infinity for the matcher of a very noisy pair
                rows = np.flatnonzero(pixels[rows, 2] > 0.0) + int(begin)
            frames.append(Frame(Measurements(camera.triangulate(pixels[rows]), descriptors[rows]), ids[rows]))
        return frames

    def _false_points(self, count: int, rng: np.random.Generator) -> FloatArray:
        """Draw points (count, 3) [m], camera frame, in the view: uniform in the image and in depth."""
        camera = self.config.camera
        right, down, depth = rng.uniform(-1.0, 1.0, count), rng.uniform(-1.0, 1.0, count), rng.random(count)
        rays = np.stack([right * self._view[1], down * self._view[2], np.ones(count)], axis=1)
        farthest = camera.max_range / np.linalg.norm(rays, axis=1)
        nearest = min(NEAREST_FALSE_POINT, camera.max_range)
        return np.asarray(rays * np.maximum(nearest, depth * farthest)[:, None])

    def _false_descriptors(self, count: int, rng: np.random.Generator) -> FloatArray:
        """Draw unit descriptors (count, d) of things never seen before that look like this world's landmarks."""
        own = rng.standard_normal((count, len(self._common)))
        own *= self._own_share / np.linalg.norm(own, axis=1, keepdims=True)
        descriptors = self._common + own
        return np.asarray(descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True))


def _camera_points(positions: FloatArray, poses: FloatArray, mount: FloatArray) -> FloatArray:
    """Move points (n, 3) [m] from the world to the camera frame of the robot at `poses` (n, 3), one each."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    dx, dy = positions[:, 0] - poses[:, 0], positions[:, 1] - poses[:, 1]
    ahead, left = c * dx + s * dy - mount[0], c * dy - s * dx - mount[1]
    return np.stack([-left, mount[2] - positions[:, 2], ahead], axis=1)


@jit
def _choose(
    visible: BoolArray, keys: FloatArray, detection_probability: float, places: IntArray
) -> tuple[IntArray, IntArray]:
    """Detect landmarks and choose among the detected ones.

    A landmark with a uniform key in [0, 1) is detected if the key is below the probability. The detected ones with the
    smallest keys are then a uniform choice in uniformly random order.

    Args:
        visible: (K, N) bool.
        keys: (K, N) float64, uniform.
        detection_probability: Of a visible landmark.
        places: (K,) int64. At most so many are chosen for each robot.

    Returns:
        The chosen landmarks of all robots one after the other, and the number (K,) for each robot.
    """
    chosen = np.empty(places.sum(), dtype=np.int64)
    counts = np.zeros(len(visible), dtype=np.int64)
    total = 0
    for k in range(len(visible)):
        begin = total
        for n in range(visible.shape[1]):
            if not visible[k, n] or keys[k, n] >= detection_probability:
                continue
            if counts[k] < places[k]:
                at = total
                counts[k] += 1
                total += 1
            elif counts[k] > 0 and keys[k, n] < keys[k, chosen[total - 1]]:
                at = total - 1
            else:
                continue
            while at > begin and keys[k, chosen[at - 1]] > keys[k, n]:
                chosen[at] = chosen[at - 1]
                at -= 1
            chosen[at] = n
    return chosen[:total], counts
