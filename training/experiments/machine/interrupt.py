"""Handling of SIGINT (Ctrl-C) and SIGTERM: a flag for loops, or immediate termination."""

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import connection, parent_process, resource_tracker
from types import FrameType
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class AtOnce:
    """Signal handler that raises `KeyboardInterrupt`.

    Attributes:
        number: Number of the last signal, including signals within `interrupt_flag`; None: none was received.
    """

    def __init__(self) -> None:
        self.number: int | None = None

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Record a signal and interrupt."""
        self.number = number
        raise KeyboardInterrupt


@contextmanager
def signals_answered() -> Iterator[AtOnce]:
    """Let both signals end a block by `KeyboardInterrupt`, even if the process was started with the signals ignored.

    Shells ignore SIGINT for background jobs, and some runners for all their children. Outside the main thread, where
    Python delivers no signals, nothing changes.

    Yields:
        The signal handler.
    """
    handler = AtOnce()
    usual = _handlers()
    for number in usual:
        signal.signal(number, handler)
    try:
        yield handler
    finally:
        for number, former in usual.items():
            signal.signal(number, former)


@contextmanager
def interrupt_flag(on_press: Callable[[], None] = lambda: None) -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether SIGINT or SIGTERM was received; a second signal interrupts.

    The second signal does what the first one would have done without this block, or raises `KeyboardInterrupt` if it
    was ignored. Outside the main thread, where Python delivers no signals, nothing changes.

    Args:
        on_press: Function called at the first signal, between two operations of the main thread, to notify the user.
    """
    pressed = threading.Event()
    usual = _handlers()

    def press(number: int, frame: FrameType | None) -> None:
        pressed.set()
        for each, former in usual.items():
            if isinstance(former, AtOnce):
                former.number = number
            signal.signal(each, AtOnce() if former is signal.SIG_IGN else former)
        on_press()

    for number in usual:
        signal.signal(number, press)
    try:
        yield pressed.is_set
    finally:
        for number, former in usual.items():
            signal.signal(number, former)


@contextmanager
def signals_held() -> Iterator[None]:
    """Block both signals in processes started within the block; this process receives them at its end or earlier.

    Ctrl-C, and often SIGTERM, reach a whole process group. Workers leave them to the process that started them.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    resource_tracker.ensure_running()  # otherwise the first worker starts it, and its start unblocks signals
    former = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, former)


def begin_worker() -> None:
    """Make a worker process ignore both signals, and exit when its parent process has ended for any reason."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    parent = parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()


def _end_with(sentinel: int) -> None:
    connection.wait([sentinel])
    os._exit(1)


def _handlers() -> dict[signal.Signals, Any]:
    """Return the handlers of both signals, except in other threads and for handlers set outside Python."""
    if threading.current_thread() is not threading.main_thread():
        return {}
    handlers = {number: signal.getsignal(number) for number in SIGNALS}
    return {number: handler for number, handler in handlers.items() if handler is not None}
