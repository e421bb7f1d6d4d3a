"""The command line `vslam`, called in this process as a user calls it."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

from training import cli


class Said(NamedTuple):
    """How a command ended: its exit status, and what it printed."""

    status: int
    out: str
    err: str


@pytest.fixture
def vslam(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., Said]:
    """Call the command line with arguments, and tell how it ended."""

    def call(*arguments: str) -> Said:
        capsys.readouterr()  # what was printed before is of no concern
        monkeypatch.setattr(sys, "argv", ["vslam", *arguments])
        with pytest.raises(SystemExit) as end:
            cli.main()
        return Said(int(end.value.code or 0), *capsys.readouterr())

    return call


@pytest.fixture
def refusal(vslam: Callable[..., Said], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., str]:
    """Call the command line in a folder of its own; it must end with status 2 and one line, which comes back.

    Whoever comes first with an empty cache has waited for the compiler before, and was told so on lines of its own.
    """
    monkeypatch.chdir(tmp_path)

    def call(*arguments: str) -> str:
        said = vslam(*arguments)
        assert said.status == 2
        assert not said.out
        told = [line for line in said.err.splitlines(True) if not line.startswith(("Compiling the", "Compiled in"))]
        assert len(told) == 1
        assert not Path("runs").exists()
        return told[0]

    return call
