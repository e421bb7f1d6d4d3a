"""Who waits for the compiler is told so: kernels are compiled once, and come from numba's cache on disk ever after."""

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import event as numba_event

LOGGER = logging.getLogger("slam_backend")
PACKAGES = ("slam_backend", "vslam_env", "agents", "training")  # whose kernels are meant
MESSAGE = "Compiling the kernels (once, one to two minutes) ..."


class CompilationListener(numba_event.Listener):
    """Hears of each kernel that numba compiles; of those that it finds in its cache it hears nothing.

    A kernel that another one calls is a part of that one. numba compiles under one lock, so that two threads never do
    at the same time.

    Args:
        tell: Called with a kernel's name when its compilation begins.

    Attributes:
        names: What was compiled, in order.
        seconds: How long that took [s].
    """

    def __init__(self, tell: Callable[[str], None]) -> None:
        self.names: list[str] = []
        self.seconds = 0.0
        self._tell = tell
        self._depth = 0
        self._begin = 0.0

    def on_start(self, event: Any) -> None:
        """Take in that a compilation begins."""
        self._depth += 1
        if self._depth == 1:
            self._begin = time.perf_counter()
            if _is_ours(event):
                self._tell(_name(event))

    def on_end(self, event: Any) -> None:
        """Take in that it is over."""
        self._depth -= 1
        if self._depth == 0 and _is_ours(event):
            self.names.append(_name(event))
            self.seconds += time.perf_counter() - self._begin


@contextmanager
def watch_compilation(tell: Callable[[str], None]) -> Iterator[CompilationListener]:
    """Watch, within a block, which kernels are compiled.

    Args:
        tell: Called with a kernel's name when its compilation begins; never where all come from the cache.
    """
    with numba_event.install_listener("numba:compile", CompilationListener(tell)) as watch:
        yield watch


def log_compilation(tell_first: Callable[[str], object] = LOGGER.info) -> None:
    """Announce the first compilation from now on, and log the name of each kernel with level DEBUG.

    Args:
        tell_first: Called with the announcement; logged with level INFO by default.
    """
    first = iter([True])

    def tell(name: str) -> None:
        if next(first, False):
            tell_first(MESSAGE)
        LOGGER.debug("Compiling %s", name)

    numba_event.register("numba:compile", CompilationListener(tell))  # type: ignore[no-untyped-call]


def _name(event: Any) -> str:
    """Return the dotted name of the function that an event of numba is about."""
    function = event.data["dispatcher"].py_func
    return f"{function.__module__}.{function.__qualname__}"


def _is_ours(event: Any) -> bool:
    """Tell whether it is one of this project."""
    return _name(event).split(".")[0] in PACKAGES
