"""Address space that a process may still take, which `ulimit -v` limits."""

import importlib
import logging
import os
from functools import cache
from pathlib import Path

from slam_backend.core.validation import argument_error

LOGGER = logging.getLogger("slam_backend")
OWN = Path("/proc/self/statm")
# [bytes] that the first kernels take, with OpenBLAS and the compiler: without the first nothing works, with the second
# all does; measured with two cores, of which each adds buffers and stacks.
LEAST, ENOUGH = 400_000_000, 650_000_000


def free_addresses(own: Path = OWN) -> int | None:
    """Return the address space [bytes] that this process may still take; None: there is no limit.

    Args:
        own: File with the size of this process.
    """
    try:
        resource = importlib.import_module("resource")  # missing on Windows
        limit = int(resource.getrlimit(resource.RLIMIT_AS)[0])
        size = int(own.read_text(encoding="ascii").split()[0]) * os.sysconf("SC_PAGE_SIZE")
    except (ImportError, OSError, ValueError, IndexError):
        return None
    return None if limit == resource.RLIM_INFINITY else max(limit - size, 0)


@cache
def check_address_space() -> None:
    """Refuse to load the first kernel where that would hang: without room OpenBLAS tries again for ever.

    Raises:
        ValueError: If the address space is limited to less than kernels and linear algebra take.
    """
    free = free_addresses()
    if free is None or free >= ENOUGH:
        return
    if free < LEAST:
        expected = f"a limit that leaves {ENOUGH // 10**6} MB for compiled kernels and linear algebra"
        raise argument_error("ulimit -v", expected, f"{free // 10**6} MB", "Raise the limit, or lift it.")
    LOGGER.warning(
        "ulimit -v leaves %d MB, kernels and linear algebra may need %d: this process may fail or wait for ever.",
        free // 10**6, ENOUGH // 10**6,
    )  # fmt: skip
