import re
from io import StringIO

import numba
import pytest
from rich.console import Console

from slam_backend.core.compilation.messages import MESSAGE
from training.experiments.output.compilation import compilation_progress, prepare


def _compile_two() -> None:
    """Compile two kernels like those of the project."""
    for module in ("slam_backend.a", "vslam_env.b"):

        def kernel(x: float) -> float:
            return x

        kernel.__module__ = module
        numba.njit(kernel)(1.0)


@pytest.mark.parametrize("is_terminal", [False, True])
def test_compilation_is_reported_once(is_terminal: bool) -> None:
    """For any number of kernels there is one message at the first, and one with the time at the end of the block."""
    console = Console(file=StringIO(), force_terminal=is_terminal, width=120)
    with compilation_progress(console):
        _compile_two()
        during = console.file.getvalue()  # type: ignore[attr-defined]
    after = console.file.getvalue()  # type: ignore[attr-defined]
    assert MESSAGE in during
    assert "Compiled in" not in during
    assert len(re.findall(r"Compiled in \d+ s\.", after)) == 1
    if not is_terminal:
        assert after.count("\n") == 2


def test_cached_kernels_are_not_reported(capsys: pytest.CaptureFixture[str]) -> None:
    """With all kernels loaded, a command starts without messages."""
    prepare()
    capsys.readouterr()
    called = []
    prepare(lambda: called.append("first"), lambda: called.append("second"))
    assert called == ["first", "second"]
    assert capsys.readouterr() == ("", "")
