import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_logs import LANDMARKS, write_log

from slam_backend.geometry import compose, inverse, transform_points
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.metrics import align_se2
from slam_backend.models.odometry import OdometryModel
from slam_backend.readers.mrclam import Drive, SightingNoise
from slam_backend.trajectory import Trajectory
from training.replay.config import MrclamConfig
from training.replay.core import Replay, replay_log
from training.replay.log import Log
from training.replay.metrics import align_to_truth, score_path, summarise
from training.replay.readers import read_mrclam

EXACT = {
    "drive": Drive(),
    "motion": OdometryModel(sigma_along=1e-3, sigma_across=1e-3, sigma_heading=1e-3, sigma_turn=1e-3),
    "sensor": SightingNoise(range_floor=0.02, range_share=0.0, bearing=0.01, height=0.01),
}  # fmt: skip


def played(log: Log, particles: int | None = 7, seed: int = 0) -> Replay:
    """Replay a log."""
    return replay_log(log, MrclamConfig(path="log", particles=particles, seed=seed))


def metrics_of(result: Replay, log: Log) -> dict[str, Any]:
    """Return the metrics of a replay."""
    return summarise(result, log, [score_path(result, log, robot) for robot in range(len(log.robots))])


def test_exact_readings_give_exact_results(tmp_path: Path) -> None:
    """Exact readings give one group, and paths, maps and the merge accurate to centimetres."""
    write_log(tmp_path, noise=0.0)
    log = read_mrclam(tmp_path, **EXACT)
    metrics = metrics_of(played(log), log)
    assert metrics["groups"] == [[2, 5]]
    assert len(metrics["merges"]) == 1
    assert metrics["merges"][0]["error_m"] < 0.05
    assert metrics["merges"][0]["false"] is False
    assert {"step", "landmarks"} <= set(metrics["merges"][0])
    assert metrics["merges"][0]["error_deg"] < 1.0
    for row in metrics["robots"]:
        assert row["ate_aligned_m"] < 0.05
        assert row["dead_reckoning_ate_start_m"] < 1e-3
        assert row["map_rmse_m"] < 0.05
        assert row["map_precision"] == 1.0
        assert row["map_rmse_aligned_m"] == row["map_rmse_m"]
        assert row["map_rmse_m"] - 1e-3 < row["map_rmse_start_m"] < 0.1


def test_the_filter_reduces_the_error_of_dead_reckoning(tmp_path: Path) -> None:
    """With biased odometry each path error is at most a third of dead reckoning's, in both kinds of score."""
    write_log(tmp_path, noise=1.0)
    log = read_mrclam(tmp_path)
    result = played(log, particles=25, seed=4)
    for robot in range(len(log.robots)):
        path = score_path(result, log, robot)
        assert path is not None
        assert path.scores[0].aligned < 0.5 * path.scores[1].aligned
    assert len(result.groups) == 1


def test_a_run_is_written_and_repeats_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, vslam: Any) -> None:
    """The command writes a complete folder, and repeated from its config exactly the same metrics."""
    log, first, second = (tmp_path / name for name in ("log", "first", "second"))
    log.mkdir()
    write_log(log, noise=1.0)
    monkeypatch.setenv("VSLAM_DATA", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    options = ("--path", "log", "--duration", "30", "--particles", "7", "--seed", "5")
    for arguments in (
        (*options, "--out", str(first), "--json", str(tmp_path / "copy.json")),
        ("--config", str(first), "--out", str(second)),
    ):
        said = vslam("replay", "mrclam", *arguments)
        assert said.status == 0
        monkeypatch.chdir(first)  # the config works from any folder
    assert "odometry" in said.out
    names = {f"robot{n}_{kind}.tum" for n in (2, 5) for kind in ("estimate", "dead_reckoning", "truth")}
    assert {file.name for file in first.iterdir()} == {
        "config.toml", "metrics.json", "replay.png", "joint_map_2-5.png", "timing.json", "map_2-5.npz", "map_2-5.csv",
        "map_2-5.ply", "recording.npz", "report.html", *names,
    }  # fmt: skip
    assert "Maps as data: map_2-5" in said.out
    for file in first.glob("*.png"):
        assert file.read_bytes()[:4] == b"\x89PNG"
    metrics = json.loads((first / "metrics.json").read_text())
    assert metrics["groups"] == [[2, 5]]  # its map has a figure of its own
    assert metrics == json.loads((tmp_path / "copy.json").read_text())
    assert metrics == json.loads((second / "metrics.json").read_text())
    assert metrics["seed"] == 5
    assert metrics["coverage"] is None
    assert metrics["config"]["particles"] == 7
    assert set(metrics) >= {"robots", "merges", "groups", "coverage", "config", "seed", "versions"}
    estimate = Trajectory.load_tum(first / "robot5_estimate.tum")
    assert np.array_equal(estimate.poses, Trajectory.load_tum(second / "robot5_estimate.tum").poses)


def test_maps_are_written_as_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, vslam: Any) -> None:
    """Each group's map is an archive for `LandmarkMap.load`, in its first robot's start frame, and a CSV."""
    write_log(tmp_path, noise=0.0)
    monkeypatch.chdir(tmp_path)
    options = ("--duration", "20", "--particles", "7", "--alone", "--out", "run")
    assert vslam("replay", "mrclam", "--path", ".", *options).status == 0
    log = read_mrclam(tmp_path, duration=20.0, alone=True)
    for robot, own in zip((2, 5), played(log).maps, strict=True):
        found = LandmarkMap.load(tmp_path / "run" / f"map_{robot}.npz")
        for name in ("means", "covariances", "descriptors", "counts", "ids"):
            assert np.array_equal(getattr(found, name), getattr(own, name))
        table = np.genfromtxt(tmp_path / "run" / f"map_{robot}.csv", delimiter=",", names=True)
        assert table["id"].astype(int).tolist() == own.ids.tolist()
        assert table["count"].astype(int).tolist() == own.counts.tolist()
        assert np.array_equal(np.column_stack([table[f"{axis}_m"] for axis in "xyz"]), own.means)
        for pair, (i, j) in {"xx": (0, 0), "xy": (0, 1), "yz": (1, 2), "zz": (2, 2)}.items():
            assert np.array_equal(table[f"cov_{pair}_m2"], own.covariances[:, i, j])


def test_missing_ground_truth_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, vslam: Any) -> None:
    """Without ground truth, a line replaces the tables; sorting of the log is reported in one line."""
    write_log(tmp_path, noise=1.0)
    for file in tmp_path.glob("*Groundtruth.dat"):
        file.unlink()
    rows = (tmp_path / "Robot5_Odometry.dat").read_text().splitlines()
    (tmp_path / "Robot5_Odometry.dat").write_text("\n".join([rows[1], rows[0], *rows[2:]]))
    monkeypatch.chdir(tmp_path)
    options = ("--particles", "7", "--seed", "5", "--out", "run")
    said = vslam("replay", "mrclam", "--path", ".", "--duration", "30", *options)
    assert said.status == 0
    assert "Paths: no ground truth in this log." in said.out
    assert "Maps, each in its robot's start frame: no ground truth in this log." in said.out
    assert "ATE" not in said.out
    assert "Sorted by time: Robot5_Odometry.dat (1 row, up to 0.100 s back)." in said.out.splitlines()
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["notes"] == ["Sorted by time: Robot5_Odometry.dat (1 row, up to 0.100 s back)."]
    row = metrics["robots"][0]
    assert {row[key] for key in ("ate_aligned_m", "map_rmse_m", "map_recall", "map_precision", "map_error")} == {None}
    assert metrics["groups"] == [[2, 5]]


def test_the_map_error_states_its_cutoff(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, vslam: Any) -> None:
    """The column of E gives the distance at which errors are cut."""
    write_log(tmp_path, noise=0.0)
    monkeypatch.chdir(tmp_path)
    said = vslam("replay", "mrclam", "--path", ".", "--duration", "5", "--particles", "2", "--out", "run")
    assert "map error E" in said.out
    assert "0.71 m = nothing found" in said.out
    assert "errors are cut at 1 m." in said.out


def test_a_log_without_truth_has_no_path_scores(tmp_path: Path) -> None:
    """Without true paths their errors are NaN, while the map is scored."""
    write_log(tmp_path, noise=1.0)
    (tmp_path / "Robot5_Groundtruth.dat").unlink()
    log = read_mrclam(tmp_path, robots=(5,), duration=10.0)
    row = metrics_of(played(log, particles=5), log)["robots"][0]
    assert np.isnan([row["ate_aligned_m"], row["dead_reckoning_ate_start_m"], row["map_error"]]).all()
    assert row["map_rmse_m"] < 0.6


def test_map_is_aligned_by_its_most_seen_landmarks(tmp_path: Path) -> None:
    """A duplicate seen once does not rotate the map, but lowers the precision."""
    write_log(tmp_path, noise=0.0)
    truth = read_mrclam(tmp_path).landmarks
    world_from_map = np.array([1.0, -2.0, 0.7])
    means = transform_points(inverse(world_from_map), LANDMARKS[[0, 3, 5, 3]])
    means[3] += 2.0
    covariances, counts = np.tile(np.eye(3), (4, 1, 1)), np.array([9, 9, 9, 1])
    landmarks = LandmarkMap(np.column_stack([means, np.zeros(4)]), covariances, np.ones((4, 1)), counts)
    found = align_to_truth(landmarks, np.array([0, 3, 5, 3]), truth)
    assert found is not None
    np.testing.assert_allclose(found.world_from_map, world_from_map, atol=1e-9)
    assert found.score.precision == 0.75
    assert found.score.recall == 3 / 14
    assert align_to_truth(LandmarkMap.empty(14), np.empty(0, dtype=np.int64), truth) is None


def test_robots_that_stay_alone_never_merge(tmp_path: Path) -> None:
    """Each single robot ends with its own map, and its estimates do not depend on the other robots."""
    write_log(tmp_path, noise=1.0)
    both, first = (read_mrclam(tmp_path, robots=robots, duration=20.0, alone=True) for robots in ((2, 5), (2,)))
    result = played(both, seed=4)
    assert result.groups == ((0,), (1,))
    assert not result.attempts
    assert not summarise(result, both, [None, None])["refusals"]
    np.testing.assert_array_equal(result.paths[0][:80], played(first, seed=4).paths[0][:80])


def test_hidden_identities_are_associated_by_position(tmp_path: Path) -> None:
    """Without barcodes exact readings of distant landmarks still give each of them once."""
    write_log(tmp_path, noise=0.0)
    apart: list[int] = []
    for row, place in enumerate(LANDMARKS):
        if all(np.hypot(*(place - LANDMARKS[other])) > 1.1 for other in apart):
            apart.append(row)
    file = tmp_path / "Robot2_Measurement.dat"
    kept = [line for line in file.read_text().splitlines() if int(line.split()[1]) - 106 in apart]
    file.write_text("\n".join(kept))
    log = read_mrclam(tmp_path, robots=(2,), identities="hidden", **EXACT)
    result = played(log)
    assert (result.maps[0].descriptors == 1.0).all()
    row = metrics_of(result, log)["robots"][0]
    assert row["ate_aligned_m"] < 0.05
    assert row["map_rmse_m"] < 0.05
    assert row["map_precision"] == 1.0


@pytest.mark.slow
def test_five_real_robots_become_one_team(data_dir: Path) -> None:
    """On the real log all five end in one group by right merges, with path errors a tenth of dead reckoning's.

    The path of robot 1, whose first headings are uncertain, rotates with the merges: a fifth.
    """
    log = read_mrclam(data_dir / "mrclam" / "MRCLAM_Dataset7")
    metrics = metrics_of(played(log, particles=100), log)
    assert metrics["groups"] == [[1, 2, 3, 4, 5]]
    assert not any(merge["false"] for merge in metrics["merges"])
    shares = [row["ate_aligned_m"] / row["dead_reckoning_ate_start_m"] for row in metrics["robots"]]
    assert np.mean(shares) <= 0.1
    assert shares[0] <= 0.2
    assert max(shares[1:]) <= 0.13
    for row in metrics["robots"]:
        assert row["map_rmse_m"] < 0.2
        assert row["map_recall"] == 1.0


@pytest.mark.slow
def test_single_real_robots_reach_the_recorded_accuracy(data_dir: Path) -> None:
    """The five single robots have on average a path error of 0.33 m and a map error of 0.13 m."""
    log = read_mrclam(data_dir / "mrclam" / "MRCLAM_Dataset7", alone=True)
    rows = metrics_of(played(log, None), log)["robots"]
    assert np.mean([row["ate_aligned_m"] for row in rows]) <= 0.33
    assert np.mean([row["map_rmse_m"] for row in rows]) <= 0.13


@pytest.mark.slow
def test_another_log_is_replayed_with_the_same_noise(data_dir: Path) -> None:
    """Robot 3 of data set 4, with true poses from a separate file, has a path error of 0.15 m, a map error of 0.1 m.

    The odometry noise was calibrated on it, and on data set 7.
    """
    truth = data_dir / "mrclam_extra_gt" / "D4_robot3" / "Groundtruth.csv"
    log = read_mrclam(data_dir / "mrclam" / "MRCLAM_Dataset4", robots=(3,), truth=str(truth))
    row = metrics_of(played(log, None), log)["robots"][0]
    assert row["ate_aligned_m"] <= 0.15
    assert row["map_rmse_m"] <= 0.1


def test_paths_in_start_frames_and_group_frames_agree(tmp_path: Path) -> None:
    """Late poses in the group's frame fit the true poses by the same transform as the group's map."""
    write_log(tmp_path, noise=0.0)
    log = read_mrclam(tmp_path, **EXACT)
    result = played(log)
    late = compose(inverse(result.start_from_group), result.paths[:, -4])
    group_map = result.maps[0].moved(inverse(result.start_from_group[0]))
    rows = group_map.descriptors.argmax(axis=1)
    world_from_group = align_se2(LANDMARKS[rows], group_map.means[:, :2])
    for pose, own in zip(late, log.robots, strict=True):
        assert isinstance(own.truth, Trajectory)
        error = compose(inverse(own.truth.at(result.times[-4])), compose(world_from_group, pose))
        assert np.abs(error).max() < 0.05
