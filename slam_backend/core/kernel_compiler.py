"""Compilation of kernels by several processes, into the disk cache that later processes read.

numba compiles under one lock per process, so that threads do not help. The signatures of the kernels that Python calls
are recorded in a file of each package; the kernels that these call are compiled with them. Which process compiles what
decides nothing: a kernel's machine code depends on its sources, its signature and its options alone.
"""

import importlib
import json
import logging
import math
import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from queue import Queue
from typing import Any

from filelock import FileLock, Timeout
from numba import from_dtype, types
from numba.core.registry import CPUDispatcher
from numpy import dtype

from slam_backend.core.jit import DeviceKernel
from slam_backend.core.kernel_cache import KernelCache
from slam_backend.core.validation import check_int

LOGGER = logging.getLogger("slam_backend")
SIGNATURES = "kernel_signatures.json"  # in the folder of each package
WORKER = "slam_backend.core.compile_kernels"  # run as `python -m`: no script of the user's needs a main guard
LOCK = "vslam-compile.lock"
READ_ONLY = "r"  # ends the code of an array that cannot be written to
WORD = re.compile(r"[^\s(]+(?:\([^)]*\))?")  # of a signature; a named tuple holds no other

Signatures = Mapping[str, Sequence[str]]  # by dotted name of a kernel: its signatures, see `encoded`
Progress = Callable[[int, int, float], None]  # kernels done, of how many, and estimated seconds left


# ---------------------------------------------------------------------- signatures


def recorded_signatures(*packages: str) -> dict[str, list[str]]:
    """Return the signatures that are recorded of the kernels that Python calls in some packages."""
    found: dict[str, list[str]] = {}
    for package in packages:
        file = Path(str(importlib.import_module(package).__file__)).with_name(SIGNATURES)
        found |= json.loads(file.read_text(encoding="utf-8"))
    return found


def compiled_signatures(package: str) -> dict[str, list[str]]:
    """Return the signatures of all kernels of a package that Python called in this process, by name, ascending."""
    modules = [module for name, module in sys.modules.items() if name.split(".")[0] == package]
    kernels = {
        kernel_name(value): value
        for module in modules
        for value in vars(module).values()
        if isinstance(value, CPUDispatcher) and not isinstance(value, DeviceKernel)
    }
    own = {name: kernel for name, kernel in kernels.items() if name.split(".")[0] == package and kernel.signatures}
    return {name: sorted(map(encode_signature, own[name].signatures)) for name in sorted(own)}


def kernel_name(kernel: CPUDispatcher) -> str:
    """Return the dotted name of a kernel."""
    return f"{kernel.py_func.__module__}.{kernel.py_func.__qualname__}"


def find_kernel(name: str) -> CPUDispatcher | None:
    """Import a kernel by its dotted name; None: kernels are plain functions here (`NUMBA_DISABLE_JIT`)."""
    module, _, function = name.rpartition(".")
    kernel = getattr(importlib.import_module(module), function)
    return kernel if isinstance(kernel, CPUDispatcher) else None


def encode_signature(signature: Sequence[types.Type]) -> str:
    """Return argument types as words.

    `float64` is a number, `float64[2C]` an array, `float64[2Cr]` a read-only one, `module.Class(float64 int64[1C])` a
    named tuple and `builtins.tuple(float64 int64[1C])` a plain one, which reaches a kernel 1 us sooner.
    """
    return " ".join(map(_word, signature))


def _word(argument: types.Type) -> str:
    if isinstance(argument, types.BaseTuple):
        fields: Any = argument
        kind = getattr(argument, "instance_class", tuple)
        return f"{kind.__module__}.{kind.__qualname__}({encode_signature(fields.types)})"
    if isinstance(argument, types.Array):
        read_only = "" if argument.mutable else READ_ONLY
        return f"{argument.dtype}[{argument.ndim}{argument.layout}{read_only}]"
    return str(argument)


def decode_signature(words: str) -> tuple[types.Type, ...]:
    """Return the argument types that `encoded` wrote down."""
    return tuple(map(_type, WORD.findall(words)))


def _type(word: str) -> Any:
    if word == "none":
        return types.none
    if word.endswith(")"):
        name, _, fields = word.removesuffix(")").partition("(")
        module, _, record = name.rpartition(".")
        from_types: Any = types.BaseTuple.from_types
        return from_types(decode_signature(fields), getattr(importlib.import_module(module), record))
    name, _, array = word.partition("[")
    element: Any = from_dtype(dtype(name))
    if not array:
        return element
    shape = array.removesuffix("]").removesuffix(READ_ONLY)
    layout: Any = shape[-1]
    return types.Array(element, int(shape[:-1]), layout, readonly=array.endswith(READ_ONLY + "]"))


# ---------------------------------------------------------------------- what has to be compiled, and by whom


@dataclass(frozen=True)
class Task:
    """A kernel that Python calls, in one of its signatures.

    Attributes:
        name: Dotted name.
        signature: See `encoded`.
        parts: Size of the code of the kernel and of each that it calls, by dotted name.
        folder: Of the cache's files.
    """

    name: str
    signature: str
    parts: Mapping[str, int]
    folder: str


def missing_tasks(signatures: Signatures) -> list[Task]:
    """Return what the disk cache does not hold; nothing where there is no cache, or no compiler."""
    tasks = []
    for name, words in signatures.items():
        kernel = find_kernel(name)
        cache = None if kernel is None else getattr(kernel, "_cache", None)
        if kernel is None or not isinstance(cache, KernelCache) or cache.cache_path is None:
            continue
        for signature in words:
            context: Any = kernel.targetctx
            if not cache.holds(decode_signature(signature), context.codegen()):
                tasks.append(Task(name, signature, _code_sizes(kernel), cache.cache_path))
    return tasks


def _code_sizes(kernel: CPUDispatcher) -> dict[str, int]:
    """Return the size of the code of a kernel and of all that it calls, by dotted name."""
    sizes: dict[str, int] = {}
    todo = [kernel]
    while todo:
        function = todo.pop().py_func
        name = f"{function.__module__}.{function.__qualname__}"
        if name not in sizes:
            sizes[name] = len(function.__code__.co_code)
            named = (function.__globals__.get(word) for word in function.__code__.co_names)
            todo += [value for value in named if isinstance(value, CPUDispatcher)]
    return sizes


def divide_tasks(tasks: Sequence[Task], workers: int) -> list[list[Task]]:
    """Divide tasks so that all workers have about as much to do; what two tasks both call is compiled once by each."""
    shares: list[list[Task]] = [[] for _ in range(workers)]
    known: list[dict[str, int]] = [{} for _ in range(workers)]
    for task in sorted(tasks, key=lambda task: -sum(task.parts.values())):
        costs = [sum(has.values()) + sum(n for part, n in task.parts.items() if part not in has) for has in known]
        chosen = costs.index(min(costs))
        shares[chosen].append(task)
        known[chosen] |= task.parts
    return [share for share in shares if share]


# ---------------------------------------------------------------------- compilation


def compile_kernels(signatures: Signatures, workers: int | None = None, progress: Progress | None = None) -> float:
    """Compile what the disk cache does not hold, in several processes; another process that does so is waited for.

    Args:
        signatures: By dotted name of a kernel, see `encoded`.
        workers: Processes; None: one for each core. With one nothing is started: kernels are compiled when called.
        progress: Called when a kernel is done.

    Returns:
        Seconds that this took; 0 if nothing was missing.
    """
    workers = available_cores() if workers is None else check_int("workers", workers, 1, "Use at least one process.")
    if workers < 2 or not (tasks := missing_tasks(signatures)):
        return 0.0
    begun = time.perf_counter()
    lock = FileLock(Path(tasks[0].folder) / LOCK)
    try:
        try:
            lock.acquire(blocking=False)
        except Timeout:
            LOGGER.info("Waiting for another process, which compiles the kernels ...")
            lock.acquire()
        tasks = missing_tasks(signatures)  # another process may have compiled them meanwhile
        for done, left in _compiled(divide_tasks(tasks, workers), begun):
            if progress is not None:
                progress(done, len(tasks), left)
    except OSError as error:  # kernels are compiled when they are called, then
        LOGGER.debug("Not compiled in advance: %s", error)
    finally:
        lock.release()
    return time.perf_counter() - begun


def available_cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _compiled(shares: Sequence[Sequence[Task]], begun: float) -> Iterator[tuple[int, float]]:
    """Let one process compile each share; yield, when a kernel is done, how many are, and about how long it will take.

    Kernels of a process that fails are compiled when they are called.
    """
    if not shares:
        return
    yield 0, math.nan
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    lines: Queue[str | None] = Queue()
    sizes = {f"{task.name} {task.signature}": sum(task.parts.values()) for share in shares for task in share}
    whole, done, size = sum(sizes.values()), 0, 0
    processes = [
        subprocess.Popen(
            [sys.executable, "-m", WORKER],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment,
        )
        for _ in shares
    ]  # fmt: skip
    try:
        for process, share in zip(processes, shares, strict=True):
            assert process.stdin is not None
            process.stdin.write("".join(f"{task.name} {task.signature}\n" for task in share))
            process.stdin.close()
            threading.Thread(target=_forward_lines, args=(process, lines), daemon=True).start()
        ended = 0
        while ended < len(processes):
            line = lines.get()
            if line is None:
                ended += 1
                continue
            done, size = done + 1, size + sizes.get(line, 0)
            yield done, (time.perf_counter() - begun) * (whole - size) / max(size, 1)
    finally:
        for process in processes:
            process.terminate()
            process.wait()


def _forward_lines(process: subprocess.Popen[str], lines: "Queue[str | None]") -> None:
    """Put what a process prints into a queue, and None when it ends."""
    assert process.stdout is not None
    for line in process.stdout:
        lines.put(line.strip())
    lines.put(None)


def compile_lines(lines: Iterator[str], report: Callable[[str], Any]) -> None:
    """Compile the kernels that lines name, each followed by a signature; report each when it is in the cache."""
    for line in lines:
        name, _, words = line.strip().partition(" ")
        kernel = find_kernel(name)
        if kernel is not None:
            kernel.compile(decode_signature(words))
        report(line.strip())
