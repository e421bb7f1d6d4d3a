"""Memory for the landmarks of an episode, compared with what is available before its first step."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from slam_backend.core.address_space import OWN, free_addresses
from slam_backend.core.validation import argument_error

PER_PARTICLE = 9 * 8 + 4  # bytes of a landmark in a particle: mean, covariance and count
COPIES = 2  # a map that grows is copied, and a joint map exists beside those from which it is merged
GROUP = Path("/sys/fs/cgroup")  # limits of containers
SYSTEM = Path("/proc/meminfo")


def required_memory(num_landmarks: int, num_particles: int) -> int:
    """Return the memory [bytes] for a map with all landmarks in all particles."""
    return COPIES * PER_PARTICLE * num_landmarks * num_particles


def available_memory(system: Path = SYSTEM, group: Path = GROUP, own: Path = OWN) -> int | None:
    """Return the memory [bytes] that this process can still use; None where the system does not say.

    Args:
        system: File in which Linux tells it.
        group: Folder with the limit of the process's control group, if there is one.
        own: File with the size of this process, for which `ulimit -v` sets a limit.
    """
    try:
        fields = dict(line.split(":", 1) for line in system.read_text(encoding="ascii").splitlines())
        available = 1024 * int(fields["MemAvailable"].split()[0])
    except (OSError, ValueError, KeyError, IndexError):
        return None
    try:
        limit, used = (int((group / name).read_text(encoding="ascii")) for name in ("memory.max", "memory.current"))
        available = min(available, max(limit - used, 0))
    except (OSError, ValueError):  # no group, or "max": no limit
        pass
    free = free_addresses(own)
    return available if free is None else min(available, free)


def check_memory(num_landmarks: int, num_particles: int, available: int | None) -> None:
    """Refuse an episode whose landmarks alone would not fit into the available memory [bytes].

    Args:
        num_landmarks: Number of landmarks that robots can see.
        num_particles: Number of particles of a filter.
        available: Result of `available_memory`.

    Raises:
        ValueError: If they would not.
    """
    if available is None or required_memory(num_landmarks, num_particles) <= available:
        return
    most = available // required_memory(num_landmarks, 1)
    expected = (
        f"at most {most} for the {num_landmarks} landmarks of this world in {available / 1e9:.1f} GB of free memory"
    )
    raise argument_error("num_particles", expected, num_particles, "Use fewer, or a smaller world, or free memory.")


@contextmanager
def memory_errors_as_argument_errors() -> Iterator[None]:
    """Turn a lack of memory in a block that builds an episode into a `ValueError`."""
    try:
        yield
    except MemoryError as error:
        raise argument_error("world", "one that fits into the free memory", str(error), "Use a smaller one.") from error
