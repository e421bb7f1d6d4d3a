"""Losses of accuracy: batch and online estimates of episodes, associations over merges, results and program."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from slam_backend.core.validation import FloatArray
from slam_backend.geometry import between, wrap_angle
from slam_backend.team.reports import LandmarkIdMap, MapForked, MergeUndone
from studies.bounds.episodes import RecordedEpisode, components, maps_before_merges, record_episode, replay
from studies.bounds.ladder import (
    LADDER,
    Associations,
    build_problem,
    estimates,
    fusions_of_merges,
    true_covariances,
    true_start,
    with_all_keyframes,
)
from studies.bounds.online import ideal_online
from studies.filters.losses import (
    ESTIMATES,
    LOSSES,
    STUDY,
    Config,
    count_revisits,
    environment,
    play,
    score_paths,
    trials,
)
from training.bench.exploration.players import parted
from training.experiments.run_folder import plain
from training.stereo_runs.batch_ml import BatchEstimate, batch_ml, most_likely
from training.stereo_runs.batch_problem import BatchProblem, Estimate
from training.stereo_runs.runs import RunSpec, simulate_run
from vslam_env import vslam_v0
from vslam_env.config import EnvConfig
from vslam_env.world import OdometryNoise, read_odometry

FALSE_ALARM = 1e-3
SMALL = Config(worlds=("fig5",), duration=4.0, particles=(12,), seeds=2, seed=70)
BIAS = (0.02, 0.01, 0.03)


PROGRAM = [
    sys.executable, "-m", "studies.filters.losses", "--worlds", "fig5", "--max-seconds", "2", "--particles", "5",
]  # fmt: skip


def recorded(config: Config, seed: int = 70, change: Callable[[EnvConfig], EnvConfig] = lambda env: env) -> Any:
    """Return an episode of a study, with a changed environment."""
    (trial,) = (trial for trial in trials(config) if trial.seed == seed)
    env = vslam_v0.parallel_env(config=change(environment(config, trial)))
    return record_episode(env, parted(trial.policy).make(env, 600.0), trial.seed)


@pytest.fixture(scope="module")
def problem() -> BatchProblem:
    """Two robots for 12 m; the start of the second and the odometry biases of both are unknown."""
    run = simulate_run(RunSpec(robots=2, length=12.0, measurements=9, landmarks=170), seed=8)
    known = BatchProblem.of_run(run)
    return replace(
        known, starts=np.zeros((2, 3)), bases=run.true_paths[:, 0].copy(), loose=np.array([False, True]),
        bias_sigmas=BIAS,
    )  # fmt: skip


@pytest.fixture(scope="module")
def batch(problem: BatchProblem) -> BatchEstimate:
    """Batch estimate of the problem."""
    return batch_ml(problem)


@pytest.fixture(scope="module")
def rows() -> list[dict[str, Any]]:
    """Trials of a small study, as stored."""
    return [plain(asdict(trial) | play(SMALL, trial)) for trial in trials(SMALL)]


def shifted(at: Estimate, name: str, step: FloatArray) -> Estimate:
    """Return an estimate with one of its arrays changed."""
    return replace(at, **{name: getattr(at, name) + step})


def test_jacobians_of_path_frames_and_biases_match_central_differences(problem: BatchProblem) -> None:
    """Moving a path frame, an own pose or a bias changes the residuals as the Jacobians predict."""
    at = replace(problem.dead_reckoning(), biases=np.array([[0.03, -0.02, 0.03], [-0.01, 0.04, -0.05]]))
    sights, moves = problem.sights(at), problem.moves(at)
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 1e-6
        for name, by in (("bases", sights.by_base), ("paths", sights.by_pose)):
            ahead, behind = (problem.sights(shifted(at, name, s)).residuals for s in (step, -step))
            np.testing.assert_allclose((ahead - behind) / 2e-6, by[..., axis], rtol=1e-4, atol=1e-3)
        move = np.zeros_like(at.paths)
        move[:, 1::2, axis] = 1e-6
        ahead, behind = (problem.moves(shifted(at, "paths", s)).residuals for s in (move, -move))
        odd = (np.arange(problem.num_steps - 1) % 2 == 0)[None, :, None]
        expected = np.where(odd, moves.by_second[..., axis], moves.by_first[..., axis])
        np.testing.assert_allclose((ahead - behind) / 2e-6, expected, rtol=1e-5, atol=1e-3)
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 1e-6
        ahead, behind = (problem.moves(shifted(at, "biases", s)).residuals for s in (step, -step))
        np.testing.assert_allclose((ahead - behind) / 2e-6, moves.by_bias[..., axis], rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("fused_at", [None, 20, 47])
def test_online_and_batch_agree_after_the_last_step(
    problem: BatchProblem, batch: BatchEstimate, fused_at: int | None
) -> None:
    """The filter ends with the poses and covariances of the elimination, also if the two maps are fused on the way."""
    fusions = None
    if fused_at is not None:
        fusions = fusions_of_merges(problem, [(fused_at, (0,), (1,))])
        assert len(fusions.pairs) > 0
    at = most_likely(problem)
    online = ideal_online(problem, at, fusions=fusions)
    np.testing.assert_allclose(online.paths[:, -1], batch.paths[:, -1], atol=1e-6)
    np.testing.assert_allclose(online.covariances[:, -1], batch.path_covariances[:, -1], rtol=1e-3, atol=1e-10)
    np.testing.assert_allclose(online.landmarks, batch.landmarks, atol=1e-5)
    assert online.bases is not None
    assert at.bases is not None
    np.testing.assert_allclose(online.bases, at.bases, atol=1e-5)


def test_an_unknown_start_is_found_and_a_known_one_stays(problem: BatchProblem) -> None:
    """Shared landmarks give the start of the second robot to centimetres; the first keeps its own."""
    assert problem.bases is not None
    found = most_likely(problem)
    assert found.bases is not None
    assert found.biases is not None
    np.testing.assert_array_equal(found.bases[0], problem.bases[0])
    away = between(problem.bases[1], found.bases[1])
    assert 0.0 < np.hypot(*away[:2]) < 0.2
    assert (np.abs(found.biases) < 3.0 * np.array(BIAS)).all()


def test_true_odometry_noise_is_standard_normal_after_whitening() -> None:
    """Residuals of simulated readings at the true motion are chi-square; the bias shifts them as modelled (1e-3)."""
    rng = np.random.default_rng(8)
    noise = OdometryNoise(sigma_distance=0.01, bias_distance=0.01, bias_heading_per_metre=0.03)
    bias = np.array([[0.01, 0.03, 0.0], [-0.01, -0.02, 0.0]])
    poses = np.zeros((2, 2001, 3))
    reads = np.zeros((2, 2000, 3))
    for step in range(2000):
        motion = np.column_stack([rng.uniform(-0.05, 0.1, 2), np.zeros(2), rng.uniform(-0.1, 0.1, 2)])
        c, s = np.cos(poses[:, step, 2]), np.sin(poses[:, step, 2])
        poses[:, step + 1] = poses[:, step] + np.column_stack([c * motion[:, 0], s * motion[:, 0], motion[:, 2]])
        reads[:, step] = read_odometry(poses[:, step], poses[:, step + 1], bias[:, :2], noise, rng)
    poses[..., 2] = wrap_angle(poses[..., 2])
    none = np.zeros(0, dtype=np.int64)
    problem = BatchProblem(
        starts=np.zeros((2, 3)), odometry=reads, odometry_covariances=true_covariances(reads, noise),
        camera=EnvConfig().landmark_sensor.camera, points=np.zeros((0, 3)), robots=none, steps=none, landmarks=none,
        names=none, bias_sigmas=(noise.bias_distance, noise.bias_heading_per_metre, 0.0),
    )  # fmt: skip
    # Distance and turn; the third component, across the motion, has no noise but a floor.
    moves = problem.moves(Estimate(poses, np.zeros((0, 3)), biases=bias))
    squares = np.einsum("kti,kti->", moves.residuals, moves.residuals)
    low, high = stats.chi2.interval(1.0 - FALSE_ALARM, 2 * reads[..., 0].size)
    assert 0.97 * low < squares < 1.03 * high  # a reading's distance, 1 % off, stands for the true one
    unmodelled = problem.moves(Estimate(poses, np.zeros((0, 3)))).residuals
    assert np.einsum("kti,kti->", unmodelled, unmodelled) > 1.5 * squares


def test_without_noise_every_estimate_is_exact() -> None:
    """With exact readings batch and online estimates equal the truth, whatever noise they assume."""

    def exact(env: EnvConfig) -> EnvConfig:
        return env.replace(
            odometry={
                "sigma_distance": 1e-7, "sigma_heading_per_metre": 1e-7, "bias_distance": 0.0,
                "bias_heading_per_metre": 0.0,
            },
            landmark_sensor={"camera": {"sigma_px": 1e-7, "sigma_disparity_px": 1e-7}, "false_points": 0.0},
        )  # fmt: skip

    episode = recorded(SMALL, change=exact)
    track = replay(episode, episode.config.belief.filter)
    found = estimates(episode, track) | {"all_keyframes": track.paths}
    errors = score_paths(episode, found)
    for name in ESTIMATES:
        if name not in ("filter", "all_keyframes"):
            assert errors[name] < 1e-6, name


def test_replayed_filters_repeat_the_episode() -> None:
    """Filters with the same options give the poses that the environment's beliefs had, tick by tick."""
    config = SMALL.replace(robots=(2,))
    episode = recorded(config)
    track = replay(episode, episode.config.belief.filter)
    np.testing.assert_array_equal(track.paths[:, ::10], episode.record.estimated)  # a goal is held for ten ticks
    assert len(episode.true_ids) == len(episode.readings) == track.paths.shape[1] == 41
    for tick, named, label in zip(episode.readings, episode.true_ids, track.labels, strict=True):
        for own, names, labels in zip(tick, named, label, strict=True):
            assert len(own.measurements) == len(names) == len(labels)
    wider = replay(episode, with_all_keyframes(episode.config.belief.filter))
    assert wider.paths.shape == track.paths.shape


@pytest.mark.slow
def test_errors_agree_with_the_predicted_covariances() -> None:
    """Over 20 episodes the last pose of the batch, with true associations and noise, has chi-square errors (1e-3).

    The online estimate of the last pose equals that of the batch, so its covariance is the batch's.
    """
    total = 0.0
    config = SMALL.replace(seeds=20, duration=6.0, policies=("random_goals",))
    for seed in range(70, 90):
        episode: RecordedEpisode = recorded(config, seed)
        noise = episode.config.odometry
        found = Associations(episode.true_ids, ())
        bias = noise.bias_distance, noise.bias_heading_per_metre, 0.0
        camera, covariances = episode.config.landmark_sensor.camera, true_covariances(episode.odometry, noise)
        problem, _ = build_problem(episode, found, camera, covariances, bias)
        at = most_likely(problem, true_start(episode, problem))
        online = ideal_online(problem, at)
        np.testing.assert_allclose(online.paths[:, -1], at.paths[:, -1], atol=1e-5)
        error = online.paths[0, -1] - episode.own_true_paths[0, -1]
        error[2] = wrap_angle(error[2])
        total += float(error @ np.linalg.solve(online.covariances[0, -1] + 1e-10 * np.eye(3), error))
    low, high = stats.chi2.interval(1.0 - FALSE_ALARM, 3 * 20)
    assert low < total < high


def test_associations_are_of_maps_before_merges_and_after_losses_of_contact() -> None:
    """Ids of the same number, created in the tick in which a robot gets a map of its own, are different landmarks."""

    def maps(after: tuple[int, ...], change: Any) -> list[int]:
        report: Any = SimpleNamespace(maps=after, map_changes=(change,))
        return maps_before_merges(report)

    assert maps((5, 5, 5), LandmarkIdMap((0,), (1, 2), np.empty((0, 2), np.int64), (0, 1, 5))) == [0, 1, 1]
    assert maps((0, 1, 1), MergeUndone((0, 1, 5))) == [5, 5, 5]
    assert maps((5, 6, 5), MapForked(5, 6)) == [5, 6, 5]


def test_groups_follow_merges_and_landmarks_are_fused_then() -> None:
    """Landmarks of a group have one copy; copies of two groups are fused when these merge, and only once."""
    assert components(4, [(3, (0,), (2,)), (5, (0, 2), (3,))]).tolist() == [0, 1, 0, 0]
    steps, robots = np.array([0, 0, 1, 2, 3, 4]), np.array([0, 1, 1, 1, 0, 1])
    landmarks = np.array([0, 0, 1, 1, 1, 0])
    problem = BatchProblem(
        starts=np.zeros((2, 3)), odometry=np.zeros((2, 4, 3)), odometry_covariances=np.tile(np.eye(3), (2, 4, 1, 1)),
        camera=EnvConfig().landmark_sensor.camera, points=np.ones((6, 3)), robots=robots, steps=steps,
        landmarks=landmarks, names=np.array([7, 9]),
    )  # fmt: skip
    found = fusions_of_merges(problem, [(2, (0,), (1,))])
    assert found.copies.tolist() == [0, 1, 2, 2, 2, 0]
    assert found.pairs.tolist() == [[2, 0, 1]]


def test_without_landmarks_all_estimates_are_dead_reckoning() -> None:
    """Where nothing is seen, batch and filter have odometry alone; the report leaves missing figures out."""
    config = SMALL.replace(max_ranges=(0.9,), duration=2.0, seeds=1, seed=72)
    (trial,) = trials(config)
    row = plain(asdict(trial) | play(config, trial))
    assert row["num_measurements"] == row["landmarks"] == 0
    for name in ("batch", "ideal_online", "noise_as_assumed", "own_associations", "online"):
        assert row[name] == pytest.approx(row["odometry"]), name
    (line,) = STUDY.tables[2].lines([row])
    assert line["map over batch"].value is None


def test_losses_multiply_to_the_whole(rows: list[dict[str, Any]]) -> None:
    """The product of all losses is the filter's error over that of the batch, of each trial and of the means."""
    assert LADDER[0][0] == "batch"
    assert LADDER[-1][0] == "filter"
    assert LOSSES == ("assumed noise", "association", "online", "particles", "keyframe reduction")
    for row in rows:
        assert np.prod([row[f"loss of {loss}"] for loss in LOSSES]) == pytest.approx(row["filter"] / row["batch"])
    (line,) = STUDY.tables[1].lines(rows)
    whole = float(np.sqrt(np.prod([row["over_batch"] for row in rows])))
    assert np.prod([line[loss].value for loss in LOSSES]) == pytest.approx(whole)


def test_trials_report_errors_and_associations(rows: list[dict[str, Any]]) -> None:
    """Odometry is worse than batch over both trials, shares are shares, and a trial repeats itself."""
    batch, odometry = (np.hypot(*(row[name] for row in rows)) for name in ("batch", "odometry"))
    assert 0.0 < batch < odometry
    for row in rows:
        assert 0.0 <= row["wrong_match_share"] <= 1.0
        assert 0.0 <= row["unused_share"] <= 1.0
        assert row["copies_per_landmark"] >= 1.0
        assert 0 <= row["missed_revisits"] <= row["revisits"]
        assert row["duration_s"] == pytest.approx(4.0)
    first, *_ = trials(SMALL)
    again = plain(asdict(first) | play(SMALL, first))
    assert {**again, "seconds": 0.0} == {**rows[0], "seconds": 0.0}


def test_revisits_are_missed_where_no_measurement_has_an_earlier_label() -> None:
    """A visit ends after 100 ticks without a measurement; a match may follow a rejection in the same visit."""
    seen = {  # tick: (true landmark, label) of the measurements of robot 0; robot 1 sees landmark 7 once
        0: [(7, 0), (8, 1), (-1, 2)], 90: [(7, 0)], 195: [(7, -1)], 196: [(7, 0)], 200: [(8, 5), (9, 6)],
        301: [(8, 1)], 320: [(9, -1)],
    }  # fmt: skip
    truths, labels = (
        [[np.array([pair[k] for pair in seen.get(tick, [])], dtype=np.int64), np.array([7 - 7 * k] * (tick == 250))]
         for tick in range(330)]
        for k in (0, 1)
    )  # fmt: skip
    # 7 again at 195: found in the next tick. 8 at 200: a new landmark; at 301: found. 9 at 320: rejected.
    assert count_revisits(truths, labels) == {"revisits": 4, "missed_revisits": 2}
    assert count_revisits([], []) == {"revisits": 0, "missed_revisits": 0}


def test_conditions_name_what_differs_from_the_default() -> None:
    """Trials with equal options but for the seed have one name."""
    config = SMALL.replace(policies=("random_walk",), max_ranges=(12.0,), measurements=(15,))
    assert {trial.condition for trial in trials(SMALL)} == {"fig5, K = 1, M = 12"}
    assert {trial.condition for trial in trials(config)} == {"fig5, K = 1, random_walk, range 12 m, B = 15, M = 12"}


def test_cameras_change_in_the_world_and_in_the_filter() -> None:
    """Range and baseline are those of the true and of the assumed camera, and their noise stays as it is."""
    config = SMALL.replace(max_ranges=(4.0,), baselines=(0.24,), measurements=(3,))
    env, usual = (environment(each, trials(each)[0]) for each in (config, SMALL))
    for camera, before in (
        (env.landmark_sensor.camera, usual.landmark_sensor.camera),
        (env.belief.filter.camera, usual.belief.filter.camera),
    ):
        assert (camera.max_range, camera.baseline) == (4.0, 0.24)
        assert camera.sigma_px == before.sigma_px
    assert env.landmark_sensor.max_measurements == 3


@pytest.mark.parametrize(("values", "match"), [
    ({"presets": ("good",)}, "presets: expected one of 'easy', 'standard', 'hard', got 'good'"),
    ({"worlds": ("nowhere",)}, "world: expected one of 'office'"), ({"policies": ("magic",)}, "policy"),
    ({"policies": ("oracles@bound",)}, "policy: expected a policy of robots or of the team"),
    ({"robots": (9,)}, "robots: expected an int from 1 to 8, got 9"),
    ({"duration": 0.0}, "max_seconds: expected a finite number >= 1, got 0.0"),
    ({"baselines": (0.0,)}, "baselines: expected a finite number > 0, got 0.0"),
])  # fmt: skip
def test_what_cannot_be_played_is_refused(values: dict[str, Any], match: str) -> None:
    """Worlds, policies and numbers are refused, and bounds, which know the truth."""
    with pytest.raises(ValueError, match=match):
        Config(**values)


def test_the_program_leaves_out_policies_that_fail(tmp_path: Path) -> None:
    """An episode whose policy raises costs one line; the others are summed up, with status 2 at the end."""
    (tmp_path / "lost.py").write_text(
        "class Lost:\n"
        "    def reset(self):\n        pass\n"
        "    def act(self, observation, belief, rng):\n        raise KeyError('way')\n"
    )  # fmt: skip
    arguments = [*PROGRAM, "--seeds", "1", "--policies", "lost:Lost,frontier", "--out", "run"]
    paths = {"PYTHONPATH": os.pathsep.join(map(str, (Path.cwd(), tmp_path)))}
    done = subprocess.run(arguments, cwd=tmp_path, env=os.environ | paths, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "1 of 2 trials failed" in done.stdout
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert [row["policy"] for row in metrics["trials"]] == ["frontier"]
    assert [line["condition"] for line in metrics["tables"]["losses"]] == ["fig5, K = 1, M = 5"]
    assert "| fig5, K = 1, M = 5 |" in (tmp_path / "run" / "tables.md").read_text()
    assert (tmp_path / "run" / "curves.png").stat().st_size > 10_000
