"""`SlotWorkers`: the environments of a `SlotBatch` divided among processes; observations come by shared memory."""

import atexit
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
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
from training.rl.slots import NOTHING_SENT, Infos, Layout, MakeEnv, SlotBatch, Stepped, buffers

CLOSE_S = 5.0  # workers that have not ended by then are killed


class SlotWorkers:
    """Environments in other processes, with the methods and the results of a `SlotBatch`.

    Each worker takes a run of consecutive environments, as equal in number as can be. It writes observations into
    memory that it shares with this process, which copies them out before the next step; all else goes through a pipe.
    Workers use one thread each, leave SIGINT and SIGTERM to this process, and end when it does. An error in a worker is
    raised here, and ends all of them.

    Args:
        makers: Each makes an environment; what cloudpickle can pickle. This process makes each once, to see its spaces.
        workers: How many processes, at least 1.
        prepare: Called once in each of them, in all at a time, before environments are made: what it loads keeps no
            step waiting later. Picklable likewise.

    Attributes:
        observation_space: Of a slot.
        action_space: Of a slot.
        render_mode: Of the environments.
        counts: How many slots each environment has.

    Raises:
        ValueError: If there are more workers than environments, or their spaces differ.
    """

    def __init__(self, makers: Sequence[MakeEnv], workers: int, prepare: Callable[[], object] = lambda: None) -> None:
        sample = SlotBatch(makers)
        if workers > len(makers):
            cure = "Use fewer workers, or more environments."
            raise argument_error("workers", f"at most one per environment, {len(makers)}", workers, cure)
        self.observation_space: spaces.Space[Any] = sample.observation_space
        self.action_space: spaces.Space[Any] = sample.action_space
        self.render_mode, self.counts = sample.render_mode, sample.counts
        sample.close()
        context = get_context("spawn")
        memory = {
            name: context.RawArray("b", max(1, array.nbytes))
            for name, array in buffers(sample.layout, sample.num_slots).items()
        }
        self._seen = _views(memory, sample.layout, sample.num_slots)
        self._envs: list[slice] = []
        self._slots: list[slice] = []
        self._pipes: list[Connection] = []
        self._processes: list[Any] = []
        self._sent = False
        ends = [0, *np.cumsum(self.counts).tolist()]
        self._kill = partial(_kill, self._processes)
        atexit.register(self._kill)  # comes before multiprocessing's own, which sends SIGTERM and waits
        with one_thread_each(), signals_held():
            for share in np.array_split(np.arange(len(makers)), workers):
                envs = slice(int(share[0]), int(share[-1]) + 1)
                slots = slice(ends[envs.start], ends[envs.stop])
                ours, theirs = context.Pipe()
                packed = cloudpickle.dumps((prepare, list(makers[envs])))
                process = context.Process(target=_serve, args=(theirs, packed, memory, slots, ends[-1]), daemon=True)
                process.start()
                theirs.close()
                self._envs.append(envs)
                self._slots.append(slots)
                self._pipes.append(ours)
                self._processes.append(process)

    @property
    def num_slots(self) -> int:
        """S."""
        return sum(self.counts)

    def reset(
        self, seeds: Sequence[int | None], options: Sequence[Mapping[str, Any]]
    ) -> tuple[dict[str, NDArray[Any]], Infos]:
        """Reset all environments; as of `SlotBatch`."""
        self._settle()
        told = self._ask_all([("reset", list(seeds[envs]), list(options[envs])) for envs in self._envs])
        return self._copied(), [info for infos in told for info in infos]

    def send(self, actions: NDArray[Any]) -> None:
        """Let all environments begin a step with actions (S, ...)."""
        self._settle()
        for pipe, slots in zip(self._pipes, self._slots, strict=True):
            self._send(pipe, ("step", actions[slots]))
        self._sent = True

    def receive(self) -> Stepped:
        """Wait for the step to end, and return what it led to.

        Raises:
            RuntimeError: If nothing was sent.
        """
        if not self._sent:
            raise RuntimeError(NOTHING_SENT)
        self._sent = False
        told = self._answers()
        rewards, dones, spent = (np.concatenate([each[part] for each in told]) for part in (0, 1, 2))
        return Stepped(self._copied(), rewards, dones, [info for each in told for info in each[3]], spent)

    def ask(self, command: str, slots: Sequence[int], name: str, *rest: Any) -> list[Any]:
        """Get, set, look for or call an attribute of some slots, as `SlotBatch` does; what comes back is pickled."""
        self._settle()
        asked: dict[int, list[int]] = {}
        for slot in slots:
            worker = next(w for w, part in enumerate(self._slots) if part.start <= slot < part.stop)
            asked.setdefault(worker, []).append(slot)
        for worker, theirs in asked.items():
            local = [slot - self._slots[worker].start for slot in theirs]
            self._send(self._pipes[worker], ("ask", command, local, name, *rest))
        found: dict[int, Any] = {}
        for worker, theirs in asked.items():
            found |= dict(zip(theirs, self._answer(worker), strict=True))
        return [found[slot] for slot in slots]

    def close(self) -> None:
        """End all processes."""
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

    def _settle(self) -> None:
        """Take back a step that nobody waited for, and refuse to go on after the end."""
        if not self._pipes:
            raise RuntimeError("environments: expected running workers, got closed ones. Make new ones.")
        if self._sent:
            self.receive()

    def _ask_all(self, messages: Sequence[tuple[Any, ...]]) -> list[Any]:
        for pipe, message in zip(self._pipes, messages, strict=True):
            self._send(pipe, message)
        return self._answers()

    def _send(self, pipe: Connection, message: tuple[Any, ...]) -> None:
        with suppress(BrokenPipeError):  # a worker that died is found out when its answer is missed
            pipe.send(message)

    def _answers(self) -> list[Any]:
        return [self._answer(worker) for worker in range(len(self._pipes))]

    def _answer(self, worker: int) -> Any:
        """Return what a worker answers; its error, or its death, ends all workers."""
        try:
            failed, answer = self._pipes[worker].recv()
        except (EOFError, ConnectionResetError):
            self._processes[worker].join(CLOSE_S)
            code = self._processes[worker].exitcode
            self.close()
            envs = self._envs[worker]
            text = f"worker {worker}: expected an answer of environments {envs.start} to {envs.stop - 1}, got its end"
            raise RuntimeError(f"{text} with status {code}. Make new environments.") from None
        if failed:
            self.close()
            raise answer
        return answer

    def _copied(self) -> dict[str, NDArray[Any]]:
        return {name: view.copy() for name, view in self._seen.items()}


def _kill(processes: Sequence[Any]) -> None:
    """End the workers of environments that were never closed."""
    for process in processes:
        process.kill()


def _views(memory: Mapping[str, Any], layout: Layout, slots: int) -> dict[str, NDArray[Any]]:
    """Return arrays (slots, ...) over shared memory."""
    return {
        name: np.frombuffer(memory[name], array.dtype, array.size).reshape(array.shape)
        for name, array in buffers(layout, slots).items()
    }


def _serve(pipe: Connection, packed: bytes, memory: Mapping[str, Any], part: slice, slots: int) -> None:
    """Run a worker: answer commands until told to close, or until the other process is gone."""
    begin_worker()
    batch: SlotBatch | None = None
    failure: Exception | None = None
    try:
        prepare, makers = cloudpickle.loads(packed)
        prepare()
        batch = SlotBatch(makers)
        rows = {name: view[part] for name, view in _views(memory, batch.layout, slots).items()}
    except Exception as error:  # told when something is asked for
        failure = _noted(error)
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
            answer = (True, failure) if batch is None or failure else (False, _obey(batch, rows, command, rest))
        except Exception as error:
            answer = (True, _noted(error))
        if not _answered(pipe, answer):
            return


def _answered(pipe: Connection, answer: tuple[bool, Any]) -> bool:
    """Send an answer, or the error of one that cannot be pickled; return whether the other process is still there."""
    try:
        pipe.send(answer)
    except OSError:
        return False
    except Exception as error:
        return _answered(pipe, (True, _noted(error)))
    return True


def _noted(error: Exception) -> Exception:
    """Return an error that is being handled, with its traceback as a note, which other processes get to see."""
    error.add_note(f"In a worker:\n{traceback.format_exc()}")
    return error


def _obey(batch: SlotBatch, rows: Mapping[str, NDArray[Any]], command: str, rest: Sequence[Any]) -> Any:
    """Carry out a command; observations go to the shared rows, the answer is what else there is to tell."""
    if command == "step":
        stepped = batch.step(rest[0])
        _show(rows, stepped.observations)
        return stepped.rewards, stepped.dones, stepped.spent, stepped.infos
    if command == "reset":
        observations, infos = batch.reset(*rest)
        _show(rows, observations)
        return infos
    return getattr(batch, command)(*rest)


def _show(rows: Mapping[str, NDArray[Any]], observations: Mapping[str, NDArray[Any]]) -> None:
    for name, array in observations.items():
        rows[name][...] = array
