"""SIGINT (Ctrl-C) and SIGTERM: a question that a loop asks, or the end of what runs; also if ignored at the start."""

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
    """A handler that ends what runs by `KeyboardInterrupt`.

    Attributes:
        number: The last signal that came, within `interrupt_flag` too; None: there was none.
    """

    def __init__(self) -> None:
        self.number: int | None = None

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Take in a signal."""
        self.number = number
        raise KeyboardInterrupt


@contextmanager
def signals_answered() -> Iterator[AtOnce]:
    """Let both signals end a block by `KeyboardInterrupt`, even in a process that was started with them ignored.

    A shell does that to its background jobs, and some runners do it to all they start. Outside the main thread, where
    Python delivers no signals, nothing is changed.

    Yields:
        The handler.
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
    """Give a function that tells whether SIGINT or SIGTERM came; the second one interrupts.

    The second one does what the first would have done without this block, or raises `KeyboardInterrupt` where that is
    nothing. Outside the main thread, where Python delivers no signals, nothing is changed.

    Args:
        on_press: Called when the first one comes, between two operations of the main thread, to tell the user so.
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
    """Hold both signals back from processes that are started in a block; this one gets them at its end, or before.

    Ctrl-C, and often SIGTERM, go to a whole group of processes. Workers leave them to the process that started them.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    resource_tracker.ensure_running()  # the first process of a kind starts it, and it lets signals through again
    former = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, former)


def begin_worker() -> None:
    """Let a worker process ignore both signals, and end when the process that started it has ended in any way."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    parent = parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()


def _end_with(sentinel: int) -> None:
    connection.wait([sentinel])
    os._exit(1)


def _handlers() -> dict[signal.Signals, Any]:
    """Return how both signals are handled; those that were set up outside Python, and other threads', are left out."""
    if threading.current_thread() is not threading.main_thread():
        return {}
    handlers = {number: signal.getsignal(number) for number in SIGNALS}
    return {number: handler for number, handler in handlers.items() if handler is not None}
