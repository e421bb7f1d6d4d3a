"""Compilation, by other processes, of the kernels that a program will soon call.

A kernel that the disk cache lacks is compiled when it is called, by the calling process, on one core. A program that
has said what it will need (`expect`) lets the other cores compile the rest of that meanwhile: first what it will call
soon, and of that what takes longest. A kernel that one of them has begun is waited for when it is called, and the
caller compiles others meanwhile; one that none has begun is compiled by the caller.
"""

import atexit
import logging
import os
import subprocess
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

from numba.core.targetconfig import ConfigStack

from slam_backend.core.compilation.compiler import (
    Signatures,
    Task,
    available_cores,
    cache_lock,
    compile_lines,
    encode_signature,
    kernel_name,
    missing_tasks,
    start_worker,
)

if TYPE_CHECKING:
    from filelock import FileLock

LOGGER = logging.getLogger("slam_backend")
MOST = 3  # processes beside the program: the longest kernel takes a third of all that an environment needs at first
Needed = Callable[[], Signatures]


class Helpers:
    """Worker processes that compile kernels, each of them once, until none is left.

    Args:
        tasks: Kernels to compile.
        later: Prefixes of the names of kernels that come last.
        number: Number of processes.
        lock: Lock on the cache, released when they have ended.
    """

    def __init__(self, tasks: Sequence[Task], later: tuple[str, ...], number: int, lock: "FileLock") -> None:
        longest_first = sorted(tasks, key=lambda task: (task.name.startswith(later), -sum(task.parts.values())))
        self.process = os.getpid()
        self._lines = [f"{task.name} {task.signature}" for task in longest_first]
        self._later = later
        self._begun: set[str] = set()
        self._changed = threading.Condition()
        self._lock = lock
        self._workers = [start_worker() for _ in range(min(number, len(tasks)))]
        self._threads = [threading.Thread(target=self._serve, args=(w,), daemon=True) for w in self._workers]
        self._serving = len(self._threads)
        for thread in self._threads:
            thread.start()

    def wait_for(self, line: str, helps: bool = False) -> bool:
        """Wait until a kernel is compiled if a worker has begun with it; else leave it to the caller.

        Args:
            line: Name and signature.
            helps: Whether to compile meanwhile, in this process, what the program will call soon.

        Returns:
            Whether a worker had begun with it; it is in the cache then, unless the worker failed.
        """
        with self._changed:
            if line in self._lines:
                self._lines.remove(line)
            if line not in self._begun:
                return False
        while helps and (other := self._take_soon(line)):
            compile_lines(iter([other]), lambda done: None)
        with self._changed:
            self._changed.wait_for(lambda: line not in self._begun)
        return True

    def _take_soon(self, line: str) -> str:
        """Return a kernel for this process to compile; empty: none will be called soon, or the awaited one is done."""
        with self._changed:
            soon = [other for other in self._lines if not other.startswith(self._later)]
            if line not in self._begun or not soon:
                return ""
            self._lines.remove(soon[0])
            return soon[0]

    def end(self) -> None:
        """End the workers and release the lock."""
        with self._changed:
            self._lines.clear()
        for worker in self._workers:
            worker.terminate()
        for thread in self._threads:
            thread.join()

    def _serve(self, worker: "subprocess.Popen[str]") -> None:
        """Give a worker one kernel after the other."""
        assert worker.stdin is not None
        assert worker.stdout is not None
        with suppress(OSError):  # the worker was ended
            while line := self._next_line():
                try:
                    worker.stdin.write(f"{line}\n")
                    worker.stdin.flush()
                    if not worker.stdout.readline():
                        break
                finally:
                    with self._changed:
                        self._begun.discard(line)
                        self._changed.notify_all()
        with suppress(OSError):
            worker.stdin.close()
        worker.stdout.close()
        worker.wait()
        with self._changed:
            self._serving -= 1
            if not self._serving:
                self._lock.release()

    def _next_line(self) -> str:
        """Return the next kernel to compile; empty: none is left."""
        with self._changed:
            if not self._lines:
                return ""
            line = self._lines.pop(0)
            self._begun.add(line)
            return line


# What the program said it will need, and prefixes of what it calls last; None: nothing, or it was asked for already.
_needed: tuple[Needed, tuple[str, ...]] | None = None
_helpers: Helpers | None = None
_is_set_aside = False


def expect(needed: Needed, later: tuple[str, ...] = ()) -> None:
    """Say what this program will call. Nothing happens unless it calls a kernel that the cache lacks.

    Args:
        needed: Function that returns signatures by dotted name of a kernel.
        later: Prefixes of the names of kernels that it calls later than others.
    """
    global _needed
    if not _is_set_aside:
        _needed = needed, later


def await_kernel(kernel: Any, signature: Sequence[Any]) -> bool:
    """Return, before a kernel is compiled, whether a worker has compiled it meanwhile; wait for it if it has begun."""
    if _needed is None and (_helpers is None or _helpers.process != os.getpid()):
        return False
    line = f"{kernel_name(kernel)} {encode_signature(signature)}"
    if _needed is not None:
        _start(*_needed, line)
    # A compilation within another one may inherit its options.
    return _helpers is not None and _helpers.wait_for(line, helps=not ConfigStack())  # type: ignore[no-untyped-call]


@contextmanager
def set_aside() -> Iterator[None]:
    """End the workers of this process, and start none within the block."""
    global _needed, _is_set_aside
    _end()
    before, _needed, _is_set_aside = _is_set_aside, None, True
    try:
        yield
    finally:
        _is_set_aside = before


def _start(needed: Needed, later: tuple[str, ...], own: str) -> None:
    """Start workers on the other cores, unless another process compiles for the same cache.

    Args:
        needed: Function that returns the signatures of the kernels to compile.
        later: Prefixes of the names of those that come last.
        own: Name and signature of the kernel that the caller compiles.
    """
    global _needed, _helpers
    _needed = None
    number = min(available_cores() - 1, MOST)
    if number < 1 or (_helpers is not None and _helpers.process == os.getpid()):
        return
    _helpers = None  # of the process that forked this one
    try:
        tasks = [task for task in missing_tasks(needed()) if f"{task.name} {task.signature}" != own]
        if tasks:
            lock = cache_lock()
            lock.acquire(blocking=False)
            _helpers = Helpers(tasks, later, number, lock)
    except OSError as error:
        LOGGER.debug("Not compiled ahead: %s", error)


@atexit.register
def _end() -> None:
    """End the workers that this process has started."""
    global _helpers
    if _helpers is not None and _helpers.process == os.getpid():
        _helpers.end()
    _helpers = None
