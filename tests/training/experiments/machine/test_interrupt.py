"""SIGINT and SIGTERM stop a command in order, and at once if repeated, even if they were ignored at first."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from training import cli
from training.commands.helpers.progress import trial_progress
from training.experiments.machine.interrupt import SIGNALS, interrupt_flag, signals_answered, signals_held
from training.experiments.trial_store import open_folder, run_trials

BOTH = pytest.mark.parametrize("number", SIGNALS)
Disposition = Callable[[int], Any]


@pytest.fixture(params=["default", "ignored"])
def disposition(request: pytest.FixtureRequest) -> Iterator[str]:
    """Set both signals as a shell does for a command in the foreground, or in the background."""
    ignored = request.param == "ignored"
    wanted = {
        signal.SIGINT: signal.SIG_IGN if ignored else signal.default_int_handler,
        signal.SIGTERM: signal.SIG_IGN if ignored else signal.SIG_DFL,
    }
    inherited = {number: signal.signal(number, handler) for number, handler in wanted.items()}
    yield request.param
    now = {number: signal.getsignal(number) for number in wanted}
    for number, handler in inherited.items():
        signal.signal(number, handler)
    assert now == wanted


@BOTH
@pytest.mark.usefixtures("disposition")
def test_the_first_signal_sets_the_flag_and_the_second_interrupts(number: int) -> None:
    """The first signal calls the callback and sets the flag; the second interrupts; then handlers are restored."""
    calls: list[str] = []

    def insist() -> None:
        with signals_answered(), interrupt_flag(lambda: calls.append("pressed")) as pressed:
            assert not pressed()
            signal.raise_signal(number)
            assert pressed()
            signal.raise_signal(signal.SIGINT + signal.SIGTERM - number)

    with pytest.raises(KeyboardInterrupt, match=r"^$"):
        insist()
    assert calls == ["pressed"]


@pytest.mark.usefixtures("disposition")
def test_a_flag_works_outside_commands() -> None:
    """A loop outside a command is also interrupted by the second Ctrl-C."""

    def insist() -> None:
        with interrupt_flag() as pressed:
            signal.raise_signal(signal.SIGINT)
            assert pressed()
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt, match=r"^$"):
        insist()


def test_other_threads_change_nothing() -> None:
    """Outside the main thread both blocks keep the handlers unchanged."""
    before = [signal.getsignal(number) for number in SIGNALS]
    within: list[Any] = []

    def look() -> None:
        with signals_answered(), interrupt_flag() as pressed:
            within.extend([pressed(), [signal.getsignal(number) for number in SIGNALS]])

    thread = threading.Thread(target=look)
    thread.start()
    thread.join()
    assert within == [False, before]


@BOTH
@pytest.mark.usefixtures("disposition")
@pytest.mark.parametrize("presses", [1, 2])
def test_a_stopped_command_has_the_status_of_its_signal(
    presses: int, number: int, vslam: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stopped in order or at once, a command exits with 128 + signal number."""
    summed_up: list[bool] = []

    def app(prog_name: str) -> None:
        from rich.console import Console

        with trial_progress(Console(stderr=True), 1) as (_, interrupted):
            for _ in range(presses):
                signal.raise_signal(number)
            assert interrupted()
        summed_up.append(True)
        sys.exit(0)

    def as_typer_does(prog_name: str) -> None:
        try:
            app(prog_name)
        except KeyboardInterrupt:
            sys.exit(130)

    monkeypatch.setattr(cli, "app", as_typer_does)
    said = vslam("anything")
    assert said.status == 128 + number
    assert summed_up == [True] * (presses == 1)
    assert ("Stopped by" in said.err) == (presses == 2)


def test_bad_input_keeps_its_status_after_a_signal(vslam: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """A write error after a stop is not hidden by the signal."""

    def app(prog_name: str) -> None:
        with interrupt_flag():
            signal.raise_signal(signal.SIGTERM)
        raise ValueError("out: expected a file that can be written, got 'x'.")

    monkeypatch.setattr(cli, "app", app)
    assert vslam("anything").status == 2


@pytest.mark.skipif(not hasattr(signal, "pthread_sigmask"), reason="signals cannot be held back here")
@pytest.mark.usefixtures("disposition")
def test_blocked_signals_are_delivered_later() -> None:
    """A signal within the block is not lost, and a process started there never receives any."""
    with interrupt_flag() as pressed:
        with signals_held():
            os.kill(os.getpid(), signal.SIGTERM)
            command = [sys.executable, "-c", "import os, signal; os.kill(os.getpid(), signal.SIGTERM); print('alive')"]
            assert subprocess.check_output(command, text=True) == "alive\n"
        assert pressed()


@dataclass(frozen=True, slots=True, kw_only=True)
class Sleep:
    """Slow trial.

    Attributes:
        seed: Seed of the trial.
        seconds: Duration of the trial.
        folder: Folder in which it records its start and its process.
    """

    seed: int
    seconds: float
    folder: str


def sleep(trial: Sleep) -> dict[str, Any]:
    """Record the process, and sleep."""
    part = Path(trial.folder) / f"part-{trial.seed}"
    part.write_text(str(os.getpid()))
    part.rename(Path(trial.folder) / f"begun-{trial.seed}")
    time.sleep(trial.seconds)
    return {"seed": trial.seed, "seconds": trial.seconds, "folder": trial.folder}


def main() -> None:
    """Run slow trials in two processes, like a benchmark; the command of the test below."""
    folder, seconds = sys.argv[1:]

    def app(prog_name: str) -> None:
        from rich.console import Console

        trials = [Sleep(seed=seed, seconds=float(seconds), folder=folder) for seed in range(99)]
        try:
            with trial_progress(Console(stderr=True), 99) as (_, interrupted):
                kept = open_folder(Path(folder) / "run", "sleep", {}, 0)
                run_trials(kept, "trials.jsonl", sleep, trials, 2, interrupted, lambda row: None)
            sys.exit(0)
        except KeyboardInterrupt:
            sys.exit(130)

    cli.app = app  # type: ignore[assignment]
    cli.main()


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")
@pytest.mark.parametrize(
    ("signals", "to_group", "status", "seconds"),
    [
        ([signal.SIGINT], True, 130, 2.0),
        ([signal.SIGTERM], False, 143, 2.0),
        ([signal.SIGTERM], True, 143, 2.0),
        ([signal.SIGINT, signal.SIGTERM], True, 143, 600.0),
        ([signal.SIGTERM, signal.SIGINT], False, 130, 600.0),
        ([signal.SIGKILL], False, -9, 600.0),
    ],
)
def test_no_worker_survives_a_signal(
    signals: list[signal.Signals], to_group: bool, status: int, seconds: float, tmp_path: Path
) -> None:
    """One signal lets workers finish their trials, which are kept; two stop at once; no worker survives."""
    code = "import sys; sys.path.insert(0, sys.argv.pop(1)); import test_interrupt; test_interrupt.main()"
    command = [sys.executable, "-c", code, str(Path(__file__).parent), str(tmp_path), str(seconds)]
    shielded = ["sh", "-c", 'trap "" INT; exec "$@"', "sh", *command]
    environment = os.environ | {"PYTHONPATH": str(Path(cli.__file__).parents[1])}
    with subprocess.Popen(
        shielded, env=environment, start_new_session=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    ) as process:
        _wait(lambda: len(list(tmp_path.glob("begun-*"))) >= 2)
        workers = [int(file.read_text()) for file in tmp_path.glob("begun-*")]
        for number in signals:
            (os.killpg if to_group else os.kill)(process.pid, number)
            time.sleep(0.3)
        assert process.wait(60) == status
        assert process.stderr is not None
        _wait(lambda: not any(_alive(worker) for worker in workers))
        said = process.stderr.read()
    assert "Traceback" not in said
    trials = tmp_path / "run" / "trials.jsonl"
    rows = [json.loads(line) for line in trials.read_text().splitlines()] if trials.exists() else []
    begun = len(list(tmp_path.glob("begun-*")))
    assert len(rows) == (begun if len(signals) == 1 and status > 0 else 0)


def _alive(process: int) -> bool:
    try:
        state = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except OSError:
        return False
    return state != "Z"  # ended, but its status was not collected


def _wait(until: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60.0
    while not until():
        assert time.monotonic() < deadline
        time.sleep(0.05)
