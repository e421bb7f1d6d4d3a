"""`vslam warm-up`: compile all kernels now, so that nothing has to wait for them later."""

from typing import Annotated

import typer
from rich.console import Console


def warm_up(
    everything: Annotated[bool, typer.Option("--all", help="Also what the default environment does not need.")] = False,
    workers: Annotated[int | None, typer.Option(help="Processes that compile; one for each core if left out.")] = None,
) -> None:
    """Compile the kernels into the cache on disk; takes seconds if they are there already."""
    import vslam_env
    from training.experiments.compilation import compilation_shown

    with compilation_shown(Console(stderr=True)) as progress:
        seconds = vslam_env.warm_up(everything=everything, workers=workers, progress=progress)
    if not seconds:
        Console().print("The kernels are in the cache.")
