"""What a command shows while kernels are compiled, which happens once; later it shows nothing."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

from rich.console import Console
from rich.live import Live
from rich.spinner import Spinner


@contextmanager
def compilation_shown(console: Console) -> Iterator[None]:
    """Show, from the first compilation in the block on, that the user waits for the compiler, and afterwards how long.

    A terminal shows a spinner, anything else one line. Nothing is shown where all kernels come from the cache. The
    block must not print to a live display of its own.

    Args:
        console: Where to; one on stderr leaves the output of a command alone.
    """
    from slam_backend.core.compilation import MESSAGE, watch_compilation

    with ExitStack() as stack:
        shown: list[str] = []

        def tell(name: str) -> None:
            if not shown:
                if console.is_terminal:
                    stack.enter_context(Live(Spinner("dots", MESSAGE), console=console, transient=True))
                else:
                    console.print(MESSAGE, highlight=False)
            shown.append(name)

        watch = stack.enter_context(watch_compilation(tell))
        yield
    if shown:
        console.print(f"Compiled in {watch.seconds:.0f} s; later runs take them from a cache.", highlight=False)


def prepare(*first_steps: Callable[[], object]) -> None:
    """Compile or load all kernels before a command's own displays begin; who has to wait is told so on stderr.

    Args:
        first_steps: Of the command, called in turn; what is wrong with its input shows before the long wait.
    """
    from slam_backend.warm_up import warm_up

    with compilation_shown(Console(stderr=True)):
        for step in (*first_steps, warm_up):
            step()
