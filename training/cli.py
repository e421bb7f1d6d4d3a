"""Command line `vslam`: lists the commands, each of which has its own module and is imported when it is called."""

import errno
import os
import sys
from collections.abc import Iterator, Mapping
from importlib import import_module
from importlib.metadata import version
from signal import Signals
from typing import Annotated, Any, NoReturn

import typer
from typer.core import TyperCommand, TyperGroup

from training.experiments.machine.interrupt import signals_answered
from training.experiments.output.console import make_console, print_error
from training.experiments.output.logs import LogLevel, begin_logging

BAD_INPUT = 2
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
INTERRUPTED = 130  # typer's status after a KeyboardInterrupt


# Module in `training.commands`, function or group there, and what `vslam --help` says of it, by name of the command.
COMMANDS = {
    "run": ("run", "run", "Let robots with unknown starts explore a building, map it, and merge their maps."),
    "drive": (
        "drive", "drive_by_hand",
        "Drive a robot with the arrow keys or WASD; Tab selects the next robot, Escape or Q quits.",
    ),
    "train": (
        "train", "train",
        "Train one network for all robots by PPO with masked goal actions; use it with vslam run --policy FOLDER.",
    ),
    "train-batched": (
        "train_batched", "train_batched",
        "Train one driver for all robots by PPO, with many environments stepped at once; for accelerators.",
    ),
    "evaluate": (
        "train", "evaluate",
        "Compare a model with baseline policies on the same unseen worlds, with confidence intervals.",
    ),
    "record": (
        "record", "record",
        "Record episodes as a data set: observations, actions, rewards, ends and the truth, with a card and digests.",
    ),
    "report": (
        "report", "report",
        "Write report.html into a run folder: playback of the episode, curves and tables, in one file for any browser.",
    ),
    "compare": ("report", "compare", "Compare two run folders: options that differ, and metrics side by side."),
    "score": ("score", "score", "Score paths and a map of one robot or a team against the truth, under one alignment."),
    "merge": ("merge", "merge", "Align two landmark maps from files and merge them, or say why not."),
    "warm-up": (
        "warm_up", "warm_up", "Compile the kernels into the disk cache; takes seconds if they are cached already.",
    ),
    "replay": ("replay", "replay", "Run the backend on logs of real robots."),
    "bench": ("bench", "bench", "Compare policies, and measure the speed of filters and environments."),
    "paper": ("paper", "paper", "Reproduce figures of the paper."),
    "worlds": ("worlds", "worlds", "List, preview, check and import worlds."),
}  # fmt: skip


class ImportedCommands(Mapping[str, Any]):
    """The commands by name, imported when they are looked up."""

    def __getitem__(self, name: str) -> Any:
        module, attribute, _ = COMMANDS[name]
        found: Any = getattr(import_module(f"training.commands.{module}"), attribute)
        if isinstance(found, typer.Typer):
            command: Any = typer.main.get_group(found)
        else:
            alone = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
            alone.command()(found)
            command = typer.main.get_command(alone)
        command.name = name
        return command

    def __iter__(self) -> Iterator[str]:
        return iter(COMMANDS)

    def __len__(self) -> int:
        return len(COMMANDS)


class Commands(TyperGroup):
    """The group of all commands, of which only the one that is called is imported."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.commands: Any = ImportedCommands()

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of the commands."""
        return list(COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return a command, imported unless help alone is printed; None if there is none of this name."""
        if ctx.meta.get(ONLY_HELP):
            return TyperCommand(cmd_name, help=COMMANDS[cmd_name][-1])
        return super().get_command(ctx, cmd_name)

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Print the help, for which no command is imported."""
        ctx.meta[ONLY_HELP] = True
        super().format_help(ctx, formatter)


ONLY_HELP = "training.cli.only_help"  # key of a context's notes


def _print_version(is_wanted: bool) -> None:
    if is_wanted:
        typer.echo(f"vslam-env {version('vslam-env')}")
        raise typer.Exit


app = typer.Typer(
    name="vslam", help="Robots that do not know where they start explore, map and merge: runs, replays and figures.",
    cls=Commands, no_args_is_help=True, pretty_exceptions_enable=False,
)  # fmt: skip


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and exit.", callback=_print_version, is_eager=True)
    ] = False,
    log_level: Annotated[
        LogLevel, typer.Option(help="Messages on stderr from this level on: debug, info, warning or error.")
    ] = "warning",
) -> None:
    """Take the options that come before a command."""
    begin_logging(log_level)


def main() -> None:
    """Run the command line."""
    run(app, "vslam")


def run(app: typer.Typer, name: str) -> None:
    """Run commands under a name; bad input, a full disk or no memory gives one line on stderr and exit status 2.

    A command stopped by SIGINT or SIGTERM, at once or after finishing its current work, exits with 128 + signal number.
    """
    os.environ["MPLBACKEND"] = "agg"  # that of a notebook may not exist here; matplotlib reads it when it is imported
    with signals_answered() as handler:
        try:
            app(prog_name=name)
        except SystemExit as end:
            if handler.number is None or end.code == BAD_INPUT:
                raise
            if end.code == INTERRUPTED:
                make_console(stderr=True).print(f"Stopped by {Signals(handler.number).name}.")
            sys.exit(128 + handler.number)
        except ValueError as error:
            from slam_backend.core.validation import is_argument_error  # a slow import

            if not is_argument_error(error):
                raise
            _refuse(str(error))
        except MemoryError as error:
            _refuse(f"memory: expected more of it, got none left. Use less, or raise ulimit -v. {error}".rstrip())
        except OSError as error:
            if _has_no_folder():
                _refuse("folder: expected a current folder, got a deleted one. Change into one that exists.")
            # stdout or a library failed to write: the project's own writers raise ValueError.
            if error.errno not in NO_ROOM:
                raise
            _abandon_stdout()
            where = "stdout" if error.filename is None else repr(error.filename)
            _refuse(f"output: expected a disk with free space, got {where}. The system says: {error.strerror}.")


def _refuse(text: str) -> NoReturn:
    """Exit with one line on stderr."""
    print_error(text)
    sys.exit(BAD_INPUT)


def _has_no_folder() -> bool:
    """Return whether the folder in which the command was called was deleted."""
    try:
        os.getcwd()
    except FileNotFoundError:
        return True
    return False


def _abandon_stdout() -> None:
    """Discard buffered output that cannot be printed: Python would try again at exit and complain."""
    try:
        sys.stdout.flush()
    except OSError:
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115   # until exit


if __name__ == "__main__":
    main()
