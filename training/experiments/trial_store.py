"""Trials that are kept as soon as they are finished, so that a stopped run goes on where it stopped."""

import json
import os
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import closing, contextmanager
from multiprocessing import active_children, get_context
from pathlib import Path
from typing import Any, TypeVar

from slam_backend.core.files import append_text
from slam_backend.core.validation import argument_error
from training.experiments.interrupt import begin_worker, signals_held
from training.experiments.run_folder import CONFIG_FILE, RunFolder, installed_versions, plain, read_config

SINGLE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

TrialT = TypeVar("TrialT")


def open_folder(out: Path | None, command: str, config: Mapping[str, Any], seed: int) -> RunFolder:
    """Make the run folder, or go on with the one in which the same run was begun.

    Args:
        out: The folder. None: the next free one.

    Raises:
        ValueError: If `out` holds another run, or cannot be written.
    """
    if out is None or not (out / CONFIG_FILE).is_file():
        return RunFolder.create(out, command, config, seed)
    values, kept_seed = read_config(out, command)
    asked = {name: value for name, value in plain(config).items() if value is not None}  # TOML knows no None
    if (values, kept_seed) != (asked, seed):
        cure = f"Repeat the options in {str(out / CONFIG_FILE)!r}, or choose another folder."
        expected = f"a folder of this very {command.split()[0]}"
        raise argument_error("out", expected, "a folder of one with other options", cure)
    return RunFolder(out, command, values, seed, installed_versions())


def finished_trials(folder: RunFolder, name: str, kind: type[TrialT]) -> dict[TrialT, dict[str, Any]]:
    """Read the trials that a folder holds; a last line that was cut off is dropped, from the file too.

    Args:
        kind: A frozen dataclass, whose fields a row holds beside the figures.

    Raises:
        ValueError: If a line is no such row.
    """
    file = folder.path / name
    if not file.is_file():
        return {}
    rows = []
    for line in file.read_text(encoding="utf-8").splitlines():
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            break
        except RecursionError:
            rows.append(None)
    try:
        trials = {trial_of(row, kind): row for row in rows}
    except (KeyError, TypeError, ValueError) as error:
        cure = f"Take {str(file)!r} away, or choose another folder: {error}."
        raise argument_error("out", "trials that a run kept", "others", cure) from error
    folder.write_text(name, "".join(json.dumps(row) + "\n" for row in rows))
    return trials


def trial_of(row: Mapping[str, Any], kind: type[TrialT]) -> TrialT:
    """Return the trial, a dataclass, whose row this is."""
    fields: Mapping[str, Any] = kind.__dataclass_fields__  # type: ignore[attr-defined]
    return kind(**{name: row[name] for name in fields})


def run_trials(
    folder: RunFolder, name: str, play: Callable[[TrialT], dict[str, Any]], trials: Iterable[TrialT], processes: int,
    interrupted: Callable[[], bool], on_trial: Callable[[dict[str, Any]], None],
) -> None:  # fmt: skip
    """Run trials and append each to the folder as it ends; on an interrupt those under way are finished.

    Args:
        play: Runs a trial and returns its row; a function of a module, so that other processes find it.
        processes: How many run at a time; 1: in this process.

    Raises:
        ValueError: If a row cannot be written; those before it are kept.
    """
    going = _until(interrupted, trials)
    with closing(_in_turn(play, going) if processes == 1 else _spread(play, going, processes)) as rows:
        for row in rows:
            kept = plain(row)
            append_text(folder.path / name, json.dumps(kept, allow_nan=False) + "\n", "out")
            on_trial(kept)


def _until(interrupted: Callable[[], bool], trials: Iterable[TrialT]) -> Iterator[TrialT]:
    """Hand out trials until Ctrl-C."""
    for trial in trials:
        if interrupted():
            return
        yield trial


def _in_turn(
    play: Callable[[TrialT], dict[str, Any]], trials: Iterable[TrialT]
) -> Generator[dict[str, Any], None, None]:
    """Run trials in this process."""
    for trial in trials:
        yield play(trial)


def _spread(
    play: Callable[[TrialT], dict[str, Any]], trials: Iterable[TrialT], processes: int
) -> Generator[dict[str, Any], None, None]:
    """Run trials in several processes, each with one thread, and give their rows as they end.

    Where the rows are not wanted to the end, the processes are killed, whatever they do.
    """
    context = get_context("spawn")
    others = set(active_children())
    with one_thread_each(), ProcessPoolExecutor(processes, mp_context=context, initializer=begin_worker) as pool:
        try:
            running: set[Future[dict[str, Any]]] = set()
            for trial in trials:
                with signals_held():
                    running.add(pool.submit(play, trial))  # starts a process, if there are too few
                while len(running) >= processes:
                    done, running = wait(running, return_when=FIRST_COMPLETED)
                    yield from (future.result() for future in done)
            for future in running:
                yield future.result()
        except BaseException:
            for process in set(active_children()) - others:
                process.kill()
            raise


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Start processes whose libraries use one thread each: more would only get in the others' way."""
    before = {name: os.environ.get(name) for name in SINGLE_THREAD}
    os.environ |= dict.fromkeys(SINGLE_THREAD, "1")
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
