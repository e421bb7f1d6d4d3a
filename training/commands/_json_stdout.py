"""`--json -`: the metrics alone go to stdout, and everything for people to stderr."""

import os
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, redirect_stdout, suppress
from contextvars import ContextVar
from pathlib import Path
from typing import TextIO

import typer

STDOUT = Path("-")

_STREAM: ContextVar[TextIO | None] = ContextVar("stream", default=None)


def claim_stdout(context: typer.Context, json: Path | None) -> Path | None:
    """Return the option --json; if it names stdout, all other output of the command goes to stderr from now on."""
    if json == STDOUT:
        context.with_resource(_others_on_stderr())
    return json


def write_json(json: Path, text: str) -> None:
    """Write a text to the file, or the stdout, that the option --json names.

    Raises:
        ValueError: If it cannot be written.
    """
    from slam_backend.core.files import refusing, write_file

    if json != STDOUT:
        write_file(json, text, "json")
        return
    stream = _STREAM.get() or sys.stdout
    with refusing("stdout", "json"):
        stream.write(text)
        stream.flush()


@contextmanager
def _others_on_stderr() -> Iterator[None]:
    """Send to stderr what this process and those that it starts print; only `write_json` reaches stdout."""
    with ExitStack() as stack:
        others = sys.stderr or stack.enter_context(open(os.devnull, "w", encoding="utf-8"))
        stream = sys.stdout
        sys.stdout.flush()
        if _descriptor(sys.stdout) == 1 and (number := _descriptor(others)) is not None:
            stream = open(os.dup(1), "w", encoding="utf-8")  # noqa: SIM115   # closed by the next line
            stack.callback(_close, stream)
            stack.callback(os.dup2, stream.fileno(), 1)
            os.dup2(number, 1)
        stack.callback(_STREAM.reset, _STREAM.set(stream))
        stack.enter_context(redirect_stdout(others))
        yield


def _close(stream: TextIO) -> None:
    with suppress(OSError):  # `write_json` has told of it
        stream.close()


def _descriptor(stream: TextIO) -> int | None:
    """Return the descriptor below a stream; None: it has none."""
    try:
        return stream.fileno()
    except (OSError, ValueError):
        return None
