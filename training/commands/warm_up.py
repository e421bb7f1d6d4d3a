"""Command `vslam warm-up`: compile all kernels in advance."""

from typing import Annotated

import typer

from training.experiments.output.console import make_console


def warm_up(
    everything: Annotated[
        bool, typer.Option("--all", help="Include kernels that the default environment does not need.")
    ] = False,
    workers: Annotated[int | None, typer.Option(help="Number of compiling processes; default: one per core.")] = None,
    report: Annotated[bool, typer.Option(help="Print the processor time of each kernel, the dearest first.")] = False,
) -> None:
    """Compile the kernels into the disk cache; takes seconds if they are cached already."""
    import vslam_env
    from slam_backend.core.jit import IS_PLAIN
    from training.experiments.output.compilation import compilation_progress

    costs: dict[str, float] = {}
    with compilation_progress(make_console(stderr=True)) as progress:
        seconds = vslam_env.warm_up(everything=everything, workers=workers, progress=progress, costs=costs)
    if report and costs:
        for name, cost in sorted(costs.items(), key=lambda item: -item[1]):
            make_console().print(f"{cost:7.1f} s  {name}", highlight=False, soft_wrap=True)
        make_console().print(
            f"{sum(costs.values()):7.1f} s  {len(costs)} kernels that Python calls", highlight=False, soft_wrap=True
        )
    if not seconds:
        make_console().print("There is nothing to compile." if IS_PLAIN else "All kernels are in the cache.")
