import re
from io import StringIO

import numba
import pytest
from rich.console import Console

from slam_backend.core.compilation import MESSAGE
from training.experiments.compilation import compilation_shown, prepare


def _compile_two() -> None:
    """Compile two kernels as if they were the project's own."""
    for module in ("slam_backend.a", "vslam_env.b"):

        def kernel(x: float) -> float:
            return x

        kernel.__module__ = module
        numba.njit(kernel)(1.0)


@pytest.mark.parametrize("is_terminal", [False, True])
def test_who_waits_for_the_compiler_is_told_once(is_terminal: bool) -> None:
    """However many kernels: one message when the first begins, and one with the time when the block is over."""
    console = Console(file=StringIO(), force_terminal=is_terminal, width=120)
    with compilation_shown(console):
        _compile_two()
        during = console.file.getvalue()  # type: ignore[attr-defined]
    after = console.file.getvalue()  # type: ignore[attr-defined]
    assert MESSAGE in during
    assert "Compiled in" not in during
    assert len(re.findall(r"Compiled in \d+ s; later runs take them from a cache\.", after)) == 1
    if not is_terminal:
        assert after.count("\n") == 2


def test_nothing_is_shown_where_nothing_is_compiled(capsys: pytest.CaptureFixture[str]) -> None:
    """Once the kernels are there, a command begins in silence."""
    prepare()
    capsys.readouterr()
    called = []
    prepare(lambda: called.append("first"), lambda: called.append("second"))
    assert called == ["first", "second"]
    assert capsys.readouterr() == ("", "")
