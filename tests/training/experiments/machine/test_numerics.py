import os
import subprocess
import sys

import pytest

from training.experiments.machine.numerics import CORE, PORTABLE, numerics, variables_for

HERE = numerics()


def of_a_process(variables: dict[str, str]) -> str:
    """Return the numerics of a new process, which has the environment of this one, too."""
    code = "from training.experiments.machine.numerics import numerics; print(numerics())"
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | variables, capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


def test_a_process_has_the_numerics_asked_for() -> None:
    """With the variables for older processors a process uses no more than these have."""
    if "X86_V3" not in HERE:
        pytest.skip(f"a processor without AVX2: {HERE}")
    assert of_a_process(variables_for(PORTABLE)).startswith(f"{PORTABLE}, ")


def test_nothing_is_changed_where_nothing_need_be_or_can_be() -> None:
    """The numerics of this machine need no variables, and those of none that is known to be inferior have none."""
    assert variables_for(HERE) == {}
    assert variables_for(f"{HERE}, python 3.11.7, numpy 2.4.6") == {}
    assert variables_for("SIMD X86_V9, OpenBLAS Haswell, glibc 2.36") == {}
    assert variables_for("znver5/3cc6f2b4, python 3.11.7") == {}
    assert CORE not in variables_for(HERE.replace("OpenBLAS ", "OpenBLAS SapphireRapids "))
