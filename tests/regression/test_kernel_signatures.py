import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.slow
def test_recorded_signatures_are_those_of_a_warm_up() -> None:
    """What is compiled in advance is what is called, each kernel in no other signature."""
    program = Path(__file__).with_name("kernel_signatures.py")
    done = subprocess.run([sys.executable, str(program)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
