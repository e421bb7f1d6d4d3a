"""Single-threaded BLAS: sums do not depend on the number of threads, and small systems gain nothing from more."""

from collections.abc import Callable
from functools import cache, wraps
from typing import ParamSpec, TypeVar

from threadpoolctl import LibController, ThreadpoolController

P = ParamSpec("P")
R = TypeVar("R")


@cache
def _blas_libraries() -> list[LibController]:
    """Return the controllers of the loaded BLAS libraries, cached, as the search takes milliseconds."""
    libraries: list[LibController] = ThreadpoolController().select(user_api="blas").lib_controllers
    return libraries


def single_threaded_blas(function: Callable[P, R]) -> Callable[P, R]:
    """Limit BLAS to one thread while `function` runs; the previous limits return afterwards."""

    @wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> R:
        threads = [(library, library.num_threads) for library in _blas_libraries()]
        many = [(library, number) for library, number in threads if number != 1]
        for library, _ in many:
            library.set_num_threads(1)
        try:
            return function(*args, **kwargs)
        finally:
            for library, number in many:
                library.set_num_threads(number)

    return limited
