"""Code blocks on pages run as written, and give the output that the page shows."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest

from agents import make_policy
from tests.docs.blocks import FENCE, PAGES, ROOT, alike, blocks, call, commands
from tests.regression.recorded_digests import recorded
from vslam_env import vslam_v0

# Pages that take more than a few seconds
SLOW = (
    "docs/how-to/training.md",
    "docs/how-to/own_study.md",
    *(f"docs/tutorials/{stem}.md" for stem in ("reinforcement_learning", "own_planner")),
)
NEEDS = {
    "docs/how-to/training.md": "stable_baselines3",
}
IS_RECORDED = recorded() is not None  # numbers on pages are those of the libraries and numerics of the digests
KINDS = {"python", "console", "text", "sh", "toml"}
FOOTER = re.compile(r"^\*[^*]+\*$", re.MULTILINE)  # of a table of figures
ORIGIN = re.compile(r"\b202\d-\d\d-\d\d\b|\d [A-Z][a-z]+ 202\d\b|\bcommit [0-9a-f]{7}|\bZen \d|\bGHz\b")


def name(page: Path) -> str:
    """Return the path of a page in the repository."""
    return page.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_every_block_runs_or_says_why_not(page: Path) -> None:
    """A block is a program, commands with their output, a text, or has a comment `not run: REASON` above it."""
    for block in blocks(page):
        assert block.kind in KINDS, f"a block without a kind: {block.text[:60]!r}"
        if block.kind != "text":
            assert block.runs or block.why, f"a block that is not run, without a reason: {block.text[:60]!r}"
        if block.runs and block.kind == "console":
            assert block.text.startswith("$ ")


@pytest.mark.parametrize("page", [*PAGES, ROOT / "CHANGELOG.md"], ids=name)
def test_lines_are_short(page: Path) -> None:
    """Lines have at most 120 columns, outside of code, tables and pictures."""
    lines = FENCE.sub("", page.read_text(encoding="utf-8")).splitlines()
    assert [line for line in lines if len(line) > 120 and not line.startswith(("|", "!["))] == []


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_dates_of_figures_stand_below_tables(page: Path) -> None:
    """Running text names no dates, commits or processors: pages have current figures."""
    assert ORIGIN.findall(FOOTER.sub("", FENCE.sub("", page.read_text(encoding="utf-8")))) == []


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, id=name(page), marks=[pytest.mark.slow] if name(page) in SLOW else [])
        for page in PAGES
        if any(block.runs for block in blocks(page))
    ],
)
def test_blocks_run_as_written(
    page: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The blocks of a page run in their order in one empty folder; no program is long.

    Where libraries and numerics are those of the recorded digests, numbers of their output count, too, unless a comment
    `numbers vary: REASON` above the block says that they depend on more.
    """
    if name(page) in NEEDS:
        pytest.importorskip(NEEDS[name(page)], reason="stable-baselines3 is not installed: pip install .[train]")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    before = set(sys.modules)
    for block in blocks(page):
        if not block.runs:
            continue
        if block.kind == "python":
            lines = filter(str.strip, block.text.splitlines())
            assert sum(not line.startswith(("import", "from", "#")) for line in lines) <= 26
            if file := re.match(r"# (\w+\.py)\n", block.text):
                Path(file[1]).write_text(block.text, encoding="utf-8")
            monkeypatch.setattr(sys, "argv", ["page.py"])
            try:
                exec(compile(block.text, str(page), "exec"), {"__name__": "__main__"})
            except SystemExit as end:  # of a program with a command line
                if end.code:
                    raise
            given = [(block.text[:60], block.output or "...", capsys.readouterr().out)]
        else:
            given = []
            for command, expected in commands(block.text):
                call(command, monkeypatch)
                said = capsys.readouterr()
                given.append((command, expected or "...", said.out + said.err))
        for what, expected, got in given:
            exact = IS_RECORDED and not block.varies
            assert alike(expected, got, exact), f"{what}\nexpected:\n{expected}\ngot:\n{got}"
    for module in set(sys.modules) - before:  # modules of the folder
        if str(tmp_path) in str(getattr(sys.modules[module], "__file__", "")):
            del sys.modules[module]


def test_the_planner_of_a_page_is_found_by_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The planner of the page, saved under the name that the page gives, is a policy of the command line."""
    program = blocks(ROOT / "docs" / "tutorials" / "own_planner.md")[0]
    assert program.text.startswith("# look_again.py\n")
    (tmp_path / "look_again.py").write_text(program.text, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    policy = make_policy("look_again:LookAgain", "goal")
    env = vslam_v0.parallel_env(world="office", num_robots=1, action_type="goal", max_cycles=3)
    observations, _ = env.reset(seed=0)
    for _ in range(2):
        action = policy.act(observations["robot_0"], env.belief("robot_0"), np.random.default_rng(0))
        observations = env.step({"robot_0": action})[0]
    candidates = env.belief("robot_0").candidates
    nearest = int(np.nanargmin(np.where(candidates.kinds == 0, candidates.lengths, np.nan)))
    assert policy.act(observations["robot_0"], env.belief("robot_0"), np.random.default_rng(0)) == 1 + nearest
