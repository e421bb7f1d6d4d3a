"""Start and end of commands with a run folder, and output of their metrics."""

import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, redirect_stdout, suppress
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TextIO, TypeVar

import typer
from rich.console import Console

from training.experiments.config import ExperimentConfig
from training.experiments.output.compilation import prepare
from training.experiments.output.console import make_console
from training.experiments.output.logs import LOGGER
from training.replay.config import find_log

if TYPE_CHECKING:  # numerical modules are imported when a command runs, so that --help is fast
    from training.experiments.run_folder import RunFolder

STDOUT = Path("-")
ConfigT = TypeVar("ConfigT", bound=ExperimentConfig)

_STREAM: ContextVar[TextIO | None] = ContextVar("stream", default=None)


@dataclass(eq=False)
class Call(Generic[ConfigT]):
    """Call of a command with a run folder."""

    kind: type[ConfigT]  # Class of the configuration
    command: str  # Name of the command, without the leading `vslam`
    given: dict[str, Any]  # Given options, by field of the configuration; paths are absolute
    out: Path | None = None  # Run folder
    json: Path | None = None  # Additional file for the metrics
    file: Path | None = None  # Configuration of an earlier run
    quick: Mapping[str, Any] = field(default_factory=dict)  # Values set by --quick, if it was given
    # Default of `path` below the data folder, and the expected content, worded for an error
    log: tuple[Path, str] | None = None
    continues: bool = False  # Whether `out` may be the folder of the same run, stopped early
    console: Console = field(default_factory=make_console)  # Console for the output
    folder: "RunFolder" = field(init=False)  # Run folder; set by `begin`
    metrics: dict[str, Any] = field(init=False)  # Metrics as written; set by `write`

    @cached_property
    def values(self) -> dict[str, Any]:
        """Given options, over values of --quick, over the configuration of an earlier run.

        Raises:
            ValueError: If `json` cannot be written, the file cannot be read or belongs to another command, or the log
                is missing, or the file names a custom policy that the options do not name.
        """
        from slam_backend.core.files import check_writable
        from training.experiments.policy_names import check_configuration
        from training.experiments.run_folder import read_config

        if self.json not in (None, STDOUT) and self.json.parent != self.out:  # the run folder is created later
            check_writable(self.json, "json")
        values: dict[str, Any] = {}
        if self.file is not None:
            values, values["seed"] = read_config(self.file, self.command)
            check_configuration(values, self.given)
        values = self.kind.merged(values, {**self.quick, **self.given})
        if self.log is not None:
            values["path"] = find_log(values.get("path"), *self.log)
        return values

    @cached_property
    def config(self) -> ConfigT:
        """Validated configuration."""
        return self.kind.from_mapping(self.values)

    def resumed(self, folder: Path, others: str) -> ConfigT:
        """Return the configuration of a stopped training.

        Args:
            folder: Run folder to resume.
            others: Options that may be given beside it.

        Raises:
            ValueError: If options would change the configuration, or it cannot be read.
        """
        from slam_backend.core.validation import argument_error
        from training.experiments.run_folder import read_config

        given = [*self.given, *(name for name, value in (("out", self.out), ("config", self.file)) if value)]
        if given:
            hint = f"A resumed training keeps its configuration; omit all but {others}."
            raise argument_error("resume", "no options that change the training", given, hint)
        values, seed = read_config(folder, self.command, "resume")
        return self.kind.from_mapping(values | {"seed": seed})

    def begin(
        self, *first_steps: Callable[[], object], config: ExperimentConfig | None = None
    ) -> tuple[Console, "RunFolder"]:
        """Create the run folder, and compile or load all kernels before any output.

        Args:
            first_steps: First steps of the work, run before the folder is created to detect bad input.

        Raises:
            ValueError: If the folder is not free or cannot be created; nothing has been compiled then.
        """
        from training.experiments.run_folder import CONFIG_FILE, RunFolder, check_free
        from training.experiments.trial_store import open_folder

        chosen, out = config or self.config, self.out
        if out is not None and not (self.continues and (out / CONFIG_FILE).is_file()):
            check_free(out)  # before the kernels are compiled, which may take minutes
        make = open_folder if self.continues else RunFolder.create
        folders: list[RunFolder] = []
        prepare(*first_steps, lambda: folders.append(make(out, self.command, chosen.to_mapping(), chosen.seed)))
        self.folder = folders[0]
        LOGGER.info("Seed %d, configuration in %s", self.folder.seed, self.folder.path / CONFIG_FILE)
        return self.console, self.folder

    def write(self, metrics: Mapping[str, Any]) -> None:
        """Write `metrics.json`, before any pictures, which may fill the disk."""
        self.metrics = self.folder.write_metrics(metrics)

    def finish(self, check: bool = False, held: Iterable[bool] = ()) -> None:
        """Write the metrics for --json, print the run folder, and check the claims if requested.

        Raises:
            typer.Exit: With status 1, if `check` is set and a claim does not hold or none was checked.
        """
        from training.experiments.run_folder import to_json
        from training.report.page import write_report

        if self.json is not None:
            write_json(self.json, to_json(self.metrics))
        report = write_report(self.folder.path)
        self.console.print(f"Report: {report}", soft_wrap=True)
        self.console.print(f"Run folder: {self.folder.path}", soft_wrap=True)
        verdicts = list(held)
        if check and not (verdicts and all(verdicts)):
            raise typer.Exit(1)


def claim_stdout(context: typer.Context, json: Path | None) -> Path | None:
    """Return the option --json; if it is stdout, redirect all other output of the command to stderr."""
    if json == STDOUT:
        context.with_resource(_others_on_stderr())
    return json


def write_json(json: Path, text: str) -> None:
    """Write a text to the file, or the stdout, given by the option --json.

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
    """Redirect output of this process and its children to stderr; only `write_json` writes to stdout."""
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
    with suppress(OSError):  # `write_json` has reported it
        stream.close()


def _descriptor(stream: TextIO) -> int | None:
    """Return the file descriptor of a stream, or None if it has none."""
    try:
        return stream.fileno()
    except (OSError, ValueError):
        return None
