"""`ClusterEnvs`: environments of `SyncEnvs` in actors of a Ray cluster."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any

import cloudpickle
import numpy as np
from numpy.typing import NDArray

from slam_backend.core.validation import argument_error
from training.experiments.cluster import LostWorkerError, connected
from training.experiments.run_folder import installed_versions
from training.rl.slots import MakeEnv, SyncEnvs
from training.rl.workers import WorkerEnvs, with_traceback

START_S = 300.0  # limit for the start of all actors, which need a free core each
SAME = ("vslam-env", "numpy", "scipy", "numba", "pymunk")  # packages whose versions must match for equal results


class ClusterEnvs(WorkerEnvs):
    """Environments in the actors of a Ray cluster, one per core, with the results of any other workers.

    Observations and all else are sent through the network. An error in an actor is raised here and ends all actors, as
    does the loss of one.

    Args:
        makers: Functions that each make an environment, see `WorkerEnvs`.
        address: Address of the cluster, see `ray.init`.
        workers: Number of actors; 0: the cores of the cluster, at most one per environment.
        prepare: Function called once in each actor before environments are made, e.g. to load kernels.

    Raises:
        ValueError: If Ray is not installed, the cluster cannot be reached, has too few free cores or other versions of
            packages, or there are more workers than environments.
    """

    def __init__(
        self,
        makers: Sequence[MakeEnv],
        address: str,
        workers: int = 0,
        prepare: Callable[[], object] = lambda: None,
    ) -> None:
        super().__init__(makers)
        with ExitStack() as stack:
            self._ray = stack.enter_context(connected(address))
            cores = int(self._ray.cluster_resources().get("CPU", 0))
            if workers > cores:
                hint = "Use fewer workers, or more machines."
                raise argument_error("workers", f"at most one per core of the cluster, {cores}", workers, hint)
            self._divide(workers or max(1, min(cores, len(makers))))
            start: Any = self._ray.remote(num_cpus=1)(_Actor).remote
            self._actors = [start(cloudpickle.dumps((prepare, list(makers[envs])))) for envs in self._envs]
            self._places = self._find_places()
            self._pending: list[Any] = [actor.load.remote() for actor in self._actors]
            self._disconnect = stack.pop_all().close
        self._answers()

    def close(self) -> None:
        """End all actors, and leave the cluster."""
        if self._is_open:
            for actor in self._actors:
                self._ray.kill(actor)  # its core is free at once
        self._is_open = False
        self._disconnect()

    # ------------------------------------------------------------------ within

    def _find_places(self) -> list[str]:
        """Return the machine of each actor, once all have started with the same packages as this process."""
        ray = self._ray
        try:
            found = ray.get([actor.about.remote() for actor in self._actors], timeout=START_S)
        except ray.exceptions.GetTimeoutError as error:
            hint = "Stop other jobs, use fewer --workers, or see `ray status`."
            got = f"{ray.available_resources().get('CPU', 0):.0f} free of {len(self._actors)}"
            raise argument_error("ray", f"a free core for each worker within {START_S:.0f} s", got, hint) from error
        except ray.exceptions.RayError as error:
            hint = f"Install the same packages on all machines. Ray says: {str(error).strip().splitlines()[-1].strip()}"
            raise argument_error("ray", "machines that can start workers", "one that cannot", hint) from error
        ours = _versions()
        for place, theirs in found:
            for name in ours:
                if theirs.get(name) != ours[name]:
                    hint = "Install the same packages on all machines."
                    got = f"{theirs.get(name)} at {place}"
                    raise argument_error("ray", f"{name} {ours[name]} on all machines", got, hint)
        return [place for place, _ in found]

    def _send(self, worker: int, command: str, *rest: Any) -> None:
        self._pending[worker] = self._actors[worker].call.remote(command, *rest)

    def _answer(self, worker: int) -> Any:
        ray = self._ray
        try:
            return ray.get(self._pending[worker])
        except ray.exceptions.RayTaskError as error:
            self.close()
            raise error.cause from error
        except ray.exceptions.RayError as error:
            self.close()
            envs = self._envs[worker]
            hint = "The training resumes from its last checkpoint, with the machines that are left."
            got = f"a lost one at {self._places[worker]}, with environments {envs.start} to {envs.stop - 1}"
            raise LostWorkerError(str(argument_error("ray", "workers that run", got, hint))) from error

    def _observations(self, parts: Sequence[dict[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


class _Actor:
    """Worker on a machine of the cluster."""

    def __init__(self, packed: bytes) -> None:
        self._packed = packed

    def about(self) -> tuple[str, dict[str, str]]:
        """Return the address of this machine and the versions of its packages."""
        import ray

        address: Any = ray.util.get_node_ip_address
        return address(), _versions()

    def load(self) -> None:
        """Prepare this process and make the environments."""
        try:
            prepare, makers = cloudpickle.loads(self._packed)
            prepare()
            self._batch = SyncEnvs(makers)
        except Exception as error:
            raise with_traceback(error) from None

    def call(self, command: str, *rest: Any) -> Any:
        """Call a method of the environments."""
        try:
            return getattr(self._batch, command)(*rest)
        except Exception as error:
            raise with_traceback(error) from None


def _versions() -> dict[str, str]:
    installed = installed_versions()
    return {name: installed[name] for name in ("python", *SAME) if name in installed}
