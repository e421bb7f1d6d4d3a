"""What commands say while kernels are compiled."""

import math
import re
from io import StringIO
from typing import Any

import numba
import pytest
from rich.console import Console

from slam_backend.core.compilation import compiler
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


@pytest.mark.parametrize(
    ("is_terminal", "says"), [(False, f"{MESSAGE} 57 in all\n"), (True, f"{MESSAGE} 12 of 57, about")]
)
def test_kernels_that_are_expected_are_counted(is_terminal: bool, says: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A terminal shows how many of all are compiled, other outputs how many they are."""

    def compile_some(signatures: Any, progress: Any) -> float:
        progress(0, 57, math.nan)
        progress(12, 57, 40.0)
        return 1.0

    monkeypatch.setattr(compiler, "compile_kernels", compile_some)
    console = Console(file=StringIO(), force_terminal=is_terminal, width=120)
    with compilation_progress(console):
        compiler.expect(dict)
        assert compiler.compile_expected()
    assert says in console.file.getvalue()  # type: ignore[attr-defined]


def test_cached_kernels_are_not_reported(capsys: pytest.CaptureFixture[str]) -> None:
    """With all kernels loaded, a command starts without messages."""
    prepare()
    capsys.readouterr()
    called = []
    prepare(lambda: called.append("first"), lambda: called.append("second"))
    assert called == ["first", "second"]
    assert capsys.readouterr() == ("", "")
