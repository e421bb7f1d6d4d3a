"""Workload of the filter benchmark: robots in front of a cloud of landmarks, measured at random."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.validation import FloatArray, IntArray, argument_error, check_int
from slam_backend.fastslam.options import FilterOptions
from slam_backend.geometry import between, compose, inverse, transform_points
from slam_backend.models.camera import ROBOT_FROM_CAMERA
from slam_backend.models.measurements import Measurements
from training.experiments.config import Checked, NonNegative, Positive, Proposal

LARGE_LOADS: list[dict[str, Any]] = [
    {"particles": 10_000, "landmarks": landmarks, "measurements": 15} for landmarks in (300, 1000)
]
DESCRIPTOR_SIZE = 64
DESCRIPTOR_NOISE = 0.1  # RMS norm of the noise added to a descriptor before normalisation
DEPTHS = (2.0, 7.0)  # range of depths [m]
IMAGE_SHARE = 0.8  # share of the image used by landmarks; the margin allows motion
MAPPED_AT_ONCE = 50  # measurements per frame while the map is built
GAP = 0.1  # distance between neighbouring robots [m]
SWAY_POSITION, SWAY_HEADING = 0.1, 0.03  # amplitudes of the robots' motion [m], [rad]
SWAY_PER_STEP = np.array([0.11, 0.19])  # phase increments [rad]


class FilterLoad(Checked):
    """One row of the table."""

    proposal: Proposal = "fastslam2"  # Proposal of the filter
    particles: Positive = 100  # M
    landmarks: int = 300  # N, in each particle's map
    measurements: int = 15  # B per step, of all robots together
    robots: Positive = 1  # K
    lookalikes: Positive = 1  # Number of landmarks that share a descriptor; 1: all differ
    seed: NonNegative = 0  # Seed of all random draws

    def check(self) -> None:
        """Refuse more measurements than possible."""
        check_int("measurements", self.measurements, self.robots, "Give each robot at least one measurement.")
        hint = "Each robot measures different landmarks, and sees nearly all of them."
        check_int("landmarks", self.landmarks, 2 * self.measurements, hint)

    @property
    def options(self) -> FilterOptions:
        """Options of the filter: it assumes the true noise, resamples at every step, and is not rejuvenated."""
        return FilterOptions(
            num_particles=self.particles, proposal=self.proposal, resample_threshold=1.0, rejuvenate_every=None
        )


@dataclass(frozen=True, slots=True, eq=False)
class LoadStep:
    """Readings of one step."""

    odometry: tuple[FloatArray | None, ...]  # Odometry of each robot, (3,) [m, m, rad], or None
    frames: tuple[Measurements | None, ...]  # Measurements of each robot, or None
    names: tuple[IntArray, ...]  # True landmarks of each robot's measurements, (n_i,) int64


class LoadWorld:
    """Landmarks, and robots that oscillate in front of them.

    Landmarks fill the first robot's view between two depths, uniformly over the image. Robots are side by side at known
    poses and oscillate by decimetres, so that each sees nearly all landmarks at all times. Measurements of a step are a
    random choice of the landmarks in view, so that two steps have little in common.
    """

    def __init__(self, load: FilterLoad) -> None:
        self.load = load
        self._rng = np.random.default_rng(load.seed)
        self._camera = load.options.camera
        self._motion = load.options.motion
        depth = self._rng.uniform(*DEPTHS, load.landmarks)
        half_image = [0.5 * self._camera.width, 0.5 * self._camera.height]
        image = IMAGE_SHARE * self._rng.uniform(-1.0, 1.0, (load.landmarks, 2)) * half_image
        seen = np.column_stack([image * (depth / self._camera.focal_px)[:, None], depth])
        self.landmarks: FloatArray = seen @ ROBOT_FROM_CAMERA.T  # (N, 3), map frame; the first robot starts near 0
        kinds = self._rng.standard_normal((-(-load.landmarks // load.lookalikes), DESCRIPTOR_SIZE))
        self.descriptors = _unit(kinds)[np.arange(load.landmarks) // load.lookalikes]
        self.starts = np.zeros((load.robots, 3))
        self.starts[:, 1] = GAP * (np.arange(load.robots) - 0.5 * (load.robots - 1))
        self._phases = self._rng.uniform(0.0, 2.0 * np.pi, (load.robots, 2))
        self._time = 0

    def true_pose(self, robot: int, time: int) -> FloatArray:
        """Return the true pose (3,) of a robot, map frame; its start pose at time 0."""
        phases = self._phases[robot]
        ahead, turn = np.sin(SWAY_PER_STEP * time + phases) - np.sin(phases)
        return compose(self.starts[robot], [SWAY_POSITION * ahead, 0.0, SWAY_HEADING * turn])

    def mapping(self, sweeps: int) -> Iterator[LoadStep]:
        """Yield steps in which the first robot, at its start, measures all landmarks `sweeps` times, identified."""
        rest = (None,) * (self.load.robots - 1)
        for _ in range(sweeps):
            order = self._rng.permutation(self.load.landmarks)
            for begin in range(0, len(order), MAPPED_AT_ONCE):
                names = order[begin : begin + MAPPED_AT_ONCE]
                none = tuple(np.empty(0, np.int64) for _ in rest)
                yield LoadStep((None, *rest), (self._measure(self.starts[0], names), *rest), (names, *none))

    def course(self, num: int) -> Iterator[LoadStep]:
        """Yield `num` steps in which all robots move and make B measurements in total, divided evenly."""
        load = self.load
        shares = load.measurements // load.robots + (np.arange(load.robots) < load.measurements % load.robots)
        for _ in range(num):
            odometry: list[FloatArray] = []
            frames: list[Measurements] = []
            names: list[IntArray] = []
            for robot, share in enumerate(shares):
                before, now = self.true_pose(robot, self._time), self.true_pose(robot, self._time + 1)
                move = between(before, now)
                odometry.append(move + self._rng.standard_normal(3) * self._motion.sigmas(move))
                in_view = np.flatnonzero(self._camera.sees(self._seen_from(now)))
                if len(in_view) < share:
                    hint = "Use more landmarks, or fewer measurements."
                    raise argument_error("landmarks", f"{share} in a robot's view", f"a view of {len(in_view)}", hint)
                names.append(self._rng.choice(in_view, share, replace=False))
                frames.append(self._measure(now, names[-1]))
            self._time += 1
            yield LoadStep(tuple(odometry), tuple(frames), tuple(names))

    def _seen_from(self, pose: FloatArray) -> FloatArray:
        """Return the landmarks (N, 3) [m] in the camera frame of a robot at `pose`."""
        return self._camera.camera_from_robot(transform_points(inverse(pose), self.landmarks))

    def _measure(self, pose: FloatArray, names: IntArray) -> Measurements:
        """Return noisy measurements of landmarks from `pose`."""
        pixels = self._camera.project(self._seen_from(pose)[names])
        sigmas = [self._camera.sigma_px, self._camera.sigma_px, self._camera.sigma_disparity_px]
        pixels += self._rng.standard_normal(pixels.shape) * sigmas
        noise = self._rng.standard_normal((len(names), DESCRIPTOR_SIZE)) * (DESCRIPTOR_NOISE / np.sqrt(DESCRIPTOR_SIZE))
        return Measurements(self._camera.triangulate(pixels), _unit(self.descriptors[names] + noise))


def _unit(vectors: FloatArray) -> NDArray[np.float32]:
    """Return the normalised vectors (n, d)."""
    unit: NDArray[np.float32] = (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)
    return unit
