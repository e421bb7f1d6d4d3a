import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

from training import cli


def test_a_fault_of_the_program_keeps_its_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    """A ValueError without the project's format is not bad input."""

    def broken(prog_name: str) -> None:
        raise ValueError("operands could not be broadcast together")

    monkeypatch.setattr(cli, "app", broken)
    with pytest.raises(ValueError, match="broadcast"):
        cli.main()


@pytest.mark.parametrize("module", ["training", "training.cli"])
def test_modules_run_the_command(module: str) -> None:
    """`python -m training` and `python -m training.cli` have the output and exit status of `vslam`."""
    for arguments, status, says in (
        (["--help"], 0, "Usage: vslam"),
        (["--version"], 0, f"vslam-env {version('vslam-env')}"),
        (["run", "--robots", "0"], 2, "robots: expected"),
    ):
        done = subprocess.run([sys.executable, "-m", module, *arguments], capture_output=True, text=True)
        assert done.returncode == status
        assert says in done.stdout + done.stderr


def test_help_needs_no_heavy_import() -> None:
    """The command line is built without numba, OpenCV, matplotlib or torch, so that --help is fast."""
    heavy = "{'numba', 'cv2', 'matplotlib', 'torch', 'scipy'}"
    code = f"import sys, training.cli; print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("arguments", [("run", "--max-cycles", "3"), ("worlds", "preview", "fig5")])
def test_a_deleted_folder_gives_a_one_line_error(arguments: tuple[str, ...], tmp_path: Path) -> None:
    """A command called in a deleted folder has a clear error; --help works there."""
    gone = tmp_path / "gone"
    gone.mkdir()
    shell = ["sh", "-c", 'rmdir "$0"; exec "$@"', str(gone), sys.executable, "-m", "training"]
    environment = os.environ | {"PYTHONPATH": str(Path(cli.__file__).parents[1])}
    done = subprocess.run([*shell, *arguments], cwd=gone, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (2, "")
    expected = "error folder: expected a current folder, got a deleted one. Change into one that exists."
    assert done.stderr.splitlines() == [expected]
    gone.mkdir()
    assert subprocess.run([*shell, "--help"], cwd=gone, env=environment, capture_output=True).returncode == 0
