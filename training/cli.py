"""Command line `vslam`: registers the commands, each of which has its own module."""

import errno
import os
import sys
from importlib.metadata import version
from signal import Signals
from typing import Annotated, NoReturn

import typer

from training.commands.bench import bench
from training.commands.drive import drive_by_hand
from training.commands.evaluate import evaluate
from training.commands.paper import paper
from training.commands.replay import replay
from training.commands.report import compare, report
from training.commands.run import run
from training.commands.train import train
from training.commands.warm_up import warm_up
from training.commands.worlds import worlds
from training.experiments.console import make_console, print_error
from training.experiments.interrupt import signals_answered
from training.experiments.logs import LogLevel, begin_logging

BAD_INPUT = 2
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
INTERRUPTED = 130  # typer's status after a KeyboardInterrupt


def _print_version(is_wanted: bool) -> None:
    if is_wanted:
        typer.echo(f"vslam-env {version('vslam-env')}")
        raise typer.Exit


app = typer.Typer(
    name="vslam", help="Robots that do not know where they start explore, map and merge: runs, replays and figures.",
    no_args_is_help=True, pretty_exceptions_enable=False,
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


app.command("run")(run)
app.command("drive")(drive_by_hand)
app.command("train")(train)
app.command("evaluate")(evaluate)
app.command("report")(report)
app.command("compare")(compare)
app.command("warm-up")(warm_up)
app.add_typer(replay, name="replay")
app.add_typer(bench, name="bench")
app.add_typer(paper, name="paper")
app.add_typer(worlds, name="worlds")


def main() -> None:
    """Run the command line; bad input gives one line on stderr and exit status 2.

    A command stopped by SIGINT or SIGTERM, at once or after finishing its current work, exits with 128 + signal number.
    """
    os.environ["MPLBACKEND"] = "agg"  # that of a notebook may not exist here; matplotlib reads it when it is imported
    with signals_answered() as handler:
        try:
            app(prog_name="vslam")
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
