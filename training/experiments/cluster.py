"""Connection to a Ray cluster."""

import logging
import signal
import socket
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from slam_backend.core.validation import argument_error

CONNECT_S = 10.0  # limit for reaching a cluster
SINGLE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class LostWorkerError(ValueError):
    """A process or a machine of the cluster was lost."""


@contextmanager
def connected(address: str, variables: Mapping[str, str] | None = None) -> Iterator[Any]:
    """Connect this process to a Ray cluster, whose processes then use one thread each.

    Args:
        address: Address of the cluster, see `ray.init`.
        variables: More variables of the environment of its processes.

    Yields:
        The module `ray`.

    Raises:
        ValueError: If Ray is not installed, or the cluster cannot be reached.
    """
    try:
        import ray
    except ImportError as error:
        hint = 'Install it: pip install "vslam-env[distributed]".'
        raise argument_error("ray", "an installation of Ray", "none", hint) from error
    settings = {"env_vars": dict.fromkeys(SINGLE_THREAD, "1") | dict(variables or {})}
    try:
        _check_reachable(address)  # Ray itself tries for minutes
        with _sigterm_kept():
            ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR, runtime_env=settings)
    except (OSError, ValueError, RuntimeError) as error:
        hint = f"Start one with `ray start --head`. Ray says: {str(error).splitlines()[0]}"
        raise argument_error("ray", "the address of a Ray cluster that runs", address, hint) from error
    try:
        yield ray
    finally:
        ray.shutdown()


def _check_reachable(address: str) -> None:
    """Raise an OSError unless something listens at HOST:PORT; other addresses, such as `auto`, are left to Ray."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host and port.isdecimal():
        socket.create_connection((host, int(port)), CONNECT_S).close()


@contextmanager
def _sigterm_kept() -> Iterator[None]:
    """Restore the handler of SIGTERM, which `ray.init` replaces by one that ends the process."""
    handler = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread() and handler is not None:
            signal.signal(signal.SIGTERM, handler)
