"""Storage of finished trials, so that a stopped run can be resumed."""

import json
import os
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import closing, contextmanager
from multiprocessing import active_children, get_context
from pathlib import Path
from typing import Any, TypeVar

from slam_backend.core.files import append_text
from slam_backend.core.text_files import read_text
from slam_backend.core.validation import argument_error
from training.experiments.cluster import SINGLE_THREAD, connected
from training.experiments.interrupt import begin_worker, signals_held
from training.experiments.run_folder import CONFIG_FILE, RunFolder, installed_versions, plain, read_config

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
        hint = f"Repeat the options in {str(out / CONFIG_FILE)!r}, or choose another folder."
        expected = f"a folder of the same {command.split()[0]} run"
        raise argument_error("out", expected, "a folder of a run with other options", hint)
    return RunFolder(out, command, values, seed, installed_versions())


def finished_trials(folder: RunFolder, name: str, kind: type[TrialT]) -> dict[TrialT, dict[str, Any]]:
    """Read the trials in a folder; a truncated last line is dropped, and removed from the file.

    Args:
        kind: Frozen dataclass of the trials; a row contains its fields and the metrics.

    Raises:
        ValueError: If a line is not such a row.
    """
    file = folder.path / name
    if not file.is_file():
        return {}
    rows = []
    for line in read_text(file, "out", "a file of trials").splitlines():
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            break
        except RecursionError:
            rows.append(None)
    try:
        trials = {trial_of(row, kind): row for row in rows}
    except (KeyError, TypeError, ValueError) as error:
        hint = f"Remove {str(file)!r}, or choose another folder. Error: {error}."
        raise argument_error("out", "trials of an earlier run", "a file with other content", hint) from error
    folder.write_text(name, "".join(json.dumps(row) + "\n" for row in rows))
    return trials


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
        ValueError: If a row cannot be written, or the cluster cannot be reached; earlier rows are kept.
    """
    going = _until(interrupted, trials)
    if cluster is not None:
        played = _over_cluster(play, going, cluster, variables)
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
                    running.add(pool.submit(play, trial))  # starts a process if there are fewer than the maximum
                while len(running) >= workers:
                    done, running = wait(running, return_when=FIRST_COMPLETED)
                    yield from (future.result() for future in done)
            for future in running:
                yield future.result()
        except BaseException:
            for process in set(active_children()) - others:
                process.kill()
            raise


def _over_cluster(
    play: Callable[[TrialT], dict[str, Any]], trials: Iterable[TrialT], address: str,
    variables: Mapping[str, str] | None,
) -> Generator[dict[str, Any], None, None]:  # fmt: skip
    """Run trials on a Ray cluster, one per core, and yield their rows as they end.

    A trial whose process or node is lost is run again elsewhere.
    """
    with connected(address, variables) as ray:
        task: Any = ray.remote(num_cpus=1, max_retries=-1)(_play_one)
        shared: Any = ray.put(play)
        running: list[Any] = []
        cores: Any = ray.cluster_resources
        try:
            for trial in trials:
                running.append(task.remote(shared, trial))
                while len(running) >= 2 * max(1, int(cores().get("CPU", 1))):  # nodes may come and go
                    done, running = ray.wait(running)
                    yield from ray.get(done)
            while running:
                done, running = ray.wait(running)
                yield from ray.get(done)
        except ray.exceptions.RayTaskError as error:
            raise error.cause from error


def _play_one(play: Callable[[TrialT], dict[str, Any]], trial: TrialT) -> dict[str, Any]:
    """Run a trial in a process of a cluster."""
    return play(trial)


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
