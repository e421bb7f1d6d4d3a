"""Seeded stereo runs of one or several robots through an office, with ground truth."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.validation import FloatArray, IntArray, check_int
from slam_backend.fastslam.filter import FastSlam
from slam_backend.geometry import between, inverse, transform_points
from slam_backend.models.camera import StereoCamera
from slam_backend.models.measurements import Measurements
from slam_backend.models.odometry import OdometryModel
from training.experiments.config import Checked, Positive, setting
from training.stereo_runs.office import Office, start_crossings

STEP = 0.25  # distance between frames along the path [m]
EYE = (0.0, 0.0, 0.9)  # left camera in the robot frame [m]
LEAST_DISPARITY = 0.5  # lower limit of noisy disparities [px]
NEAREST_OUTLIER = 1.0  # smallest depth of false points [m]
Preset = Literal["good", "coarse", "paper"]
FALSE_POINT = -1  # landmark index of a false measurement

PRECISE_WHEELS = OdometryModel(
    sigma_along=0.02, sigma_across=0.01, sigma_heading=0.0, sigma_turn=0.03, floor_position=0.0, floor_heading=0.0015
)


@dataclass(frozen=True, slots=True, kw_only=True)
class NoisePreset:
    """True noise of a run, which the filters also assume."""

    sigma_px: float  # Standard deviation of the image coordinates u and v [px]
    sigma_disparity_px: float  # Standard deviation of the disparity [px]
    motion: OdometryModel = field(default_factory=OdometryModel)  # Noise of the odometry, independent at each step

    @property
    def camera(self) -> StereoCamera:
        """Camera of all runs (f 320 px, b 0.12 m, 320 x 240 px, range 8 m) with this noise."""
        return StereoCamera(sigma_px=self.sigma_px, sigma_disparity_px=self.sigma_disparity_px, mount=EYE)


# good: features located to 0.2 px, disparities to 0.1 px; ordinary wheels (5 % along, 2 degrees per metre). coarse: 1
# px and 0.5 px, as without refinement. paper: measurements that are uninformative relative to the odometry (2 % along,
# 1 % across, .0015 rad per step and 3 % of the turn), the regime of the paper's Fig. 6.
PRESETS: dict[str, NoisePreset] = {
    "good": NoisePreset(sigma_px=0.2, sigma_disparity_px=0.1),
    "coarse": NoisePreset(sigma_px=1.0, sigma_disparity_px=0.5),
    "paper": NoisePreset(sigma_px=10.0, sigma_disparity_px=0.6, motion=PRECISE_WHEELS),
}


class RunSpec(Checked):
    """Parameters of a simulated run, except its seed."""

    robots: Positive = 1  # K
    length: float = setting(100.0, ge=STEP)  # Path length of each robot [m]
    measurements: int = 15  # B per step, of all robots together; robot i has B // K, plus one if i < B mod K
    landmarks: Positive = 300  # N
    preset: Preset | NoisePreset = "good"  # Key of `PRESETS`, or a custom preset
    # "known": each measurement has the index of its landmark, and none is false. "unknown": data association uses
    # descriptors and positions only, with similar landmarks, false points and wrong descriptors as below.
    association: Literal["known", "unknown"] = "known"
    look_alikes: Positive = 3  # Number of landmarks that share a descriptor ("unknown" only)
    # Shares of the measurements whose point lies anywhere in view, and of those with the descriptor of another class
    # ("unknown" only)
    outliers: float = setting(0.02, ge=0.0, le=1.0)
    wrong_descriptors: float = setting(0.03, ge=0.0, le=1.0)
    descriptor_size: int = setting(64, ge=2)  # d
    # RMS norm of the noise added to a descriptor before it is normalised
    descriptor_noise: float = setting(0.17, ge=0.0)

    def check(self) -> None:
        """Refuse robots without measurements."""
        check_int("measurements", self.measurements, self.robots, "Each robot needs at least one measurement per step.")

    @property
    def noise(self) -> NoisePreset:
        """Noise preset."""
        return self.preset if isinstance(self.preset, NoisePreset) else PRESETS[self.preset]


@dataclass(frozen=True, slots=True, eq=False)
class StereoRun:
    """Motion and readings of K robots in T steps, with truth. The world frame is the map frame of `build_filter`."""

    spec: RunSpec  # Parameters of the run
    office: Office  # Walls and landmarks
    true_paths: FloatArray  # (K, T, 3) float64 [m, m, rad], world frame
    # (T, K, 3) float64 [m, m, rad]. Noisy motion from step t - 1 to t in the frame of t - 1; zero at t = 0, where the
    # robots do not move.
    odometry: FloatArray
    # Measurements by step and robot, in random order; the first are taken at the start poses
    frames: tuple[tuple[Measurements, ...], ...]
    # True landmarks (n,) int64 of the measurements, by step and robot; `FALSE_POINT`: none
    names: tuple[tuple[IntArray, ...], ...]
    descriptors: NDArray[np.float32]  # (N, d) float32. Descriptor of each landmark.

    @property
    def landmarks(self) -> FloatArray:
        """(N, 3) float64 [m], world frame."""
        return self.office.landmarks

    @property
    def num_steps(self) -> int:
        """T, including the frame at the start."""
        return len(self.frames)

    def measured_landmarks(self) -> IntArray:
        """Return the sorted indices of the landmarks that were measured at least once."""
        named = np.concatenate([names for step in self.names for names in step])
        return np.unique(named[named != FALSE_POINT])

    def readings(self) -> Iterator[dict[str, Any]]:
        """Yield the arguments of `FastSlam.step` for each step: `slam.step(**reading)`.

        The first step has no odometry; landmark identities are included if the association is known.
        """
        known = self.spec.association == "known"
        for step, (frames, names) in enumerate(zip(self.frames, self.names, strict=True)):
            odometry = [None] * len(frames) if step == 0 else list(self.odometry[step])
            yield {"odometry": odometry, "measurements": list(frames), "identities": list(names) if known else None}

    def build_filter(
        self, num_particles: int = 100, proposal: Literal["fastslam2", "fastslam1"] = "fastslam2",
        seed: int | np.random.SeedSequence = 0, **options: Any,
    ) -> FastSlam:  # fmt: skip
        """Return a filter that assumes the true noise and starts all robots at their true poses in the world frame.

        It is not rejuvenated, unless the options say so.
        """
        noise = self.spec.noise
        chosen: dict[str, Any] = {
            "num_particles": num_particles, "proposal": proposal, "camera": noise.camera, "motion": noise.motion,
            "rejuvenate_every": None, "seed": seed, "initial_poses": self.true_paths[:, 0],
        }  # fmt: skip
        return FastSlam(self.spec.robots, **(chosen | options))


@dataclass(frozen=True, slots=True, eq=False)
class _Looks:
    """Descriptors of classes (C, d), and the class of each landmark (N,)."""

    classes: FloatArray
    of_landmark: IntArray


def simulate_run(spec: RunSpec, seed: int) -> StereoRun:
    """Sample an office, the robots' paths through it, and their readings.

    The path and odometry of a robot depend only on the seed and its number: with more robots or another camera noise,
    the first robots drive the same paths.
    """
    check_int("seed", seed, 0, "Use 0 or a positive number.")
    layout, looks_seed, starts, *own = np.random.SeedSequence(seed).spawn(3 + 3 * spec.robots)
    office = Office.draw(spec.landmarks, np.random.default_rng(layout))
    looks = _draw_looks(spec, np.random.default_rng(looks_seed))
    nodes = start_crossings(spec.robots, np.random.default_rng(starts))
    paths, odometry, frames, names = [], [], [], []
    for robot in range(spec.robots):
        ways, wheels, eyes = (np.random.default_rng(s) for s in own[3 * robot : 3 * robot + 3])
        path = office.walk(nodes[robot], spec.length, STEP, ways)
        paths.append(path)
        odometry.append(_read_odometry(path, spec.noise.motion, wheels))
        share = spec.measurements // spec.robots + (robot < spec.measurements % spec.robots)
        seen = [_look(office, looks, pose, spec, share, eyes) for pose in path]
        frames.append([frame for frame, _ in seen])
        names.append([name for _, name in seen])
    return StereoRun(
        spec=spec, office=office, true_paths=np.array(paths), odometry=np.array(odometry).transpose(1, 0, 2).copy(),
        frames=tuple(zip(*frames, strict=True)), names=tuple(zip(*names, strict=True)),
        descriptors=looks.classes[looks.of_landmark].astype(np.float32),
    )  # fmt: skip


def _draw_looks(spec: RunSpec, rng: np.random.Generator) -> _Looks:
    """Sample unit descriptors, one for each class of similar landmarks; known landmarks have one class each."""
    size = spec.look_alikes if spec.association == "unknown" else 1
    classes = rng.normal(size=(-(-spec.landmarks // size), spec.descriptor_size))
    of_landmark = rng.permutation(spec.landmarks) // size
    return _Looks(classes / np.linalg.norm(classes, axis=1, keepdims=True), of_landmark)


def _read_odometry(path: FloatArray, motion: OdometryModel, rng: np.random.Generator) -> FloatArray:
    """Return noisy motions (T, 3) between the poses of a path; the first is 0."""
    odometry = np.zeros_like(path)
    odometry[1:] = between(path[:-1], path[1:])
    sigmas = np.array([motion.sigmas(move) for move in odometry[1:]]).reshape(-1, 3)
    odometry[1:] += rng.standard_normal((len(path) - 1, 3)) * sigmas
    return odometry


def _look(
    office: Office, looks: _Looks, pose: FloatArray, spec: RunSpec, most: int, rng: np.random.Generator
) -> tuple[Measurements, IntArray]:
    """Measure at most `most` of the visible landmarks, chosen at random; return measurements and landmark indices."""
    camera = spec.noise.camera
    names = rng.permutation(np.flatnonzero(office.visible(pose, camera)))[:most]
    num = len(names)
    pixels = camera.project(camera.camera_from_robot(transform_points(inverse(pose), office.landmarks[names])))
    pixels += rng.standard_normal((num, 3)) * [camera.sigma_px, camera.sigma_px, camera.sigma_disparity_px]
    classes = looks.of_landmark[names]
    if spec.association == "unknown":
        false = rng.random(num) < spec.outliers
        pixels[false] = _anywhere(camera, int(false.sum()), rng)
        names = np.where(false, FALSE_POINT, names)
        wrong = rng.random(num) < spec.wrong_descriptors
        classes = np.where(wrong, rng.integers(len(looks.classes), size=num), classes)
    pixels[:, 2] = np.maximum(pixels[:, 2], LEAST_DISPARITY)
    scatter = spec.descriptor_noise / np.sqrt(spec.descriptor_size)
    descriptors = looks.classes[classes] + scatter * rng.standard_normal((num, spec.descriptor_size))
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    return Measurements(camera.triangulate(pixels), descriptors.astype(np.float32)), names


def _anywhere(camera: StereoCamera, num: int, rng: np.random.Generator) -> FloatArray:
    """Sample pixels u, v, disparity (num, 3) of points anywhere in the image, at any depth up to the camera's range."""
    u = rng.uniform(-0.5 * camera.width, 0.5 * camera.width, num)
    v = rng.uniform(-0.5 * camera.height, 0.5 * camera.height, num)
    depth = rng.uniform(NEAREST_OUTLIER, camera.max_range, num)
    return np.column_stack([u, v, camera.focal_px * camera.baseline / depth])
