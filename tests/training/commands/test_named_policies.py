"""Custom policies in files of others: nothing of them is imported unless the command line names it."""

import json
import re
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from training.bench import exploration

POLICY = """
from pathlib import Path
Path("was_imported").touch()

class Still:
    action_type = "continuous"
    def reset(self): pass
    def act(self, observation, belief, rng): return [0.0, 0.0]
"""
FEW = ("--world", "fig5", "--robots", "1", "--particles", "5", "--max-cycles", "3", "--no-video")
BENCH = ("bench", "exploration")
SMALL = ("--worlds", "fig5", "--robots", "1", "--oracles", "none", "--seeds", "1", "--max-seconds", "1")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Yield the current folder, which has a module with a policy."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "strange_still.py").write_text(POLICY, encoding="utf-8")
    yield tmp_path
    sys.modules.pop("strange_still", None)


def _forgotten(folder: Path) -> None:
    sys.modules.pop("strange_still", None)
    (folder / "was_imported").unlink()


def test_a_configuration_imports_no_policy_that_is_not_named(folder: Path, vslam: Any) -> None:
    """The error has the complete command, which then repeats the run."""
    run = ("run", *FEW, "--policy", "strange_still:Still", "--out", "first")
    assert vslam(*run).status == 0
    _forgotten(folder)
    repeat = ("run", "--config", "first/config.toml", "--no-video", "--out", "sec ond")
    refused = vslam(*repeat)
    assert (refused.status, refused.out) == (2, "")
    (line,) = refused.err.splitlines()
    assert line.startswith("error policy: expected custom policies that the command line names, too")
    assert not (folder / "was_imported").exists()
    command = shlex.split(line.partition("run it with: ")[2])
    assert command == ["vslam", *repeat, "--policy", "strange_still:Still"]
    assert vslam(*command[1:]).status == 0
    assert (folder / "was_imported").exists()
    first, second = (json.loads((folder / name / "metrics.json").read_text()) for name in ("first", "sec ond"))
    assert first["robots"] == second["robots"]
    _forgotten(folder)
    assert vslam(*repeat[:-1], "third", "--policy", "frontier").status == 0  # another one replaces it
    assert not (folder / "was_imported").exists()


@pytest.mark.slow
@pytest.mark.parametrize("label", ["strange_still:Still", "mine=strange_still:Still@continuous"])
def test_trials_import_no_policy_that_is_not_named(label: str, folder: Path, vslam: Any) -> None:
    """Verified and repeated benchmarks name their custom policies again, with their labels or without."""
    assert vslam(*BENCH, "--policies", f"frontier,{label}", *SMALL, "--out", "bench").status == 0
    _forgotten(folder)
    for arguments in (
        ("--verify", "bench"),
        ("--config", "bench/config.toml"),
        ("--verify", "bench", "--policies", "frontier"),
    ):
        refused = vslam(*BENCH, *arguments)
        assert refused.status == 2
        assert "policies: expected custom policies that the command line names" in refused.err
        assert refused.err.rstrip().endswith(f"--policies frontier,{label}")
        assert not (folder / "was_imported").exists()
    assert vslam(*BENCH, "--verify", "bench", "--policies", "strange_still:Still").status == 0
    assert (folder / "was_imported").exists()


def test_a_plan_imports_no_policy_that_is_not_named(folder: Path, vslam: Any) -> None:
    """A plan of another person does not choose what is imported, until the command line names it, too."""
    text = (Path(exploration.__file__).parent / "plans" / "vslam-bench-v1.toml").read_text(encoding="utf-8")
    plan = re.sub(r"(?ms)^policies = \[.*?^\]", 'policies = ["frontier", "strange_still:Still"]', text, count=1)
    assert "strange_still" in plan
    (folder / "plan.toml").write_text(plan, encoding="utf-8")
    refused = vslam(*BENCH, "--plan", "plan.toml", "--quick")
    assert refused.status == 2
    assert refused.err.rstrip().endswith("--plan plan.toml --quick --policies frontier,strange_still:Still")
    assert not (folder / "was_imported").exists()


@pytest.mark.slow
def test_rows_import_no_policy_that_is_not_named(folder: Path, vslam: Any) -> None:
    """Rows of a folder that is resumed or verified do not choose what is imported."""
    assert vslam(*BENCH, "--policies", "frontier", *SMALL, "--out", "bench").status == 0
    trials = folder / "bench" / "trials.jsonl"
    row = json.loads(trials.read_text().splitlines()[0]) | {"policy": "strange_still:Still"}
    trials.write_text(json.dumps(row) + "\n")
    vslam(*BENCH, "--policies", "frontier", *SMALL, "--out", "bench")
    assert not (folder / "was_imported").exists()
    trials.write_text(json.dumps(row) + "\n")
    assert vslam(*BENCH, "--verify", "bench").status != 0
    assert not (folder / "was_imported").exists()
