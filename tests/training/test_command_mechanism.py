"""What holds for every command that leaves a run folder: how it begins, shows its work, can be stopped, and ends."""

import io
import json
import signal
import tomllib
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pytest
import typer
from rich.console import Console

from training.commands import _progress as command_progress
from training.commands._progress import KeptPart, play_kept, share_shown, trials_shown
from training.commands._run_folder import begin, choose, finish, gather
from training.experiments.config import PlainConfig
from training.experiments.run_folder import RunFolder
from training.experiments.trial_store import open_folder


@dataclass(frozen=True, slots=True, kw_only=True)
class Numbers(PlainConfig):
    """What the command `count` is told."""

    few: int = 1
    many: int = 10
    path: str = ""
    seed: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """A trial."""

    seed: int


def play(trial: Trial) -> dict[str, Any]:
    """Square its seed."""
    return asdict(trial) | {"square": trial.seed**2}


def _part(seeds: range, play: Callable[[Trial], dict[str, Any]], file: str = "trials.jsonl") -> KeptPart:
    return KeptPart(
        file=file, kind=Trial, play=play, trials=[Trial(seed=seed) for seed in seeds],
        tell=lambda row: f"seed {row['seed']}", cost=lambda trial: 1 + trial.seed,
    )  # fmt: skip


def _console() -> Console:
    return Console(file=io.StringIO(), width=200, record=True)


def test_what_is_given_goes_above_quick_and_quick_above_a_file(tmp_path: Path) -> None:
    """Each value comes from the option, else from what --quick says, else from the earlier run, else from the class."""
    RunFolder.create(tmp_path / "run", "count", {"few": 2, "many": 20}, 5)
    common: dict[str, Any] = {"config": tmp_path / "run", "json": None, "out": None}
    chosen = choose(Numbers, "count", {"few": None, "seed": None}, quick={"many": 3}, **common)
    assert (chosen.few, chosen.many, chosen.seed) == (2, 3, 5)
    chosen = choose(Numbers, "count", {"few": 7, "many": 8, "seed": 0}, quick={"many": 3}, **common)
    assert (chosen.few, chosen.many, chosen.seed) == (7, 8, 0)
    with pytest.raises(ValueError, match="config: expected a run of 'other', got 'count'"):
        gather("other", {}, **common)


def test_logs_are_looked_for_below_the_folder_of_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A log that is not named is where VSLAM_DATA says; without that variable, or a log there, the error says so."""
    common: dict[str, Any] = {"config": None, "json": None, "out": None, "log": (Path("park"), "a park's log")}
    monkeypatch.setenv("VSLAM_DATA", str(tmp_path))
    with pytest.raises(ValueError, match=r"path: expected a park's log, got no such path\. Check '.*park'; if --path"):
        choose(Numbers, "count", {}, **common)
    for name in ("park", "mine"):
        (tmp_path / name).mkdir()
    assert choose(Numbers, "count", {}, **common).path == str(tmp_path / "park")
    monkeypatch.chdir(tmp_path)
    assert choose(Numbers, "count", {"path": Path("mine")}, **common).path == str(Path("mine").resolve())
    monkeypatch.delenv("VSLAM_DATA")
    with pytest.raises(ValueError, match="path: expected a park's log, got no --path"):
        choose(Numbers, "count", {}, **common)


def test_first_steps_come_before_the_folder(tmp_path: Path) -> None:
    """Work that shows bad input leaves no folder; a folder of the same run is taken up only where that is asked for."""
    out = tmp_path / "run"

    def refuse() -> None:
        raise ValueError("world: expected another")

    with pytest.raises(ValueError, match="world"):
        begin("count", Numbers(), out, refuse)
    assert not out.exists()
    _, folder = begin("count", Numbers(many=3), out, goes_on=True)
    assert tomllib.loads((out / "config.toml").read_text())["config"]["many"] == 3
    assert begin("count", Numbers(many=3), out, goes_on=True)[1] == folder
    with pytest.raises(ValueError, match="out: expected a new or empty folder, got a folder with files"):
        begin("count", Numbers(many=3), out)


@pytest.mark.parametrize("below", [False, True])
def test_a_folder_that_cannot_be_had_is_refused_before_any_work(below: bool, tmp_path: Path) -> None:
    """Nobody waits for the compiler to read that the folder is a file, or is to stand where a file is."""
    (tmp_path / "file").write_text("x")
    out, done = tmp_path / "file" / "run" if below else tmp_path / "file", []
    with pytest.raises(ValueError, match=r"out: expected a (new or empty folder|folder that can be written), got"):
        begin("count", Numbers(), out, lambda: done.append(1), goes_on=True)
    assert done == []


@pytest.mark.parametrize(("held", "status"), [([True, True], 0), ([True, False], 1), ([], 1)])
def test_check_turns_claims_that_fail_into_status_1(held: list[bool], status: int, tmp_path: Path) -> None:
    """With --check a claim that does not hold, or none at all, is status 1; the metrics are written either way."""
    folder = RunFolder.create(tmp_path / "run", "count", {}, 0)
    copy = tmp_path / "copy.json"
    metrics = folder.write_metrics({"found": 1})
    if status:
        with pytest.raises(typer.Exit) as end:
            finish(_console(), folder, metrics, copy, True, held)
        assert end.value.exit_code == status
    else:
        finish(_console(), folder, metrics, copy, True, held)
    finish(_console(), folder, metrics, copy, False, held)
    assert json.loads(copy.read_text()) == json.loads((tmp_path / "run" / "metrics.json").read_text())


def test_a_stopped_command_says_how_to_go_on_and_does(tmp_path: Path) -> None:
    """Ctrl-C ends after the trial under way; called again only the rest is played, and rows come in order of trials."""
    folder, shown = open_folder(tmp_path / "run", "count", {}, 0), _console()
    played: list[int] = []

    def stopping(trial: Trial) -> dict[str, Any]:
        played.append(trial.seed)
        if len(played) == 2:
            signal.raise_signal(signal.SIGINT)
        return play(trial)

    parts = (_part(range(3), stopping), _part(range(5, 7), play, "others.jsonl"))
    rows = play_kept(shown, folder, *parts)
    assert [[row["seed"] for row in own] for own in rows] == [[0, 1], []]
    assert f"Stopped after 2 of 5 trials; go on with --out {folder.path}." in shown.export_text()
    rows = play_kept(shown, folder, *parts)
    assert played == [0, 1, 2]
    assert [[row["square"] for row in own] for own in rows] == [[0, 1, 4], [25, 36]]
    assert "Stopped" not in shown.export_text()


def test_a_bar_counts_what_trials_cost(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each trial is shown with its name, and what it costs is counted; libraries have one thread meanwhile."""
    import numpy as np  # noqa: F401   # a library with threads
    from threadpoolctl import threadpool_info

    monkeypatch.setattr(command_progress, "REDRAW_S", 0.0)
    shown = Console(file=io.StringIO(), width=100, force_terminal=True)
    with trials_shown(shown, 10, 4) as (advance, interrupted):
        advance("the third", 3)
        assert not interrupted()
        assert {pool["num_threads"] for pool in threadpool_info()} <= {1}
        text = shown.file.getvalue()  # type: ignore[attr-defined]
    assert "the third" in text
    assert "70%" in text


def test_lines_go_above_a_bar_of_shares() -> None:
    """What is printed while a bar runs stays, and changed fields are shown."""
    shown = _console()
    with share_shown(shown, "work", "{task.fields[left]} left", left=3) as update:
        update(0.5, left=2)
        shown.print("half of it")
    assert "half of it" in shown.export_text(clear=False)
    assert "2 left" in shown.export_text()
