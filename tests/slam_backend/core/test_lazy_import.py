"""Modules that take long to import are imported at their first use."""

import subprocess
import sys

import pytest

from slam_backend.core.lazy_import import LazyModule

SLOW = ("cv2", "filelock", "tomllib", "matplotlib", "torch", "pygame", "numba.np.arrayobj")


def test_a_lazy_module_gives_the_attributes_of_the_module() -> None:
    """Names are looked up in the module, and unknown ones are refused as by it."""
    assert LazyModule("math").pi == pytest.approx(3.14159, abs=1e-5)
    with pytest.raises(AttributeError, match="module 'math' has no attribute 'tau_of_3'"):
        _ = LazyModule("math").tau_of_3
    with pytest.raises(ModuleNotFoundError, match="no_such_module"):
        _ = LazyModule("no_such_module").anything


def test_a_plain_import_needs_no_slow_module() -> None:
    """Neither images nor files of configurations are read by the import of the environment."""
    code = f"import sys, vslam_env; print(*set({SLOW!r}).intersection(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""
