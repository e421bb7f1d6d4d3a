"""Seeded stereo runs of one or several robots through an office, with the truth: what accuracy is measured on."""

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
from training.bench.accuracy.world import Office, start_crossings
from training.experiments.config import Checked, Positive, setting

STEP = 0.25  # distance between frames along the path [m]
EYE = (0.0, 0.0, 0.9)  # of the left camera on the robot [m]
LEAST_DISPARITY = 0.5  # px; noise never brings a measured disparity below this
NEAREST_OUTLIER = 1.0  # [m]
Preset = Literal["good", "coarse", "paper"]
FALSE_POINT = -1  # name of a measurement that no landmark caused

PRECISE_WHEELS = OdometryModel(
    sigma_along=0.02, sigma_across=0.01, sigma_heading=0.0, sigma_turn=0.03, floor_position=0.0, floor_heading=0.0015
)


@dataclass(frozen=True, slots=True, kw_only=True)
class NoisePreset:
    """True noise of a run, which the filters assume too."""

    sigma_px: float  # Standard deviation of the image coordinates u and v [px]
    sigma_disparity_px: float  # Standard deviation of the disparity [px]
    motion: OdometryModel = field(default_factory=OdometryModel)  # Noise of the odometry, independent at each step

    @property
    def camera(self) -> StereoCamera:
        """The camera of all runs (f 320 px, b 0.12 m, 320 x 240 px, range 8 m) with this noise."""
        return StereoCamera(sigma_px=self.sigma_px, sigma_disparity_px=self.sigma_disparity_px, mount=EYE)


# good: features located to a fifth of a pixel, disparities to a tenth; common wheels (5 % along, 2 degrees per metre).
# coarse: to a pixel and half a pixel, as without refinement. paper: measurements that say little against the odometry
# (2 % along, 1 % across, .0015 rad per step and 3 % of the turn), the regime in which the paper's Fig. 6 holds.
PRESETS: dict[str, NoisePreset] = {
    "good": NoisePreset(sigma_px=0.2, sigma_disparity_px=0.1),
    "coarse": NoisePreset(sigma_px=1.0, sigma_disparity_px=0.5),
    "paper": NoisePreset(sigma_px=10.0, sigma_disparity_px=0.6, motion=PRECISE_WHEELS),
}


class RunSpec(Checked):
    """What decides a simulated run, its seed apart."""

    robots: Positive = 1  # K
    length: float = setting(100.0, ge=STEP)  # Of each robot's path [m]
    measurements: int = 15  # B, of all robots together in a step; robot i gets B // K, and one more if i < B mod K
    landmarks: Positive = 300  # N
    preset: Preset | NoisePreset = "good"  # Key of `PRESETS`, or a preset of one's own
    # "known": each measurement comes with the name of its landmark, and none is false. "unknown": by appearance and
    # position alone, with look-alikes, false points and wrong descriptors as below.
    association: Literal["known", "unknown"] = "known"
    look_alikes: Positive = 3  # Landmarks of a class, which all have one descriptor ("unknown" only)
    # Shares of the measurements whose point lies anywhere in view, and of those that look like another class ("unknown"
    # only)
    outliers: float = setting(0.02, ge=0.0, le=1.0)
    wrong_descriptors: float = setting(0.03, ge=0.0, le=1.0)
    descriptor_size: int = setting(64, ge=2)  # d
    # Root mean square length of the noise added to a descriptor before it is normalised again
    descriptor_noise: float = setting(0.17, ge=0.0)

    def check(self) -> None:
        """Refuse robots that see nothing."""
        check_int("measurements", self.measurements, self.robots, "Each robot needs at least one measurement a step.")

    @property
    def noise(self) -> NoisePreset:
        """The preset itself."""
        return self.preset if isinstance(self.preset, NoisePreset) else PRESETS[self.preset]


@dataclass(frozen=True, slots=True, eq=False)
class StereoRun:
    """What K robots did and read in T steps, and the truth. The world frame is the map frame of `build_filter`."""

    spec: RunSpec  # What was asked for
    office: Office  # Walls and landmarks
    true_paths: FloatArray  # (K, T, 3) float64 [m, m, rad], world frame
    # (T, K, 3) float64 [m, m, rad]. Noisy motion from step t - 1 to t in the frame of t - 1; at t = 0 the robots stand,
    # and the entry is 0.
    odometry: FloatArray
    # Per step and robot its measurements, in random order; the first is taken at the start pose
    frames: tuple[tuple[Measurements, ...], ...]
    # Per step and robot (n,) int64, the landmark behind each measurement; `FALSE_POINT`: none
    names: tuple[tuple[IntArray, ...], ...]
    descriptors: NDArray[np.float32]  # (N, d) float32, what each landmark looks like

    @property
    def landmarks(self) -> FloatArray:
        """(N, 3) float64 [m], world frame."""
        return self.office.landmarks

    @property
    def num_steps(self) -> int:
        """T, the frame at the start included."""
        return len(self.frames)

    def measured_landmarks(self) -> IntArray:
        """Return the sorted indices of the landmarks that were measured at least once."""
        named = np.concatenate([names for step in self.names for names in step])
        return np.unique(named[named != FALSE_POINT])

    def readings(self) -> Iterator[dict[str, Any]]:
        """Give the arguments of `FastSlam.step`, step by step: `slam.step(**reading)`.

        The first step has no odometry; the names of landmarks are given if the association is known.
        """
        known = self.spec.association == "known"
        for step, (frames, names) in enumerate(zip(self.frames, self.names, strict=True)):
            odometry = [None] * len(frames) if step == 0 else list(self.odometry[step])
            yield {"odometry": odometry, "measurements": list(frames), "identities": list(names) if known else None}

    def build_filter(
        self, num_particles: int = 100, proposal: Literal["fastslam2", "fastslam1"] = "fastslam2",
        seed: int | np.random.SeedSequence = 0, **options: Any,
    ) -> FastSlam:  # fmt: skip
        """Return a filter that assumes the true noise and starts all robots at their true poses in the world frame."""
        noise = self.spec.noise
        chosen: dict[str, Any] = {
            "num_particles": num_particles, "proposal": proposal, "camera": noise.camera, "motion": noise.motion,
            "seed": seed, "initial_poses": self.true_paths[:, 0],
        }  # fmt: skip
        return FastSlam(self.spec.robots, **(chosen | options))


@dataclass(frozen=True, slots=True, eq=False)
class _Looks:
    """Descriptors of classes (C, d), and the class of each landmark (N,)."""

    classes: FloatArray
    of_landmark: IntArray


def simulate_run(spec: RunSpec, seed: int) -> StereoRun:
    """Draw an office, the robots' paths through it, and what they read.

    A robot's path and odometry depend on the seed and its number alone: with more robots, or another camera noise, the
    first ones drive the same ways.
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
    """Draw unit descriptors, one for each class of look-alikes; where landmarks are known, each is its own class."""
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
    """Measure at most `most` of the visible landmarks, chosen at random; return the frame and their names."""
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
    """Draw (num, 3) pixels u, v, disparity of points anywhere in the image, at any depth up to the camera's range."""
    u = rng.uniform(-0.5 * camera.width, 0.5 * camera.width, num)
    v = rng.uniform(-0.5 * camera.height, 0.5 * camera.height, num)
    depth = rng.uniform(NEAREST_OUTLIER, camera.max_range, num)
    return np.column_stack([u, v, camera.focal_px * camera.baseline / depth])
