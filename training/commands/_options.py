"""The options that commands share, and how texts of options become values."""

from pathlib import Path
from typing import Annotated, Any

import typer

from training.commands._json_stdout import claim_stdout

Particles = Annotated[int | None, typer.Option(help="Particles per filter.", show_default="100")]
Estimator = Annotated[str | None, typer.Option(help="fastslam2 or fastslam1.", show_default="fastslam2")]
Duration = Annotated[float | None, typer.Option(help="Seconds to replay.", show_default="all")]
RejuvenateEvery = Annotated[
    int | None,
    typer.Option(help="Steps after which particles are redrawn from smoothed paths; 0: never.", show_default="100"),
]
EnvRejuvenateEvery = Annotated[
    int | None, typer.Option(help="Ticks after which particles are drawn anew; 0: never.", show_default="100")
]
Noise = Annotated[str | None, typer.Option(help="easy, standard or hard noise.", show_default="standard")]
Sensor = Annotated[str | None, typer.Option(help="landmark, or stereo: rendered eyes.", show_default="landmark")]
Seed = Annotated[int | None, typer.Option(help="Of all random draws.", show_default="0")]
FirstSeed = Annotated[int | None, typer.Option(help="The first of them.", show_default="0")]
Processes = Annotated[int, typer.Option(help="Trials at a time.")]
Check = Annotated[bool, typer.Option("--check", help="Exit with status 1 unless all claims hold.")]
Out = Annotated[Path | None, typer.Option(help="New run folder.", show_default="the next free one in runs")]
OutToGoOn = Annotated[
    Path | None,
    typer.Option(
        help="Run folder: a new one, or that of a run to go on with.", show_default="the next free one in runs"
    ),
]
Json = Annotated[
    Path | None,
    typer.Option(
        help="Write the metrics to this file too; - is stdout, and all else goes to stderr then.",
        show_default=False,
        callback=claim_stdout,
    ),
]
Config = Annotated[
    Path | None,
    typer.Option(help="config.toml of an earlier run to repeat; other options override it.", show_default=False),
]


def words(text: str | None) -> tuple[str, ...] | None:
    """Return the words of a text with commas between; of an option that was not given None."""
    return None if text is None else tuple(word.strip() for word in text.split(","))


def numbers(name: str, text: str | None, kind: type[int] | type[float] = int) -> tuple[Any, ...] | None:
    """Return the numbers of a text such as `10, 100`; of an option that was not given None.

    Args:
        name: Of the option.
        text: What was given.
        kind: Of the numbers.

    Raises:
        ValueError: If one is no number; the message names the option.
    """
    from slam_backend.core.validation import bad_argument

    if text is None:
        return None
    try:
        return tuple(kind(word) for word in text.split(","))
    except ValueError as error:
        raise bad_argument(name, "numbers with commas between", repr(text), "Write them like 10,100.") from error
