import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slam_backend.geometry import transform_points
from slam_backend.maps.alignment import AlignmentOptions, align_maps, candidate_matches
from studies.merging.alignment import GRID, STUDY, Config, Trial, play, trials
from studies.merging.map_pairs import (
    IDENTIFIABLE,
    LANDMARKS,
    LEAST_SPREAD,
    NOISE,
    UNALIGNABLE,
    draw_identifiable,
    draw_pair,
    draw_unalignable,
)


@pytest.mark.parametrize(("overlap", "outliers"), GRID)
def test_pairs_have_the_requested_shares(overlap: float, outliers: float) -> None:
    """The shares of common landmarks, up to noise, and of wrong candidates are as requested; heights never differ."""
    pair = draw_pair(overlap, outliers, np.random.default_rng(100))
    right = round(overlap * LANDMARKS)
    assert len(pair.pairs) == right
    rows_a, rows_b = pair.pairs.T
    apart = pair.a.means[rows_a] - transform_points(pair.pose, pair.b.means[rows_b])
    assert np.sqrt((apart**2).mean()) == pytest.approx(np.sqrt(2.0) * NOISE, rel=0.25)
    candidates = candidate_matches(pair.a, pair.b, AlignmentOptions())
    true = set(map(tuple, pair.pairs.tolist()))
    wrong = sum(tuple(row) not in true for row in candidates.tolist())
    assert len(candidates) - wrong >= 0.97 * right
    assert wrong / len(candidates) == pytest.approx(outliers, abs=0.03)


def test_the_bound_is_reached_by_least_squares_on_true_pairs() -> None:
    """With true pairs only, the mean squared error of the transform is the Cramer-Rao bound."""
    squares, bounds = [], []
    for seed in range(100, 250):
        pair = draw_pair(0.1, 0.0, np.random.default_rng(seed))
        error = align_maps(pair.a, pair.b).transform - pair.pose
        squares.append(error[:2] @ error[:2])
        bounds.append(np.trace(pair.bound()[:2, :2]))
    assert np.sqrt(np.mean(squares) / np.mean(bounds)) == pytest.approx(1.0, abs=0.2)  # 4 sigma


@pytest.mark.parametrize("kind", IDENTIFIABLE)
def test_identifiable_maps_have_enough_spread_pairs(kind: str) -> None:
    """There are at least 12 true pairs, spread over at least 2 m."""
    for seed in range(100, 120):
        pair = draw_identifiable(kind, np.random.default_rng(seed))
        assert len(pair.pairs) >= 12
        points = pair.b.means[pair.pairs[:, 1], :2]
        assert np.linalg.norm(points[:, None] - points[None], axis=2).max() > LEAST_SPREAD - 4.0 * NOISE


@pytest.mark.parametrize("kind", UNALIGNABLE)
def test_unalignable_maps_have_no_true_motion_and_are_refused(kind: str) -> None:
    """Maps without a true transform are refused, though most pairs of maps have enough candidates."""
    for seed in range(100, 108):
        pair = draw_unalignable(kind, np.random.default_rng(seed))
        assert np.isnan(pair.pose).all()
        if kind != "twin rooms":
            assert len(candidate_matches(pair.a, pair.b, AlignmentOptions())) >= 20
        assert not align_maps(pair.a, pair.b).success


def test_pairs_that_cannot_be_drawn_are_refused() -> None:
    """With half of the landmarks common, at most as many wrong pairs are possible."""
    with pytest.raises(ValueError, match=r"outliers: expected a finite number >= 0 and <= 0.5.* got 0.9"):
        draw_pair(0.5, 0.9, np.random.default_rng(0))
    with pytest.raises(ValueError, match="kind: expected one of 'no overlap'"):
        draw_unalignable("fog", np.random.default_rng(0))


def row(**changed: Any) -> dict[str, Any]:
    """Return the row of a successful trial on the grid."""
    return {
        "kind": "grid", "case": "", "overlap": 0.5, "outliers": 0.0, "method": "ransac", "success": True, "reason": "",
        "false": False, "seconds": 0.002, "cpu_seconds": 0.001, "error_m": 0.02, "error_rad": 0.001, "nees": 3.0,
        "bound_m2": 4e-4, "bound_rad2": 1e-6,
    } | changed  # fmt: skip


def refusal(reason: str, **changed: Any) -> dict[str, Any]:
    """Return the row of a refused trial."""
    found = ("error_m", "error_rad", "nees", "bound_m2", "bound_rad2")
    whole = row(success=False, reason=reason, **changed)
    return {name: value for name, value in whole.items() if name not in found}


def test_errors_are_relative_to_the_bound_and_refusals_are_failures() -> None:
    """Errors are RMS over the root of the mean bound; a refused trial is a failure without error."""
    rows = [row(), row(error_m=0.04, error_rad=0.003), refusal("ambiguous")]
    line, pooled = STUDY.tables[0].lines(rows)
    assert line["right [%]"].value == pytest.approx(200 / 3)
    assert line["translation/bound"].value == pytest.approx(np.sqrt(0.5 * (0.02**2 + 0.04**2)) / 0.02)
    assert line["rotation/bound"].value == pytest.approx(np.sqrt(5.0))
    anees = line["ANEES (consistent)"]
    assert anees.low < anees.value == 1.0 < anees.high
    assert pooled == line | {"overlap": "all", "outliers": "all"}
    refused, _ = STUDY.tables[1].lines([row | {"kind": "U", "case": "mirrored map"} for row in rows])
    assert refused["refused for"].value == "ambiguous 1"
    assert refused["accepted"].value == "2 of 3"


def test_a_trial_repeats() -> None:
    """The same trial gives the same results, except times, whatever ran before it."""
    trial = Trial(kind="I", case="area", overlap=0.0, outliers=0.0, method="impicp", seed=103)
    first = play(Config(), trial)
    play(Config(), Trial(kind="U", case="half alike", overlap=0.0, outliers=0.0, method="svd", seed=9))
    again = play(Config(), trial)
    assert first.keys() == again.keys()
    assert all(first[name] == again[name] for name in first if "seconds" not in name)


def test_all_methods_have_the_same_trials() -> None:
    """Trials are ordered by cell and seed, each once for each method; U and I never share the maps of a seed."""
    config = Config(methods=("ransac", "icp"), seeds=3, hard=10, seed=100)
    played = trials(config)
    assert len(played) == len(set(played)) == 2 * (3 * len(GRID) + 20)
    assert {trial.case for trial in played if trial.kind == "I"} == set(IDENTIFIABLE)
    assert Config.from_mapping(config.to_mapping() | {"seed": 100}) == config


def test_the_program_writes_tables_chart_and_trials(tmp_path: Path) -> None:
    """A small study writes its tables; when resumed in the same folder, no trial runs twice."""
    out = tmp_path / "study"
    program = [sys.executable, "-m", "studies.merging.alignment", "--methods", "ransac,icp", "--seeds", "1"]
    program += ["--hard", "9", "--first-seed", "100", "--out", str(out)]
    said = subprocess.run([*program, "--json", "-"], capture_output=True, text=True, check=True)
    assert "Maps that can barely be aligned" in said.stderr
    assert json.loads(said.stdout) == json.loads((out / "metrics.json").read_text())
    assert (out / "alignment.png").stat().st_size > 10_000
    assert "| 10 % | 90 % | ransac | 100 |" in (out / "tables.md").read_text()
    assert "case,method,accepted,refused for" in (out / "unalignable.csv").read_text()
    rows = (out / "trials.jsonl").read_text()
    assert len(rows.splitlines()) == 2 * (len(GRID) + 18)
    assert subprocess.run(program, capture_output=True, check=True).returncode == 0
    assert (out / "trials.jsonl").read_text() == rows
    assert "study alignment" in (out / "config.toml").read_text()
