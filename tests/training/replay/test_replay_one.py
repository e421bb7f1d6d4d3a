import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_logs import EAST, TREES, write_drive, write_park

from slam_backend.geometry import compose, transform_points
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.readers.conversions import integrate_commands
from slam_backend.readers.victoria import axle_velocities, load_victoria, to_filter_steps
from slam_backend.trajectory import Trajectory
from training.replay.config import ReplayConfig
from training.replay.core import Replay, replay_log
from training.replay.log import Log
from training.replay.metrics import PathScore, mean_drift, path_length, score_path, score_positions, summarise
from training.replay.readers import Park, find_loop, read_kitti, read_victoria


def played(log: Log, **options: Any) -> tuple[Replay, PathScore | None, dict[str, Any]]:
    """Replay a log of one robot; return the estimates, the score of the path, and the metrics of the robot."""
    result = replay_log(log, ReplayConfig(path="log", **options))
    score = score_path(result, log)
    metrics = summarise(result, log, [score])
    log.source.complete(metrics, result, score)
    return result, score, metrics["robots"][0]


def test_a_park_is_mapped_by_position_only(tmp_path: Path) -> None:
    """With a steering error of half a degree, unlabelled trees keep the path right, and each is in the map once."""
    write_park(tmp_path, skew=0.01)
    result, score, row = played(read_victoria(tmp_path), particles=10, seed=3)
    assert score is not None
    assert row["ate_aligned_m"] < 0.1 < 1.0 < row["dead_reckoning_ate_start_m"]
    assert row["ate_start_m"] < 0.2
    assert result.measurements["rejected"] == 0
    assert len(result.maps[0]) == len(TREES)
    world = transform_points(score.scores[0].world_from_path, result.maps[0].means[:, :2])
    nearest = np.hypot(*(world[:, None] - transform_points(EAST, TREES)[None]).transpose(2, 0, 1)).min(axis=1)
    assert nearest.max() < 0.3


def test_exact_dead_reckoning_needs_no_fit(tmp_path: Path) -> None:
    """Exact controls lead the antenna through all fixes; errors from the start and after the fit then agree."""
    write_park(tmp_path)
    log = load_victoria(tmp_path)
    _, score, _ = played(read_victoria(tmp_path), particles=2)
    assert score is not None
    assert score.scores[1].start < 0.01
    start = integrate_commands(axle_velocities(log.controls), log.scan_times[:1])[0]  # at the first scan
    np.testing.assert_allclose(score.scores[1].world_from_path, compose(EAST, start), atol=1e-3)


def test_descriptors_of_trees_are_positions(tmp_path: Path) -> None:
    """From the true pose, descriptors are the trees' positions."""
    write_park(tmp_path)
    log = load_victoria(tmp_path)
    frame = to_filter_steps(log).measurements[0]
    assert frame is not None
    pose = integrate_commands(axle_velocities(log.controls), log.scan_times[:1])[0]
    found = Park().describe(frame, lambda: pose)
    gaps = np.hypot(*(found.descriptors[:, None] - TREES[None]).transpose(2, 0, 1)).min(axis=1)
    assert gaps.max() < 1e-4
    np.testing.assert_array_equal(found.points, frame.points)


def test_a_stretch_with_fewer_than_two_fixes_has_no_scores(tmp_path: Path) -> None:
    """A stretch without GPS is replayed, but cannot be scored."""
    write_park(tmp_path)
    _, score, row = played(read_victoria(tmp_path, duration=0.4), particles=2)
    assert score is None
    assert np.isnan(row["ate_aligned_m"])


@pytest.mark.parametrize("command", ["victoria", "kitti"])
def test_missing_ground_truth_is_reported(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, vslam: Any
) -> None:
    """Without GPS or true poses there is a line in place of the table, and no dash."""
    (write_park if command == "victoria" else write_drive)(tmp_path)
    (tmp_path / ("aa3_gpsx.mat" if command == "victoria" else "poses/00.txt")).unlink()
    monkeypatch.chdir(tmp_path)
    said = vslam("replay", command, "--path", ".", "--duration", "3", "--particles", "2", "--out", "run")
    assert said.status == 0
    assert "Paths: no ground truth in this log." in said.out
    assert " - " not in said.out
    assert "RMS" not in said.out
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["robots"][0]["ate_aligned_m"] is None


def test_the_command_prints_drift_and_final_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, vslam: Any) -> None:
    """KITTI's drift over 100 m and the final error are printed for the estimate and for odometry."""
    write_drive(tmp_path, bias=0.05)
    monkeypatch.chdir(tmp_path)
    said = vslam("replay", "kitti", "--path", ".", "--particles", "2", "--out", "run")
    row = json.loads((tmp_path / "run" / "metrics.json").read_text())["robots"][0]
    assert row["end_error_percent"] == pytest.approx(100.0 * row["end_error_m"] / row["true_path_m"])
    assert row["dead_reckoning_end_error_m"] > 5.0 * row["end_error_m"] > 0.0
    assert (
        f"Final error after {row['true_path_m']:.1f} m, from the start, no fit: {row['end_error_m']:.2f} m, "
        f"{row['end_error_percent']:.2f} % of the path (odometry {row['dead_reckoning_end_error_m']:.2f} m, "
    ) in said.out
    assert ("Drift" in said.out) == (row["mean_drift"] is not None)


def test_tracks_correct_a_wrong_turn_rate(tmp_path: Path) -> None:
    """With a wrong turn rate, tracked features reduce the error to a tenth of dead reckoning's."""
    write_drive(tmp_path, bias=0.05)
    _, _, row = played(read_kitti(tmp_path), particles=10, seed=3)
    assert row["dead_reckoning_ate_start_m"] > 5.0
    assert row["ate_start_m"] < 0.1 * row["dead_reckoning_ate_start_m"]
    assert row["loop_error_m"] != row["loop_error_m"]  # there is no loop


def test_tracks_on_a_bus_are_refused(tmp_path: Path) -> None:
    """Eight tracks on a bus are rejected once it moves, and the path stays right to a decimetre."""
    write_drive(tmp_path, bus=True)
    result, score, _ = played(read_kitti(tmp_path), particles=10, seed=3)
    assert score is not None
    assert score.scores[0].start < 0.1
    assert result.measurements["rejected"] > 300


def test_a_drive_without_truth_has_no_scores(tmp_path: Path) -> None:
    """Without a true path, errors are NaN."""
    write_drive(tmp_path)
    (tmp_path / "poses" / "00.txt").unlink()
    _, score, row = played(read_kitti(tmp_path, duration=1.0), particles=2)
    assert score is None
    assert np.isnan(row["ate_aligned_m"])


def test_loops_are_found_at_revisited_places() -> None:
    """On a circle of 160 m driven one and a quarter times, the ends of the loop are one round apart."""
    angles = np.linspace(0.0, 2.5 * np.pi, 126)
    radius = 80.0 / np.pi
    circle = np.column_stack([radius * np.cos(angles), radius * np.sin(angles), angles])
    loop = find_loop(circle)
    assert loop is not None
    assert np.hypot(*(circle[loop[0]] - circle[loop[1]])[:2]) < 1.0
    assert loop[1] - loop[0] in (100, 101)
    assert find_loop(circle[:80]) is None


def test_drift_is_relative_and_frame_independent() -> None:
    """The drift of a path 3 % too long is 3 % in any frame; a turn drifts by the chord; a short path has none."""
    along = np.arange(0.0, 351.0)
    truth = np.column_stack([along, np.zeros_like(along), np.zeros_like(along)])
    assert mean_drift(compose(np.array([5.0, -2.0, 0.7]), truth * [1.03, 1.0, 1.0]), truth) == pytest.approx(0.03)
    turned = np.where(along < 120.0, 0.0, 0.1)  # the path turns after 120 m
    bent = np.column_stack([np.cumsum(np.cos(turned)), np.cumsum(np.sin(turned)), turned])
    starts, lengths = np.arange(0.0, 351.0, 10.0), np.array([100.0, 200.0, 300.0])
    aside = np.clip(starts + lengths[:, None] - 119.0, 0.0, lengths[:, None]) * (starts < 120.0)
    shares = (2.0 * np.sin(0.05) * aside / lengths[:, None])[starts + lengths[:, None] <= 350.0]
    assert mean_drift(bent, truth) == pytest.approx(shares.mean(), rel=1e-6)
    assert np.isnan(mean_drift(truth[:90], truth[:90]))


def test_positions_are_scored_before_and_after_the_fit() -> None:
    """A path that turns too far at once has no error after the fit; the one before it is from the true start."""
    truth = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 2.0, 0.0], [4.0, 3.0, 0.0]])
    path = truth + np.array([0.0, 0.0, 0.4])  # its headings are wrong, so that its start frame is, too
    moved = compose([3.0, 4.0, -0.7], path)
    score = score_positions(moved, truth)
    turned = transform_points([0.0, 0.0, -0.4], truth[:, :2])
    assert score.start == pytest.approx(np.sqrt(np.mean(np.hypot(*(turned - truth[:, :2]).T) ** 2)))
    assert score.aligned == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(compose(score.world_from_path, [3.0, 4.0, -0.7]), np.zeros(3), atol=1e-12)


@pytest.mark.parametrize("command", ["victoria", "kitti"])
def test_a_run_is_written_and_repeats_itself(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, vslam: Any
) -> None:
    """The command writes a complete folder, and repeated from its config exactly the same metrics."""
    log, first, second = (tmp_path / name for name in ("log", "first", "second"))
    log.mkdir()
    (write_park if command == "victoria" else write_drive)(log)
    monkeypatch.chdir(tmp_path)
    options = ("--path", "log", "--duration", "6", "--particles", "3", "--seed", "5")
    for arguments in (
        (*options, "--out", str(first), "--json", str(tmp_path / "copy.json")),
        ("--config", str(first), "--out", str(second)),
    ):
        said = vslam("replay", command, *arguments)
        assert said.status == 0
        monkeypatch.chdir(first)  # the config works from any folder
    assert "times real time" in said.out
    assert "ATE: root mean square distance" in said.out
    truth = {"truth.tum"} if command == "kitti" else set()
    assert {file.name for file in first.iterdir()} == truth | {
        "config.toml", "metrics.json", "replay.png", "timing.json", "estimate.tum", "dead_reckoning.tum",
        "map_1.npz", "map_1.csv", "map_1.ply", "recording.npz", "report.html",
    }  # fmt: skip
    assert (first / "replay.png").read_bytes()[:4] == b"\x89PNG"
    assert "Maps as data: map_1 (" in said.out
    assert len(LandmarkMap.load(first / "map_1.npz")) == json.loads((first / "metrics.json").read_text())["landmarks"]
    assert json.loads((first / "timing.json").read_text())["times_real_time"] > 0.0
    metrics = json.loads((first / "metrics.json").read_text())
    assert metrics == json.loads((tmp_path / "copy.json").read_text())
    assert metrics == json.loads((second / "metrics.json").read_text())
    assert set(metrics) >= {"robots", "merges", "groups", "coverage", "config", "seed", "versions"}
    estimate = Trajectory.load_tum(first / "estimate.tum")
    assert np.array_equal(estimate.poses, Trajectory.load_tum(second / "estimate.tum").poses)


@pytest.mark.slow
def test_victoria_park_has_an_error_below_five_metres(data_dir: Path) -> None:
    """On the whole real log the error of dead reckoning is 149 m, that of the fitted estimate below 5 m."""
    log = load_victoria(data_dir / "victoria_park")
    assert sum(len(scan) for scan in log.scans) == 52_974
    _, score, _ = played(read_victoria(data_dir / "victoria_park"), particles=30)
    assert score is not None
    assert score.scores[1].start == pytest.approx(149.0, abs=1.0)
    assert score.scores[0].aligned < 5.0
    assert np.median(score.scores[0].errors) < 2.0


@pytest.mark.slow
def test_a_real_drive_has_an_error_below_one_per_cent(data_dir: Path) -> None:
    """Over 694 m of KITTI, smoothed tracks give an error below 1 % of the path, and its length to 2 %."""
    result, score, row = played(read_kitti(data_dir / "kitti_landmarks"), rejuvenate_every=50)
    assert score is not None
    assert score.scores[0].aligned < min(6.9, score.scores[1].aligned / 2.0)
    assert path_length(score.at_truth[0]) == pytest.approx(score.length, rel=0.02)
    made = result.measurements
    assert made["rejected"] < 0.1 * (made["matched"] + made["rejected"])
    assert np.isfinite(row["loop_error_m"])
