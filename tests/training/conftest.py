"""Fixtures that call the command line `vslam` in this process."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

from training import cli


class Said(NamedTuple):
    """Result of a command: its exit status, and its output."""

    status: int
    out: str
    err: str


@pytest.fixture
def vslam(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., Said]:
    """Call the command line with arguments, and return its result."""

    def call(*arguments: str) -> Said:
        capsys.readouterr()  # discards earlier output
        monkeypatch.setattr(sys, "argv", ["vslam", *arguments])
        with pytest.raises(SystemExit) as end:
            cli.main()
        return Said(int(end.value.code or 0), *capsys.readouterr())

    return call


@pytest.fixture
def refusal(vslam: Callable[..., Said], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., str]:
    """Call the command line in its own folder; it must end with status 2 and one line, which is returned.

    With an empty cache, messages of the compiler come on separate lines before it.
    """
    monkeypatch.chdir(tmp_path)

    def call(*arguments: str) -> str:
        said = vslam(*arguments)
        assert said.status == 2
        assert not said.out
        lines = [line for line in said.err.splitlines(True) if not line.startswith(("Compiling the", "Compiled in"))]
        assert len(lines) == 1
        assert not Path("runs").exists()
        return lines[0]

    return call
