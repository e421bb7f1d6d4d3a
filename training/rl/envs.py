"""Environments of a vector environment, one slot per robot: `SyncEnvs` in this process, `WorkerEnvs` in workers."""

import atexit
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any

import cloudpickle
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from slam_backend.core.validation import BoolArray, Float32Array, FloatArray, argument_error
from training.experiments.machine.cluster import ClusterPool, with_traceback
from training.experiments.machine.interrupt import begin_worker, signals_held
from training.experiments.trial_store import one_thread_each

CLOSE_S = 5.0  # time after which running workers are killed
MakeEnv = Callable[[], ParallelEnv[str, Any, Any]]
Infos = list[dict[str, Any]]
WHOLE = ""  # name of the array of a plain box observation
MASK = "action_mask"
NOTHING_SENT = "step_wait: expected actions, got none. Call step_async() first."
Layout = tuple[tuple[str, tuple[int, ...], np.dtype[Any]], ...]  # names, shapes and types of observations


@dataclass(frozen=True, slots=True, eq=False)
class StepResult:
    """Result of a step for all slots."""

    observations: dict[str, NDArray[Any]]  # Arrays (S, ...) by name; not shared
    rewards: Float32Array  # (S,) float32
    dones: BoolArray  # (S,) bool. Whether the episode ended; the observation is then the first of the next.
    infos: Infos  # One dict per slot
    # (P, 2) float64 [s]. Wall-clock time and processor time that the environments of each process took.
    spent: FloatArray


@dataclass(frozen=True, slots=True)
class Slot:
    """One robot of one environment; missing attributes are looked up in the environment."""

    env: Any
    agent: str

    def __getattr__(self, name: str) -> Any:
        return getattr(self.env, name)


def row_layout(space: spaces.Space[Any]) -> Layout:
    """Return names, shapes and dtypes of the observations of a space; a plain box has the name `""`.

    Raises:
        ValueError: If the space is neither a box nor a dict of boxes.
    """
    boxes = dict(space.spaces) if isinstance(space, spaces.Dict) else {WHOLE: space}
    if not all(isinstance(box, spaces.Box) for box in boxes.values()):
        raise argument_error("observation_space", "a Box or a Dict of boxes", space, "Flatten nested spaces.")
    return tuple((name, box.shape or (), np.dtype(box.dtype)) for name, box in boxes.items())


def buffers(layout: Layout, slots: int) -> dict[str, NDArray[Any]]:
    """Return uninitialised arrays (slots, ...) by name."""
    return {name: np.empty((slots, *shape), dtype) for name, shape, dtype in layout}


def stacked(layout: Layout, observations: Sequence[Any]) -> dict[str, NDArray[Any]]:
    """Return new arrays (S, ...) by name, with one row for each of S observations; no memory is shared.

    One call joins the rows of each name: one assignment per row takes twice as long.
    """
    values = {}
    for name, rows in buffers(layout, len(observations)).items():
        parts = observations if name == WHOLE else [one[name] for one in observations]
        if rows.ndim == 1:
            rows[:] = parts
        else:
            np.concatenate(parts, out=rows.reshape(-1, *rows.shape[2:]))
        values[name] = rows
    return values


class SyncEnvs:
    """Environments in this process, with slots ordered by environment, then by agent.

    An environment whose episode ends is reset at once. Each environment gives the same results as it would alone.

    Args:
        makers: Functions that each make an environment; all agents of all environments have the same spaces.

    Attributes:
        observation_space: Observation space of a slot.
        action_space: Action space of a slot.
        render_mode: Render mode of the environments.
        counts: Number of slots of each environment.
        layout: Layout of the observations of a slot.

    Raises:
        ValueError: If there is no environment, or spaces or render modes differ.
    """

    def __init__(self, makers: Sequence[MakeEnv]) -> None:
        if not makers:
            raise argument_error("makers", "at least one function", list(makers), "Give a function per environment.")
        self.envs: list[Any] = [make() for make in makers]
        self.slots = [Slot(env, agent) for env in self.envs for agent in env.possible_agents]
        self._agents: list[tuple[str, ...]] = [tuple(env.possible_agents) for env in self.envs]
        self.counts = [len(agents) for agents in self._agents]
        first = self.slots[0]
        self.observation_space = first.env.observation_space(first.agent)
        self.action_space = first.env.action_space(first.agent)
        self.render_mode: str | None = first.env.render_mode
        for slot in self.slots:
            for kind in ("observation_space", "action_space"):
                theirs = getattr(slot.env, kind)(slot.agent)
                if theirs != getattr(self, kind):
                    raise argument_error(kind, "the same for all agents", theirs, "Use one configuration.")
            if slot.env.render_mode != self.render_mode:
                raise argument_error("render_mode", "the same for all", slot.env.render_mode, "Use one configuration.")
        self.layout = row_layout(self.observation_space)
        self._results: StepResult | None = None

    @property
    def num_slots(self) -> int:
        """S."""
        return len(self.slots)

    def reset(
        self, seeds: Sequence[int | None], options: Sequence[Mapping[str, Any]]
    ) -> tuple[dict[str, NDArray[Any]], Infos]:
        """Reset all environments.

        Returns:
            Observations (S, ...) by name, and infos.
        """
        results = [
            env.reset(seed=seed, options=dict(option))
            for env, seed, option in zip(self.envs, seeds, options, strict=True)
        ]
        observations, infos = map(self._by_slot, zip(*results, strict=True))
        return stacked(self.layout, observations), infos

    def step(self, actions: NDArray[Any]) -> StepResult:
        """Step all environments with actions (S, ...)."""
        chosen = iter(actions)  # each environment takes one action per agent
        wanted = [dict(zip(agents, chosen, strict=False)) for agents in self._agents]
        begin = time.perf_counter(), time.process_time()
        # No other work is done between the steps: they evict the caches, so that work after each step is slow.
        results = [env.step(each) for env, each in zip(self.envs, wanted, strict=True)]
        begun = [each[0] if env.agents else env.reset()[0] for env, each in zip(self.envs, results, strict=True)]
        spent = np.array([[time.perf_counter() - begin[0], time.process_time() - begin[1]]])
        last, rewards, over, cut, infos = map(self._by_slot, zip(*results, strict=True))
        for info, terminated, truncated, observation in zip(infos, over, cut, last, strict=True):
            info["TimeLimit.truncated"] = truncated and not terminated
            if terminated or truncated:
                info["terminal_observation"] = observation
        observations = stacked(self.layout, self._by_slot(begun))
        return StepResult(observations, np.array(rewards, np.float32), np.logical_or(over, cut), infos, spent)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Step with actions (S, ...); `step_wait` returns the result."""
        self._results = self.step(actions)

    def step_wait(self) -> StepResult:
        """Return the result of the last `step_async`.

        Raises:
            RuntimeError: If no actions were sent.
        """
        if self._results is None:
            raise RuntimeError(NOTHING_SENT)
        results, self._results = self._results, None
        return results

    def ask(self, command: str, slots: Sequence[int], name: str, *rest: Any) -> list[Any]:
        """Get, set, test for or call an attribute of some slots, once per slot.

        Args:
            command: `"get"`, `"set"`, `"has"` or `"call"`.
            name: Name of the attribute; if a slot lacks it, the environment's attribute is used.
            rest: Value to set, or positional and keyword arguments of the call.
        """
        chosen = [self.slots[slot] for slot in slots]
        if command == "has":
            return [hasattr(slot, name) for slot in chosen]
        if command == "set":
            for slot in chosen:
                setattr(slot.env, name, *rest)
            return [None] * len(chosen)
        values = [getattr(slot, name) for slot in chosen]
        return values if command == "get" else [method(*rest[0], **rest[1]) for method in values]

    def close(self) -> None:
        """Close all environments."""
        for env in self.envs:
            env.close()

    def _by_slot(self, by_env: Sequence[Mapping[str, Any]]) -> list[Any]:
        """Return the values of all agents, slot by slot."""
        return [of[agent] for of, agents in zip(by_env, self._agents, strict=True) for agent in agents]


class WorkerEnvs:
    """Environments divided among workers, with the methods and the results of `SyncEnvs`.

    Each worker runs consecutive environments, as equal in number as possible. An error in a worker is raised here and
    ends all workers, as does the loss of one.

    Args:
        makers: Functions that each make an environment; cloudpickle must support them. This process calls each once, to
            read its spaces.
        workers: Number of workers; 0 on a cluster: its cores, at most one per environment.
        prepare: Function called once in each worker before environments are made, e.g. to load kernels.
        cluster: Address of a Ray cluster that runs the workers, see `ray.init`. None: processes of this machine.

    Attributes:
        observation_space: Observation space of a slot.
        action_space: Action space of a slot.
        render_mode: Render mode of the environments.
        counts: Number of slots of each environment.

    Raises:
        ValueError: If there are more workers than environments, their spaces differ, or the cluster cannot be used.
    """

    def __init__(
        self, makers: Sequence[MakeEnv], workers: int, prepare: Callable[[], object] = lambda: None,
        cluster: str | None = None,
    ) -> None:  # fmt: skip
        sample = SyncEnvs(makers)
        self.observation_space: spaces.Space[Any] = sample.observation_space
        self.action_space: spaces.Space[Any] = sample.action_space
        self.render_mode, self.counts = sample.render_mode, sample.counts
        sample.close()
        self._envs: list[slice] = []
        self._slots: list[slice] = []
        self._is_open, self._sent = True, False
        self._pool = ProcessPool(sample.layout, self.num_slots) if cluster is None else ClusterPool(cluster)
        try:
            self._divide(self._pool.size(workers, len(makers)))
            parts = [partial(_make_batch, prepare, list(makers[envs])) for envs in self._envs]
            self._pool.start(list(map(cloudpickle.dumps, parts)), self._slots)
        except BaseException:
            self.close()
            raise

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
            self._pool.send(worker, "reset", list(seeds[envs]), list(options[envs]))
        answers = self._answers()
        return self._observations([seen for seen, _ in answers]), [info for _, infos in answers for info in infos]

    def step_async(self, actions: NDArray[Any]) -> None:
        """Start a step of all environments with actions (S, ...)."""
        self._discard_pending()
        for worker, slots in enumerate(self._slots):
            self._pool.send(worker, "step", actions[slots])
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
            self._pool.send(worker, "ask", command, local, name, *rest)
        results: dict[int, Any] = {}
        for worker, theirs in asked.items():
            results |= dict(zip(theirs, self._answer(worker), strict=True))
        return [results[slot] for slot in slots]

    def close(self) -> None:
        """End all workers."""
        self._is_open = False
        self._pool.close()

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

    def _answer(self, worker: int) -> Any:
        """Return the result of the last call of a worker."""
        envs = self._envs[worker]
        try:
            return self._pool.answer(worker, f"environments {envs.start} to {envs.stop - 1}")
        except Exception:
            self.close()
            raise

    def _answers(self) -> list[Any]:
        return [self._answer(worker) for worker in range(self.num_workers)]

    def _observations(self, parts: Sequence[dict[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
        """Return new arrays (S, ...) by name, from the shared memory of processes or those in all answers."""
        if isinstance(self._pool, ProcessPool):
            return {name: view.copy() for name, view in self._pool.seen.items()}
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    def _discard_pending(self) -> None:
        """Discard the result of a pending step, and refuse closed environments."""
        if not self._is_open:
            raise RuntimeError("environments: expected running workers, got closed ones. Make new ones.")
        if self._sent:
            self.step_wait()


def _make_batch(prepare: Callable[[], object], makers: Sequence[MakeEnv]) -> SyncEnvs:
    """Make the environments of a worker."""
    prepare()
    return SyncEnvs(makers)


class ProcessPool:
    """Worker processes on this machine, which use one thread each and leave SIGINT and SIGTERM to this process.

    A worker writes observations into shared memory, which this process copies before the next step; everything else
    goes through a pipe. Workers end when this process ends.

    Args:
        layout: Layout of the observations of a slot.
        num_slots: Number of slots of all workers.

    Attributes:
        seen: Observations (S, ...) by name, in shared memory.
    """

    def __init__(self, layout: Layout, num_slots: int) -> None:
        self._context = get_context("spawn")
        self._layout, self._num_slots = layout, num_slots
        self._memory = {
            name: self._context.RawArray("b", max(1, array.nbytes))
            for name, array in buffers(layout, num_slots).items()
        }
        self.seen = _views(self._memory, layout, num_slots)
        self._pipes: list[Connection] = []
        self._processes: list[Any] = []
        self._kill = partial(_kill, self._processes)
        atexit.register(self._kill)  # runs before multiprocessing's handler, which sends SIGTERM and waits

    def size(self, workers: int, most: int) -> int:
        """Return the number of workers."""
        return workers

    def start(self, packed: Sequence[bytes], parts: Sequence[slice]) -> None:
        """Start a process for each pickled function that makes a worker's environments, with these slots."""
        with one_thread_each(), signals_held():
            for make, part in zip(packed, parts, strict=True):
                ours, theirs = self._context.Pipe()
                process = self._context.Process(
                    target=_worker_loop, args=(theirs, make, self._memory, part, self._num_slots), daemon=True
                )
                process.start()
                theirs.close()
                self._pipes.append(ours)
                self._processes.append(process)

    def send(self, worker: int, command: str, *rest: Any) -> None:
        """Let a worker call a method of its `SyncEnvs`."""
        with suppress(BrokenPipeError):  # a dead worker is detected when its answer is missing
            self._pipes[worker].send((command, *rest))

    def answer(self, worker: int, what: str) -> Any:
        """Return the result of the last call, or raise its error or that of the loss of the worker of `what`."""
        try:
            failed, answer = self._pipes[worker].recv()
        except (EOFError, ConnectionResetError):
            self._processes[worker].join(CLOSE_S)
            text = f"worker {worker}: expected an answer of {what}, got an exit with status "
            raise RuntimeError(f"{text}{self._processes[worker].exitcode}. Make new environments.") from None
        if failed:
            raise answer
        return answer

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
        batch = cloudpickle.loads(packed)()
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
