"""What commands that leave a run folder have in common: their options, and how they begin and end."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

if TYPE_CHECKING:
    from training.run_folder import RunFolder

Particles = Annotated[int | None, typer.Option(help="Particles per filter.", show_default="100")]
Estimator = Annotated[str | None, typer.Option(help="fastslam2 or fastslam1.", show_default="fastslam2")]
Duration = Annotated[float | None, typer.Option(help="Seconds to replay.", show_default="all")]
RejuvenateEvery = Annotated[
    int | None,
    typer.Option(help="Steps after which particles are drawn anew from smoothed paths.", show_default="never"),
]
Seed = Annotated[int | None, typer.Option(help="Of all random draws.", show_default="0")]
Out = Annotated[Path | None, typer.Option(help="New run folder.", show_default="the next free one in runs")]
Json = Annotated[Path | None, typer.Option(help="Write the metrics to this file too.", show_default=False)]
Config = Annotated[
    Path | None,
    typer.Option(help="config.toml of an earlier run to repeat; other options override it.", show_default=False),
]


def gather(
    command: str, given: Mapping[str, Any], config: Path | None, json: Path | None, out: Path | None
) -> dict[str, Any]:
    """Return the values of an earlier run's config, if there is one, below those that are given and not None.

    Args:
        command: The command that runs, without the leading `vslam`.
        given: Options by the names that its config uses; paths come back absolute, so that a config repeats anywhere.
        config: The option of that name.
        json: Likewise; refused now if it cannot be written, rather than after the run.
        out: Likewise.

    Raises:
        ValueError: If `json` cannot be written, or `config` cannot be read or is of another command.
    """
    from training.run_folder import check_writable, read_config

    if json is not None and json.parent != out:  # the run's own folder does not exist yet
        check_writable(json, "json")
    values: dict[str, Any] = {}
    if config is not None:
        values, values["seed"] = read_config(config, command)
    told = {name: str(value.resolve()) if isinstance(value, Path) else value for name, value in given.items()}
    return values | {name: value for name, value in told.items() if value is not None}


def finish(console: Console, folder: "RunFolder", metrics: dict[str, Any], json: Path | None) -> None:
    """Write the metrics that the folder made complete to `json` too, and say where the folder is."""
    from training.run_folder import to_json, write_whole

    if json is not None:
        write_whole(json, to_json(metrics), "json")
    console.print(f"Run folder: {folder.path}", soft_wrap=True, highlight=False)
