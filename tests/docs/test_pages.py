"""Programs on the pages run as written."""

import re
from pathlib import Path

import numpy as np
import pytest

from agents import make_policy
from vslam_env import vslam_v0

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
        exec(compile(program, page, "exec"), {"__name__": "__main__"})
    assert re.search(EXPECTED[page], capsys.readouterr().out)


def test_the_planner_of_a_page_is_found_by_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The planner of the page, saved under the name that the page gives, is a policy of the command line."""
    (tmp_path / "look_again.py").write_text(_programs("how-to/own_policy.md")[0], encoding="utf-8")
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
