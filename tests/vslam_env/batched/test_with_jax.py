"""Runner of the tests that need jax."""

import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

HERE = Path(__file__).parent


@pytest.mark.skipif(find_spec("jax") is None, reason="jax, an optional extra, is not installed")
def test_the_tests_with_jax_pass_in_a_process_of_their_own() -> None:
    """All tests of the folder run there, and none is skipped."""
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", str(HERE)]
    flags = {"XLA_FLAGS": "--xla_backend_optimization_level=0"}  # compiling takes most of the time
    environment = os.environ | {"VSLAM_TESTS_WITH_JAX": "1"} | flags
    ignored = ["--ignore", str(Path(__file__))]
    done = subprocess.run([*command, *ignored], env=environment, capture_output=True, text=True, timeout=900.0)
    assert done.returncode == 0, done.stdout[-5000:] + done.stderr[-2000:]
    assert "skipped" not in done.stdout
