"""The compiled filter and its plain reference take the same decisions and compute the same numbers."""

from collections import Counter
from typing import Any

import numpy as np
import pytest

from slam_backend.camera import StereoCamera
from slam_backend.errors import FloatArray, IntArray
from slam_backend.filter import UNPACK, FastSlam
from slam_backend.filter_options import FilterOptions
from slam_backend.geometry import compose, inverse, transform_points
from slam_backend.measurements import Measurements
from slam_backend.motion import OdometryModel
from slam_backend.plain import PlainFastSlam
from slam_backend.resampling import RESAMPLING

CLOSE = {"rtol": 1e-9, "atol": 1e-9}


class Recording(FastSlam):
    """A filter that remembers what every particle did with every measurement."""

    def _step_robot(self, *args: Any) -> tuple[IntArray, FloatArray]:
        found, distances = super()._step_robot(*args)
        self.decisions.append(np.append(self._ids, -1)[found])
        return found, distances

    def step(self, *args: Any, **kwargs: Any) -> Any:
        """Forget the last step's decisions and do the next step."""
        self.decisions: list[IntArray] = []
        return super().step(*args, **kwargs)


class SmallWorld:
    """A handful of landmarks, some of them close together and alike, and robots that wander among them.

    Args:
        rng: Draws everything.
        num_robots: K.
        given: Whether measurements carry covariances.
    """

    def __init__(self, rng: np.random.Generator, num_robots: int, given: bool) -> None:
        self.rng, self.given = rng, given
        self.camera = StereoCamera(mount=(0.11, -0.05, 0.3), sigma_px=rng.uniform(0.2, 1.5), sigma_disparity_px=0.3)
        self.motion = OdometryModel(sigma_along=rng.uniform(0.0, 0.3), sigma_heading=rng.uniform(0.0, 0.2))
        centres = rng.uniform([-5.0, -5.0, -0.5], [5.0, 5.0, 1.5], (13, 3))
        self.landmarks = np.vstack([centres, centres[:6] + rng.normal(0.0, 0.15, (6, 3))])
        looks = rng.normal(0.0, 1.0, (13, 5))
        looks = np.vstack([looks, looks[:6] + rng.normal(0.0, 0.05, (6, 5))])
        self.descriptors = looks / np.linalg.norm(looks, axis=1, keepdims=True)
        self.poses = rng.uniform([-2.0, -2.0, -np.pi], [2.0, 2.0, np.pi], (num_robots, 3))
        self.start_poses = self.poses.copy()

    def move(self, robot: int) -> FloatArray | None:
        """Move a robot, or not; return its noisy odometry."""
        if self.rng.random() < 0.2:
            return None
        move = self.rng.normal([0.2, 0.0, 0.0], [0.3, 0.1, 0.3])
        self.poses[robot] = compose(self.poses[robot], move)
        if self.rng.random() < 0.2:  # a slip that the odometry misses, and after which a filter has to recover
            self.poses[robot] = compose(self.poses[robot], self.rng.normal(0.0, [0.3, 0.3, 0.05]))
        return move + self.rng.standard_normal(3) * self.motion.sigmas(move)

    def look(self, robot: int, most: int) -> tuple[Measurements | None, IntArray | None]:
        """Return at most `most` measurements of what lies ahead, now and then a false one, and their true names."""
        if self.rng.random() < 0.1:
            return None, None
        points = self.camera.camera_from_robot(transform_points(inverse(self.poses[robot]), self.landmarks))
        names = self.rng.permutation(np.flatnonzero((points[:, 2] > 0.5) & (np.abs(points[:, 0]) < points[:, 2])))
        names = names[:most]
        pixels = self.camera.project(points[names])
        pixels += self.rng.standard_normal(pixels.shape) * [self.camera.sigma_px, self.camera.sigma_px, 0.3]
        pixels[:, 2] = np.maximum(pixels[:, 2], 1.0)
        descriptors = self.descriptors[names] + self.rng.normal(0.0, 0.05, (len(names), 5))
        measured = self.camera.triangulate(pixels)
        if len(names) and self.rng.random() < 0.2:
            measured[-1] += np.abs(self.rng.normal(0.0, 0.5, 3))
            names[-1] = -1
        covariances = self.camera.covariance(measured) + 1e-6 * np.eye(3) if self.given else None
        return Measurements(measured, descriptors, covariances), names


def assert_same(slam: Recording, plain: PlainFastSlam, decisions: list[list[list[int]]], kept: Any) -> None:
    """Compare every decision of the step and every number that the two filters hold."""
    for found, expected, keep in zip(slam.decisions, decisions, kept, strict=True):
        np.testing.assert_array_equal(found[keep].T, np.array(expected, dtype=np.int64).reshape(found[keep].T.shape))
    for m, particle in enumerate(plain.particles):
        slots = np.flatnonzero(slam._present[:, m])
        assert sorted(particle.landmarks) == sorted(slam._ids[slots])
        if not len(slots):
            continue
        landmarks = [particle.landmarks[int(name)] for name in slam._ids[slots]]
        np.testing.assert_allclose(slam._landmarks[slots, :3, m], [one.mean for one in landmarks], **CLOSE)
        covariances = slam._landmarks[slots, 3:, m][:, UNPACK]
        np.testing.assert_allclose(covariances, [one.covariance for one in landmarks], **CLOSE)
        np.testing.assert_array_equal(slam._counts[slots, m], [one.count for one in landmarks])
    np.testing.assert_allclose(slam._poses.swapaxes(0, 1), [p.poses for p in plain.particles], **CLOSE)
    posteriors = [[q.covariance for q in p.posteriors] for p in plain.particles]
    np.testing.assert_allclose(slam._pose_covariances.swapaxes(0, 1), posteriors, **CLOSE)
    np.testing.assert_allclose(slam._log_weights, [p.log_weight for p in plain.particles], **CLOSE)
    np.testing.assert_allclose(slam._path_log_weights, [p.path_log_weight for p in plain.particles], **CLOSE)


def run_both(seed: int, steps: int, **choices: Any) -> dict[str, int]:
    """Let both filters live through the same small world, compare them at every step, and count what happened."""
    rng = np.random.default_rng(seed)
    num_robots, most = int(rng.integers(1, 4)), int(rng.integers(1, 7))
    named, exact = bool(choices.pop("named")), bool(choices.pop("exact"))
    world = SmallWorld(rng, num_robots, bool(choices.pop("given")))
    options = FilterOptions(
        num_particles=int(rng.integers(1, 10)),
        camera=world.camera,
        motion=world.motion,
        resampling=str(rng.choice(list(RESAMPLING))),
        resample_threshold=float(rng.choice([0.0, 0.5, 1.0])),
        ambiguity=float(rng.choice([0.0, 2.0, 6.0])),
        dead_radius=float(rng.choice([0.0, 0.4, 1.0])),
        recovery_position=float(rng.choice([0.0, 0.5])),
        one_to_one=bool(rng.random() < 0.7),
        **choices,
    )
    fields = {name: getattr(options, name) for name in options.__slots__}
    slam = Recording(num_robots, seed=seed, initial_poses=world.start_poses, **fields)
    plain = PlainFastSlam(num_robots, options, seed, world.start_poses)
    counts = {"matched": 0, "new": 0, "rejected": 0, "resampled": 0}
    for _ in range(steps):
        odometry = [world.move(robot) for robot in range(num_robots)]
        looks = [world.look(robot, most) for robot in range(num_robots)]
        frames = [frame for frame, _ in looks]
        names = [name for _, name in looks] if named else None
        poses = [compose(inverse(a), b) for a, b in zip(world.start_poses, world.poses, strict=True)] if exact else None
        report = slam.step(odometry, frames, names, poses)
        decisions = plain.step(odometry, frames, names, poses)
        assert report.resampled == plain.resampled
        assert report.ess == pytest.approx(plain.ess, rel=1e-6)
        kept = [
            np.flatnonzero(name >= 0) if named and name is not None else np.arange(0 if frame is None else len(frame))
            for frame, name in looks
        ]
        assert_same(slam, plain, decisions, kept)
        counts["resampled"] += report.resampled
        for one, made in zip(report.associations, report.created, strict=True):
            counts["rejected"] += int(np.sum(one < 0))
            counts["new"] += int(np.sum((one >= 0) & (one == made)))
            counts["matched"] += int(np.sum((one >= 0) & (one != made)))
    return counts


def run_worlds(seeds: range) -> dict[str, int]:
    """Run worlds that differ in size, options and luck; return what happened in all of them."""
    total: Counter[str] = Counter()
    for seed in seeds:
        proposal = ("fastslam2", "fastslam1", "fastslam2")[seed % 3]
        choices = {"given": seed // 3 % 2 == 1, "named": seed // 6 % 4 == 3, "exact": seed // 24 % 3 == 2}
        total.update(run_both(seed, 8, proposal=proposal, **choices))
    return total


def test_compiled_filter_equals_the_plain_one() -> None:
    """In small random worlds every decision of every particle is the same, and every number to 1e-9."""
    happened = run_worlds(range(1000, 1012))
    assert min(happened.values()) > 5, "each kind of decision has to occur"


@pytest.mark.slow
def test_compiled_filter_equals_the_plain_one_in_many_worlds() -> None:
    """The same over some thousand steps, with all combinations of proposal, covariances, names and exact poses."""
    happened = run_worlds(range(120))
    assert min(happened.values()) > 40, "each kind of decision has to occur"


def test_a_named_landmark_behind_the_camera_or_a_motion_without_noise_is_no_special_case() -> None:
    """Both filters agree where a prediction fails and where the prior of the pose is a point."""
    options = FilterOptions(num_particles=2, motion=OdometryModel(
        sigma_along=0.0, sigma_across=0.0, sigma_heading=0.0, sigma_turn=0.0, floor_position=0.0, floor_heading=0.0
    ))
    frame = Measurements([[0.1, 0.2, 2.0], [-0.4, 0.0, 3.0]], np.eye(2))
    for proposal in ("fastslam2", "fastslam1"):
        fields = {name: getattr(options, name) for name in options.__slots__} | {"proposal": proposal}
        slam = Recording(seed=3, **fields)
        plain = PlainFastSlam(1, FilterOptions(**fields), 3)
        for move, names in ((None, [4, 7]), ([0.5, 0.0, np.pi], [4, 7]), ([0.1, 0.0, 0.0], [9, -1])):
            odometry = [None if move is None else np.array(move)]
            slam.step(odometry, [frame], [names])
            kept = [np.flatnonzero(np.array(names) >= 0)]
            assert_same(slam, plain, plain.step(odometry, [frame], [names]), kept)
