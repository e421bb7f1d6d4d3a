"""Scores of anybody's paths and maps, and merges of maps from files."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from slam_backend import LandmarkMap, Trajectory
from slam_backend.geometry import compose, inverse
from slam_backend.metrics import ate

MOTION = np.array([3.0, -2.0, 0.7])
WITH_MAP = "--truth t0.txt --estimate r0.txt --map"


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder of two robots' paths and maps, and of their truth."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    for robot in range(2):
        poses = np.cumsum(rng.normal(0.0, 0.1, (50, 3)), axis=0)
        times = 0.1 * np.arange(50)
        Trajectory(times, poses).save_tum(f"t{robot}.txt")
        wrong = poses + rng.normal(0.0, 0.02, poses.shape)
        Trajectory(times + 0.004, compose(inverse(MOTION), wrong)).save_tum(f"r{robot}.txt")
    means = rng.uniform(-6.0, 6.0, (30, 3))
    descriptors = rng.normal(size=(30, 64))
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    whole = LandmarkMap(means, np.tile(1e-4 * np.eye(3), (30, 1, 1)), descriptors)
    whole.subset(np.arange(20)).save("a.npz")
    whole.subset(np.arange(8, 30)).moved(inverse(MOTION)).save("b.npz")
    whole.subset(np.arange(3)).save("few.npz")
    lines = "\n".join(f"{x},{y},{z}" for x, y, z in means)
    Path("l.csv").write_text(f"x,y,z\n{lines}\n")
    return tmp_path


def test_a_team_is_scored_under_one_alignment(vslam: Any, files: Path) -> None:
    """Errors of all robots and the map, in metres, on the console and as JSON."""
    done = vslam(
        "score", "--truth", "t0.txt,t1.txt", "--estimate", "r0.txt,r1.txt", "--map", "b.npz", "--landmarks", "l.csv",
        "--json", "score.json",
    )  # fmt: skip
    assert done.status == 0
    found = json.loads(Path("score.json").read_text())
    assert [robot["poses"] for robot in found["robots"]] == [50, 50]
    assert 0.01 < found["ate_m"] < 0.05
    np.testing.assert_allclose(found["truth_from_estimated"], MOTION, atol=0.05)
    assert found["map"]["matched"] == 22
    assert found["map"]["precision"] == 1.0
    assert f"Team: ATE {found['ate_m']:.3f} m" in done.out
    both = [np.concatenate([Trajectory.load_tum(f"{side}{k}.txt").poses for k in range(2)]) for side in "rt"]
    assert found["ate_m"] == pytest.approx(ate(*both).aligned, rel=1e-12)


MAPS = "expected a map, .npz of this project or .csv with columns x, y and perhaps z, got"
TUM = "expected a TUM trajectory file, got"


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ("--truth t0.txt --estimate r0.txt,r1.txt", "truth: expected as many paths as estimated ones, 2, got 1."),
        ("--truth t0.txt,t1.txt --estimate r0.txt", "truth: expected as many paths as estimated ones, 1, got 2."),
        ("--truth t0.txt,none.txt --estimate r0.txt,r1.txt", f"truth: {TUM} no such file. Check 'none.txt'."),
        ("--truth t0.txt --estimate none.txt", f"estimate: {TUM} no such file. Check 'none.txt'."),
        ("--truth t0.txt --estimate .", f"estimate: {TUM} a folder. Check '.'."),
        (
            "--truth t0.txt --estimate r0.txt --max-gap 0.001",
            "estimate: expected paths that overlap in time, got a path",
        ),
        (
            "--truth t0.txt --estimate r0.txt --map b.npz",
            "landmarks: expected a file beside --map, got no --landmarks.",
        ),
        (
            "--truth t0.txt --estimate r0.txt --landmarks l.csv",
            "map: expected a file beside --landmarks, got no --map.",
        ),
        (f"{WITH_MAP} t0.txt --landmarks l.csv", f"map: {MAPS} 't0.txt'. Only these are read."),
        (f"{WITH_MAP} gone.csv --landmarks l.csv", f"map: {MAPS} no such file. Check 'gone.csv'."),
        (f"{WITH_MAP} b.npz --landmarks odd.csv", f"landmarks: {MAPS} a table without these names. Name the columns"),
        (
            f"{WITH_MAP} broken.npz --landmarks l.csv",
            "map: expected a map (.npz) that LandmarkMap.save wrote, got a br",
        ),
        ("--truth t0.txt --estimate r0.txt --delta 0", "delta: expected an int >= 1"),
        ("--truth t0.txt --estimate r0.txt --json no/such/file.json", "json: expected"),
    ],
)
def test_bad_scores_cost_one_line(options: str, says: str, vslam: Any, files: Path) -> None:
    """Missing and foreign files, clocks that differ, numbers of paths; each error begins with the option at fault."""
    Path("odd.csv").write_text("north,east\n1,2\n")
    Path("broken.npz").write_bytes(Path("b.npz").read_bytes()[:-9])
    done = vslam("score", *options.split())
    assert done.status == 2
    assert done.err.startswith(f"error {says}")
    assert done.err.count("\n") == 1


def test_maps_from_files_are_merged_or_refused_with_the_reason(vslam: Any, files: Path) -> None:
    """The motion with its sigma, the merged map and a picture; or the reason, a picture and status 3."""
    done = vslam("merge", "a.npz", "b.npz", "--out", "both.npz", "--json", "merge.json")
    assert done.status == 0, done.err
    assert "aligned on 12 of them" in done.out
    found = json.loads(Path("merge.json").read_text())["first_from_second"]
    np.testing.assert_allclose([found["x_m"], found["y_m"], found["theta_rad"]], MOTION, atol=1e-3)
    assert len(LandmarkMap.load("both.npz")) == 30
    with Image.open("both.png") as picture:
        assert min(picture.size) > 300
    assert vslam("merge", "a.npz", "b.npz", "--out", "both.ply").status == 0
    assert Path("both.ply").read_bytes().startswith(b"ply\n")
    done = vslam("merge", "a.npz", "few.npz", "--out", "none.npz")
    assert done.status == 3
    assert "Reason: too few candidates" in done.out
    assert Path("none.png").is_file()
    assert not Path("none.npz").exists()
    saved = "expected a map (.npz) that LandmarkMap.save wrote, got"
    for arguments, says in (
        (("a.npz", "l.csv"), f"other: {saved} a file of another kind. Check 'l.csv': only .npz is read back."),
        (("gone.npz", "a.npz"), f"one: {saved} no such file. Check 'gone.npz'."),
        (("a.npz", "b.npz", "--out", "map.txt"), "out: expected a name that ends in .npz, .csv or .ply, got 'map.txt'"),
    ):
        done = vslam("merge", *arguments)
        assert done.status == 2
        assert says in done.err


def test_errors_are_those_of_evo(vslam: Any, files: Path) -> None:
    """ATE after alignment and RPE of a path equal those of evo, which is only called here."""
    pytest.importorskip("evo", reason="evo, an optional peer, is not installed: pip install evo")
    from evo.core import metrics, sync
    from evo.tools import file_interface

    assert vslam("score", "--truth", "t0.txt", "--estimate", "r0.txt", "--json", "score.json").status == 0
    (found,) = json.loads(Path("score.json").read_text())["robots"]
    true, guess = (file_interface.read_tum_trajectory_file(name) for name in ("t0.txt", "r0.txt"))
    true, guess = sync.associate_trajectories(true, guess, max_diff=0.01)
    relations = metrics.PoseRelation
    for name, relation in (("rpe_m", relations.translation_part), ("rpe_rad", relations.rotation_angle_rad)):
        rpe = metrics.RPE(relation, delta=1, delta_unit=metrics.Unit.frames)
        rpe.process_data((true, guess))
        assert found[name] == pytest.approx(rpe.get_statistic(metrics.StatisticsType.rmse), rel=1e-6)
    guess.align(true)
    ape = metrics.APE(relations.translation_part)
    ape.process_data((true, guess))
    assert found["ate_m"] == pytest.approx(ape.get_statistic(metrics.StatisticsType.rmse), rel=1e-6)
