"""Figs. 2 to 4 of the paper: aligned and fused maps of two robots."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slam_backend.geometry import transform_points
from training.paper.config import Fig2Config, PairConfig
from training.paper.fig2 import ENOUGH_SHARED, METHODS, OURS, STUDY, TABLE, check_claims, play, unfold
from training.paper.fig3 import AlignedPair, align_pair, ellipses, fuse_pair, matches
from training.paper.map_pairs import map_alone, simulate_pair, true_motion
from training.stereo_runs.runs import FALSE_POINT

SMALL = Fig2Config(length=30.0, every=10.0, particles=30, seeds=2, seed=100)


@pytest.fixture(scope="module")
def rows() -> list[dict[str, Any]]:
    """Two short runs."""
    return [{"seed": trial.seed} | play(SMALL, trial) for trial in SMALL.trials()]


@pytest.fixture(scope="module")
def pair() -> AlignedPair:
    """Two aligned maps."""
    return align_pair(PairConfig(length=25.0, particles=30, seed=100))


def test_stages_have_true_associations() -> None:
    """After the true transform, landmarks of both maps with the same number have the same position."""
    run_of_two = simulate_pair(100, 20.0, 300)
    *_, stage = map_alone(run_of_two, 30, 100, 20.0)
    truth = true_motion(run_of_two)
    assert stage.shared > 20
    map_a, map_b = stage.maps
    moved = transform_points(truth, map_b.means)
    apart = []
    for row, name in enumerate(stage.true_ids[0].tolist()):
        for other in np.flatnonzero(stage.true_ids[1] == name):
            if name != FALSE_POINT:
                apart.append(np.linalg.norm(map_a.means[row] - moved[other]))
    assert np.median(apart) < 0.15
    assert len(apart) >= stage.shared


def test_stages_have_errors_of_all_methods(rows: list[dict[str, Any]]) -> None:
    """Maps grow along the path, and with enough shared landmarks RANSAC and our method are near the truth."""
    for row in rows:
        sizes = [stage["size"] for stage in row["stages"]]
        assert len(sizes) == 3
        assert sizes == sorted(sizes)
        for stage in row["stages"]:
            assert set(METHODS) <= set(stage)
            if stage["shared"] >= 40:
                assert stage["ransac"]["translation_m"] < 0.5
                assert stage[OURS]["rotation_deg"] < 3.0
            if not stage["shared"]:
                assert stage[OURS] is None
    assert any(stage["shared"] >= ENOUGH_SHARED for row in rows for stage in row["stages"])
    lines = {line["method"]: line for line in STUDY.tables[1].lines(unfold(rows))}
    assert lines[OURS]["falsely aligned"].value == 0


def test_a_run_repeats() -> None:
    """The same seed gives the same stages."""
    trial = Fig2Config(length=10.0, every=10.0, particles=10, seeds=1, seed=102).trials()[0]
    assert play(SMALL, trial) == play(SMALL, trial)


def stage(size: float, errors: dict[str, float | None], shared: int = 50) -> dict[str, Any]:
    """Return a stage with the given error of each method, in metres and in degrees."""
    rows_of_methods = {m: None if e is None else {"translation_m": e, "rotation_deg": e} for m, e in errors.items()}
    return {"length": 5.0, "size": size, "shared": shared, **dict.fromkeys(METHODS), **rows_of_methods}


def test_the_papers_claim_is_checked() -> None:
    """The claim holds if RANSAC is best and near zero for every size, and fails if it is not for one size."""
    good = {"svd": 2.0, "icp": 1.0, "impicp": 0.5, "ransac": 0.1, OURS: 0.1}
    fine = unfold([{"seed": 0, "stages": [stage(60.0, good), stage(160.0, good), stage(160.0, good, shared=3)]}])
    found = [(line["size"], line["method"]) for line in TABLE.lines(fine)]
    assert found == [(size, method) for size in (75.0, 175.0) for method in METHODS]
    assert all(claim.holds for claim in check_claims(fine))
    poor = unfold([{"seed": 0, "stages": [stage(60.0, good), stage(160.0, good | {"ransac": 3.0})]}])
    holding = {claim.text for claim in check_claims(poor) if claim.holds}
    assert holding == {f"RANSAC over svd, mean {figure}" for figure in ("translation [m]", "rotation [deg]")}
    lost = unfold([{"seed": 0, "stages": [stage(60.0, good | {"ransac": None})]}])
    assert not any(claim.holds for claim in check_claims(lost))
    assert not any(claim.holds for claim in check_claims([]))


def test_false_alignments_are_counted() -> None:
    """Our method is false if it accepts with an error above 0.5 m or 5 degrees, whatever the maps share."""
    stages = [stage(60.0, {OURS: 0.6}), stage(60.0, {OURS: 0.4}), stage(60.0, {OURS: 4.0}, shared=2), stage(60.0, {})]
    lines = {line["method"]: line for line in STUDY.tables[1].lines(unfold([{"seed": 0, "stages": stages}]))}
    assert (lines[OURS]["share too little"].value, lines[OURS]["falsely aligned"].value) == (1, 2)
    assert lines["svd"]["falsely aligned"].value == 0


def test_the_estimated_transform_aligns_the_maps(pair: AlignedPair) -> None:
    """Nearly all inliers are true, and the error agrees with the covariance and the deformation of the maps."""
    found = matches(pair)
    assert len(found) >= 20
    assert sum(row["is_true"] for row in found) >= 0.95 * len(found)
    metres, degrees = pair.errors()
    assert metres < 0.4
    assert degrees < 2.0


def test_fusion_reduces_covariances(pair: AlignedPair) -> None:
    """Fusion never adds uncertainty, and the fused mean lies between both in Mahalanobis terms."""
    fused = fuse_pair(pair)
    assert len(fused.true_ids) == 3
    assert len(ellipses(fused)) == 3 * 3
    one, two, both = fused.covariances
    for other in (one, two):
        assert np.linalg.eigvalsh(other - both).min() > -1e-12
    assert (np.linalg.det(both) < np.minimum(np.linalg.det(one), np.linalg.det(two))).all()


def test_the_commands_write_pictures_and_tables(vslam: Any, tmp_path: Path) -> None:
    """Each figure gives PNG, CSV and metrics.json; fig2 resumed in its folder runs no stage twice."""
    options = ("--seeds", "1", "--first-seed", "100", "--length", "10", "--every", "10", "--particles", "20")
    for _ in range(2):
        said = vslam("paper", "fig2", *options, "--out", str(tmp_path / "fig2"))
        assert said.status == 0
        assert "RANSAC, median translation" in said.out
        assert len((tmp_path / "fig2" / "trials.jsonl").read_text().splitlines()) == 1
    for name in ("fig3", "fig4"):
        few = ("--seed", "100", "--length", "20", "--particles", "20")
        assert vslam("paper", name, *few, "--out", str(tmp_path / name)).status == 0
    for name, head in (("fig2", "seed"), ("fig3", "true_a"), ("fig4", "landmark")):
        folder = tmp_path / name
        with (folder / "trials.csv").open() as file:
            table = list(csv.reader(file))
        assert table[0][0] == head
        assert len(table) > 5
        assert (folder / f"{name}.png").stat().st_size > 5_000
        assert "config" in json.loads((folder / "metrics.json").read_text())
