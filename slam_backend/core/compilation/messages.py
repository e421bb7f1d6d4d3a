"""Messages about the compilation of kernels. numba compiles them once and caches them on disk."""

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import event as numba_event

LOGGER = logging.getLogger("slam_backend")
PACKAGES = ("slam_backend", "vslam_env", "agents", "training")  # packages with kernels of this project
MESSAGE = "Compiling the kernels (once, one to two minutes) ..."


class CompilationListener(numba_event.Listener):
    """Listener for each kernel that numba compiles; kernels from the disk cache cause no events.

    Kernels called by another kernel count as part of it. numba compiles under one lock, so that threads never overlap.

    Args:
        tell: Called with a kernel's name when its compilation begins.

    Attributes:
        names: Names of the compiled kernels, in order.
        seconds: Total compilation time [s].
    """

    def __init__(self, tell: Callable[[str], None]) -> None:
        self.names: list[str] = []
        self.seconds = 0.0
        self._tell = tell
        self._depth = 0
        self._begin = 0.0

    def on_start(self, event: Any) -> None:
        """Note the start of a compilation."""
        self._depth += 1
        if self._depth == 1:
            self._begin = time.perf_counter()
            if _is_ours(event):
                self._tell(_name(event))

    def on_end(self, event: Any) -> None:
        """Note the end of a compilation."""
        self._depth -= 1
        if self._depth == 0 and _is_ours(event):
            self.names.append(_name(event))
            self.seconds += time.perf_counter() - self._begin


@contextmanager
def watch_compilation(tell: Callable[[str], None]) -> Iterator[CompilationListener]:
    """Record which kernels are compiled within a block.

    Args:
        tell: Called with a kernel's name when its compilation begins; not called for kernels from the cache.
    """
    with numba_event.install_listener("numba:compile", CompilationListener(tell)) as watch:
        yield watch


def message(total: int = 0) -> str:
    """Return why the program waits, with the number of kernels to compile; 0: not known.

    >>> message(57)
    'Compiling the kernels (once, one to two minutes) ... 57 in all'
    """
    return f"{MESSAGE} {total} in all" if total else MESSAGE


_announced = False


def announce(total: int = 0) -> None:
    """Say once why the program waits: log `message` with level INFO, or print it on stderr without any logging."""
    global _announced
    if not _announced:
        LOGGER.log(logging.INFO if LOGGER.hasHandlers() else logging.WARNING, message(total))
    _announced = True


def log_compilation(begin: Callable[[], object] = announce) -> None:
    """Announce the next compilation, and log the name of each kernel with level DEBUG.

    Args:
        begin: Called when the first kernel is compiled.
    """
    first = iter([True])

    def tell(name: str) -> None:
        if next(first, False):
            begin()
        LOGGER.debug("Compiling %s", name)

    numba_event.register("numba:compile", CompilationListener(tell))  # type: ignore[no-untyped-call]


def _name(event: Any) -> str:
    """Return the dotted name of the function that a numba event refers to."""
    function = event.data["dispatcher"].py_func
    return f"{function.__module__}.{function.__qualname__}"


def _is_ours(event: Any) -> bool:
    """Return whether the function belongs to this project."""
    return _name(event).split(".")[0] in PACKAGES
