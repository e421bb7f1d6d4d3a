"""Compilation of kernels by several processes into the disk cache.

numba compiles under one lock per process, so that threads do not help. A file in each package lists the signatures of
the kernels that Python calls; the kernels that these call are compiled with them. A kernel's machine code depends only
on its sources, its signature and its options, not on the process that compiles it.
"""

import gc
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
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from queue import Queue
from typing import TYPE_CHECKING, Any, cast

from numba import from_dtype, types
from numba.core.registry import CPUDispatcher
from numpy import dtype

from slam_backend.core.compilation.cache import KernelCache, cache_folder
from slam_backend.core.compilation.messages import announce
from slam_backend.core.compilation.shipped import CONFIG
from slam_backend.core.jit import DeviceKernel
from slam_backend.core.validation import check_int

if TYPE_CHECKING:
    from filelock import FileLock

LOGGER = logging.getLogger("slam_backend")
SIGNATURES = "kernel_signatures.json"  # file in the folder of each package
WORKER = "slam_backend.core.compilation.worker"  # run as `python -m`, so that user scripts need no main guard
LOCK = "vslam-compile.lock"
RECORD = "slam_backend.fastslam.options.KERNEL_OPTIONS"  # the only structured type of arrays, written `RECORD[]`
READ_ONLY = "r"  # suffix of the code of a read-only array
WORD = re.compile(r"[^\s(]+(?:\([^)]*\))?")  # word of a signature; named tuples are not nested

Signatures = Mapping[str, Sequence[str]]  # signatures by dotted name of a kernel, see `encode_signature`
Progress = Callable[[int, int, float], None]  # number of kernels compiled, total number, estimated seconds left


# ---------------------------------------------------------------------- signatures


def recorded_signatures(*packages: str) -> dict[str, list[str]]:
    """Return the recorded signatures of the kernels that Python calls in some packages."""
    found: dict[str, list[str]] = {}
    for package in packages:
        file = Path(str(importlib.import_module(package).__file__)).with_name(SIGNATURES)
        found |= json.loads(file.read_text(encoding="utf-8"))
    return found


def compiled_signatures(package: str) -> dict[str, list[str]]:
    """Return the signatures of all kernels of a package that Python called in this process, sorted by name."""
    modules = [module for name, module in sys.modules.items() if name.split(".")[0] == package]
    kernels = {
        kernel_name(value): value
        for module in modules
        for value in vars(module).values()
        if isinstance(value, CPUDispatcher) and not isinstance(value, DeviceKernel)
    }
    called = {name: kernel for name, kernel in kernels.items() if name.split(".")[0] == package and kernel.signatures}
    return {name: sorted(map(encode_signature, called[name].signatures)) for name in sorted(called)}


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
    named tuple and `builtins.tuple(float64 int64[1C])` a plain one, whose conversion from Python is 1 us faster.
    """
    return " ".join(map(_word, signature))


def _word(argument: types.Type) -> str:
    if isinstance(argument, types.BaseTuple):
        fields: Any = argument
        kind = getattr(argument, "instance_class", tuple)
        return f"{kind.__module__}.{kind.__qualname__}({encode_signature(fields.types)})"
    if isinstance(argument, types.Array):
        if isinstance(argument.dtype, types.Record):
            return f"{RECORD}[]"
        read_only = "" if argument.mutable else READ_ONLY
        return f"{argument.dtype}[{argument.ndim}{argument.layout}{read_only}]"
    return str(argument)


def decode_signature(words: str) -> tuple[types.Type, ...]:
    """Return the argument types that `encode_signature` wrote."""
    return tuple(map(_type, WORD.findall(words)))


def _type(word: str) -> Any:
    if word == "none":
        return types.none
    if word.endswith(")"):
        name, _, fields = word.removesuffix(")").partition("(")
        module, _, record = name.rpartition(".")
        from_types: Any = types.BaseTuple.from_types
        return from_types(decode_signature(fields), getattr(importlib.import_module(module), record))
    if word.endswith("[]"):
        module, _, name = word.removesuffix("[]").rpartition(".")
        return types.Array(from_dtype(getattr(importlib.import_module(module), name)), 1, cast(Any, "C"))
    name, _, array = word.partition("[")
    element: Any = from_dtype(dtype(name))
    if not array:
        return element
    shape = array.removesuffix("]").removesuffix(READ_ONLY)
    layout: Any = shape[-1]
    return types.Array(element, int(shape[:-1]), layout, readonly=array.endswith(READ_ONLY + "]"))


# ---------------------------------------------------------------------- division of the work


@dataclass(frozen=True)
class Task:
    """Kernel that Python calls, in one of its signatures.

    Attributes:
        name: Dotted name.
        signature: Argument types, see `encode_signature`.
        parts: Code size of the kernel and of each kernel that it calls, by dotted name.
    """

    name: str
    signature: str
    parts: Mapping[str, int]


def missing_tasks(signatures: Signatures) -> list[Task]:
    """Return the kernels that the disk cache lacks; none without a cache or a compiler."""
    tasks = []
    for name, words in signatures.items():
        kernel = find_kernel(name)
        cache = None if kernel is None else getattr(kernel, "_cache", None)
        if kernel is None or not isinstance(cache, KernelCache) or cache.cache_path is None:
            continue
        for signature in words:
            context: Any = kernel.targetctx
            if not cache.holds(decode_signature(signature), context.codegen()):
                tasks.append(Task(name, signature, _code_sizes(kernel)))
    return tasks


def _code_sizes(kernel: CPUDispatcher) -> dict[str, int]:
    """Return the code size of a kernel and of all kernels that it calls, by dotted name."""
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
    """Divide tasks into shares of similar cost; a kernel that several shares call is compiled once in each."""
    shares: list[list[Task]] = [[] for _ in range(workers)]
    known: list[dict[str, int]] = [{} for _ in range(workers)]
    for task in sorted(tasks, key=lambda task: -sum(task.parts.values())):
        costs = [sum(has.values()) + sum(n for part, n in task.parts.items() if part not in has) for has in known]
        chosen = costs.index(min(costs))
        shares[chosen].append(task)
        known[chosen] |= task.parts
    return [share for share in shares if share]


# ---------------------------------------------------------------------- compilation


def compile_kernels(
    signatures: Signatures,
    workers: int | None = None,
    progress: Progress | None = None,
    costs: dict[str, float] | None = None,
) -> float:
    """Compile the kernels that the disk cache lacks, in several processes, after waiting for any other such process.

    Args:
        signatures: Signatures by dotted name of a kernel, see `encode_signature`.
        workers: Number of processes; None: one for each core. With one, kernels are compiled when they are called.
        progress: Called after each kernel; None: one line says that the compiler runs.
        costs: Processor time [s] of each kernel compiled, by dotted name, is added. What several kernels call counts
            as part of the first in each process.

    Returns:
        Seconds that this took; 0 if no kernel was missing.
    """
    workers = available_cores() if workers is None else check_int("workers", workers, 1, "Use at least one process.")
    if workers < 2 or not (tasks := missing_tasks(signatures)):
        return 0.0
    begun = time.perf_counter()
    lock = cache_lock()
    try:
        try:
            lock.acquire(blocking=False)
        except TimeoutError:
            LOGGER.warning("Waiting for another process that compiles the kernels ...")
            lock.acquire()
        tasks = missing_tasks(signatures)  # another process may have compiled them meanwhile
        if tasks and progress is None:
            announce(len(tasks))
        for done, left in _compiled(divide_tasks(tasks, workers), begun, {} if costs is None else costs):
            if progress is not None:
                progress(done, len(tasks), left)
    except OSError as error:  # kernels are compiled when they are called
        LOGGER.debug("Not compiled in advance: %s", error)
    finally:
        lock.release()
    return time.perf_counter() - begun


_expected: Callable[[], Signatures] | None = None  # what this program will call, until a kernel is missing


def expect(needed: Callable[[], Signatures]) -> None:
    """Say what this program will call: the first of it that the cache lacks is then compiled with all the rest.

    Args:
        needed: Function that returns signatures by dotted name of a kernel.
    """
    global _expected
    _expected = needed


def compile_expected() -> bool:
    """Compile with all cores what the program will call, if it has said so; return whether anything was compiled."""
    global _expected
    needed, _expected = _expected, None
    return needed is not None and compile_kernels(needed(), progress=_shown) > 0.0


_shown: Progress | None = None  # what receives the progress of `compile_expected`


@contextmanager
def showing(progress: Progress) -> Iterator[None]:
    """Give the progress of what is compiled as expected within a block to a function; else one line says that it is."""
    global _shown
    before, _shown = _shown, progress
    try:
        yield
    finally:
        _shown = before


def cache_lock() -> "FileLock":
    """Return the lock of the process that fills the cache.

    Raises:
        OSError: If there is no cache.
    """
    from filelock import FileLock  # a slow import

    folder = cache_folder(Path(__file__).parent, CONFIG.CACHE_DIR)
    if folder is None:
        raise OSError("no folder of the cache can be written")
    return FileLock(folder / LOCK)


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _compiled(shares: Sequence[Sequence[Task]], begun: float, costs: dict[str, float]) -> Iterator[tuple[int, float]]:
    """Compile each share in a process of its own; yield after each kernel the number compiled and the seconds left.

    Kernels of a process that fails are compiled when they are called.
    """
    if not shares:
        return
    yield 0, math.nan
    lines: Queue[str | None] = Queue()
    sizes = {f"{task.name} {task.signature}": sum(task.parts.values()) for share in shares for task in share}
    whole, done, size = sum(sizes.values()), 0, 0
    processes = [start_worker() for _ in shares]
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
            line, _, seconds = line.rpartition(" ")
            name = line.partition(" ")[0]
            costs[name] = costs.get(name, 0.0) + float(seconds)
            done, size = done + 1, size + sizes.get(line, 0)
            yield done, (time.perf_counter() - begun) * (whole - size) / max(size, 1)
    finally:
        for process in processes:
            process.terminate()
            process.wait()


def start_worker() -> "subprocess.Popen[str]":
    """Start a process that compiles the kernels named on its input; it ends with this one.

    It imports what this process imports: `-P` keeps it from looking into the current folder first.
    """
    return subprocess.Popen(
        [sys.executable, "-P", "-m", WORKER, str(os.getpid())],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path)},
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
    )  # fmt: skip


def _forward_lines(process: subprocess.Popen[str], lines: "Queue[str | None]") -> None:
    """Put what a process prints into a queue, and None when it ends."""
    assert process.stdout is not None
    with process.stdout:
        for line in process.stdout:
            lines.put(line.strip())
    lines.put(None)


def compile_lines(lines: Iterator[str], report: Callable[[str, float], Any]) -> None:
    """Compile the kernels named by lines, each with its signature; report each line and its processor time [s]."""
    for line in lines:
        name, _, words = line.strip().partition(" ")
        kernel, begun = find_kernel(name), time.process_time()
        if kernel is not None:
            kernel.compile(decode_signature(words))
        report(line.strip(), time.process_time() - begun)


def exempt_from_collection() -> None:
    """Leave all objects that there are, most of which belong to kernels, out of Python's later searches for garbage.

    A search among those of all kernels takes 0.1 s, and may fall into any step.
    """
    gc.collect()
    gc.freeze()
