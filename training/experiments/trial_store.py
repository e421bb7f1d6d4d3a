"""Storage of finished trials, so that a stopped run can be resumed."""

import json
import os
import pickle
import traceback
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from multiprocessing import active_children, get_context
from pathlib import Path
from typing import Any, TypeVar

from filelock import FileLock, Timeout

from slam_backend.core.files import append_text, write_file
from slam_backend.core.text_files import read_text
from slam_backend.core.validation import argument_error
from training.experiments.machine.cluster import SINGLE_THREAD, over_cluster
from training.experiments.machine.interrupt import begin_worker, signals_held
from training.experiments.run_folder import CONFIG_FILE, RunFolder, installed_versions, plain, read_config

LOCK_FILE = ".lock"  # in a run folder: held by the process that adds to it
TRIALS_FILE = "trials.jsonl"  # file of a run folder with the rows of finished trials
FAILED = "failed"  # field of the row of a trial without a result: the error, in one line

TrialT = TypeVar("TrialT")


def open_folder(out: Path | None, command: str, config: Mapping[str, Any], seed: int) -> RunFolder:
    """Create the run folder, or resume the folder of the same run.

    Args:
        out: Run folder. None: the next free one.

    Raises:
        ValueError: If `out` belongs to another run, or cannot be written.
    """
    if out is None or not (out / CONFIG_FILE).is_file():
        return RunFolder.create(out, command, config, seed)
    values, kept_seed = read_config(out, command)
    asked = {name: value for name, value in plain(config).items() if value is not None}  # TOML has no None
    if (values, kept_seed) != (asked, seed):
        kept, new = values | {"seed": kept_seed}, asked | {"seed": seed}
        other = ", ".join(name for name in kept | new if kept.get(name) != new.get(name))
        hint = f"Repeat the options in {str(out / CONFIG_FILE)!r}, or choose another folder."
        expected = f"a folder of the same {command.split()[0]} run"
        raise argument_error("out", expected, f"a folder of a run with another {other}", hint)
    return RunFolder(out, command, values, seed, installed_versions())


def finished_trials(
    file: Path, kind: type[TrialT], check: Callable[[Mapping[str, Any]], object] = bool
) -> dict[TrialT, dict[str, Any]]:
    """Read the rows of finished trials; a last line that was cut short is left out. The file is not changed.

    Args:
        file: File of rows; it may not exist yet.
        kind: Frozen dataclass of the trials; a row contains its fields and the metrics.
        check: Function that raises if the metrics of a row are damaged; the default accepts all.

    Raises:
        ValueError: If another line is not such a row; the text names it.
    """
    trials: dict[TrialT, dict[str, Any]] = {}
    lines = read_text(file, "out", "a file of trials").splitlines(keepends=True) if file.is_file() else []
    for count, line in enumerate(lines, start=1):
        try:
            row = json.loads(line)
            trial = trial_of(row, kind)
            check(row)
            trials[trial] = row
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            if count == len(lines) and not line.endswith("\n") and isinstance(error, json.JSONDecodeError):
                break
            hint = f"Remove line {count} of {str(file)!r}, whose trial is then repeated, or choose another folder."
            raise argument_error("out", "a trial in each line", f"a damaged line {count}", hint) from error
    return trials


@contextmanager
def owned(folder: Path) -> Iterator[None]:
    """Keep other processes from resuming a run folder meanwhile.

    Raises:
        ValueError: If another process does so; or the folder cannot be written.
    """
    lock = FileLock(folder / LOCK_FILE)
    try:
        lock.acquire(blocking=False)
    except Timeout as error:
        hint = "Wait for it, or choose another folder."
        raise argument_error("out", "a folder that no process uses", "a folder with a running command", hint) from error
    except OSError as error:
        hint = f"Check its permissions. The system says: {error.strerror}."
        raise argument_error("out", "a folder that can be written", str(folder), hint) from error
    try:
        yield
    finally:
        lock.release()


def _end_last_line(file: Path) -> None:
    """Complete the last line of a file of rows, or remove it if it was cut short."""
    if file.is_file() and (text := read_text(file, "out", "a file of trials")) and not text.endswith("\n"):
        *_, last = text.splitlines()
        try:
            json.loads(last)
        except json.JSONDecodeError:
            write_file(file, text.removesuffix(last), "out")
        else:
            append_text(file, "\n", "out")


def trial_of(row: Mapping[str, Any], kind: type[TrialT]) -> TrialT:
    """Return the trial of a row, as a dataclass."""
    fields: Mapping[str, Any] = kind.__dataclass_fields__  # type: ignore[attr-defined]
    return kind(**{name: row[name] for name in fields})


def run_trials(
    folder: RunFolder, name: str, play: Callable[[TrialT], dict[str, Any]], trials: Iterable[TrialT], workers: int,
    interrupted: Callable[[], bool], on_trial: Callable[[dict[str, Any]], None], cluster: str | None = None,
    variables: Mapping[str, str] | None = None,
) -> None:  # fmt: skip
    """Run trials and append each to the folder as it ends; after an interrupt, running trials are finished.

    Rows with the field `FAILED` are not kept, so that a resumed run repeats their trials.

    Args:
        play: Function that runs a trial and returns its row; importable by other processes.
        workers: Number of parallel processes; 1: this process, unless there are variables.
        cluster: Address of a Ray cluster that runs the trials instead, see `ray.init`; None: this machine.
        variables: Variables of the environment of the processes that run the trials.

    Raises:
        ValueError: If a row cannot be written, the cluster cannot be reached, or a process was killed; earlier rows are
            kept.
    """
    _end_last_line(folder.path / name)
    going = _until(interrupted, trials)
    if cluster is not None:
        played = over_cluster(_play_one, ((play, trial) for trial in going), cluster, variables)
    elif workers == 1 and not variables:
        played = _in_turn(play, going)
    else:
        played = run_in_processes(play, going, workers, variables)
    with closing(played) as rows:
        for row in rows:
            kept = plain(row)
            if FAILED not in kept:
                append_text(folder.path / name, json.dumps(kept, allow_nan=False) + "\n", "out")
            on_trial(kept)


def _until(interrupted: Callable[[], bool], trials: Iterable[TrialT]) -> Iterator[TrialT]:
    """Yield trials until the user interrupts."""
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


def run_in_processes(
    play: Callable[[TrialT], dict[str, Any]], trials: Iterable[TrialT], workers: int,
    variables: Mapping[str, str] | None = None,
) -> Generator[dict[str, Any], None, None]:  # fmt: skip
    """Run trials in several processes with one thread each, and yield their rows as they end.

    If the consumer stops early, the processes are killed.

    Args:
        variables: More variables of their environment.
    """
    context = get_context("spawn")
    others = set(active_children())
    with one_thread_each(variables), ProcessPoolExecutor(workers, mp_context=context, initializer=begin_worker) as pool:
        try:
            running: set[Future[dict[str, Any]]] = set()
            for trial in trials:
                with signals_held():
                    running.add(pool.submit(_play_one, play, trial))  # starts a process if there is room for one
                while len(running) >= workers:
                    done, running = wait(running, return_when=FIRST_COMPLETED)
                    yield from (future.result() for future in done)
            for future in running:
                yield future.result()
        except BrokenProcessPool as error:
            hint = "The same command with --out FOLDER goes on; with fewer --workers it needs less memory."
            got = "a process that was killed"
            raise argument_error("workers", "processes that run to their end", got, hint) from error
        except BaseException:
            for process in set(active_children()) - others:
                process.kill()
            raise


def _play_one(play: Callable[[TrialT], dict[str, Any]], trial: TrialT) -> dict[str, Any]:
    """Run a trial in another process. Its errors arrive as they are, or as text if they cannot be sent."""
    try:
        return play(trial)
    except Exception as error:
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:  # of any kind: its class may do anything
            text = "".join(traceback.format_exception(error))
        else:
            raise
    raise RuntimeError(f"{trial}: {text}")


@contextmanager
def one_thread_each(variables: Mapping[str, str] | None = None) -> Iterator[None]:
    """Limit the libraries of started processes to one thread each, because processes already use all cores.

    Args:
        variables: More variables of their environment.
    """
    changed = dict.fromkeys(SINGLE_THREAD, "1") | dict(variables or {})
    before = {name: os.environ.get(name) for name in changed}
    os.environ |= changed
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
