"""Rows of finished trials: damage, two processes in one folder, killed processes, errors of other processes."""

import os
import re
import signal
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import pytest

from training.experiments.run_folder import RunFolder
from training.experiments.trial_store import finished_trials, owned, run_trials

GOOD = [f'{{"seed": {seed}, "figure": {seed * seed}}}\n' for seed in range(5)]


@dataclass(frozen=True)
class Trial:
    """A trial."""

    seed: int


class Unsendable(Exception):
    """Error that another process cannot rebuild."""

    def __init__(self, first: str, second: str) -> None:
        super().__init__(f"{first} and {second}")


def _square(trial: Trial) -> dict[str, Any]:
    return {"seed": trial.seed, "figure": trial.seed**2}


def _killed(trial: Trial) -> dict[str, Any]:
    if trial.seed == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return _square(trial)


def _unsendable(trial: Trial) -> dict[str, Any]:
    raise Unsendable("one", "two")


def _refused(trial: Trial) -> dict[str, Any]:
    raise KeyError("as it is")


def _folder(tmp_path: Path) -> RunFolder:
    return RunFolder.create(tmp_path / "run", "run", {}, 1)


def _run(folder: RunFolder, play: Callable[[Trial], dict[str, Any]], seeds: range, workers: int = 1) -> None:
    run_trials(folder, "trials.jsonl", play, map(Trial, seeds), workers, lambda: False, lambda row: None)


@pytest.mark.parametrize("end", ["", GOOD[4][:-1], GOOD[4][:9], GOOD[4][:-3]])
def test_a_run_goes_on_after_a_last_line_that_was_cut_short(end: str, tmp_path: Path) -> None:
    """A whole last line counts, with or without its line break; a part of one is dropped, once the run goes on."""
    folder = _folder(tmp_path)
    file = folder.path / "trials.jsonl"
    text = "".join(GOOD[:4]) + end
    file.write_text(text)
    found = finished_trials(file, Trial)
    whole = end == GOOD[4][:-1]
    assert list(found) == [Trial(seed) for seed in range(5 if whole else 4)]
    assert file.read_text() == text
    _run(folder, _square, range(len(found), 7))
    assert list(finished_trials(file, Trial)) == [Trial(seed) for seed in range(7)]
    assert len(file.read_text().splitlines()) == 7


@pytest.mark.parametrize("bad", ["[]", "3", '{"figure": 2}', "[" * 10**5, '{"seed": [1]}', '{"seed": 2, "f', ""])
def test_any_other_damage_is_refused_by_its_line(bad: str, tmp_path: Path) -> None:
    """No row after a damaged line is lost: the text names the line, and the file stays as it is."""
    file = tmp_path / "trials.jsonl"
    text = "".join([*GOOD[:2], bad + "\n", *GOOD[3:]])
    file.write_text(text)
    with pytest.raises(
        ValueError, match=r"out: expected a trial in each line, got a damaged line 3\. Remove line 3 of"
    ):
        finished_trials(file, Trial)
    assert file.read_text() == text


def _try_to_own(folder: Path, said: Any) -> None:
    try:
        with owned(folder):
            said.send("owned")
    except ValueError as error:
        said.send(str(error))


def test_the_second_process_in_a_folder_is_refused(tmp_path: Path) -> None:
    """Only one process at a time may add to a folder."""
    context = get_context("spawn")

    def other() -> str:
        ours, theirs = context.Pipe()
        process = context.Process(target=_try_to_own, args=(tmp_path, theirs))
        process.start()
        text: str = ours.recv()
        process.join()
        return text

    with owned(tmp_path):
        assert re.match("out: expected a folder that no process uses, got a folder with a running command", other())
    assert other() == "owned"


@pytest.mark.slow
def test_a_killed_process_leaves_one_line(tmp_path: Path) -> None:
    """Rows before are kept; the text says how to go on."""
    folder = _folder(tmp_path)
    with pytest.raises(ValueError, match=r"workers: .* got a process that was killed\. .* --out FOLDER"):
        _run(folder, _killed, range(5), workers=2)
    found = finished_trials(folder.path / "trials.jsonl", Trial)
    assert Trial(1) not in found
    _run(folder, _square, range(1, 5))
    assert Trial(1) in finished_trials(folder.path / "trials.jsonl", Trial)


@pytest.mark.slow
def test_errors_of_other_processes_arrive(tmp_path: Path) -> None:
    """An error arrives as it is; one that cannot be sent arrives as text, with its traceback and its trial."""
    with pytest.raises(KeyError, match="as it is"):
        _run(_folder(tmp_path / "a"), _refused, range(3), workers=2)
    with pytest.raises(RuntimeError, match=r"(?s)Trial\(seed=\d\).*in _unsendable.*Unsendable: one and two"):
        _run(_folder(tmp_path / "b"), _unsendable, range(3), workers=2)
