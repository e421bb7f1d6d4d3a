"""`WorkerEnvs`: environments of `SyncEnvs` divided among workers; `ProcessEnvs`: workers are processes."""

import atexit
import time
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any

import cloudpickle
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from slam_backend.core.validation import argument_error
from training.experiments.interrupt import begin_worker, signals_held
from training.experiments.trial_store import one_thread_each
from training.rl.slots import NOTHING_SENT, Infos, Layout, MakeEnv, StepResult, SyncEnvs, buffers

CLOSE_S = 5.0  # time after which running workers are killed


class WorkerEnvs(ABC):
    """Environments divided among workers, with the methods and the results of `SyncEnvs`.

    Each worker runs consecutive environments, as equal in number as possible.

    Args:
        makers: Functions that each make an environment; cloudpickle must support them. This process calls each once, to
            read its spaces.

    Attributes:
        observation_space: Observation space of a slot.
        action_space: Action space of a slot.
        render_mode: Render mode of the environments.
        counts: Number of slots of each environment.

    Raises:
        ValueError: If the spaces of environments differ.
    """

    def __init__(self, makers: Sequence[MakeEnv]) -> None:
        sample = SyncEnvs(makers)
        self.observation_space: spaces.Space[Any] = sample.observation_space
        self.action_space: spaces.Space[Any] = sample.action_space
        self.render_mode, self.counts = sample.render_mode, sample.counts
        self._layout = sample.layout
        sample.close()
        self._envs: list[slice] = []
        self._slots: list[slice] = []
        self._is_open = True
        self._sent = False

    @property
    def num_slots(self) -> int:
        """S."""
        return sum(self.counts)

    @property
    def num_workers(self) -> int:
        """P."""
        return len(self._envs)

    def reset(
        self, seeds: Sequence[int | None], options: Sequence[Mapping[str, Any]]
    ) -> tuple[dict[str, NDArray[Any]], Infos]:
        """Reset all environments; see `SyncEnvs.reset`."""
        self._discard_pending()
        for worker, envs in enumerate(self._envs):
            self._send(worker, "reset", list(seeds[envs]), list(options[envs]))
        answers = self._answers()
        return self._observations([seen for seen, _ in answers]), [info for _, infos in answers for info in infos]

    def step_async(self, actions: NDArray[Any]) -> None:
        """Start a step of all environments with actions (S, ...)."""
        self._discard_pending()
        for worker, slots in enumerate(self._slots):
            self._send(worker, "step", actions[slots])
        self._sent = True

    def step_wait(self) -> StepResult:
        """Wait for the end of the step, and return its result.

        Raises:
            RuntimeError: If no actions were sent.
        """
        if not self._sent:
            raise RuntimeError(NOTHING_SENT)
        self._sent = False
        answers: list[StepResult] = self._answers()
        return StepResult(
            self._observations([each.observations for each in answers]),
            np.concatenate([each.rewards for each in answers]),
            np.concatenate([each.dones for each in answers]),
            [info for each in answers for info in each.infos],
            np.concatenate([each.spent for each in answers]),
        )

    def ask(self, command: str, slots: Sequence[int], name: str, *rest: Any) -> list[Any]:
        """Get, set, test for or call an attribute of some slots, as `SyncEnvs.ask`; answers are pickled."""
        self._discard_pending()
        asked: dict[int, list[int]] = {}
        for slot in slots:
            worker = next(w for w, part in enumerate(self._slots) if part.start <= slot < part.stop)
            asked.setdefault(worker, []).append(slot)
        for worker, theirs in asked.items():
            local = [slot - self._slots[worker].start for slot in theirs]
            self._send(worker, "ask", command, local, name, *rest)
        results: dict[int, Any] = {}
        for worker, theirs in asked.items():
            results |= dict(zip(theirs, self._answer(worker), strict=True))
        return [results[slot] for slot in slots]

    @abstractmethod
    def close(self) -> None:
        """End all workers."""

    # ------------------------------------------------------------------ within

    def _divide(self, workers: int) -> None:
        """Divide environments and slots among workers.

        Raises:
            ValueError: If there are more workers than environments.
        """
        if workers > len(self.counts):
            hint = "Use fewer workers, or more environments."
            raise argument_error("workers", f"at most one per environment, {len(self.counts)}", workers, hint)
        ends = [0, *np.cumsum(self.counts).tolist()]
        for share in np.array_split(np.arange(len(self.counts)), workers):
            self._envs.append(slice(int(share[0]), int(share[-1]) + 1))
            self._slots.append(slice(ends[self._envs[-1].start], ends[self._envs[-1].stop]))

    @abstractmethod
    def _send(self, worker: int, command: str, *rest: Any) -> None:
        """Let a worker call a method of its `SyncEnvs`."""

    @abstractmethod
    def _answer(self, worker: int) -> Any:
        """Return the result of the last call; an error or the loss of a worker ends all workers."""

    def _answers(self) -> list[Any]:
        return [self._answer(worker) for worker in range(self.num_workers)]

    @abstractmethod
    def _observations(self, parts: Sequence[dict[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
        """Return new arrays (S, ...) by name, from those in the answers of all workers."""

    def _discard_pending(self) -> None:
        """Discard the result of a pending step, and refuse closed environments."""
        if not self._is_open:
            raise RuntimeError("environments: expected running workers, got closed ones. Make new ones.")
        if self._sent:
            self.step_wait()


class ProcessEnvs(WorkerEnvs):
    """Environments in worker processes.

    A worker writes observations into shared memory, which this process copies before the next step; everything else
    goes through a pipe. Workers use one thread each, leave SIGINT and SIGTERM to this process, and end when it ends. An
    error in a worker is raised here and ends all workers.

    Args:
        makers: Functions that each make an environment, see `WorkerEnvs`.
        workers: Number of processes, at least 1.
        prepare: Function called once in each process, in all at the same time, before environments are made, e.g. to
            load kernels. Picklable by cloudpickle.

    Raises:
        ValueError: If there are more workers than environments, or their spaces differ.
    """

    def __init__(self, makers: Sequence[MakeEnv], workers: int, prepare: Callable[[], object] = lambda: None) -> None:
        super().__init__(makers)
        self._divide(workers)
        context = get_context("spawn")
        memory = {
            name: context.RawArray("b", max(1, array.nbytes))
            for name, array in buffers(self._layout, self.num_slots).items()
        }
        self._seen = _views(memory, self._layout, self.num_slots)
        self._pipes: list[Connection] = []
        self._processes: list[Any] = []
        self._kill = partial(_kill, self._processes)
        atexit.register(self._kill)  # runs before multiprocessing's handler, which sends SIGTERM and waits
        with one_thread_each(), signals_held():
            for envs, slots in zip(self._envs, self._slots, strict=True):
                ours, theirs = context.Pipe()
                packed = cloudpickle.dumps((prepare, list(makers[envs])))
                process = context.Process(
                    target=_worker_loop, args=(theirs, packed, memory, slots, self.num_slots), daemon=True
                )
                process.start()
                theirs.close()
                self._pipes.append(ours)
                self._processes.append(process)

    def close(self) -> None:
        """End all processes."""
        self._is_open = False
        atexit.unregister(self._kill)
        for pipe in self._pipes:
            with suppress(OSError):
                pipe.send(("close",))
        deadline = time.monotonic() + CLOSE_S
        for process in self._processes:
            process.join(max(0.0, deadline - time.monotonic()))
            if process.is_alive():
                process.kill()
                process.join()
        for pipe in self._pipes:
            pipe.close()
        self._pipes, self._processes = [], []

    # ------------------------------------------------------------------ within

    def _send(self, worker: int, command: str, *rest: Any) -> None:
        with suppress(BrokenPipeError):  # a dead worker is detected when its answer is missing
            self._pipes[worker].send((command, *rest))

    def _answer(self, worker: int) -> Any:
        try:
            failed, answer = self._pipes[worker].recv()
        except (EOFError, ConnectionResetError):
            self._processes[worker].join(CLOSE_S)
            code = self._processes[worker].exitcode
            self.close()
            envs = self._envs[worker]
            text = f"worker {worker}: expected an answer of environments {envs.start} to {envs.stop - 1}, got an exit"
            raise RuntimeError(f"{text} with status {code}. Make new environments.") from None
        if failed:
            self.close()
            raise answer
        return answer

    def _observations(self, parts: Sequence[dict[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
        return {name: view.copy() for name, view in self._seen.items()}


def _kill(processes: Sequence[Any]) -> None:
    """Kill the workers of environments that were not closed."""
    for process in processes:
        process.kill()


def _views(memory: Mapping[str, Any], layout: Layout, slots: int) -> dict[str, NDArray[Any]]:
    """Return arrays (slots, ...) over shared memory."""
    return {
        name: np.frombuffer(memory[name], array.dtype, array.size).reshape(array.shape)
        for name, array in buffers(layout, slots).items()
    }


def _worker_loop(pipe: Connection, packed: bytes, memory: Mapping[str, Any], part: slice, slots: int) -> None:
    """Run a worker: answer commands until it is closed or the parent process is gone."""
    begin_worker()
    batch: SyncEnvs | None = None
    failure: Exception | None = None
    try:
        prepare, makers = cloudpickle.loads(packed)
        prepare()
        batch = SyncEnvs(makers)
        rows = {name: view[part] for name, view in _views(memory, batch.layout, slots).items()}
    except Exception as error:  # reported in the answer to the next command
        failure = with_traceback(error)
    while True:
        try:
            command, *rest = pipe.recv()
        except (EOFError, OSError):
            return
        if command == "close":
            if batch is not None:
                batch.close()
            return
        try:
            answer = (True, failure) if batch is None or failure else (False, _execute(batch, rows, command, rest))
        except Exception as error:
            answer = (True, with_traceback(error))
        if not _send_answer(pipe, answer):
            return


def _send_answer(pipe: Connection, answer: tuple[bool, Any]) -> bool:
    """Send an answer, or the error if it cannot be pickled; return whether the parent process still exists."""
    try:
        pipe.send(answer)
    except OSError:
        return False
    except Exception as error:
        return _send_answer(pipe, (True, with_traceback(error)))
    return True


def with_traceback(error: Exception) -> Exception:
    """Return the current error with its traceback as a note, which survives pickling."""
    error.add_note(f"In a worker:\n{traceback.format_exc()}")
    return error


def _execute(batch: SyncEnvs, rows: Mapping[str, NDArray[Any]], command: str, rest: Sequence[Any]) -> Any:
    """Execute a command; observations go to the shared rows, all other results into the answer."""
    answer = getattr(batch, command)(*rest)
    if command == "step":
        _write_rows(rows, answer.observations)
        return replace(answer, observations={})
    if command == "reset":
        _write_rows(rows, answer[0])
        return {}, answer[1]
    return answer


def _write_rows(rows: Mapping[str, NDArray[Any]], observations: Mapping[str, NDArray[Any]]) -> None:
    for name, array in observations.items():
        rows[name][...] = array
