"""Losses of accuracy: batch and online estimates of episodes, associations over merges, summary and command."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from slam_backend.core.validation import FloatArray
from slam_backend.geometry import between, wrap_angle
from training.bench.accuracy.batch_ml import BatchEstimate, batch_ml, most_likely
from training.bench.accuracy.batch_problem import BatchProblem, Estimate
from training.bench.accuracy.episodes import RecordedEpisode, components, record_episode, replay
from training.bench.accuracy.losses import (
    ESTIMATES,
    LADDER,
    LOSSES,
    Associations,
    build_problem,
    count_revisits,
    estimates,
    fusions_of_merges,
    play,
    score_paths,
    true_covariances,
    true_start,
    with_all_keyframes,
)
from training.bench.accuracy.losses_report import (
    condition_name,
    draw_losses,
    geometric_mean,
    losses_of,
    markdown,
    summarise,
)
from training.bench.accuracy.online_bound import ideal_online
from training.bench.accuracy.runs import RunSpec, simulate_run
from training.bench.config import AccuracyConfig
from training.experiments.run_folder import plain
from vslam_env import vslam_v0
from vslam_env.config import EnvConfig
from vslam_env.world import OdometryNoise, read_odometry

FALSE_ALARM = 1e-3
SMALL = AccuracyConfig(worlds=("fig5",), duration=4.0, particles=(12,), seeds=2, seed=70)
BIAS = (0.02, 0.01, 0.03)


def recorded(config: AccuracyConfig, change: Callable[[EnvConfig], EnvConfig] = lambda env: env) -> RecordedEpisode:
    """Return the first episode of a benchmark, with a changed environment."""
    trial = config.episodes()[0]
    env = vslam_v0.parallel_env(config=change(config.environment(trial)))
    return record_episode(env, config.run(trial).make_policies(env), trial.seed)


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
    """Trials of a small benchmark, as stored."""
    return [play(SMALL, trial) for trial in SMALL.episodes()]


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

    episode = recorded(SMALL, exact)
    track = replay(episode, episode.config.belief.filter)
    found = estimates(episode, track) | {"all_keyframes": track.paths}
    errors = score_paths(episode, found)["position_rms_m"]
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
    for trial in config.episodes():
        env = vslam_v0.parallel_env(config=config.environment(trial))
        episode = record_episode(env, config.run(trial).make_policies(env), trial.seed)
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
    (trial,) = config.episodes()
    row = play(config, trial)
    assert row["num_measurements"] == row["landmarks"] == 0
    errors = row["position_rms_m"]
    for name in ("batch", "ideal_online", "noise_as_assumed", "own_associations", "online"):
        assert errors[name] == pytest.approx(errors["odometry"]), name
    (line,) = summarise(json.loads(json.dumps([plain(row)])))
    assert line["map_over_batch"]["mean"] is None
    assert "| - |" in markdown([line])


def test_losses_multiply_to_the_whole(rows: list[dict[str, Any]]) -> None:
    """The product of all losses is the filter's error over that of the batch, of each trial and of the means."""
    assert LADDER[0][0] == "batch"
    assert LADDER[-1][0] == "filter"
    assert LOSSES == ("assumed noise", "association", "online", "particles", "keyframe reduction")
    for row in rows:
        assert set(row["position_rms_m"]) == set(ESTIMATES)
        errors = row["position_rms_m"]
        assert np.prod(list(losses_of(row).values())) == pytest.approx(errors["filter"] / errors["batch"])
    (line,) = summarise(rows)
    whole = line["filter_over_batch"]
    assert np.prod([found["mean"] for found in line["losses"].values()]) == pytest.approx(whole["mean"])
    assert whole["seeds"] == line["seeds"] == 2
    assert whole["low"] <= whole["mean"] <= whole["high"] <= whole["worst"] * (1.0 + 1e-12)


def test_trials_report_errors_and_associations(rows: list[dict[str, Any]]) -> None:
    """Odometry is worse than batch over both trials, shares are shares, and a trial repeats itself."""
    batch, odometry = (np.hypot(*(row["position_rms_m"][name] for row in rows)) for name in ("batch", "odometry"))
    assert 0.0 < batch < odometry
    for row in rows:
        assert 0.0 <= row["wrong_match_share"] <= 1.0
        assert 0.0 <= row["unused_share"] <= 1.0
        assert row["copies_per_landmark"] >= 1.0
        assert 0 <= row["missed_revisits"] <= row["revisits"]
        assert row["duration_s"] == pytest.approx(4.0)
        assert json.loads(json.dumps(row)) == row
    again = play(SMALL, SMALL.episodes()[0])
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


def test_failures_of_policies_are_reported(vslam: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An episode whose policy raises is left out with one line; the command goes on and ends with status 2."""
    (tmp_path / "lost.py").write_text(
        "class Lost:\n"
        "    def reset(self):\n        pass\n"
        "    def act(self, observation, belief, rng):\n        raise KeyError('way')\n"
    )  # fmt: skip
    monkeypatch.chdir(tmp_path)
    arguments = ["bench", "accuracy", "--worlds", "fig5", "--max-seconds", "2", "--particles", "5", "--seeds", "1"]
    said = vslam(*arguments, "--policies", "lost:Lost,frontier", "--out", "run")
    assert said.status == 2
    assert "1 of 2 trials failed" in said.out
    (line,) = json.loads((tmp_path / "run" / "metrics.json").read_text())["summary"]
    assert line["policy"] == "frontier"


def test_geometric_means_ignore_missing_values() -> None:
    """Ratios have geometric means with bootstrap intervals; missing ones are left out, a single one has no interval."""
    found = geometric_mean(np.array([0.5, 2.0, 4.0, np.nan, 0.0]))
    assert found["mean"] == pytest.approx(4.0 ** (1.0 / 3.0))
    assert found["seeds"] == 3
    assert found["low"] <= found["mean"] <= found["high"] <= found["worst"] == 4.0  # type: ignore[operator]
    assert geometric_mean(np.array([3.0]))["low"] is None
    assert geometric_mean(np.array([np.nan]))["mean"] is None


def test_tables_name_what_differs_from_the_default(rows: list[dict[str, Any]], tmp_path: Path) -> None:
    """Each condition has a row in each table; the figure is a PNG file."""
    wide = [row | {"max_range": 12.0, "measurements": 15, "policy": "random_walk"} for row in rows]
    lines = summarise([*rows, *wide])
    assert [condition_name(line) for line in lines] == [
        "fig5, K = 1, M = 12", "fig5, K = 1, random_walk, range 12 m, B = 15, M = 12",
    ]  # fmt: skip
    text = markdown(lines)
    assert text.count("| fig5, K = 1, M = 12 |") == 3
    assert "keyframe reduction" in text
    draw_losses(tmp_path / "losses.png", lines)
    assert (tmp_path / "losses.png").read_bytes().startswith(b"\x89PNG")


def test_cameras_change_in_the_world_and_in_the_filter() -> None:
    """Range and baseline are those of the true and of the assumed camera, and their noise stays as it is."""
    config = SMALL.replace(max_ranges=(4.0,), baselines=(0.24,), measurements=(3,))
    (trial,) = (trial for trial in config.episodes() if trial.seed == 70)
    env, usual = config.environment(trial), SMALL.environment(SMALL.episodes()[0])
    for camera, before in (
        (env.landmark_sensor.camera, usual.landmark_sensor.camera),
        (env.belief.filter.camera, usual.belief.filter.camera),
    ):
        assert (camera.max_range, camera.baseline) == (4.0, 0.24)
        assert camera.sigma_px == before.sigma_px
    assert env.landmark_sensor.max_measurements == 3


def test_options_without_effect_are_refused() -> None:
    """Options of one kind of trial are refused with the other, as are presets and policies that do not exist."""
    for values, match in (
        ({"split": "any"}, "world_split: expected no value without --worlds, got 'any'"),
        ({"duration": 9.0}, "max_seconds: expected no value without --worlds, got 9"),
        ({"baselines": (0.2,)}, "baselines: expected no value without --worlds"),
        ({"presets": ("easy",)}, "presets: expected one of 'good', 'coarse', 'paper', got 'easy'"),
        ({"worlds": ("office",), "lengths": (9.0,)}, "lengths: expected no value with --worlds"),
        (
            {"worlds": ("office",), "presets": ("good",)},
            "presets: expected one of 'easy', 'standard', 'hard', got 'good'",
        ),
        ({"worlds": ("nowhere",)}, "world: expected one of 'office'"),
        ({"worlds": ("office",), "policies": ("magic",)}, "policy"),
        ({"worlds": ("office",), "policies": ("oracles@bound",)}, "policy: expected a policy of robots or of the team"),
        ({"worlds": ("office",), "robots": (9,)}, "robots: expected an int from 1 to 8, got 9"),
    ):
        with pytest.raises(ValueError, match=match):
            AccuracyConfig(**values)


def test_the_command_resumes_and_writes_tables(vslam: Any, tmp_path: Path) -> None:
    """The command writes rows, metrics, tables and a figure; a stopped run continues; its config repeats it."""
    out, again = tmp_path / "first", tmp_path / "again"
    arguments = ["bench", "accuracy", "--worlds", "fig5", "--max-seconds", "2", "--particles", "5", "--seeds", "2"]
    arguments += ["--first-seed", "71"]
    said = vslam(*arguments, "--out", str(out), "--json", str(out / "copy.json"))
    assert said.status == 0, said.err
    metrics = json.loads((out / "copy.json").read_text())
    assert [row["seed"] for row in metrics["trials"]] == [71, 72]
    assert (out / "losses.png").is_file()
    assert "keyframe reduction" in (out / "tables.md").read_text()
    lines = (out / "episodes.jsonl").read_text().splitlines()
    (out / "episodes.jsonl").write_text(lines[0] + "\n" + lines[1][:40])
    assert vslam(*arguments, "--out", str(out)).status == 0
    first, second = (json.loads(line) for line in (out / "episodes.jsonl").read_text().splitlines())
    assert first == json.loads(lines[0])
    assert second | {"seconds": 0.0} == json.loads(lines[1]) | {"seconds": 0.0}
    assert vslam("bench", "accuracy", "--config", str(out), "--seeds", "1", "--out", str(again)).status == 0
    (row,) = (json.loads(line) for line in (again / "episodes.jsonl").read_text().splitlines())
    assert row | {"seconds": 0.0} == first | {"seconds": 0.0}
