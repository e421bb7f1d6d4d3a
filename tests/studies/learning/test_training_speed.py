"""Study of training speed: parts, numbers of workers, and the program."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch", reason="torch is not installed: pip install .[train]")
pytest.importorskip("sb3_contrib", reason="sb3-contrib is not installed: pip install .[train]")

from studies.learning import speed
from studies.learning.speed import PARTS, STUDY, Config, Trial, WorkerTimes, play, trials


def test_workers_are_compared_with_one_step_by_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """Gain and work are medians of each step relative to one worker; balance is mean over slowest."""
    alone = WorkerTimes(
        masks=np.array([0.0, 0.0, 1.0]), steps=np.array([4.0, 6.0, 3.0]),
        spent=np.array([[[4.0, 3.0]], [[5.0, 4.0]], [[3.0, 2.0]]]),
    )  # fmt: skip
    two = WorkerTimes(
        masks=np.array([0.5, 0.0, 0.0]), steps=np.array([1.5, 5.0, 2.5]),
        spent=np.array([[[1.0, 1.0], [1.25, 2.0]], [[2.0, 3.0], [4.5, 3.0]], [[1.5, 1.0], [2.0, 1.0]]]),
    )  # fmt: skip
    asked: list[tuple[int, ...]] = []
    monkeypatch.setattr(speed, "time_workers", lambda config, counts: asked.append(counts) or (two, alone))
    row = play(Config(envs=4, robots=3), Trial(part="workers", workers=2)) | {"workers": 2}
    assert asked == [(2, 1)]
    assert row["balance"] == 1.0  # 3/4, 1, 1
    assert row["work"] == pytest.approx(1.0)  # 3/3, 6/4, 2/2
    assert row["beside_us"] == pytest.approx(1e6 / 12 * 0.5)  # 1/4, 1/2, 1/2
    assert row["rate"] == pytest.approx(36 / 9.5)
    (line,) = STUDY.tables[1].lines([row])
    assert line["speedup"] == pytest.approx((1.6, 1.2, 2.0))  # 4/2, 6/5, 4/2.5
    assert (line["median"].value, line["fastest"].value) == pytest.approx((12 / 2.5, 12 / 2.0))


@pytest.mark.parametrize(("values", "match"), [
    ({"envs": 1, "workers": (2,)}, "workers: expected at most one per environment, 1, got 2"),
    ({"world": "castle"}, "world: expected one of 'office'"),
])  # fmt: skip
def test_what_cannot_be_timed_is_refused(values: dict[str, object], match: str) -> None:
    """Too many workers, and worlds that do not exist."""
    with pytest.raises(ValueError, match=match):
        Config(**values)


@pytest.mark.slow
def test_the_program_times_all_parts(tmp_path: Path) -> None:
    """The tables have all parts of a decision, and the rates over workers."""
    out = tmp_path / "run"
    program = [sys.executable, "-m", "studies.learning.speed", "--world", "fig5", "--robots", "1", "--envs", "1"]
    program += ["--workers", "0", "--steps", "3", "--out", str(out)]
    subprocess.run(program, capture_output=True, check=True)
    tables = json.loads((out / "metrics.json").read_text())["tables"]
    assert [line["part"] for line in tables["parts"]] == list(PARTS)
    assert [line["workers"] for line in tables["workers"]] == [0]
    assert len((out / "trials.jsonl").read_text().splitlines()) == len(trials(Config(workers=(0,))))
