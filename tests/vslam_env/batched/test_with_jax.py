"""Runner of the tests that need jax."""

import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

HERE = Path(__file__).parent


@pytest.mark.slow
@pytest.mark.skipif(find_spec("jax") is None, reason="jax, an optional extra, is not installed")
@pytest.mark.parametrize("chosen", ["not nightly", pytest.param("nightly", marks=pytest.mark.nightly)])
def test_the_tests_with_jax_pass_in_a_process_of_their_own(chosen: str) -> None:
    """The tests of the folder run there, those that compile for long in the night, and none is skipped."""
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "-m", chosen]
    flags = {"XLA_FLAGS": "--xla_backend_optimization_level=0"}  # compiling takes most of the time
    environment = os.environ | {"VSLAM_TESTS_WITH_JAX": "1"} | flags
    tests = [str(HERE), "--ignore", str(Path(__file__))]
    done = subprocess.run([*command, *tests], env=environment, capture_output=True, text=True, timeout=900.0)
    assert done.returncode == 0, done.stdout[-5000:] + done.stderr[-2000:]
    assert "skipped" not in done.stdout


def test_a_missing_package_is_one_line_that_names_the_extra() -> None:
    """Imports of batched teams and their commands say what to install."""
    hidden = "import sys; sys.modules['jax'] = None; "
    program = f"{hidden}import vslam_env.batched.environment"
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=100.0).stderr
    assert said.splitlines()[-1].endswith('Install the extra: pip install "vslam-env[jax]".')
    for words in (["train-batched", "--quick"], ["bench", "speed", "batched", "--quick"]):
        program = f"{hidden}sys.argv = ['vslam', *{words!r}]; from training.cli import main; main()"
        done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=100.0)
        assert done.returncode == 2, done.stderr
        (line,) = done.stderr.splitlines()
        assert line.startswith("error jax: expected the packages of the extra 'jax', got no jax. Install them: ")
