"""Ray clusters, on which trials and environments run: `over_cluster` and `ClusterPool`."""

import logging
import signal
import socket
import threading
import traceback
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

import cloudpickle

from slam_backend.core.validation import argument_error
from training.experiments.run_folder import installed_versions

CONNECT_S = 10.0  # limit for reaching a cluster
START_S = 300.0  # limit for the start of all actors, which need a free core each
SAME = ("python", "vslam-env", "numpy", "scipy", "numba", "pymunk")  # whose versions must match for equal results
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


def over_cluster(
    play: Callable[..., dict[str, Any]], arguments: Iterable[tuple[Any, ...]], address: str,
    variables: Mapping[str, str] | None = None,
) -> Generator[dict[str, Any], None, None]:  # fmt: skip
    """Call a function with each of some arguments, one call per core, and yield the results as they end.

    A call whose process or node is lost is repeated elsewhere.
    """
    with connected(address, variables) as ray:
        task: Any = ray.remote(num_cpus=1, max_retries=-1)(lambda function, values: function(*values))
        shared: Any = ray.put(play)
        running: list[Any] = []
        cores: Any = ray.cluster_resources
        try:
            for values in arguments:
                running.append(task.remote(shared, values))
                while len(running) >= 2 * max(1, int(cores().get("CPU", 1))):  # nodes may come and go
                    done, running = ray.wait(running)
                    yield from ray.get(done)
            while running:
                done, running = ray.wait(running)
                yield from ray.get(done)
        except ray.exceptions.RayTaskError as error:
            raise error.cause from error


class ClusterPool:
    """Workers in actors of a Ray cluster, one per core; calls and results are sent through the network.

    Args:
        address: Address of the cluster, see `ray.init`.

    Raises:
        ValueError: If Ray is not installed, or the cluster cannot be reached.
    """

    def __init__(self, address: str) -> None:
        self._stack = ExitStack()
        self._ray = self._stack.enter_context(connected(address))
        self._actors: list[Any] = []

    def size(self, workers: int, most: int) -> int:
        """Return the number of workers: that asked for; 0: the cores of the cluster, at most `most`.

        Raises:
            ValueError: If there are fewer cores.
        """
        cores = int(self._ray.cluster_resources().get("CPU", 0))
        if workers > cores:
            hint = "Use fewer workers, or more machines."
            raise argument_error("workers", f"at most one per core of the cluster, {cores}", workers, hint)
        return workers or max(1, min(cores, most))

    def start(self, packed: Sequence[bytes], parts: Sequence[slice]) -> None:
        """Start an actor for each pickled function that makes the object of a worker.

        Raises:
            ValueError: If there are too few free cores, or other versions of packages.
        """
        ray = self._ray
        start: Any = ray.remote(num_cpus=1)(_Actor).remote
        self._actors = [start() for _ in packed]
        try:
            found = ray.get([actor.about.remote() for actor in self._actors], timeout=START_S)
        except ray.exceptions.GetTimeoutError as error:
            hint = "Stop other jobs, use fewer --workers, or see `ray status`."
            got = f"{ray.available_resources().get('CPU', 0):.0f} free of {len(self._actors)}"
            raise argument_error("ray", f"a free core for each worker within {START_S:.0f} s", got, hint) from error
        except ray.exceptions.RayError as error:
            hint = f"Install the same packages on all machines. Ray says: {str(error).strip().splitlines()[-1].strip()}"
            raise argument_error("ray", "machines that can start workers", "one that cannot", hint) from error
        for place, theirs in found:
            for name, ours in _versions().items():
                if theirs.get(name) != ours:
                    hint, got = "Install the same packages on all machines.", f"{theirs.get(name)} at {place}"
                    raise argument_error("ray", f"{name} {ours} on all machines", got, hint)
        self._places = [place for place, _ in found]
        self._pending = [actor.load.remote(make) for actor, make in zip(self._actors, packed, strict=True)]
        for worker in range(len(packed)):
            self.answer(worker, f"part {worker}")

    def send(self, worker: int, command: str, *rest: Any) -> None:
        """Let a worker call a method of its object."""
        self._pending[worker] = self._actors[worker].call.remote(command, *rest)

    def answer(self, worker: int, what: str) -> Any:
        """Return the result of the last call, or raise its error.

        Raises:
            LostWorkerError: If the worker of `what` is lost.
        """
        try:
            return self._ray.get(self._pending[worker])
        except self._ray.exceptions.RayTaskError as error:
            raise error.cause from error
        except self._ray.exceptions.RayError as error:
            hint = "The training resumes from its last checkpoint, with the machines that are left."
            got = f"a lost one at {self._places[worker]}, with {what}"
            raise LostWorkerError(str(argument_error("ray", "workers that run", got, hint))) from error

    def close(self) -> None:
        """End all actors, and leave the cluster."""
        for actor in self._actors:
            self._ray.kill(actor)  # its core is free at once
        self._actors = []
        self._stack.close()


class _Actor:
    """Worker on a machine of the cluster."""

    def about(self) -> tuple[str, dict[str, str]]:
        """Return the address of this machine and the versions of its packages."""
        import ray

        address: Any = ray.util.get_node_ip_address
        return address(), _versions()

    def load(self, packed: bytes) -> None:
        """Make the object."""
        try:
            self._object = cloudpickle.loads(packed)()
        except Exception as error:
            raise with_traceback(error) from None

    def call(self, command: str, *rest: Any) -> Any:
        """Call a method of the object."""
        try:
            return getattr(self._object, command)(*rest)
        except Exception as error:
            raise with_traceback(error) from None


def with_traceback(error: Exception) -> Exception:
    """Return the current error with its traceback as a note, which survives pickling."""
    error.add_note(f"In a worker:\n{traceback.format_exc()}")
    return error


def _versions() -> dict[str, str]:
    installed = installed_versions()
    return {name: installed[name] for name in SAME if name in installed}
