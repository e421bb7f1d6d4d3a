"""A limit of the address space is found, and refused where kernels cannot be loaded."""

import importlib
import subprocess
import sys

import pytest

from slam_backend.core import address_space
from slam_backend.core.address_space import ENOUGH, LEAST, check_address_space

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the size of a process is read from /proc")


@pytest.mark.parametrize(
    ("free", "is_refused", "warnings"),
    [(None, False, 0), (ENOUGH, False, 0), (ENOUGH - 1, False, 1), (LEAST, False, 1), (LEAST - 1, True, 0)],
)
def test_too_little_is_refused_and_a_little_more_is_reported(
    free: int | None, is_refused: bool, warnings: int, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Below what nothing works with there is an error; below what all works with one line says what may happen."""
    monkeypatch.setattr(address_space, "free_addresses", lambda: free)
    check_address_space.cache_clear()
    if is_refused:
        with pytest.raises(ValueError, match=r"ulimit -v: expected a limit that leaves 650 MB .* got .399 MB"):
            check_address_space()
    else:
        check_address_space()
    assert len(caplog.records) == warnings
    check_address_space.cache_clear()


@pytest.mark.slow
def test_a_program_with_too_little_ends_with_one_error_instead_of_waiting_for_ever() -> None:
    """As after `ulimit -v`: OpenBLAS would try to get its memory again and again."""
    code = (
        "import resource, vslam_env; from vslam_env import vslam_v0; from slam_backend.core import address_space as a; "
    )
    code += "size = int(a.OWN.read_text().split()[0]) * resource.getpagesize() + 390_000_000; "
    code += "resource.setrlimit(resource.RLIMIT_AS, (size, size)); vslam_v0.parallel_env().reset(seed=0)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=100)
    assert done.returncode == 1
    assert "ValueError: ulimit -v: expected a limit that leaves 650 MB" in done.stderr.splitlines()[-1]


def test_there_is_a_limit_or_none() -> None:
    """The result agrees with what the system says."""
    resource = importlib.import_module("resource")
    is_unlimited = resource.getrlimit(resource.RLIMIT_AS)[0] == resource.RLIM_INFINITY
    assert (address_space.free_addresses() is None) == is_unlimited
