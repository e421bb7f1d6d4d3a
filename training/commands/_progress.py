"""What commands show while they work: a bar over trials, or over a share of the whole; Ctrl-C ends after the trial."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

if TYPE_CHECKING:  # what computes is imported when a command runs, so that --help answers at once
    from training.experiments.run_folder import RunFolder

REDRAW_S = 0.1  # between two pictures of a bar over trials


@contextmanager
def trials_shown(
    console: Console, total: int | None, completed: int = 0, timed: bool = True
) -> Iterator[tuple[Callable[..., None], Callable[[], bool]]]:
    """Show a bar over trials; all libraries work on one thread, and Ctrl-C becomes a question.

    Args:
        timed: Whether something is timed: the bar is then drawn between trials only, so that no other thread of this
            process works meanwhile.

    Yields:
        A function that counts one trial, by its name and its share of `total`, and one that tells whether Ctrl-C was
        pressed.
    """
    from threadpoolctl import threadpool_limits

    from training.experiments.interrupt import interrupt_flag

    columns = (
        TextColumn("{task.description}"), BarColumn(20), TaskProgressColumn(), TimeElapsedColumn(),
        TimeRemainingColumn(),
    )  # fmt: skip
    with (
        threadpool_limits(1),
        interrupt_flag() as interrupted,
        Progress(*columns, console=console, transient=True, auto_refresh=not timed) as progress,
    ):
        task = progress.add_task("", total=total, completed=completed)
        drawn = 0.0

        def advance(name: str, by: int = 1) -> None:
            nonlocal drawn
            now = time.monotonic()
            redraw = now - drawn >= REDRAW_S
            drawn = now if redraw else drawn
            progress.update(task, description=name, advance=by, refresh=redraw)

        yield advance, interrupted


@dataclass(frozen=True, slots=True, kw_only=True)
class KeptPart:
    """Trials of one kind that a run folder keeps."""

    file: str  # In which their rows are kept
    kind: type[Any]  # The dataclass of a trial
    # Runs a trial and returns its row; a function of a module, so that other processes find it
    play: Callable[[Any], dict[str, Any]]
    trials: Sequence[Any]  # All, in order
    tell: Callable[[dict[str, Any]], str]  # Describes a row in a few words
    cost: Callable[[Any], int] = lambda trial: 1  # About how long a trial takes, in an arbitrary unit
    processes: int = 1  # How many run at a time; 1: in this process


def play_kept(
    console: Console, folder: "RunFolder", *parts: KeptPart, timed: bool = False
) -> list[list[dict[str, Any]]]:
    """Play what a folder does not hold yet under a bar, part after part; say how to go on if Ctrl-C ended it.

    Returns:
        Per part the rows of all finished trials, in the order of the trials.
    """
    from training.experiments.trial_store import finished_trials, run_trials, trial_of

    kept = [finished_trials(folder, part.file, part.kind) for part in parts]
    total = sum(part.cost(trial) for part in parts for trial in part.trials)
    done = sum(part.cost(t) for part, found in zip(parts, kept, strict=True) for t in part.trials if t in found)
    with trials_shown(console, total, done, timed) as (advance, interrupted):
        for part, found in zip(parts, kept, strict=True):

            def on_trial(row: dict[str, Any], part: KeptPart = part, found: dict[Any, Any] = found) -> None:
                trial = trial_of(row, part.kind)
                found[trial] = row
                advance(part.tell(row), part.cost(trial))

            left = [trial for trial in part.trials if trial not in found]
            run_trials(folder, part.file, part.play, left, part.processes, interrupted, on_trial)
    rows = [[found[t] for t in part.trials if t in found] for part, found in zip(parts, kept, strict=True)]
    finished, wanted = sum(map(len, rows)), sum(len(part.trials) for part in parts)
    if finished < wanted:
        text = f"Stopped after {finished} of {wanted} trials; go on with --out {folder.path}."
        console.print(text, soft_wrap=True)
    return rows


@contextmanager
def share_shown(console: Console, text: str, *more: str, **fields: Any) -> Iterator[Callable[..., None]]:
    """Show a bar over the share of the work that is done.

    Args:
        more: Templates of further columns.
        fields: What these begin with, as `task.fields`.

    Yields:
        A function of the share, in [0, 1], and of fields that have changed.
    """
    columns = (
        TextColumn(text), BarColumn(), TextColumn("{task.percentage:>3.0f} %"), *map(TextColumn, more),
        TimeElapsedColumn(), TimeRemainingColumn(),
    )  # fmt: skip
    with Progress(*columns, console=console) as progress:
        task = progress.add_task("", total=1.0, **fields)

        def update(share: float, **changed: Any) -> None:
            progress.update(task, completed=share, **changed)

        yield update
