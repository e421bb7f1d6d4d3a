"""Progress display of commands while kernels are compiled; nothing is shown if all are cached."""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

from rich.console import Console
from rich.live import Live
from rich.spinner import Spinner

from training.experiments.output.console import make_console


@contextmanager
def compilation_progress(console: Console) -> Iterator[Callable[[int, int, float], None]]:
    """Show that the compiler runs, from the first compilation in the block on, and its total time afterwards.

    A terminal shows a spinner with the number of kernels compiled, other outputs one line. Nothing is shown if all
    kernels come from the cache. The block must not use a live display of its own.

    Yields:
        Progress callback for `warm_up`.
    """
    from slam_backend.core.compilation.compiler import showing
    from slam_backend.core.compilation.messages import MESSAGE, message, watch_compilation

    spinner = Spinner("dots", MESSAGE)
    begun: list[float] = []
    with ExitStack() as stack:

        def begin(name: str = "", total: int = 0) -> None:
            if not begun:
                begun.append(time.perf_counter())
                if console.is_terminal:
                    stack.enter_context(Live(spinner, console=console, transient=True))
                else:
                    console.print(message(total), highlight=False)

        def progress(done: int, total: int, left: float) -> None:
            begin(total=total)
            time_left = "" if math.isnan(left) else f", about {left:.0f} s left"
            spinner.update(text=f"{MESSAGE} {done} of {total}{time_left}")

        stack.enter_context(watch_compilation(begin))
        stack.enter_context(showing(progress))
        yield progress
        seconds = time.perf_counter() - begun[0] if begun else 0.0
    if begun:
        console.print(f"Compiled in {seconds:.0f} s.", highlight=False)


def prepare(*first_steps: Callable[[], object]) -> None:
    """Compile or load all kernels before a command shows its own output; report compilation on stderr.

    Args:
        first_steps: Functions called in order before all kernels are compiled, so that bad input is reported early.
    """
    from slam_backend.core.compilation.messages import MESSAGE, log_compilation
    from vslam_env._warm_up import warm_up

    with compilation_progress(make_console(stderr=True)) as progress:
        for step in first_steps:
            step()
        warm_up(progress=progress)
    log_compilation(lambda: make_console(stderr=True).print(MESSAGE))  # kernels that only some runs need
