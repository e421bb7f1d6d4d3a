"""Accuracy benchmark: metrics, summary, and stored trials."""

import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from slam_backend.geometry import compose, transform_points
from training.bench.accuracy import trials as accuracy_trials
from training.bench.accuracy.report import FIGURES, describe, draw_accuracy, markdown, print_tables, summarise
from training.bench.accuracy.runs import FALSE_POINT, RunSpec, StereoRun, simulate_run
from training.bench.accuracy.trials import TRIALS_FILE, Answer, Trial, play, score
from training.bench.config import AccuracyConfig
from training.experiments.run_folder import RunFolder, plain
from training.experiments.statistics import interval
from training.experiments.trial_store import finished_trials, open_folder, run_trials

SMALL = AccuracyConfig(robots=(2,), lengths=(4.0,), particles=(5, 9), seeds=2, seed=31)


@pytest.fixture(scope="module")
def run() -> StereoRun:
    """Two robots for 4 m."""
    return simulate_run(RunSpec(robots=2, length=4.0), seed=3)


@pytest.fixture(scope="module")
def rows() -> list[dict[str, Any]]:
    """All trials of a small benchmark."""
    return [plain(play(trial)) for trial in SMALL.trials()]


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
        of_all = [figure for figure in FIGURES if figure not in ("rejuvenation_ms", "refused_share")]
        assert row["particles"] == 0 or all(row[figure] is not None for figure in of_all), row
        if row["method"] in ("batch_ml", "ideal_online"):
            assert row["map_recall"] == row["map_precision"] == 1.0
            assert 0.0 < row["anees"] < 10.0
        if row["method"] == "fastslam2":
            assert row["wrong_match_share"] == 0.0  # associations are known
            assert 0.2 < row["ess_share"] <= 1.0


def test_trials_repeat(rows: list[dict[str, Any]]) -> None:
    """The same trial gives the same metrics, except times, whatever ran before it."""
    accuracy_trials._run_of.cache_clear()
    for row in (rows[-1], rows[1]):
        again = plain(play(Trial(**{name: row[name] for name in Trial.__dataclass_fields__})))
        for name, value in again.items():
            assert name in ("seconds", "step_ms") or row[name] == value, name


def test_unknown_association_is_scored_with_its_errors() -> None:
    """False points become landmarks, which reduce precision, and which an existence model deletes in part."""
    trial = Trial(
        preset="coarse", association="unknown", robots=1, length=12.0, method="fastslam2", particles=20, seed=30
    )
    row = play(trial)
    assert row["map_precision"] < 1.0
    assert 0.0 <= row["wrong_match_share"] < 0.2
    assert row["held_back_share"] > 0.0
    assert play(replace(trial, method="fastslam2+existence"))["map_precision"] > row["map_precision"]


def test_rejuvenation_is_a_separate_method() -> None:
    """Rejuvenation is attempted every 25 steps, with its time and refusals reported; other metrics are as usual."""
    trial = Trial(
        preset="good", association="known", robots=1, length=12.0, method="fastslam2+rejuvenation", particles=20,
        seed=30,
    )  # fmt: skip
    row, plain_row = play(trial), play(replace(trial, method="fastslam2"))
    assert row["refused_share"] == 0.0
    assert row["rejuvenation_ms"] > row["step_ms"]
    assert np.isnan(plain_row["rejuvenation_ms"])
    assert row["map_recall"] == plain_row["map_recall"] == 1.0
    assert row["pose_rms_m"] != plain_row["pose_rms_m"]


def test_more_assumed_noise_raises_covariances() -> None:
    """More assumed noise of measurements or landmarks raises covariances; the run and other methods are the same."""
    trial = Trial(preset="good", association="known", robots=1, length=12.0, method="fastslam2", particles=20, seed=30)
    as_it_is = play(trial)["nees_median"]
    assert play(replace(trial, noise_factor=9.0))["nees_median"] < 0.5 * as_it_is
    assert play(replace(trial, landmark_noise=0.03))["nees_median"] < 0.9 * as_it_is
    peer = replace(trial, method="batch_ml", particles=0)
    assert play(peer)["pose_rms_m"] == play(replace(peer, noise_factor=9.0))["pose_rms_m"]


def test_summary_and_intervals(rows: list[dict[str, Any]]) -> None:
    """There is one line per condition, method and M; the mean is the mean of the rows and is in its interval."""
    lines = summarise(rows)
    assert [(line["method"], line["particles"]) for line in lines] == [
        ("dead_reckoning", 0), ("batch_ml", 0), ("ideal_online", 0),
        ("fastslam1", 5), ("fastslam1", 9), ("fastslam2", 5), ("fastslam2", 9),
    ]  # fmt: skip
    line = lines[-1]
    values = [row["map_rmse_m"] for row in rows if row["method"] == "fastslam2" and row["particles"] == 9]
    assert line["seeds"] == len(values) == 2
    assert line["map_rmse_m"]["mean"] == pytest.approx(np.mean(values))
    assert line["map_rmse_m"]["worst"] == max(values)
    assert line["map_rmse_m"]["mean_low"] <= np.mean(values) <= line["map_rmse_m"]["mean_high"]
    assert lines[0]["anees"] is None
    assert describe(np.array([2.5])) == {
        "worst": 2.5, "mean": 2.5, "mean_low": None, "mean_high": None, "median": 2.5, "median_low": None,
        "median_high": None,
    }  # fmt: skip


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


def _open(out: Path, config: AccuracyConfig) -> RunFolder:
    return open_folder(out, "bench accuracy", config.to_mapping(), config.seed)


def test_finished_trials_are_kept(tmp_path: Path, rows: list[dict[str, Any]]) -> None:
    """A benchmark stopped after three trials runs only the rest when resumed; a truncated line is run again."""
    folder = _open(tmp_path / "bench", SMALL)
    done: list[dict[str, Any]] = []
    run_trials(folder, TRIALS_FILE, play, SMALL.trials(), 1, lambda: len(done) >= 3, done.append)
    assert len(done) == 3
    file = folder.path / TRIALS_FILE
    file.write_text(file.read_text()[:-20])
    again = _open(tmp_path / "bench", SMALL)
    kept = finished_trials(again.path / TRIALS_FILE, Trial)
    assert list(kept) == SMALL.trials()[:2]
    rest: list[dict[str, Any]] = []
    left = [trial for trial in SMALL.trials() if trial not in kept]
    run_trials(again, TRIALS_FILE, play, left, 1, lambda: False, rest.append)
    assert len(rest) == len(rows) - 2
    assert list(finished_trials(again.path / TRIALS_FILE, Trial)) == SMALL.trials()
    for line, row in zip(file.read_text().splitlines(), rows, strict=True):
        assert json.loads(line)["pose_rms_m"] == row["pose_rms_m"]


def test_a_folder_accepts_one_configuration(tmp_path: Path) -> None:
    """Other options are refused in the folder of a benchmark."""
    _open(tmp_path / "bench", SMALL)
    with pytest.raises(
        ValueError, match="out: expected a folder of the same bench run, got a folder of a run with other"
    ):
        _open(tmp_path / "bench", SMALL.replace(seeds=3))


@pytest.mark.slow
def test_results_do_not_depend_on_processes(tmp_path: Path, rows: list[dict[str, Any]]) -> None:
    """Two processes give the results of one: exactly for the filter, to 1e-7 for batch maximum likelihood.

    The linear algebra of the latter uses a BLAS, whose sums depend on its number of threads and on the processor, and
    the processes of a benchmark have one thread each; the descent ends within its tolerance. The only matrix product in
    a run of the filter is with the camera's axes, a signed permutation, which is exact in any order.
    """
    few = [trial for trial in SMALL.trials() if trial.method in ("batch_ml", "fastslam2")]
    done: list[dict[str, Any]] = []
    run_trials(_open(tmp_path / "bench", SMALL), TRIALS_FILE, play, few, 2, lambda: False, done.append)
    expected = {(row["seed"], row["method"], row["particles"]): row["pose_rms_m"] for row in rows}
    assert len(done) == len(few)
    for row in done:
        alone = expected[row["seed"], row["method"], row["particles"]]
        assert row["pose_rms_m"] == (pytest.approx(alone, rel=1e-7) if row["method"] == "batch_ml" else alone)


def test_tables_and_figure(tmp_path: Path, rows: list[dict[str, Any]]) -> None:
    """Tables list each method with its error, on 80 columns and as Markdown; the figure is a PNG file."""
    lines = plain(summarise(rows))
    console = Console(width=80, record=True, file=io.StringIO())
    print_tables(console, lines)
    text = console.export_text()
    assert "good stereo, known association, K = 2, 4 m, 2 seeds: paths" in text
    for line in lines:
        assert f"{line['pose_rms_m']['mean']:.3f}" in text
    assert "| fastslam2, 9 |" in markdown(lines)
    draw_accuracy(tmp_path / "accuracy.png", lines)
    assert (tmp_path / "accuracy.png").read_bytes().startswith(b"\x89PNG")


def test_the_command_from_end_to_end(vslam: Any, tmp_path: Path) -> None:
    """The command prints its tables, writes JSON, Markdown and figure, and resumes when called again."""
    out = tmp_path / "bench"
    arguments = ["bench", "accuracy", "--seeds", "1", "--first-seed", "40", "--lengths", "3,5", "--methods"]
    arguments += ["dead_reckoning,fastslam2", "--particles", "7", "--out", str(out), "--json", str(out / "copy.json")]
    for _ in range(2):
        said = vslam(*arguments)
        assert said.status == 0
        assert "fastslam2, 7" in said.out
    content = json.loads((out / "copy.json").read_text())
    assert [line["length"] for line in content["summary"]] == [3.0, 3.0, 5.0, 5.0]
    assert len(content["trials"]) == len((out / TRIALS_FILE).read_text().splitlines()) == 4
    assert (out / "tables.md").read_text().startswith("### Good stereo, known association, K = 1, 3 m")
    assert (out / "accuracy.png").is_file()
