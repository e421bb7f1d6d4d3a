"""Benchmark plans: frozen tasks, episodes, resuming, tables, forged rows, repetition, leaderboard and submissions."""

import csv
import gzip
import hashlib
import io
import json
import shutil
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from studies.bench_tasks import digest, tasks
from training.bench.exploration import machine as machine_module
from training.bench.exploration import verification
from training.bench.exploration.aggregate import mean_with_interval, performance_profile
from training.bench.exploration.episodes import (
    CSV,
    FIELDS,
    MOST_BYTES,
    PACKED,
    Field,
    episodes_csv,
    kept_episodes,
    read_episodes,
    row_digest,
    tidy_rows,
    write_parquet,
)
from training.bench.exploration.leaderboard import Results, leaderboard, played_rows, read_results
from training.bench.exploration.plan import FLOOR_PLANS, Plan, task_name
from training.bench.exploration.plan_report import markdown, ordered, tables
from training.experiments.trial_store import TRIALS_FILE

FROZEN = {"vslam-bench-v1": "304cb87e4dc4f3a3"}  # by name; a plan that changes gets a new name once it is frozen
TINY = """
name = "tiny"
split = "validation"
first_seed = 7
duration = 4.0
policies = ["frontier", "random_walk"]
relaxed_policy = "frontier"
[tracks.standard]
title = "two robots"
worlds = ["office", "hall"]
robots = [2]
seeds = 2
base = 1
relaxed = 1
options = { belief = { filter = { num_particles = 10 } } }
[tracks.team]
title = "team size"
worlds = ["office"]
robots = [1, 2]
seeds = 1
options = { belief = { filter = { num_particles = 10 } } }
[relaxations.floor]
title = "known floor plan"
options = { oracle_floor = true }
[relaxations.time]
title = "twice the time"
times = 2.0
oracle = "pose"
"""
COUNT = 2 * (4 + 2) + 2 * 2  # episodes of both policies, and those with limits relaxed


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Plan of episodes of four seconds, with the digests of its tasks."""
    file = tmp_path_factory.mktemp("plans") / "tiny.toml"
    file.write_text(TINY)
    found = "".join(f'"{name}" = "{words}"\n' for name, words in tasks(Plan.load(str(file))).items())
    file.write_text(f"{TINY}[tasks]\n{found}")
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


# ------------------------------------------------------------------ plans


@pytest.mark.parametrize("name", FROZEN)
def test_shipped_plans_do_not_change(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The hash of a plan stands here: results of one hash belong together."""
    monkeypatch.delenv("VSLAM_DATA", raising=False)
    plan = Plan.load(name)
    assert (plan.name, plan.digest) == (name, FROZEN[name])
    base = plan.trials(("frontier@continuous",), extent="base")
    assert len(base) == len({(t.track, t.world, t.seed) for t in base}) == 2 * 4 * 30
    assert {t.seed for t in plan.trials()} <= set(range(5000, 5200))
    assert plan.trials(("frontier@continuous",))[: len(base)] == base
    assert FLOOR_PLANS not in {t.family for t in plan.trials()}
    assert plan.missing_floor_plans() == list(plan.floor_plans)
    whole = plan.trials(("tare",), with_missing=True)
    assert {t.relaxation for t in whole} == {"none"}
    assert sum(t.family == FLOOR_PLANS for t in whole) == 2 * len(plan.floor_plans)
    assert {t.track for t in plan.trials(tracks=["radio"], extent="quick")} == {"radio"}
    (trial, *_) = plan.trials(tracks=["large"])
    assert plan.environment(trial).max_seconds == 600.0
    relaxed = {t.relaxation: t for t in plan.trials(tracks=["hard"]) if t.relaxation != "none"}
    wide = {name: plan.environment(trial) for name, trial in relaxed.items()}
    assert wide["time"].max_seconds == 240.0
    assert wide["camera"].landmark_sensor.camera.width == wide["camera"].belief.filter.camera.width == 640
    assert wide["camera"].landmark_sensor.camera.max_range == 5.0
    assert [wide[name].oracle_pose for name in ("pose", "all", "merge")] == [True, True, False]


@pytest.mark.parametrize("name", FROZEN)
def test_tasks_of_shipped_plans_do_not_change(name: str) -> None:
    """The first episode of each track, world and team size has the walls, landmarks, starts and readings it had."""
    plan = Plan.load(name)
    firsts = {task_name(t): t for t in plan.trials(("frontier",), with_missing=True)[::-1] if t.relaxation == "none"}
    assert plan.tasks.keys() == firsts.keys()
    for trial in firsts.values():
        if trial.family != FLOOR_PLANS:
            assert digest(plan, trial) == plan.task_of(trial), trial
    counts = {name: len(words.split()) for name, words in plan.tasks.items()}
    assert counts["standard, office, 3"] == counts["hard, hall, 3"] == 100
    assert counts[f"hard, {FLOOR_PLANS}, 3"] == len(plan.floor_plans)


def test_the_task_does_not_depend_on_policy_and_estimator(tiny: Path) -> None:
    """Other actions and filters leave a task as it is; another seed, sensor or radio of the robots does not."""
    from training.bench.exploration.trials import task_digest
    from vslam_env import vslam_v1

    plan = Plan.load(str(tiny))
    first, *others = (t for t in plan.trials(("frontier",)) if t.track == "standard")
    config = plan.environment(first)

    def of(seed: int = first.seed, **changes: Any) -> str:
        env = vslam_v1.parallel_env(config=config.replace(**changes))
        env.reset(seed=seed)
        return task_digest(env)

    assert of() == plan.task_of(first)
    assert of(action_type="continuous") == of(belief={"filter": {"num_particles": 3}}) == of(oracle_pose=True) == of()
    odd = of(seed=99), of(landmark_sensor={"false_points": 2.0}), of(odometry={"bias_distance": 0.5}), of(num_robots=1)
    assert len({of(), *odd}) == 5
    assert len({plan.task_of(trial) for trial in (first, *others) if trial.relaxation == "none"}) == 4


def test_the_hash_follows_the_content_alone(tiny: Path) -> None:
    """Comments, the order of names and the default policies do not change it, each other value does."""
    plan = Plan.load(str(tiny))
    values = plan.model_dump()
    assert Plan(**dict(reversed(values.items()))).digest == plan.digest
    assert Plan(**{**values, "policies": ("random_walk",)}).digest == plan.digest
    tracks = {**values["tracks"], "team": {**values["tracks"]["team"], "seeds": 6}}
    changes = {"tracks": tracks}, {"duration": 121.0}, {"tasks": {}}, {"first_seed": 8}
    assert len({Plan(**{**values, **change}).digest for change in changes} | {plan.digest}) == 5


def test_floor_plans_are_found_by_their_content(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file of that name with other content is not the floor plan; without it the rows are left out."""
    text = TINY.replace('"hall"]', f'"{FLOOR_PLANS}"]')
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
        worlds = {(t.world, t.seed) for t in plan.trials() if t.family == FLOOR_PLANS}
        assert worlds == ({("a.png", 7)} if is_there else set())
        assert FLOOR_PLANS not in {t.family for t in plan.trials(extent="base")}


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("seeds = 2", "", "seeds: expected a value, got 'none'"),
        ('"hall"', '"halls"', "world: expected one of 'office'"),
        ('"hall"', '"floor plans"', "floor_plans: expected names and digests, got 'none'"),
        ("duration", "length", "config: expected names among name, split, first_seed, duration"),
        ("robots = [1, 2]", "robots = [9]", "robots: expected an int from 1 to 8, got 9"),
        ("base = 1", "base = 3", "base: expected at most 2 seeds, got 3"),
        ("oracle_floor", "oracle_flour", "oracle_flour"),
        ("= [", "= ", "plan: expected a file in TOML"),
        ('name = "tiny"', 'name = "vslam-bench-v1"', "plan: expected another name for a changed plan"),
    ],
)
def test_bad_plans_are_refused(old: str, new: str, says: str, tmp_path: Path) -> None:
    """The error names the file and the field."""
    file = tmp_path / "bad.toml"
    file.write_text(TINY.replace(old, new, 1))
    with pytest.raises(ValueError, match=says) as error:
        Plan.load(str(file))
    assert str(file) in str(error.value)


# ------------------------------------------------------------------ runs


@pytest.mark.slow
def test_a_plan_is_resumed_and_tabulated(vslam: Any, run: Path, tiny: Path) -> None:
    """A killed run is resumed where it stopped, with the same rows; tables, CSV and Parquet have all of them."""
    first, tables = _rows(run), (run / "tables.md").read_text()
    assert len(first) == COUNT
    lines = (run / TRIALS_FILE).read_text().splitlines()
    (run / TRIALS_FILE).write_text("\n".join([*lines[:-2], lines[-2][:50]]))
    done = vslam("bench", "exploration", "--plan", str(tiny), "--out", str(run), "--workers", "2")
    assert done.status == 0
    assert f"{COUNT - 2} of {COUNT} trials are finished, 2 are left" in done.out
    assert {row["digest"] for row in _rows(run)} == {row["digest"] for row in first}
    for title in (
        "Mean of standard",
        "Track drive",
        "Maps, standard",
        "Driving, team",
        "What each limit costs, standard",
    ):
        assert f"### {title}" in tables
    found = list(csv.DictReader(io.StringIO((run / CSV).read_text())))
    assert [row["digest"] for row in found] == [row["digest"] for row in first]
    for row in first:
        parts = sum(row[f"squared_{name}"] for name in ("missed", "misplaced", "duplicate", "false"))
        if row["robots"] == 1:  # the mean of squares is the square of the mean of one robot alone
            assert parts == pytest.approx(row["map_error"] ** 2, abs=1e-9)
        assert row["nees"] is None or row["nees"] > 0.0
        assert 0.0 <= row["balance"] <= 1.0
    assert read_results(run).rows == read_episodes((run / CSV).read_bytes(), CSV)
    pytest.importorskip("pyarrow", reason="extra parquet is not installed")
    from pyarrow import parquet

    table = parquet.read_table(run / "episodes.parquet").to_pylist()
    assert {row["digest"] for row in table} == {row["digest"] for row in first}


def test_tracks_without_rows_are_named(run: Path, tiny: Path) -> None:
    """A table that is not there was not forgotten."""
    plan, rows = Plan.load(str(tiny)), _rows(run)
    others = ", ".join(name for name in plan.all_tracks if name != "standard")
    only = [row for row in rows if row["track"] == "standard"]
    assert f"Tracks without rows: {others}." in markdown(plan, only, ())
    assert "Tracks without rows" not in markdown(plan, rows, ())


@pytest.mark.slow
def test_tracks_and_parts_of_a_plan_are_chosen(vslam: Any, tiny: Path, tmp_path: Path) -> None:
    """Tracks by name, the base part alone, and wrong names and combinations in one line."""
    command = ("bench", "exploration", "--plan", str(tiny), "--policies", "random_walk")
    assert vslam(*command, "--base", "--out", str(tmp_path / "base")).status == 0
    assert {(row["track"], row["seed"]) for row in _rows(tmp_path / "base")} == {("standard", 7)}
    assert vslam(*command, "--tracks", "team", "--quick", "--out", str(tmp_path / "team")).status == 0
    assert {(row["track"], row["robots"]) for row in _rows(tmp_path / "team")} == {("team", 1), ("team", 2)}
    assert read_results(tmp_path / "base").rows
    done = vslam("bench", "leaderboard", str(tmp_path / "team"), "--out", str(tmp_path / "page.md"))
    assert "folders: expected complete results, got" in done.err
    assert "Play the base part in a new folder: --base --out NEW." in done.err
    for options, says in (
        (("--tracks", "teams"), "tracks: expected one of 'standard', 'team', got 'teams'"),
        (("--base", "--quick"), "base: expected no value with --quick"),
        (("--rows", "3"), "rows: expected no value without --verify, got 3"),
    ):
        assert says in vslam(*command, *options).err
    assert "tracks: expected a plan with it" in vslam("bench", "exploration", "--tracks", "team").err


@pytest.mark.slow
def test_episodes_are_played_again(vslam: Any, run: Path) -> None:
    """The same numerics give the same bits; a changed digest is found, and with other versions a changed number."""

    def outcomes() -> dict[str, list[int]]:
        return verification.replayed(run, kept_episodes(run) or [])

    verify = "bench", "exploration", "--verify", str(run)
    assert vslam(*verify).status == 0
    kept = [json.loads(line) for line in (run / verification.VERIFIED_FILE).read_text().splitlines()]
    assert [row["is_equal"] for row in kept] == [True, True]  # a tenth, rounded up
    assert outcomes() == {"frontier": [1, 0, 0], "random_walk": [1, 0, 0]}
    changed = [json.dumps({**row, "policy_digest": "0" * 16}) for row in _rows(run)]
    (run / TRIALS_FILE).write_text("\n".join(changed) + "\n")
    assert "The file of frontier" in vslam(*verify, "--rows", "1").out
    for change in ({"digest": "0" * 32}, {"map_error": 0.02}):
        forged = [json.dumps({**row, **change}) for row in _rows(run)]
        (run / TRIALS_FILE).write_text("\n".join(forged) + "\n")
        assert vslam(*verify, "--rows", "1").status == 1
    damaged = [{name: value for name, value in row.items() if name != "map_error"} for row in map(json.loads, forged)]
    (run / TRIALS_FILE).write_text("\n".join(map(json.dumps, damaged)) + "\n")
    assert "out: expected a trial in each line, got a damaged line 1" in vslam(*verify).err
    for name in (TRIALS_FILE, verification.VERIFIED_FILE):
        (run / name).unlink()  # kept results have compressed rows alone
    rows = (run / CSV).read_text().replace(machine_module.PACKAGES[0], "another package")
    (run / CSV).unlink()
    (run / PACKED).write_bytes(gzip.compress(rows.encode()))
    done = vslam(*verify, "--rows", "1")
    assert done.status == 0
    assert "Other numerics or versions" in done.out
    assert outcomes() == {"frontier": [0, 1, 0], "random_walk": [0, 1, 0]}
    (run / verification.VERIFIED_FILE).unlink()
    (run / PACKED).write_bytes(gzip.compress(_changed(rows, map_error=lambda text: str(1.001 * float(text))).encode()))
    assert vslam(*verify, "--rows", "1").status == 0  # allowed elsewhere
    assert outcomes() == {"frontier": [0, 0, 1], "random_walk": [0, 0, 1]}
    (run / verification.VERIFIED_FILE).write_text("garbage\n")
    assert "verify: expected a comparison in each line, got a damaged line 1" in vslam(*verify).err


@pytest.mark.slow
def test_the_leaderboard_is_made_from_kept_results(vslam: Any, run: Path, tiny: Path, tmp_path: Path) -> None:
    """Compressed results suffice; a policy in two folders counts once; tracks that are not finished are left out."""
    kept = tmp_path / "kept"
    kept.mkdir()
    (kept / "config.toml").write_text((run / "config.toml").read_text())
    (kept / "plan.toml").write_text(tiny.read_text())
    (kept / PACKED).write_bytes(gzip.compress((run / CSV).read_bytes()))
    page = tmp_path / "leaderboard.md"
    assert vslam("bench", "leaderboard", str(kept), "--out", str(page)).status == 0
    text = page.read_text()
    assert text.startswith("# Leaderboard of exploration policies\n")
    assert "](leaderboard.png)" in text
    assert text.count("| claimed |") == 2
    with Image.open(tmp_path / "leaderboard.png") as figure:
        assert min(figure.size) > 400
    for section in (run / "tables.md").read_text().split("### ")[1:]:
        assert " ".join(section.split()) in " ".join(text.split())  # lines may end elsewhere
    assert vslam("bench", "leaderboard", str(kept), str(run), "--out", str(page)).status == 0
    assert page.read_text() == text
    lines = (run / CSV).read_text().splitlines(keepends=True)
    team = next(k for k, line in enumerate(lines) if line.startswith("team,frontier,"))
    (kept / PACKED).write_bytes(gzip.compress("".join(lines[:team] + lines[team + 1 :]).encode()))
    assert vslam("bench", "leaderboard", str(kept), "--out", str(page)).status == 0
    (section,) = (part for part in page.read_text().split("### ") if part.startswith("Maps, team"))
    assert "random_walk" in section
    assert "frontier" not in section
    assert vslam("bench", "exploration", "--verify", str(run)).status == 0
    assert vslam("bench", "leaderboard", str(run), "--out", str(page)).status == 0
    assert page.read_text().count("| replayed |") == 2
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


@pytest.mark.slow
def test_submissions_hold_what_a_row_needs(
    vslam: Any, tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows, configuration, plan and policy are packed with digests, and make a row; a changed policy is refused."""
    source = "class Still:\n    def reset(self): pass\n    def act(self, observation, belief, rng): return 0\n"
    (tmp_path / "still_policy.py").write_text(source)
    monkeypatch.chdir(tmp_path)
    run = ("bench", "exploration", "--plan", str(tiny), "--policies", "mine=still_policy:Still", "--base")
    assert vslam(*run, "--out", "run").status == 0
    assert vslam("bench", "submit", "run", "--out", "entry").status == 0
    card = tomllib.loads(Path("entry/submission.toml").read_text())
    assert card["policies"]["mine=still_policy:Still"]["file"] == "still_policy.py"
    for name, known in card["files"].items():
        assert hashlib.sha256((Path("entry") / name).read_bytes()).hexdigest() == known
    assert set(card["files"]) == {"config.toml", "plan.toml", PACKED, "still_policy.py"}
    assert read_results(Path("entry")).rows == read_results(Path("run")).rows
    assert vslam("bench", "leaderboard", "entry", "--out", "page.md").status == 0
    assert "out: expected a new or empty folder" in vslam("bench", "submit", "run", "--out", "entry").err
    Path("still_policy.py").write_text(source + "# changed\n")
    done = vslam("bench", "submit", "run", "--out", "other")
    assert "folder: expected the file of 'mine' as it was played" in done.err
    assert not Path("other").exists()
    sys.modules.pop("still_policy", None)


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


# ------------------------------------------------------------------ rows that others wrote


def _row(policy: str, family: str, seed: int, **values: Any) -> dict[str, Any]:
    """Return a row of the standard track in which all metrics are one half."""
    about = {
        "track": "standard", "policy": policy, "family": family, "world": family, "robots": 3, "relaxation": "none",
        "seed": seed, "action_type": "goal", "task": "",
        "digest": hashlib.sha256(repr((policy, family, seed)).encode()).hexdigest()[:32],
        "policy_digest": "", "version": "0.3.0", "machine": machine_module.machine(), "refusals": {},
    }  # fmt: skip
    numbers = {name: {int: 1, float: 0.5, bool: True}[f.kind] for name, f in FIELDS.items() if f.kind is not str}
    return {name: value for name, value in (numbers | about | values).items() if not name.startswith("refused: ")}


def _changed(text: str, line: int | None = None, **cells: Any) -> str:
    """Return a table of episodes in which functions changed some cells, of one line or of all."""
    head, *rows = csv.reader(io.StringIO(text))
    for name, change in cells.items():
        column = head.index(name)
        for k, row in enumerate(rows, start=2):
            if line in (None, k):
                row[column] = change(row[column])
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows([head, *rows])
    return out.getvalue()


def test_rows_survive_csv_and_parquet(tmp_path: Path) -> None:
    """Reading what was written gives the same rows: texts, numbers, refusals, unknown values."""
    rows = [
        _row("frontier", "office", 0, refusals={"ambiguous": 2}, nees=None, digest="1" * 32),
        _row("mine=a:B", "maze", 1, refusals={"mirrored": 1}, map_error=1e-5, digest="12e4" * 8, policy_digest="ab"),
    ]
    assert read_episodes(episodes_csv(rows).encode(), CSV) == rows
    if write_parquet(tmp_path / "episodes.parquet", rows):
        from pyarrow import parquet

        assert parquet.read_table(tmp_path / "episodes.parquet").to_pylist() == tidy_rows(rows)


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("map_error", "nan", "a number from 0 to 10 as 'map_error' in line 3, got 'nan'"),
        ("map_error", "-inf", "a number from 0 to 10 as 'map_error' in line 3, got '-inf'"),
        ("map_error", "-5", "a number from 0 to 10 as 'map_error' in line 3, got '-5'"),
        ("way_m", "inf", "a number >= 0 as 'way_m' in line 3, got 'inf'"),
        ("map_recall", "1.01", "a number from 0 to 1 as 'map_recall' in line 3, got '1.01'"),
        ("seed", "1" * 5000, "an int >= 0 as 'seed' in line 3"),
        ("robots", "3.0", "an int from 1 to 8 as 'robots' in line 3, got '3.0'"),
        ("one_group", "yes", "True or False as 'one_group' in line 3, got 'yes'"),
        ("below_50_s", "", "a number >= 0 as 'below_50_s' in line 3, got ''"),
        ("machine", "a\x1b[2J", "a text of at most 300 printable characters as 'machine' in line 3"),
        ("machine", "x" * 400, "a text of at most 300 printable characters as 'machine' in line 3"),
    ],
)
def test_values_out_of_range_cost_one_line(name: str, text: str, expected: str) -> None:
    """The error names file, line, column and range."""
    table = episodes_csv([_row("frontier", "office", seed) for seed in range(3)])
    with pytest.raises(ValueError, match="folders: expected ") as error:
        read_episodes(_changed(table, 3, **{name: lambda _: text}).encode(), "rows.csv")
    assert expected in str(error.value)
    assert "rows.csv" in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"policy\nfrontier\n", "a column 'track' in the first line, got 'none'"),
        (b"", "a column 'track' in the first line, got 'none'"),
        (b"HEAD,x,y\n", "only columns of an episode, each once, in the first line, got 'x'"),
        (b"HEAD,track\n", "only columns of an episode, each once, in the first line, got 'track'"),
        (b"\xff\xfe", "a table of episodes"),
        (b'"', "a table of episodes"),
        (b"x" * 200_000, "a table of episodes"),
        (b"HEAD\n1,2\n", r"\d+ values in line 2, got 2"),
        (b"HEAD\n\n", r"\d+ values in line 2, got 0"),
    ],
)
def test_damaged_tables_cost_one_line(content: bytes, expected: str) -> None:
    """Whatever the bytes are, the error says what a table of episodes is."""
    with pytest.raises(ValueError, match=f"folders: expected {expected}"):
        read_episodes(content.replace(b"HEAD", ",".join(FIELDS).encode()), "rows.csv")


def test_packed_files_are_bounded(tmp_path: Path) -> None:
    """A small file that unpacks to more than the limit, a cut one, and none that is packed are refused at once."""
    file = tmp_path / PACKED
    whole = gzip.compress(bytes(MOST_BYTES + 10), 9)
    assert len(whole) < MOST_BYTES // 500
    for content, says in (
        (whole, "a file of at most 64 MiB, got a larger one"),
        (whole[:5000], "a whole file of episodes, got a damaged one"),
        (b"not packed", "a whole file of episodes, got a damaged one"),
    ):
        file.write_bytes(content)
        with pytest.raises(ValueError, match=says):
            kept_episodes(tmp_path)


def test_fields_have_words_for_their_ranges() -> None:
    """Each kind says what it takes."""
    assert Field(int, 1, 8).expected == "an int from 1 to 8"
    assert Field(float).expected == "a number >= 0"
    assert Field(float, may_lack=True).parsed("") is None


@pytest.fixture
def forged(tiny: Path, tmp_path: Path) -> Any:
    """Function that writes a folder of rows of both policies of the tiny plan, and reads its results."""
    plan = Plan.load(str(tiny))
    rows = [
        _row(
            trial.policy, trial.family, trial.seed, track=trial.track, robots=trial.robots,
            task=plan.task_of(trial) or "", relaxation=trial.relaxation,
            digest=hashlib.sha256(repr(trial).encode()).hexdigest()[:32],
        )
        for trial in plan.trials()
    ]  # fmt: skip
    folder = tmp_path / "forged"
    folder.mkdir()
    (folder / "plan.toml").write_text(tiny.read_text())
    config = f'command = "bench exploration"\nseed = 0\n[config]\nplan = "tiny"\nplan_hash = "{plan.digest}"\n'
    (folder / "config.toml").write_text(config)

    def read(change: Any = lambda rows: rows, verified: str = "") -> Results:
        (folder / CSV).write_text(episodes_csv(change([dict(row) for row in rows])))
        (folder / verification.VERIFIED_FILE).write_text(verified)
        return read_results(folder)

    return read


def test_rows_must_be_those_of_the_plan(forged: Any) -> None:
    """Repeated, relabelled, missing and foreign episodes, other tasks, and several versions are refused."""

    def with_last(**values: Any) -> Any:
        return lambda rows: [*rows[:-1], {**rows[-1], **values}]

    assert len(forged().rows) == COUNT
    for change, says in (
        (lambda rows: [rows[0], *rows], "expected each episode once"),
        (lambda rows: [rows[0], *rows[2:], rows[0]], "expected each episode once"),
        (lambda rows: [{**rows[0], "seed": row["seed"], "policy": row["policy"]} for row in rows], "expected"),
        (lambda rows: [*rows[:2], {**rows[2], "digest": rows[0]["digest"]}, *rows[3:]], "expected each episode once"),
        (lambda rows: rows[2:], "expected complete results"),
        (lambda rows: [], "expected results of a plan"),
        (with_last(seed=9), "expected episodes of the plan"),
        (with_last(world="maze"), "expected episodes of the plan"),
        (with_last(track="hard"), "expected episodes of the plan"),
        (with_last(robots=8), "expected episodes of the plan"),
        (lambda rows: [{**rows[0], "task": "0" * 8}, *rows[1:]], "expected an episode with the task"),
        (with_last(version="0.2.9"), "expected one version for each policy"),
        (lambda rows: [{**row, "version": "999.0"} for row in rows], "expected results up to version"),
    ):
        with pytest.raises(ValueError, match=f"folders: {says}"):
            forged(change)


def test_invented_comparisons_do_not_count(forged: Any) -> None:
    """Lines of other rows, of rows that say something else by now, or of another command verify nothing.

    Damaged lines are named.
    """
    rows = forged().rows
    good = {"date": "2026-01-01", "by": f"{verification.COMMAND} 0.3.0", "is_equal": True, "is_close": True}
    lines = [{**good, "policy": "frontier", "digest": f"{k:032x}", "row": "0"} for k in range(5000)]
    of_rows = [{**good, "policy": row["policy"], "digest": row["digest"], "row": row_digest(row)} for row in rows]
    lines += [{**line, "by": "my own program"} for line in of_rows]
    lines += [{**line, "policy": "tare"} for line in of_rows]
    better = [{**row, "map_error": 0.5 * row["map_error"]} for row in rows]
    lines += [{**line, "row": row_digest(row)} for line, row in zip(of_rows, better, strict=True)]
    assert forged(verified="\n".join(map(json.dumps, lines))).again == {}
    lines = [line for line in of_rows for _ in range(3)]
    text = "\n".join(map(json.dumps, lines))
    counts = forged(verified=text).again
    assert counts == {"frontier": [COUNT - 6, 0, 0], "random_walk": [6, 0, 0]}
    for line in ("{", "[]", "3", '{"digest": 3}', json.dumps({**lines[0], "is_close": "yes"}), "[" * 10_000):
        with pytest.raises(ValueError, match="folders: expected a comparison in each line, got a damaged line 2"):
            forged(verified=f"{json.dumps(lines[0])}\n{line}\n")


def test_texts_of_others_are_shown_as_they_are(forged: Any) -> None:
    """A name of a machine or a policy with HTML or table marks changes nothing on the page."""
    results = forged(lambda rows: [{**row, "machine": "<script>alert(1)</script> | `x`"} for row in rows])
    page = leaderboard([results], "leaderboard.png")
    assert "<script>" not in page
    assert "&lt;script&gt;alert(1)&lt;/script&gt; &#124; &#96;x&#96;" in page


def test_the_latest_version_is_shown_and_older_ones_are_named(forged: Any) -> None:
    """Rows of an older version are not compared with later ones; the latest of two folders counts."""
    now, older = forged(), forged(lambda rows: [{**row, "version": "0.2.9"} for row in rows])
    assert {row["version"] for row in played_rows([older, now])} == {"0.3.0"}
    part = Results(older.plan, [row for row in older.rows if row["policy"] == "random_walk"], {})
    other = Results(now.plan, [row for row in now.rows if row["policy"] == "frontier"], {})
    page = leaderboard([part, other], "leaderboard.png")
    assert "Older: `random_walk`, played by version 0.2.9." in page
    assert "| random" not in page


# ------------------------------------------------------------------ tables and statistics


def test_policies_are_ordered_and_compared_with_the_first() -> None:
    """The best map comes first; differences are paired, to the plan's first policy."""
    plan = Plan.load("vslam-bench-v1")
    rows = [
        _row(policy, family, 5000 + seed, map_error=0.125 * seed + more, track=track)
        for policy, more in (("random_walk", 0.0625), ("frontier", 0.0))
        for track in ("standard", "hard")
        for family in ("office", "maze")
        for seed in range(4)
    ]

    def cells_of(rows: list[dict[str, Any]]) -> dict[str, list[list[str]]]:
        lines = {table.name: (table, table.lines(ordered(plan, rows))) for table in tables(plan, rows)}
        return {name: list(map(table.cells, own)) for name, (table, own) in lines.items()}

    found = cells_of(rows)
    assert [cells[0] for cells in found["headline"]] == ["frontier", "random_walk"]
    assert found["headline"][0][1].startswith("18.8 (")
    assert found["headline"][0][2] == "-"
    assert found["headline"][1][2] == "6.2 (6.2 .. 6.2)"
    assert found["goal"] == found["headline"]
    assert found["drive"] == []
    assert cells_of([row for row in rows if row["track"] == "hard"])["headline"] == []  # no mean over both tracks
    text = markdown(plan, rows, ("frontier", "tare"))
    assert "`frontier` has 16 of 240 episodes of the base part" in text
    assert "`tare` has 0 of 240 episodes of the base part" in text  # all have failed
    late = [{**row, "seed": row["seed"] + 30, "map_error": 0.7} for row in rows]
    whole = cells_of(rows + late)
    assert whole["headline"] == found["headline"]  # of the base part alone
    assert whole["maps"] != found["maps"]


def test_relaxed_limits_are_compared_in_the_same_worlds() -> None:
    """The difference of a relaxation is that to the same policy in the same worlds, whatever else it played."""
    plan = Plan.load("vslam-bench-v1")
    rows = [_row("next_best_view@continuous", "office", 5000 + k, map_error=0.25 + 0.0625 * k) for k in range(8)]
    rows += [{**row, "relaxation": "floor", "map_error": row["map_error"] - 0.125} for row in rows[2:5]]
    (limits,) = (table for table in tables(plan, rows) if table.name == "limits")
    assert [limits.cells(line) for line in limits.lines(rows)] == [
        ["known floor plan", "3", "31.2 (25.0 .. 37.5)", "-12.5 (-12.5 .. -12.5)"]
    ]


def test_stratified_intervals_hold_their_level() -> None:
    """Of 95 % intervals of the mean over two strata of 30 worlds, about 95 % contain the true mean."""
    rng = np.random.default_rng(3)
    held = 0
    for _ in range(200):
        _, low, high = mean_with_interval([rng.normal(1.0, 1.0, 30), rng.normal(3.0, 2.0, 30)], 400)
        held += low <= 2.0 <= high
    assert (
        176 <= held <= 198
    )  # binomial with p = .95 lies within in all but .1 % of the cases; bootstrap is a bit short
    assert np.isnan(mean_with_interval([np.ones(1)])[1])
    assert mean_with_interval([np.ones(3), np.full(9, 3.0)])[0] == 2.0  # strata count alike


def test_profiles_are_shares_below_thresholds() -> None:
    """Strata count alike, whatever their number of worlds."""
    profile = performance_profile([np.array([0.1, 0.3]), np.array([0.9])], np.array([0.0, 0.2, 0.5, 1.0]))
    np.testing.assert_allclose(profile, [0.0, 0.25, 0.5, 1.0])
