"""How commands that leave a run folder begin and end."""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import typer
from rich.console import Console

from training.commands._json_stdout import STDOUT, write_json
from training.experiments.compilation import prepare

if TYPE_CHECKING:  # what computes is imported when a command runs, so that --help answers at once
    from training.experiments.config import PlainConfig
    from training.experiments.run_folder import RunFolder

ConfigT = TypeVar("ConfigT", bound="PlainConfig")


def choose(
    kind: type[ConfigT],
    command: str,
    given: Mapping[str, Any],
    *,
    config: Path | None,
    json: Path | None,
    out: Path | None,
    quick: Mapping[str, Any] | None = None,
    log: tuple[Path, str] | None = None,
) -> ConfigT:
    """Return the configuration: what is given, above what --quick says, above that of an earlier run.

    Args:
        kind: Of the configuration.
        command: The command that runs, without the leading `vslam`.
        given: Options by the names of the configuration; None: not given. Paths are kept absolute, so that a
            configuration repeats from anywhere.
        config: The option of that name.
        json: Likewise; refused now if it cannot be written, rather than after the work.
        out: Likewise.
        quick: What --quick stands for, if it was given.
        log: Where `path` is if nobody says it: below the folder of data, and what must be there, as an error says it.

    Raises:
        ValueError: If `json` cannot be written, `config` cannot be read or is of another command, there is no such
            `log`, or a value is out of its range.
    """
    return kind.from_mapping(gather(command, given, config=config, json=json, out=out, quick=quick, log=log))


def gather(
    command: str,
    given: Mapping[str, Any],
    *,
    config: Path | None,
    json: Path | None,
    out: Path | None,
    quick: Mapping[str, Any] | None = None,
    log: tuple[Path, str] | None = None,
) -> dict[str, Any]:
    """Return the plain values of which `choose` makes a configuration; arguments and errors as there."""
    from slam_backend.core.files import check_writable
    from training.experiments.run_folder import read_config
    from training.replay.paths import find_log

    if json not in (None, STDOUT) and json.parent != out:  # the run's own folder does not exist yet
        check_writable(json, "json")
    values: dict[str, Any] = {}
    if config is not None:
        values, values["seed"] = read_config(config, command)
    values |= dict(quick or {}) | _given(given)
    if log is not None:
        values["path"] = find_log(values.get("path"), *log)
    return values


def _given(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options that were given, paths absolute."""
    told = {name: str(value.resolve()) if isinstance(value, Path) else value for name, value in options.items()}
    return {name: value for name, value in told.items() if value is not None}


def begin(
    command: str,
    chosen: "PlainConfig",
    out: Path | None,
    *first_steps: Callable[[], object],
    goes_on: bool = False,
) -> tuple[Console, "RunFolder"]:
    """Make the run folder, and compile or load all kernels before anything is shown; return console and folder.

    Args:
        command: The command that runs, without the leading `vslam`.
        chosen: Its configuration.
        out: The option of that name.
        first_steps: Of the work, done before there is a folder, as they may show what is wrong with the input.
        goes_on: Whether `out` may be the folder of the same run, stopped half-way.

    Raises:
        ValueError: If the folder is not free or cannot be made; nothing has been compiled then.
    """
    from training.experiments.run_folder import CONFIG_FILE, RunFolder, check_free
    from training.experiments.trial_store import open_folder

    if out is not None and not (goes_on and (out / CONFIG_FILE).is_file()):
        check_free(out)  # at once: the compiler may take a minute
    open_or_create = open_folder if goes_on else RunFolder.create
    folders: list[RunFolder] = []
    prepare(*first_steps, lambda: folders.append(open_or_create(out, command, chosen.to_mapping(), chosen.seed)))
    return Console(), folders[0]


def finish(
    console: Console,
    folder: "RunFolder",
    metrics: dict[str, Any],
    json: Path | None,
    check: bool = False,
    held: Iterable[bool] = (),
) -> None:
    """Write the metrics to `json` too, say where the folder is, and check the claims if asked to.

    Args:
        console: Where to say it.
        folder: Of the run.
        metrics: As `RunFolder.write_metrics` returned them.
        json: The option of that name.
        check: Likewise.
        held: Whether each claim holds.

    Raises:
        typer.Exit: With status 1, if `check` and a claim does not hold or none was checked.
    """
    from training.experiments.run_folder import to_json

    if json is not None:
        write_json(json, to_json(metrics))
    console.print(f"Run folder: {folder.path}", soft_wrap=True, highlight=False)
    verdicts = list(held)
    if check and not (verdicts and all(verdicts)):
        raise typer.Exit(1)
