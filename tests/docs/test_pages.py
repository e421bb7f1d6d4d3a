"""Programs on the pages run as written."""

import re
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"
BLOCK = re.compile(r"^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)
EXPECTED = {
    "how-to/environment.md": r"^$",
    "how-to/own_world.md": r"rooms 7 walls, \d+ observable landmarks",
    "how-to/own_reward.md": r"\S+ 0\.0\n$",
    "how-to/own_policy.md": r"\d+% of the floor seen, map error 0\.\d\d m",
    "how-to/own_log.md": r"^door at 2\.9, 0\.9 m\ndesk at -0\.\d, 1\.8 m\nlamp at 0\.3, -4\.0 m\n$",
    "tutorials/first_episode.md": r"landmarks, pose(.|\n)*'merge', \(0,\), \(1,\)",
    "tutorials/first_filter.md": r"\(\)\ngroups \(\(0, 1\),\) .*: \[-1\.0, -?0\.0, -?0\.0\]\n$",
}


def _programs(page: str) -> list[str]:
    return BLOCK.findall((DOCS / page).read_text(encoding="utf-8"))


@pytest.mark.parametrize("page", EXPECTED)
def test_programs_run_as_written(
    page: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each program of a page runs by itself; the last one prints the topic of the page; none is long."""
    monkeypatch.chdir(tmp_path)  # output of a program is removed
    programs = _programs(page)
    assert programs
    for program in programs:
        lines = [line for line in program.splitlines() if line.strip() and not line.startswith(("import", "from"))]
        assert len(lines) <= 26
        exec(compile(program, page, "exec"), {"__name__": "__page__"})
    assert re.search(EXPECTED[page], capsys.readouterr().out)
