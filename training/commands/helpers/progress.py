"""Progress displays of commands: a bar over trials or over a fraction of the work; Ctrl-C stops after the trial."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TimeElapsedColumn, TimeRemainingColumn

from training.experiments.output.console import print_error, text_column
from training.experiments.output.logs import LOGGER

if TYPE_CHECKING:  # numerical modules are imported when a command runs, so that --help is fast
    from training.experiments.run_folder import RunFolder

REDRAW_S = 0.1  # interval between redraws of the bar over trials


def training_bar(console: Console, done: str = "{task.completed:,.0f} of {task.total:,.0f}") -> Progress:
    """Return the bar of a training, with the field `status` and the time left.

    Args:
        console: Console of the command.
        done: Template of the text before the bar.
    """
    columns = (
        text_column(done), BarColumn(None), text_column("{task.fields[status]}"), TimeElapsedColumn(),
        text_column("left"), TimeRemainingColumn(),
    )  # fmt: skip
    return Progress(*columns, console=console, expand=True, speed_estimate_period=300.0)


@contextmanager
def trial_progress(
    console: Console, total: int | None, completed: int = 0, timed: bool = True
) -> Iterator[tuple[Callable[..., None], Callable[[], bool]]]:
    """Show a bar over trials; all libraries use one thread, and Ctrl-C sets a flag.

    Args:
        timed: Whether trials are timed: the bar is then drawn between trials only, so that no other thread of this
            process runs during a trial.

    Yields:
        A function that counts a trial by its name, and a function that returns whether Ctrl-C
        was pressed.
    """
    from threadpoolctl import threadpool_limits

    from training.experiments.machine.interrupt import interrupt_flag

    columns = (
        text_column("{task.description}"), BarColumn(20), TaskProgressColumn(), TimeElapsedColumn(),
        TimeRemainingColumn(),
    )  # fmt: skip
    with (
        threadpool_limits(1),
        interrupt_flag() as interrupted,
        Progress(*columns, console=console, transient=True, auto_refresh=not timed) as progress,
    ):
        task = progress.add_task("", total=total, completed=completed)
        drawn = 0.0

        def advance(name: str) -> None:
            nonlocal drawn
            now = time.monotonic()
            redraw = now - drawn >= REDRAW_S
            drawn = now if redraw else drawn
            progress.update(task, description=name, advance=1, refresh=redraw)

        yield advance, interrupted


@dataclass(frozen=True, slots=True, kw_only=True)
class TrialSet:
    """Trials of one kind that a run folder stores."""

    kind: type[Any]  # Dataclass of a trial
    # Function that runs a trial and returns its row; importable by other processes
    play: Callable[[Any], dict[str, Any]]
    trials: Sequence[Any]  # All trials, in order
    workers: int = 1  # Number of parallel processes; 1: this process, unless there are variables
    cluster: str | None = None  # Address of a Ray cluster that runs the trials instead; None: this machine
    check: Callable[[Mapping[str, Any]], object] = bool  # Function that raises if a stored row is damaged
    variables: Mapping[str, str] | None = None  # Variables of the environment of the processes that run the trials
    failures: list[str] = field(default_factory=list)  # Errors of failed trials, appended as they end


def run_trial_set(console: Console, folder: "RunFolder", part: TrialSet, timed: bool = False) -> list[dict[str, Any]]:
    """Run the trials that a folder does not contain yet, under a bar; after Ctrl-C, print how to resume.

    Returns:
        Rows of all finished trials, in the order of the trials.
    """
    from training.experiments.trial_store import owned

    with owned(folder.path):
        return _run_owned(console, folder, part, timed)


def _run_owned(console: Console, folder: "RunFolder", part: TrialSet, timed: bool) -> list[dict[str, Any]]:
    """Run the missing trials of a folder that no other process uses; see `run_trial_set`."""
    from training.experiments.trial_store import FAILED, TRIALS_FILE, finished_trials, run_trials, trial_of

    found = finished_trials(folder.path / TRIALS_FILE, part.kind, part.check)
    left, wanted = [trial for trial in part.trials if trial not in found], len(part.trials)
    if found:
        text = f"Resuming {folder.path}: {wanted - len(left)} of {wanted} trials are finished, {len(left)} are left."
        console.print(text, soft_wrap=True)
    with trial_progress(console, wanted, wanted - len(left), timed) as (advance, interrupted):

        def on_trial(row: dict[str, Any]) -> None:
            if FAILED in row:
                if row[FAILED] not in part.failures:  # once, even if it fails in each trial
                    print_error(row[FAILED], console)
                part.failures.append(row[FAILED])
                advance("failed")
                return
            found[trial_of(row, part.kind)] = row
            values = (row[name] for name in part.kind.__dataclass_fields__)
            trial = ", ".join(str(value) for value in values if value not in ("", None))
            LOGGER.debug("Finished %s", trial)
            advance(trial)

        run_trials(
            folder, TRIALS_FILE, part.play, left, part.workers, interrupted, on_trial, part.cluster, part.variables
        )
    rows = [found[trial] for trial in part.trials if trial in found]
    if failed := len(part.failures):
        text = f"{failed} of {wanted} trials failed; the same command with --out {folder.path} repeats them."
        console.print(text, soft_wrap=True)
    if len(rows) + failed < wanted:
        text = f"Stopped after {len(rows)} of {wanted} trials; resume with --out {folder.path}."
        console.print(text, soft_wrap=True)
    return rows


@contextmanager
def share_progress(console: Console, text: str, *more: str, **fields: Any) -> Iterator[Callable[..., None]]:
    """Show a bar over the completed fraction of the work.

    Args:
        more: Templates of additional columns.
        fields: Initial values of the fields in these templates, as `task.fields`.

    Yields:
        A function of the completed fraction, in [0, 1], and of changed fields.
    """
    columns = (
        text_column("{task.description}"), BarColumn(), text_column("{task.percentage:>3.0f} %"),
        *map(text_column, more), TimeElapsedColumn(), TimeRemainingColumn(),
    )  # fmt: skip
    with Progress(*columns, console=console) as progress:
        task = progress.add_task(text, total=1.0, **fields)

        def update(share: float, **changed: Any) -> None:
            progress.update(task, completed=share, **changed)

        yield update
