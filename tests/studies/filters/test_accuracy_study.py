"""Study of accuracy: metrics, methods, results and program."""

import json
import subprocess
import sys
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slam_backend.geometry import compose, transform_points
from studies.filters.accuracy import STUDY, Config, Trial, play, run_of, trials
from training.experiments.run_folder import plain
from training.experiments.statistics import interval
from training.experiments.trial_store import run_in_processes
from training.stereo_runs.runs import FALSE_POINT, RunSpec, StereoRun, simulate_run
from training.stereo_runs.scores import Answer, score

SMALL = Config(robots=(2,), lengths=(4.0,), particles=(5, 9), seeds=2, seed=31)


@pytest.fixture(scope="module")
def run() -> StereoRun:
    """Two robots for 4 m."""
    return simulate_run(RunSpec(robots=2, length=4.0), seed=3)


@pytest.fixture(scope="module")
def rows() -> list[dict[str, Any]]:
    """All trials of a small study, as stored."""
    return [plain(asdict(trial) | play(SMALL, trial)) for trial in trials(SMALL)]


def test_the_truth_scores_zero(run: StereoRun) -> None:
    """The true paths and landmarks have no error, full recall and precision, and no NEES."""
    measured = run.measured_landmarks()
    everywhere = np.tile(0.01 * np.eye(3), (*run.true_paths.shape[:2], 1, 1))
    sure = np.ones(len(measured), dtype=bool)
    row = score(run, Answer(run.true_paths.copy(), everywhere, run.landmarks[measured], measured, sure))
    errors = "pose_rms_m", "pose_aligned_rms_m", "heading_rms_deg", "map_rmse_m", "map_aligned_rmse_m", "nees_mean"
    for name in errors:
        assert row[name] == pytest.approx(0.0, abs=1e-9), name
    assert row["map_recall"] == row["map_precision"] == row["confirmed_precision"] == 1.0


def test_a_rigid_motion_changes_only_unaligned_metrics(run: StereoRun) -> None:
    """A rigid motion of path and map changes the raw metrics and NEES, but not the aligned ones."""
    motion = np.array([0.3, -0.4, 0.02])
    paths = compose(motion, run.true_paths)
    measured = run.measured_landmarks()
    means = transform_points(motion, run.landmarks[measured])
    covariances = np.tile(np.diag([0.04, 0.09, 1e-4]), (*run.true_paths.shape[:2], 1, 1))
    row = score(run, Answer(paths, covariances, means, measured, np.ones(len(measured), dtype=bool)))
    offsets = (paths - run.true_paths)[..., :2].reshape(-1, 2)
    assert row["pose_rms_m"] == pytest.approx(np.sqrt((offsets**2).sum(axis=1).mean()))
    assert row["heading_rms_deg"] == pytest.approx(np.degrees(0.02))
    assert row["map_rmse_m"] > 0.1
    assert row["pose_aligned_rms_m"] == pytest.approx(0.0, abs=1e-9)
    assert row["map_aligned_rmse_m"] == pytest.approx(0.0, abs=1e-9)
    squares = (paths - run.true_paths)[:, 1:, :2] ** 2 / [0.04, 0.09]
    assert row["nees_mean"] == pytest.approx(squares.sum(axis=2).mean() + 4.0, rel=1e-3)
    assert row["anees"] == pytest.approx(row["nees_mean"] / 3.0)


def test_maps_are_scored_by_true_landmarks(run: StereoRun) -> None:
    """Duplicates and false landmarks reduce precision, missing ones recall; landmarks seen once are not confirmed."""
    measured = run.measured_landmarks()
    true = run.landmarks[measured]
    half = len(measured) // 2
    means = np.vstack([true[:half], true[:2] + 0.5, [[5.0, 5.0, 1.0]]])
    claims = np.concatenate([measured[:half], measured[:2], [FALSE_POINT]])
    confirmed = np.arange(len(means)) < half
    row = score(run, Answer(run.true_paths.copy(), None, means, claims, confirmed))
    assert row["map_recall"] == pytest.approx(half / len(measured))
    assert row["map_precision"] == pytest.approx(half / (half + 3))
    assert row["confirmed_precision"] == 1.0
    assert row["map_rmse_m"] == pytest.approx(0.0, abs=1e-12)
    assert np.isnan(row["nees_mean"])


def test_methods_are_ordered_by_accuracy(rows: list[dict[str, Any]]) -> None:
    """Batch ML has the smallest errors, dead reckoning the largest; each method has all its metrics."""
    mean = {method: np.mean([row["pose_rms_m"] for row in rows if row["method"] == method]) for method in SMALL.methods}
    assert mean["batch_ml"] <= mean["ideal_online"] < mean["fastslam2"] < mean["dead_reckoning"]
    for row in rows:
        unknown = {name for name, value in row.items() if value is None}
        assert row["particles"] is None or unknown == {"rejuvenation_ms", "refused_share"}, row
        if row["method"] in ("batch_ml", "ideal_online"):
            assert row["map_recall"] == row["map_precision"] == 1.0
            assert 0.0 < row["anees"] < 10.0
        if row["method"] == "fastslam2":
            assert row["wrong_match_share"] == 0.0  # associations are known
            assert 0.2 < row["ess_share"] <= 1.0


def test_trials_repeat(rows: list[dict[str, Any]]) -> None:
    """The same trial gives the same metrics, except times, whatever ran before it."""
    run_of.cache_clear()
    for row in (rows[-1], rows[1]):
        again = plain(play(SMALL, Trial(**{name: row[name] for name in Trial.__dataclass_fields__})))
        for name, value in again.items():
            assert name in ("seconds", "step_ms") or row[name] == value, name


def test_unknown_association_is_scored_with_its_errors() -> None:
    """False points become landmarks, which reduce precision, and which an existence model deletes in part."""
    trial = Trial(
        preset="coarse", association="unknown", robots=1, length=12.0, method="fastslam2", particles=20, seed=30
    )
    row = play(Config(), trial)
    assert row["map_precision"] < 1.0
    assert 0.0 <= row["wrong_match_share"] < 0.2
    assert row["held_back_share"] > 0.0
    assert play(Config(), replace(trial, method="fastslam2+existence"))["map_precision"] > row["map_precision"]


def test_rejuvenation_is_a_separate_method() -> None:
    """Rejuvenation is attempted every 25 steps, with its time and refusals reported; other metrics are as usual."""
    trial = Trial(
        preset="good", association="known", robots=1, length=12.0, method="fastslam2+rejuvenation", particles=20,
        seed=30,
    )  # fmt: skip
    row, plain_row = (play(Config(), each) for each in (trial, replace(trial, method="fastslam2")))
    assert row["refused_share"] == 0.0
    assert row["rejuvenation_ms"] > row["step_ms"]
    assert np.isnan(plain_row["rejuvenation_ms"])
    assert row["map_recall"] == plain_row["map_recall"] == 1.0
    assert row["pose_rms_m"] != plain_row["pose_rms_m"]


def test_more_assumed_noise_raises_covariances() -> None:
    """More assumed noise of measurements or landmarks raises covariances; the run and other methods are the same."""
    trial = Trial(preset="good", association="known", robots=1, length=12.0, method="fastslam2", particles=20, seed=30)
    usual, more, moving = Config(), Config(noise_factor=9.0), Config(landmark_noise=0.03)
    as_it_is = play(usual, trial)["nees_median"]
    assert play(more, trial)["nees_median"] < 0.5 * as_it_is
    assert play(moving, trial)["nees_median"] < 0.9 * as_it_is
    peer = replace(trial, method="batch_ml", particles=None)
    assert play(usual, peer)["pose_rms_m"] == play(more, peer)["pose_rms_m"]


def test_tables_have_a_line_for_each_method_and_number(rows: list[dict[str, Any]]) -> None:
    """The mean over the seeds is in its interval; methods without a map or covariances have no line in these tables."""
    paths, maps, consistency, matches = (table.lines(rows) for table in STUDY.tables)
    peers, filters = [("batch_ml", None), ("ideal_online", None)], [("fastslam1", 5), ("fastslam1", 9)]
    filters += [("fastslam2", 5), ("fastslam2", 9)]
    for lines, expected in (
        (paths, [("dead_reckoning", None), *peers, *filters]), (maps, peers + filters),
        (consistency, peers + filters), (matches, filters),
    ):  # fmt: skip
        assert [(line["method"], line["particles"]) for line in lines] == expected
    values = [row["map_rmse_m"] for row in rows if (row["method"], row["particles"]) == ("fastslam2", 9)]
    found = maps[-1]["map [m]"]
    assert len(values) == 2
    assert found.value == pytest.approx(np.mean(values))
    assert found.low <= found.value <= found.high


def test_intervals_cover_what_they_should() -> None:
    """Of 300 intervals of the mean of 16 normal values about 95 % contain the truth: 86 to 98 % with false alarm 1e-3.

    The percentile bootstrap of 16 values is known to cover about 92 %.
    """
    rng = np.random.default_rng(8)
    held = 0
    for values in rng.normal(size=(300, 16)):
        low, high = interval(values, np.mean)
        assert low is not None
        assert high is not None
        held += low < 0.0 < high
    assert 0.86 * 300 < held < 0.98 * 300


@pytest.mark.slow
def test_results_do_not_depend_on_processes(tmp_path: Path, rows: list[dict[str, Any]]) -> None:
    """Two processes give the results of one: exactly for the filter, to 1e-7 for batch maximum likelihood.

    The linear algebra of the latter uses a BLAS, whose sums depend on its number of threads and on the processor, and
    the processes of a benchmark have one thread each; the descent ends within its tolerance. The only matrix product in
    a run of the filter is with the camera's axes, a signed permutation, which is exact in any order.
    """
    few = [trial for trial in trials(SMALL) if trial.method in ("batch_ml", "fastslam2")]
    expected = {(row["seed"], row["method"], row["particles"]): row["pose_rms_m"] for row in rows}
    done = list(run_in_processes(partial(_named, SMALL), few, 2))
    assert len(done) == len(few)
    for row in done:
        alone = expected[row["seed"], row["method"], row["particles"]]
        assert row["pose_rms_m"] == (pytest.approx(alone, rel=1e-7) if row["method"] == "batch_ml" else alone)


def _named(config: Config, trial: Trial) -> dict[str, Any]:
    """Return the row of a trial with its fields."""
    return asdict(trial) | play(config, trial)


def test_the_program_from_end_to_end(tmp_path: Path) -> None:
    """The program prints its tables, writes JSON, Markdown and chart, and resumes when called again."""
    out = tmp_path / "study"
    program = [sys.executable, "-m", "studies.filters.accuracy", "--seeds", "1", "--first-seed", "40"]
    program += ["--lengths", "3,5", "--methods", "dead_reckoning,fastslam2", "--particles", "7"]
    program += ["--out", str(out), "--json", "-"]
    for _ in range(2):
        said = subprocess.run(program, capture_output=True, text=True, check=True)
    assert "fastslam2" in said.stderr
    content = json.loads(said.stdout)
    assert [line["method"] for line in content["tables"]["paths"]] == 2 * ["dead_reckoning", "fastslam2"]
    assert len(content["trials"]) == len((out / "trials.jsonl").read_text().splitlines()) == 4
    assert "| good, known, K = 1, 3 m | fastslam2 | 7 |" in (out / "tables.md").read_text()
    assert (out / "accuracy.png").stat().st_size > 10_000
