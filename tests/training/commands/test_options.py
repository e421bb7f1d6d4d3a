"""Common behaviour of commands with a run folder: options, start, progress and end."""

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
from typer.testing import CliRunner

from training.commands.helpers import progress
from training.commands.helpers.options import numbers, options, words
from training.commands.helpers.progress import TrialSet, run_trial_set, share_progress, trial_progress
from training.commands.helpers.run_folder import Call
from training.experiments.config import ExperimentConfig, Positive, option, setting
from training.experiments.run_folder import RunFolder
from training.experiments.trial_store import open_folder


class Numbers(ExperimentConfig):
    """Configuration of the command `count`."""

    few: int = option(1, "A few [m].")
    many: int = option(10, "Many.", ge=1)
    sizes: tuple[Positive, ...] = option((3, 4), "Sizes.", name="size")
    fine: bool = option(False, "Fine or not.")
    path: str = option("", "A folder.", shown="here", is_path=True)
    hidden: float = setting(0.5, gt=0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """Trial with a seed."""

    seed: int


def play(trial: Trial) -> dict[str, Any]:
    """Square the seed."""
    return asdict(trial) | {"square": trial.seed**2}


def _part(seeds: range, play: Callable[[Trial], dict[str, Any]]) -> TrialSet:
    return TrialSet(kind=Trial, play=play, trials=[Trial(seed=seed) for seed in seeds])


def _console() -> Console:
    return Console(file=io.StringIO(), width=200, record=True)


def _call(given: dict[str, Any] | None = None, command: str = "count", **options: Any) -> Call[Numbers]:
    return Call(kind=Numbers, command=command, given=given or {}, **options)


def test_options_are_those_of_the_configuration(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each `option` becomes one, with help and default; texts become lists, paths absolute; others stay unset."""
    calls: list[Call[Numbers]] = []
    app = typer.Typer()

    @app.command()
    @options(Numbers, "count", quick={"many": 2}, quick_help="Two.")
    def count(call: Call[Numbers], own: bool = False) -> None:
        """Count."""
        assert own
        calls.append(call)

    shown = CliRunner().invoke(app, ["--help"], env={"COLUMNS": "200"}).output
    for text in ("Count.", "--few", "A few [m].", "(1)", "--size", "(3,4)", "--fine", "--no-fine", "(no-fine)",
                 "(here)", "--quick", "--out", "--json", "--config", "--seed"):  # fmt: skip
        assert text in shown
    assert "hidden" not in shown
    monkeypatch.chdir(tmp_path)
    assert CliRunner().invoke(app, ["--own", "--size", "5, 6", "--path", "x", "--fine", "--quick"]).exit_code == 0
    assert calls[0].given == {"sizes": (5, 6), "path": str(tmp_path / "x"), "fine": True}
    assert (calls[0].config.many, calls[0].config.sizes, calls[0].config.few) == (2, (5, 6), 1)
    assert CliRunner().invoke(app, ["--own"]).exit_code == 0
    assert calls[1].config == Numbers()


def test_comma_separated_numbers() -> None:
    """Blanks are allowed; entries that are not numbers are refused by the name of the option."""
    assert numbers("robots", "1, 4,2") == (1, 4, 2)
    assert numbers("length", "1, 2.5", float) == (1.0, 2.5)
    assert words("a, b") == ("a", "b")
    with pytest.raises(ValueError, match="robots: expected comma-separated numbers, got '1-3'"):
        numbers("robots", "1-3")


def test_options_override_quick_and_quick_overrides_a_file(tmp_path: Path) -> None:
    """Each value comes from the option, else from --quick, else from the earlier run, else from the class."""
    RunFolder.create(tmp_path / "run", "count", {"few": 2, "many": 20}, 5)
    chosen = _call({}, file=tmp_path / "run", quick={"many": 3}).config
    assert (chosen.few, chosen.many, chosen.seed) == (2, 3, 5)
    chosen = _call({"few": 7, "many": 8, "seed": 0}, file=tmp_path / "run", quick={"many": 3}).config
    assert (chosen.few, chosen.many, chosen.seed) == (7, 8, 0)
    with pytest.raises(ValueError, match="config: expected a run of 'other', got 'count'"):
        _ = _call(command="other", file=tmp_path / "run").config


def test_logs_are_looked_for_below_the_folder_of_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A log without --path is below VSLAM_DATA; without that variable, or without a log there, there is an error."""
    log = (Path("park"), "a park's log")
    monkeypatch.setenv("VSLAM_DATA", str(tmp_path))
    with pytest.raises(
        ValueError, match=r"path: expected a park's log, got no such file\. Check '.*park'\. Without --path"
    ):
        _ = _call(log=log).config
    for name in ("park", "mine"):
        (tmp_path / name).mkdir()
    assert _call(log=log).config.path == str(tmp_path / "park")
    assert _call({"path": str(tmp_path / "mine")}, log=log).config.path == str(tmp_path / "mine")
    monkeypatch.delenv("VSLAM_DATA")
    with pytest.raises(ValueError, match="path: expected a park's log, got no --path"):
        _ = _call(log=log).config


def test_first_steps_come_before_the_folder(tmp_path: Path) -> None:
    """First steps with bad input leave no folder; a folder of the same run is reused only where allowed."""
    out = tmp_path / "run"

    def refuse() -> None:
        raise ValueError("world: expected another")

    with pytest.raises(ValueError, match="world"):
        _call(out=out).begin(refuse)
    assert not out.exists()
    _, folder = _call({"many": 3}, out=out, continues=True).begin()
    assert tomllib.loads((out / "config.toml").read_text())["config"]["many"] == 3
    assert _call({"many": 3}, out=out, continues=True).begin()[1] == folder
    with pytest.raises(ValueError, match="out: expected a new or empty folder, got a folder with files"):
        _call({"many": 3}, out=out).begin()
    with pytest.raises(ValueError, match="got a folder of a run with another many"):
        _call({"many": 4}, out=out, continues=True).begin()


@pytest.mark.parametrize("below", [False, True])
def test_a_bad_folder_is_refused_before_any_work(below: bool, tmp_path: Path) -> None:
    """A folder that is a file, or is below a file, is refused before anything is compiled."""
    (tmp_path / "file").write_text("x")
    out, done = tmp_path / "file" / "run" if below else tmp_path / "file", []
    with pytest.raises(ValueError, match=r"out: expected a (new or empty folder|folder that can be written), got"):
        _call(out=out, continues=True).begin(lambda: done.append(1))
    assert done == []


@pytest.mark.parametrize(("held", "status"), [([True, True], 0), ([True, False], 1), ([], 1)])
def test_check_turns_claims_that_fail_into_status_1(held: list[bool], status: int, tmp_path: Path) -> None:
    """With --check a claim that fails, or the lack of claims, is status 1; the metrics are written in any case."""
    copy = tmp_path / "copy.json"
    call = _call(out=tmp_path / "run", json=copy, console=_console())
    call.begin()
    call.write({"found": 1})
    if status:
        with pytest.raises(typer.Exit) as end:
            call.finish(True, held)
        assert end.value.exit_code == status
    else:
        call.finish(True, held)
    call.finish(False, held)
    assert json.loads(copy.read_text()) == json.loads((tmp_path / "run" / "metrics.json").read_text())


def test_a_stopped_command_can_be_resumed(tmp_path: Path) -> None:
    """Ctrl-C ends after the current trial; called again, only the rest is run, and rows keep the order of trials."""
    folder, shown = open_folder(tmp_path / "run", "count", {}, 0), _console()
    played: list[int] = []

    def stopping(trial: Trial) -> dict[str, Any]:
        played.append(trial.seed)
        if len(played) == 2:
            signal.raise_signal(signal.SIGINT)
        return play(trial)

    part = _part(range(3), stopping)
    assert [row["seed"] for row in run_trial_set(shown, folder, part)] == [0, 1]
    assert f"Stopped after 2 of 3 trials; resume with --out {folder.path}." in shown.export_text()
    rows = run_trial_set(shown, folder, part)
    assert f"Resuming {folder.path}: 2 of 3 trials are finished, 1 are left." in shown.export_text(clear=False)
    assert played == [0, 1, 2]
    assert [row["square"] for row in rows] == [0, 1, 4]
    assert "Stopped" not in shown.export_text()


def test_a_bar_counts_trials(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each trial is shown with its name, and counted; libraries have one thread meanwhile."""
    import numpy as np  # noqa: F401   # a library with threads
    from threadpoolctl import threadpool_info

    monkeypatch.setattr(progress, "REDRAW_S", 0.0)
    shown = Console(file=io.StringIO(), width=100, force_terminal=True)
    with trial_progress(shown, 10, 4) as (advance, interrupted):
        advance("the fifth")
        assert not interrupted()
        assert {pool["num_threads"] for pool in threadpool_info()} <= {1}
        text = shown.file.getvalue()  # type: ignore[attr-defined]
    assert "the fifth" in text
    assert "50%" in text


def test_lines_go_above_a_bar_of_shares() -> None:
    """Output printed while a bar runs is kept, and changed fields are shown."""
    shown = _console()
    with share_progress(shown, "work", "{task.fields[left]} left", left=3) as update:
        update(0.5, left=2)
        shown.print("half of it")
    assert "half of it" in shown.export_text(clear=False)
    assert "2 left" in shown.export_text()
