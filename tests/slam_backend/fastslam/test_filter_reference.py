"""The compiled filter and the plain one take the same decisions and compute the same numbers."""

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from builders.filters import dense
from builders.worlds import EXACT_MOTION, SmallWorld

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.fastslam.existence import ExistenceModel
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.options import FilterOptions
from slam_backend.fastslam.reports import StepReport
from slam_backend.geometry import wrap_angle
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.models.measurements import Measurements
from slam_backend.models.odometry import OdometryModel
from slam_backend.reference import ReferenceFastSlam, fastslam2
from slam_backend.reference import filter as plain_filter
from slam_backend.resampling import RESAMPLING

CLOSE = {"rtol": 1e-8, "atol": 1e-8}  # ill-conditioned updates amplify the rounding of either
UPPER = np.triu_indices(3)
BIASES: tuple[dict[str, float], ...] = ({}, {"bias_scale": 0.1, "bias_heading": 0.05, "bias_turn": 0.1})


def assert_same_pose(found: FloatArray, expected: FloatArray, close: dict[str, float] = CLOSE) -> None:
    """Compare poses (..., 3), headings on the circle."""
    np.testing.assert_allclose(found[..., :2], expected[..., :2], **close)
    np.testing.assert_allclose(wrap_angle(found[..., 2] - expected[..., 2]), 0.0, atol=close["atol"])


class WatchedPlainFastSlam(ReferenceFastSlam):
    """A plain filter that knows what it would report if any of the equally probable particles were the best.

    Where several are the most probable up to rounding, it looks for landmarks from the one that `preferred` says.
    """

    preferred = 0

    @property
    def best_particle(self) -> int:
        """One of the most probable particles."""
        return self.preferred if self.preferred in self.equally_probable() else super().best_particle

    def equally_probable(self) -> IntArray:
        """Return the particles that are the most probable up to rounding, by which a best one may differ."""
        log_weights = np.array([particle.path_log_weight for particle in self.particles])
        return np.flatnonzero(log_weights.max() - log_weights <= 1e-9 * max(1.0, abs(log_weights.max())))

    def _report(self, records: Any, best: int) -> StepReport:
        self.possible_reports = [super(WatchedPlainFastSlam, self)._report(records, m) for m in self.equally_probable()]
        return super()._report(records, best)


def assert_same_map(found: LandmarkMap, expected: LandmarkMap, close: dict[str, float] = CLOSE) -> None:
    """Compare two maps, ids and descriptors exactly."""
    np.testing.assert_array_equal(found.ids, expected.ids)
    np.testing.assert_array_equal(found.counts, expected.counts)
    if len(expected):
        np.testing.assert_array_equal(found.descriptors, expected.descriptors)
    np.testing.assert_allclose(found.means, expected.means, **close)
    np.testing.assert_allclose(found.covariances, expected.covariances, **close)


def assert_same_report(found: StepReport, plain: WatchedPlainFastSlam) -> None:
    """Compare what two filters say of a step."""
    same = [r for r in plain.possible_reports if all(map(np.array_equal, r.associations, found.associations))]
    assert same, f"{found.associations}, and not as in {plain.possible_reports}"
    for a, b in zip(found.created, same[0].created, strict=True):
        np.testing.assert_array_equal(a, b)
    for name in ("num_created", "num_new", "num_matched", "num_rejected", "resampled"):
        assert getattr(found, name) == getattr(same[0], name), name
    assert found.ess == pytest.approx(same[0].ess, rel=1e-6)
    assert any(found.nis == pytest.approx(r.nis, rel=1e-6, nan_ok=True) for r in same)


def assert_same_particles(slam: FastSlam, plain: ReferenceFastSlam) -> None:
    """Compare each landmark of each particle; particles that hold the same landmarks made the same decisions."""
    ids, means, covariances, counts = dense(slam)
    expected_counts = np.zeros_like(counts)
    expected_means, expected_covariances = np.zeros_like(means), np.zeros_like(covariances)
    rows = {int(name): row for row, name in enumerate(ids)}
    for m, particle in enumerate(plain.particles):
        assert set(particle.landmarks) <= set(rows)
        for name, landmark in particle.landmarks.items():
            row = rows[name]
            expected_counts[row, m] = landmark.count
            expected_means[row, :, m] = landmark.mean
            expected_covariances[row, :, m] = landmark.covariance[UPPER]
    np.testing.assert_array_equal(counts, expected_counts)
    held = (counts > 0)[:, None, :]
    np.testing.assert_allclose(np.where(held, means, 0.0), expected_means, **CLOSE)
    np.testing.assert_allclose(np.where(held, covariances, 0.0), expected_covariances, **CLOSE)
    if slam.options.existence is not None:
        log_odds, _ = slam.maps.odds_and_counts(slam.maps.used_slots())
        for m, particle in enumerate(plain.particles):
            for name, landmark in particle.landmarks.items():
                assert log_odds[rows[name], m] == pytest.approx(landmark.log_odds, abs=1e-9)


def assert_same(slam: FastSlam, plain: ReferenceFastSlam) -> None:
    """Compare every number that the two filters hold.

    Log-weights are differences of log-likelihoods, whose rounding is relative to their own size: after a false match
    that is ten thousands, and what depends on the weights agrees to fewer digits.
    """
    assert_same_particles(slam, plain)
    size = max(1.0, *(abs(particle.path_log_weight) for particle in plain.particles))
    weighted = {"rtol": 1e-9 * size, "atol": 1e-9 * size}
    np.testing.assert_allclose(slam.weights, plain.weights, **weighted)
    for robot in range(slam.num_robots):
        poses, log_weights = slam.particles(robot)
        assert_same_pose(poses, np.array([particle.poses[robot] for particle in plain.particles]))
        np.testing.assert_allclose(log_weights, [particle.log_weight for particle in plain.particles], **weighted)
        assert_same_pose(slam.pose(robot).mean, plain.pose(robot).mean, weighted)
        biases = slam.biases[robot, :, : slam.num_particles].T
        np.testing.assert_allclose(biases, [particle.biases[robot] for particle in plain.particles], **CLOSE)
        bias = plain.biases[robot]
        np.testing.assert_allclose(slam.bias_covariances[:, robot], [bias.covariance, bias.cross], **CLOSE)
        np.testing.assert_allclose(slam.pose(robot).covariance, plain.pose(robot).covariance, **weighted)
    best = slam.best_particle
    assert best in plain.equally_probable()
    assert_same_map(slam.map(), plain._map_of(plain.particles[best], "best"))
    assert_same_map(slam.map("mixture"), plain._map_of(plain.particles[best], "mixture"), weighted)


def both(num_robots: int, seed: int, starts: Any = None, **choices: Any) -> tuple[FastSlam, WatchedPlainFastSlam]:
    """Build the two filters, not rejuvenated."""
    choices = {"rejuvenate_every": None} | choices
    slam = FastSlam(num_robots, seed=seed, initial_poses=starts, **choices)
    return slam, WatchedPlainFastSlam(num_robots, FilterOptions(**choices), seed, starts)


@pytest.fixture
def happened(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """Count events inside the plain filter that its reports do not show."""
    counts: Counter[str] = Counter()
    is_lost, refine, update_existence = fastslam2.is_lost, fastslam2.refine, plain_filter.update_existence
    is_confirmed = fastslam2.is_confirmed

    def counted_is_lost(*args: Any) -> bool:
        answer = is_lost(*args)
        counts["lost"] += answer
        return answer

    def counted_is_confirmed(*args: Any) -> bool:
        answer = is_confirmed(*args)
        counts["confirmed" if answer else "unconfirmed"] += 1
        return answer

    def counted_refine(*args: Any) -> Any:
        counts["refined further"] += args[4] > 1
        return refine(*args)

    def counted_weigh_existence(particles: Any, *args: Any) -> None:
        before = sum(len(particle.landmarks) for particle in particles)
        update_existence(particles, *args)
        counts["given up"] += before - sum(len(particle.landmarks) for particle in particles)

    monkeypatch.setattr(plain_filter, "update_existence", counted_weigh_existence)
    monkeypatch.setattr(fastslam2, "is_lost", counted_is_lost)
    monkeypatch.setattr(fastslam2, "is_confirmed", counted_is_confirmed)
    monkeypatch.setattr(fastslam2, "refine", counted_refine)
    return counts


def some_existence(seed: int) -> ExistenceModel | None:
    """Return, for every fourth world, a model that gives landmarks up after a miss or a few."""
    if seed % 4 != 3:
        return None
    rng = np.random.default_rng(seed)
    return ExistenceModel(
        detection=rng.uniform(0.5, 0.9),
        prior=rng.uniform(0.3, 0.6),
        delete_below=rng.uniform(0.05, 0.25),
        cap=rng.uniform(0.8, 0.99),
        margin_px=rng.uniform(0.0, 20.0),
        range_share=rng.uniform(0.3, 1.0),
        nearest=rng.uniform(0.0, 1.0),
        frame_limit=None if rng.random() < 0.5 else int(rng.integers(1, 6)),
    )


def run_both(seed: int, num_particles: int, most: int, steps: int, proposal: str) -> Counter[str]:
    """Let both filters live through the same small world, compare them at every step, and count what happened."""
    rng = np.random.default_rng(seed)
    shares = [float(rng.choice([0.0, 0.3, 1.0], p=[0.5, 0.25, 0.25])) for _ in range(3)]
    num_robots = int(rng.integers(1, 4))
    world = SmallWorld(rng, num_robots, most, *shares)
    slam, plain = both(
        num_robots,
        seed,
        world.start_poses,
        num_particles=num_particles,
        camera=world.camera,
        motion=replace(world.motion, **BIASES[seed // 2 % 2]),
        proposal=proposal,
        resampling=str(rng.choice(list(RESAMPLING))),
        resample_threshold=float(rng.choice([0.0, 0.5, 1.0])),
        ambiguity_margin=float(rng.choice([0.0, 2.0, 6.0])),
        new_landmark_gate=float(rng.choice([11.34, 25.0])),
        new_landmark_radius=float(rng.choice([0.0, 0.4, 1.0])),
        recovery_position=float(rng.choice([0.0, 0.5])),
        one_to_one=bool(rng.random() < 0.6),
        landmark_noise=(0.0, 0.03)[seed // 3 % 2],
        existence=some_existence(seed),
    )
    counts: Counter[str] = Counter()
    for _ in range(steps):
        readings = world.read()
        arguments = (readings.odometry, readings.frames, readings.names, readings.poses)
        plain.preferred = slam.best_particle
        was_blind = [blind and frame is not None for blind, frame in zip(plain.is_blind, readings.frames, strict=True)]
        report = slam.step(*arguments)
        plain.step(*arguments)
        assert_same_report(report, plain)
        assert_same(slam, plain)
        counts["steps"] += 1
        counts["frames of fifteen and more"] += sum(len(found) >= 15 for found in report.associations)
        counts["resampled"] += report.resampled
        counts["rejected"] += report.num_rejected
        counts["new"] += report.num_new
        counts["matched"] += report.num_matched
        counts["sighted after blindness"] += sum(
            was and not now for was, now in zip(was_blind, plain.is_blind, strict=True)
        )
    return counts


def run_worlds(seeds: range, sizes: tuple[int, ...], most: int, steps: int) -> Counter[str]:
    """Run worlds that differ in size, options and luck; return what happened in all of them."""
    total: Counter[str] = Counter()
    for i, seed in enumerate(seeds):
        proposal = ("fastslam2", "fastslam2", "fastslam1")[i % 3]
        total.update(run_both(seed, sizes[i % len(sizes)], most, steps, proposal))
    return total


KINDS = ("matched", "new", "rejected", "resampled", "sighted after blindness", "lost", "refined further", "given up")


def test_compiled_filter_equals_the_plain_one(happened: Counter[str]) -> None:
    """In small random worlds every decision of every particle is the same, and every number to 1e-8."""
    happened.update(run_worlds(range(1000, 1030), (1, 2, 3, 5, 7), 7, 8))
    assert min(happened[kind] for kind in KINDS) > 5, happened


@pytest.mark.slow
def test_compiled_filter_equals_the_plain_one_in_many_worlds(happened: Counter[str]) -> None:
    """The same over hundreds of steps, with all combinations of options and of arguments."""
    happened.update(run_worlds(range(2000, 2060), (1, 2, 3, 5, 7), 7, 14))
    assert min(happened[kind] for kind in KINDS) > 15, happened
    assert happened["steps"] == 60 * 14


@pytest.mark.slow
def test_compiled_filter_equals_the_plain_one_in_a_crowd(happened: Counter[str]) -> None:
    """The same with up to a hundred particles and twenty measurements in a frame."""
    happened.update(run_worlds(range(3000, 3004), (33, 100), 20, 3))
    assert min(happened[kind] for kind in ("matched", "new", "resampled", "frames of fifteen and more")) > 5, happened


def step_both(slam: FastSlam, plain: WatchedPlainFastSlam, *arguments: Any) -> StepReport:
    """Do one step with both filters, compare them, and return what the compiled one reports."""
    report = slam.step(*arguments)
    plain.step(*arguments)
    assert_same_report(report, plain)
    assert_same(slam, plain)
    return report


@pytest.mark.parametrize("proposal", ["fastslam2", "fastslam1"])
def test_a_named_landmark_behind_the_camera_or_a_motion_without_noise_is_no_special_case(proposal: str) -> None:
    """Both filters agree where a prediction fails and where the prior of the pose is a point."""
    slam, plain = both(1, 3, num_particles=2, motion=EXACT_MOTION, proposal=proposal)
    frame = Measurements([[0.1, 0.2, 2.0], [-0.4, 0.0, 3.0]], np.eye(2))
    for move, names in ((None, [4, 7]), ([0.5, 0.0, np.pi], [4, 7]), ([0.1, 0.0, 0.0], [9, -1])):
        step_both(slam, plain, [None if move is None else np.array(move)], [frame], [names])


def test_a_landmark_that_only_the_refined_pose_can_see_is_matched() -> None:
    """A match behind the camera at the predicted pose counts; the NIS is that of the others."""
    slam, plain = both(1, 3, num_particles=3, motion=OdometryModel(sigma_along=0.3), resample_threshold=0.0)
    points = np.array([[0.2, 0.1, 3.0], [-0.5, 0.2, 2.5], [0.6, -0.3, 3.5], [-0.1, 0.05, 0.45]])
    step_both(slam, plain, [None], [Measurements(points, np.eye(4))], [range(4)])
    odometry = np.array([0.45, 0.0, 0.0])  # the last landmark would be in the lens; in fact the robot drove 0.3 m
    frame = Measurements(points - [0.0, 0.0, 0.3], np.eye(4))
    report = step_both(slam, plain, [odometry], [frame], [range(4)])
    np.testing.assert_array_equal(report.associations[0], range(4))
    assert 0.0 < report.nis < 5.0


@pytest.mark.parametrize("turn", [0.0, 0.7], ids=["straight", "turning"])
def test_a_robot_without_measurements_has_the_same_singular_covariance_in_both_filters(turn: float) -> None:
    """Both filters agree after many steps without measurements in which some directions, but not all, are noisy."""
    motion = OdometryModel(
        sigma_along=0.1, sigma_across=0.0, sigma_heading=0.0, sigma_turn=0.05, floor_position=0.0, floor_heading=0.0
    )
    slam, plain = both(1, 3, num_particles=5, motion=motion)
    points = np.array([[0.2, 0.1, 3.0], [-0.5, 0.2, 2.5], [0.6, -0.3, 3.5]])
    step_both(slam, plain, [None], [Measurements(points, np.eye(3))])
    for _ in range(40):
        step_both(slam, plain, [np.array([0.1, 0.0, turn])], [None])
    for _ in range(40):
        step_both(slam, plain, [np.array([0.0, 0.0, -turn])], [None])
    farther = points + np.array([0.0, 0.0, 0.02])
    step_both(slam, plain, [None], [Measurements(farther, np.eye(3))])


@pytest.mark.parametrize(("num_displaced", "is_lost"), [(2, False), (3, False), (4, True)])
def test_half_of_the_measurements_do_not_make_a_robot_lost(
    happened: Counter[str], num_displaced: int, is_lost: bool
) -> None:
    """Of six landmarks, more than half have to lie elsewhere, all by the same motion, before a pose is doubted."""
    slam, plain = both(1, 3, num_particles=2)
    points = np.array([[x, 0.1 * x, 2.0] for x in (-0.9, -0.5, -0.2, 0.2, 0.5, 0.9)])
    step_both(slam, plain, [None], [Measurements(points, np.eye(6))])
    points[:num_displaced, 2] += 0.15
    step_both(slam, plain, [None], [Measurements(points, np.eye(6))])
    assert happened["lost"] == happened["confirmed"] == (2 if is_lost else 0)


def test_a_pose_that_explains_each_measurement_by_itself_is_not_taken(happened: Counter[str]) -> None:
    """Six landmarks lie elsewhere, each by another motion: no pose explains three, and the robot keeps its own."""
    slam, plain = both(1, 3, num_particles=2)
    points = np.array([[x, 0.1 * x, 2.0] for x in (-0.9, -0.5, -0.2, 0.2, 0.5, 0.9)])
    step_both(slam, plain, [None], [Measurements(points, np.eye(6))])
    points[:, 0] += 0.3 * np.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
    points[:, 2] += 0.3 * np.array([1.0, 1.0, -1.0, -1.0, 1.0, 1.0])
    report = step_both(slam, plain, [None], [Measurements(points, np.eye(6))])
    assert happened["lost"] == happened["unconfirmed"] == 2
    assert report.num_matched == 0
    assert np.linalg.norm(slam.pose().mean) < 0.01
