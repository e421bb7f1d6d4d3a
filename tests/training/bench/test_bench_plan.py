"""Benchmark plans: frozen content, episodes, resuming, tables, repetition of episodes, and the leaderboard."""

import csv
import gzip
import hashlib
import io
import json
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from training.bench.exploration import machine as machine_module
from training.bench.exploration import verification
from training.bench.exploration.aggregate import (
    iqm,
    performance_profile,
    pooled,
    probability_of_improvement,
    stratified_ci,
)
from training.bench.exploration.leaderboard import Results, played_rows
from training.bench.exploration.plan import FLOOR_PLANS, Plan
from training.bench.exploration.plan_report import (
    episodes_csv,
    markdown,
    ordered,
    read_episodes,
    tables,
    tidy_rows,
    write_parquet,
)
from training.experiments.trial_store import TRIALS_FILE

FROZEN = {"vslam-bench-v0": "c93f9cc37b4e9f61"}  # by name; a plan that changes gets a new name once it is frozen
TINY = """
name = "tiny"
split = "validation"
duration = 4.0
policies = ["frontier", "random_walk"]
[parts.base]
title = "two robots"
worlds = ["office", "hall"]
robots = [2]
particles = [10]
seeds = 2
[parts.one_robot]
title = "one robot"
worlds = ["office"]
robots = [1]
particles = [10]
seeds = 1
[parts.oracles]
title = "oracles"
worlds = ["office"]
robots = [2]
particles = [10]
seeds = 1
oracles = ["pose", "all"]
[parts.team_size]
title = "team size"
worlds = ["office"]
robots = [1, 2]
particles = [10]
seeds = 1
policies = ["frontier"]
"""


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Plan of episodes of four seconds."""
    file = tmp_path_factory.mktemp("plans") / "tiny.toml"
    file.write_text(TINY)
    return file


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the episodes, which the first test plays."""
    return tmp_path_factory.mktemp("results") / "run"


@pytest.fixture
def run(vslam: Any, tiny: Path, played: Path, tmp_path: Path) -> Path:
    """Copy of the run folder of the plan."""
    if not played.exists():
        done = vslam("bench", "exploration", "--plan", str(tiny), "--out", str(played))
        assert done.status == 0, done.out
    return Path(shutil.copytree(played, tmp_path / "run"))


def _rows(run: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (run / TRIALS_FILE).read_text().splitlines()]


@pytest.mark.parametrize("name", FROZEN)
def test_shipped_plans_do_not_change(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The hash of a plan stands here: results of one hash belong together."""
    monkeypatch.delenv("VSLAM_DATA", raising=False)
    plan = Plan.load(name)
    assert (plan.name, plan.digest) == (name, FROZEN[name])
    per_policy = [t for t in plan.trials(("frontier@continuous",)) if t.part == "base"]
    assert len(per_policy) == len({(t.world, t.seed) for t in per_policy}) == 4 * 30  # floor plans are left out
    assert plan.missing_floor_plans() == list(plan.floor_plans)
    quick = plan.trials(quick=True)
    assert {t.part for t in quick} == {"base"}
    assert {t.duration for t in plan.trials() if t.part != "large_world"} == {plan.duration}
    (trial, *_) = (t for t in plan.trials() if t.part == "large_world")
    assert plan.environment(trial).max_seconds == trial.duration == 600.0
    assert len(quick) == 4 * 2 * len(plan.policies)


def test_the_hash_follows_the_content_alone() -> None:
    """Comments, the order of names and the default policies do not change it, each other value does."""
    plan = Plan.load("vslam-bench-v0")
    values = plan.model_dump()
    assert Plan(**dict(reversed(values.items()))).digest == plan.digest
    assert Plan(**{**values, "policies": ("random_walk",)}).digest == plan.digest
    parts = {**values["parts"], "hard": {**values["parts"]["hard"], "seeds": 6}}
    assert Plan(**{**values, "parts": parts}).digest != plan.digest
    assert Plan(**{**values, "duration": 121.0}).digest != plan.digest


def test_floor_plans_are_found_by_their_content(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file of that name with other content is not the floor plan; without it the rows are left out."""
    text = TINY.replace('"hall"]', f'"{FLOOR_PLANS}"]').replace("seeds = 2", "seeds = 1")
    digest = hashlib.sha256(b"walls").hexdigest()
    file = tmp_path / "plan.toml"
    file.write_text(f'{text}[floor_plans]\n"a.png" = "{digest}"\n')
    monkeypatch.setenv("VSLAM_DATA", str(tmp_path))
    plan = Plan.load(str(file))
    for content, is_there in ((b"others", False), (b"walls", True)):
        folder = tmp_path / content.decode()
        folder.mkdir()
        (folder / "a.png").write_bytes(content)
        monkeypatch.setenv("VSLAM_DATA", str(folder))
        worlds = {t.world for t in plan.trials() if t.family == FLOOR_PLANS}
        assert worlds == ({"a.png"} if is_there else set())


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("seeds = 2", "", "seeds: expected a value, got 'none'"),
        ('"hall"', '"halls"', "world: expected one of 'office'"),
        ('"hall"', '"floor plans"', "floor_plans: expected at least 2, got 0"),
        ("duration", "length", "config: expected names among name, split, duration"),
        ("robots = [1]", "robots = [9]", "robots: expected an int from 1 to 8, got 9"),
        ("= [", "= ", "plan: expected a file in TOML"),
    ],
)
def test_bad_plans_are_refused(old: str, new: str, says: str, tmp_path: Path) -> None:
    """The error names the file and the field."""
    file = tmp_path / "bad.toml"
    file.write_text(TINY.replace(old, new, 1))
    with pytest.raises(ValueError, match=says) as error:
        Plan.load(str(file))
    assert str(file) in str(error.value)


@pytest.mark.slow
def test_a_plan_is_resumed_and_tabulated(vslam: Any, run: Path, tiny: Path) -> None:
    """A killed run is resumed where it stopped, with the same rows; tables, CSV and Parquet have all of them."""
    first, tables = _rows(run), (run / "tables.md").read_text()
    assert len(first) == 2 * (4 + 1 + 2) + 2
    lines = (run / TRIALS_FILE).read_text().splitlines()
    (run / TRIALS_FILE).write_text("\n".join([*lines[:-2], lines[-2][:50]]))
    done = vslam("bench", "exploration", "--plan", str(tiny), "--out", str(run), "--workers", "2")
    assert done.status == 0
    assert "14 of 16 trials are finished, 2 are left" in done.out
    assert {row["digest"] for row in _rows(run)} == {row["digest"] for row in first}
    for title in ("All worlds", "Families", "What the map error", "One factor", "Oracle ladder", "Team size"):
        assert f"### {title}" in tables
    found = list(csv.DictReader(io.StringIO((run / "episodes.csv").read_text())))
    assert [row["digest"] for row in found] == [row["digest"] for row in first]
    for row in first:
        parts = sum(row[f"squared_{name}"] for name in ("missed", "misplaced", "duplicate", "false"))
        if row["robots"] == 1:  # the mean of squares is the square of the mean of one robot alone
            assert parts == pytest.approx(row["map_error"] ** 2, abs=1e-9)
        assert row["nees"] is None or row["nees"] > 0.0
        assert 0.0 <= row["balance"] <= 1.0
    pytest.importorskip("pyarrow", reason="extra parquet is not installed")
    from pyarrow import parquet

    table = parquet.read_table(run / "episodes.parquet").to_pylist()
    assert {row["digest"] for row in table} == {row["digest"] for row in first}


@pytest.mark.slow
def test_episodes_are_played_again(vslam: Any, run: Path) -> None:
    """The same numerics give the same bits; a changed digest is found, and with other versions a changed number."""
    done = vslam("bench", "exploration", "--verify", str(run), "--rows", "1")
    assert done.status == 0
    kept = [json.loads(line) for line in (run / verification.VERIFIED_FILE).read_text().splitlines()]
    assert [row["is_equal"] for row in kept] == [True, True]
    assert verification.last_outcomes(run) == {"frontier": [1, 0, 0], "random_walk": [1, 0, 0]}
    changed = [json.dumps({**row, "policy_digest": "0" * 16}) for row in _rows(run)]
    (run / TRIALS_FILE).write_text("\n".join(changed) + "\n")
    assert "The file of frontier" in vslam("bench", "exploration", "--verify", str(run), "--rows", "1").out
    forged = [json.dumps({**row, "digest": "0" * 32}) for row in _rows(run)]
    (run / TRIALS_FILE).write_text("\n".join(forged) + "\n")
    assert vslam("bench", "exploration", "--verify", str(run), "--rows", "1").status == 1
    for name in ("trials.jsonl", "verified.jsonl"):
        (run / name).unlink()  # kept results have compressed rows alone
    rows = (run / "episodes.csv").read_text().replace(machine_module.PACKAGES[0], "another package")
    (run / "episodes.csv").unlink()
    (run / "episodes.csv.gz").write_bytes(gzip.compress(rows.encode()))
    done = vslam("bench", "exploration", "--verify", str(run), "--rows", "1")
    assert done.status == 0
    assert "Other numerics or versions" in done.out
    assert verification.last_outcomes(run) == {"frontier": [0, 1, 0], "random_walk": [0, 1, 0]}
    (run / "verified.jsonl").unlink()
    names, *lines = rows.splitlines()
    column = names.split(",").index("map_error")
    changed = [names.split(",")]
    for cells in csv.reader(lines):
        changed.append([*cells[:column], str(1.001 * float(cells[column])), *cells[column + 1 :]])
    text = io.StringIO()
    csv.writer(text).writerows(changed)
    (run / "episodes.csv.gz").write_bytes(gzip.compress(text.getvalue().encode()))
    assert vslam("bench", "exploration", "--verify", str(run), "--rows", "1").status == 0  # allowed elsewhere
    assert verification.last_outcomes(run) == {"frontier": [0, 0, 1], "random_walk": [0, 0, 1]}


@pytest.mark.slow
def test_the_leaderboard_is_made_from_kept_results(vslam: Any, run: Path, tiny: Path, tmp_path: Path) -> None:
    """Compressed results suffice; results of another plan and repeated policies are refused."""
    kept = tmp_path / "kept"
    kept.mkdir()
    (kept / "config.toml").write_text((run / "config.toml").read_text())
    (kept / "episodes.csv.gz").write_bytes(gzip.compress((run / "episodes.csv").read_bytes()))
    page = tmp_path / "leaderboard.md"
    assert vslam("bench", "leaderboard", str(kept), "--out", str(page)).status == 0
    text = page.read_text()
    assert text.startswith("# Leaderboard of exploration policies\n")
    assert "](leaderboard.png)" in text
    with Image.open(tmp_path / "leaderboard.png") as figure:
        assert min(figure.size) > 400
    for section in (run / "tables.md").read_text().split("### ")[1:]:
        assert " ".join(section.split()) in " ".join(text.split())  # lines may end elsewhere
    assert vslam("bench", "leaderboard", str(kept), str(run), "--out", str(page)).status == 0
    assert page.read_text() == text  # a policy in both, such as the baseline, counts once
    played = (run / "episodes.csv").read_text().splitlines()
    assert "\nteam_size,frontier," in "\n".join(played)
    (kept / "episodes.csv.gz").write_bytes(gzip.compress("\n".join(played[:-1]).encode()))
    assert vslam("bench", "leaderboard", str(kept), "--out", str(page)).status == 0
    assert page.read_text().count("### ") == text.count("### ") - 1  # the last part is not finished
    assert (run / "plan.toml").read_text() == tiny.read_text()  # results are read where the plan's file is not
    other = (run / "episodes.csv").read_text().replace(",random_walk,", ",frontier,")
    (run / "episodes.csv").write_text("\n".join(other.splitlines()[:4]) + "\n")
    done = vslam("bench", "leaderboard", str(kept), str(run), "--out", str(page))
    assert "folders: expected complete results, got" in done.err
    assert "of 4 episodes of the base part" in done.err
    done = vslam("bench", "leaderboard", str(tmp_path), "--out", str(page))
    assert "folders: expected the config.toml of an earlier run" in done.err


@pytest.mark.slow
def test_results_of_other_plans_are_not_mixed(vslam: Any, run: Path, tiny: Path, tmp_path: Path) -> None:
    """A folder of another plan or version is refused, and so are options that the plan fixes."""
    other = tmp_path / "other.toml"
    other.write_text(TINY.replace("4.0", "5.0"))
    done = vslam("bench", "exploration", "--plan", str(other), "--out", str(run))
    assert "out: expected a folder of plan 'tiny', hash" in done.err
    done = vslam("bench", "exploration", "--plan", str(tiny), "--worlds", "maze")
    assert "worlds: expected no value with --plan, which fixes it" in done.err
    text = (run / "config.toml").read_text()
    assert 'vslam-env = "' in text
    (run / "config.toml").write_text(text.replace('vslam-env = "', 'vslam-env = "9.'))
    done = vslam("bench", "exploration", "--plan", str(tiny), "--out", str(run))
    assert "out: expected results of vslam-env" in done.err


def test_a_changed_policy_does_not_continue_old_results(
    vslam: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The rows name the policy's file by its digest; a folder of another version of it is refused."""
    file = tmp_path / "plan_policies.py"
    source = """
class Staying:
    def reset(self):
        pass

    def act(self, observation, belief, rng):
        return 0
"""
    file.write_text(source)
    monkeypatch.chdir(tmp_path)
    command = (
        "bench", "exploration", "--policies", "plan_policies:Staying", "--worlds", "fig5", "--robots", "1",
        "--oracles", "none", "--max-seconds", "2", "--particles", "5", "--seeds", "1", "--out", "run",
    )  # fmt: skip
    assert vslam(*command).status == 0
    (row,) = _rows(tmp_path / "run")
    assert row["policy_digest"] == hashlib.sha256(source.encode()).hexdigest()[:16]
    file.write_text(source + "# changed\n")
    done = vslam(*command)
    assert "out: expected episodes of 'plan_policies:Staying' as it is now, got" in done.err
    file.write_text(source)
    assert vslam(*command).status == 0
    sys.modules.pop("plan_policies", None)


# ------------------------------------------------------------------ tables and statistics


def _row(policy: str, family: str, seed: int, **values: Any) -> dict[str, Any]:
    """Return a row of the base part in which all metrics are one half."""
    names = (
        "map_error", "mean_coverage", "below_50_s", "below_90_s", "map_recall", "ate_start_m", "nees",
        "decision_p99_ms",
        "squared_missed", "squared_misplaced", "squared_duplicate", "squared_false", "map_rmse_m", "map_precision",
        "right_merges", "false_merges", "undone_merges", "last_merge_s", "overlap", "way_m", "balance", "collisions",
        "bytes_sent",
    )  # fmt: skip
    about = {
        "part": "base", "policy": policy, "family": family, "world": family, "robots": 3, "particles": 100,
        "oracle": "none", "preset": "standard", "comm_loss": None, "duration": 120.0, "seed": seed,
        "digest": f"{seed:032x}", "policy_digest": None, "machine": machine_module.machine(), "refusals": {},
    }  # fmt: skip
    return about | dict.fromkeys(names, 0.5) | values


def test_rows_survive_csv_and_parquet(tmp_path: Path) -> None:
    """Reading what was written gives the same rows: texts, numbers, refusals, unknown values."""
    rows = [
        _row("frontier", "office", 0, refusals={"ambiguous": 2}, nees=None, digest="1" * 32),
        _row("mine=a:B", "maze", 1, comm_loss=0.5, refusals={"mirrored": 1}, map_error=1e-5, digest="12e4" * 8),
    ]
    assert read_episodes(episodes_csv(rows)) == rows
    with pytest.raises(ValueError, match="episodes: expected a column 'part', got 'none'"):
        read_episodes("policy\nfrontier\n")
    if write_parquet(tmp_path / "episodes.parquet", rows):
        from pyarrow import parquet

        assert parquet.read_table(tmp_path / "episodes.parquet").to_pylist() == tidy_rows(rows)


def test_policies_are_ordered_and_compared_with_the_first() -> None:
    """The best map comes first; differences and probabilities are relative to the plan's first policy."""
    rows = [
        _row(policy, family, seed, map_error=0.125 * seed + more)
        for policy, more in (("frontier", 0.0), ("random_walk", 0.0625))
        for family in ("office", "maze")
        for seed in range(4)
    ]
    plan = Plan.load("vslam-bench-v0")
    first, second = (
        [table.cells(line) for line in table.lines(ordered(rows[::-1]))] for table in tables(plan, rows)[:2]
    )
    assert [cells[0] for cells in first] == ["frontier", "random_walk"]
    assert first[0][1].startswith("18.8 (")  # the middle half of 0, 12.5, 25, 37.5 cm
    assert first[0][-1] == "-"
    assert first[1][-1].startswith("0.38 (")  # 3 + 2 + 1 of 16 pairs are better, none is equal
    assert second[1][1] == "25.0, 6.2 (6.2 .. 6.2)"
    text = markdown(plan, rows, ("frontier", "tare"))
    assert "There are no rows of floor plans" in text
    assert "`frontier` has 8 of 150 episodes of the base part" not in text
    assert "`frontier` has 8 of 120 episodes of the base part" in text
    assert "`tare` has 0 of 120 episodes of the base part" in text  # all have failed
    assert "There are no rows" not in markdown(plan, [*rows, _row("frontier", FLOOR_PLANS, 0)], ())


def test_policies_of_a_leaderboard_have_played_in_the_same_families() -> None:
    """Rows without floor plans are not put beside rows with them, which are harder."""
    plan = Plan.load("vslam-bench-v0")
    whole, other = (
        Results(plan, [_row(policy, family, 0) for family in families], {})
        for policy, families in (("frontier", ("office", FLOOR_PLANS)), ("tare", ("office",)))
    )
    assert len(played_rows([whole])) == 2
    with pytest.raises(ValueError, match="none of 'tare' in floor plans"):
        played_rows([whole, other])


def test_interquartile_means_ignore_outliers() -> None:
    """A quarter of the values at each end does not count."""
    values = np.array([[0.0, 2.0, 4.0, 1e9], [1.0, 1.0, 1.0, 1.0]])
    np.testing.assert_array_equal(iqm(values), [3.0, 1.0])


def test_stratified_intervals_hold_their_level() -> None:
    """Of 95 % intervals of the mean over two families of 30 worlds, about 95 % contain the true mean."""
    rng = np.random.default_rng(3)
    held = 0
    for _ in range(200):
        strata = [rng.normal(1.0, 1.0, 30), rng.normal(3.0, 2.0, 30)]
        _, low, high = stratified_ci(strata, pooled(lambda values: values.mean(axis=-1)), 400)
        held += low <= 2.0 <= high
    assert (
        176 <= held <= 198
    )  # binomial with p = .95 lies within in all but .1 % of the cases; bootstrap is a bit short
    assert np.isnan(stratified_ci([np.ones(1)], pooled(iqm))[1])


def test_probability_of_improvement_is_that_of_mann_and_whitney() -> None:
    """The share of pairs that are better, and half of the equal ones, is U / (n m); families count alike."""
    from scipy.stats import mannwhitneyu

    rng = np.random.default_rng(4)
    own, other = ([rng.integers(0, 6, n).astype(float) for n in counts] for counts in ((9, 20), (11, 5)))
    expected = np.mean([mannwhitneyu(a, b).statistic / (len(a) * len(b)) for a, b in zip(own, other, strict=True)])
    value, low, high = probability_of_improvement(own, other, 300)
    assert value == pytest.approx(expected)
    assert low < value < high


def test_profiles_are_shares_above_thresholds() -> None:
    """Families count alike, whatever their number of worlds."""
    profile = performance_profile([np.array([0.1, 0.3]), np.array([0.9])], np.array([0.0, 0.2, 0.5, 1.0]))
    np.testing.assert_allclose(profile, [1.0, 0.75, 0.5, 0.0])
