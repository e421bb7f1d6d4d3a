"""How commands that leave a run folder begin and end, and where they write their metrics."""

import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, redirect_stdout, suppress
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TextIO, TypeVar

import typer
from rich.console import Console

from training.experiments.compilation import prepare
from training.experiments.config import ExperimentConfig
from training.replay.config import find_log

if TYPE_CHECKING:  # what computes is imported when a command runs, so that --help answers at once
    from training.experiments.run_folder import RunFolder

STDOUT = Path("-")
ConfigT = TypeVar("ConfigT", bound=ExperimentConfig)

_STREAM: ContextVar[TextIO | None] = ContextVar("stream", default=None)


@dataclass(eq=False)
class Call(Generic[ConfigT]):
    """A call of a command that leaves a run folder."""

    kind: type[ConfigT]  # Class of its configuration
    command: str  # The command, without the leading `vslam`
    given: dict[str, Any]  # Options that were given, by the names of the configuration's fields; paths are absolute
    out: Path | None = None  # Run folder
    json: Path | None = None  # File that gets the metrics, too
    file: Path | None = None  # Configuration of an earlier run
    quick: Mapping[str, Any] = field(default_factory=dict)  # What --quick stands for, if it was given
    # Where `path` is if it is not given: below the folder of data, and what must be there, as an error says it
    log: tuple[Path, str] | None = None
    continues: bool = False  # Whether `out` may be the folder of the same run, stopped half-way
    console: Console = field(default_factory=partial(Console, highlight=False))  # Where the command prints
    folder: "RunFolder" = field(init=False)  # Run folder; there after `begin`
    metrics: dict[str, Any] = field(init=False)  # As they were written

    @cached_property
    def values(self) -> dict[str, Any]:
        """What is given, above what --quick says, above the configuration of an earlier run.

        Raises:
            ValueError: If `json` cannot be written, the file cannot be read or is of another command, or there is no
                such log.
        """
        from slam_backend.core.files import check_writable
        from training.experiments.run_folder import read_config

        if self.json not in (None, STDOUT) and self.json.parent != self.out:  # the run's own folder is made later
            check_writable(self.json, "json")
        values: dict[str, Any] = {}
        if self.file is not None:
            values, values["seed"] = read_config(self.file, self.command)
        values |= {**self.quick, **self.given}
        if self.log is not None:
            values["path"] = find_log(values.get("path"), *self.log)
        return values

    @cached_property
    def config(self) -> ConfigT:
        """The configuration; a value out of its range is refused by name."""
        return self.kind.from_mapping(self.values)

    def begin(
        self, *first_steps: Callable[[], object], config: ExperimentConfig | None = None
    ) -> tuple[Console, "RunFolder"]:
        """Make the run folder, and compile or load all kernels before anything is shown.

        Args:
            first_steps: First steps of the work, done before there is a folder: they may show that the input is bad.

        Raises:
            ValueError: If the folder is not free or cannot be made; nothing has been compiled then.
        """
        from training.experiments.run_folder import CONFIG_FILE, RunFolder, check_free
        from training.experiments.trial_store import open_folder

        chosen, out = config or self.config, self.out
        if out is not None and not (self.continues and (out / CONFIG_FILE).is_file()):
            check_free(out)  # at once: the compiler may take a minute
        make = open_folder if self.continues else RunFolder.create
        folders: list[RunFolder] = []
        prepare(*first_steps, lambda: folders.append(make(out, self.command, chosen.to_mapping(), chosen.seed)))
        self.folder = folders[0]
        return self.console, self.folder

    def write(self, metrics: Mapping[str, Any]) -> None:
        """Write `metrics.json`, before pictures for which there may be no room."""
        self.metrics = self.folder.write_metrics(metrics)

    def finish(self, check: bool = False, held: Iterable[bool] = ()) -> None:
        """Write the metrics where --json says, say where the folder is, and check the claims if asked to.

        Raises:
            typer.Exit: With status 1, if `check` and a claim does not hold or none was checked.
        """
        from training.experiments.run_folder import to_json

        if self.json is not None:
            write_json(self.json, to_json(self.metrics))
        self.console.print(f"Run folder: {self.folder.path}", soft_wrap=True)
        verdicts = list(held)
        if check and not (verdicts and all(verdicts)):
            raise typer.Exit(1)


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
    from slam_backend.core.files import os_errors_as_argument_errors, write_file

    if json != STDOUT:
        write_file(json, text, "json")
        return
    stream = _STREAM.get() or sys.stdout
    with os_errors_as_argument_errors("stdout", "json"):
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
