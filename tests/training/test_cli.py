import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from training import cli
from training.commands._options import numbers, words

MRCLAM = "path: expected a folder of the MR.CLAM log, with Barcodes.dat, Landmark_Groundtruth.dat and Robot*.dat"


@pytest.mark.parametrize(
    "command",
    [
        (), ("replay",), ("replay", "mrclam"), ("replay", "victoria"), ("replay", "kitti"), ("bench",),
        ("bench", "filter"), ("bench", "train"), ("train",), ("evaluate",),
    ],
)  # fmt: skip
def test_every_command_explains_itself(vslam: Any, command: tuple[str, ...]) -> None:
    """`--help` works at every level and leaves with status 0."""
    said = vslam(*command, "--help")
    assert said.status == 0
    assert "Usage: vslam" in said.out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--path", "/nowhere"), MRCLAM + ", got no such path. Check '/nowhere'; if --path is left away, it is "),
        ((), MRCLAM + ", got no --path. Name it, or set VSLAM_DATA."),
        (("--path", ".", "--robots", "1;2"), "robots: expected numbers with commas between, got '1;2'."),
        (("--path", ".", "--robots", "7"), "robots: expected different numbers from 1 to 5, got (7,)."),
        (("--path", ".", "--particles", "0"), "particles: expected an int >= 1, got 0."),
        (("--path", ".", "--duration", "-1"), "duration: expected a finite number > 0, got -1.0."),
        (("--path", ".", "--estimator", "ekf"), "estimator: expected one of 'fastslam2', 'fastslam1', got 'ekf'."),
        (("--path", ".", "--seed", "-2"), "seed: expected an int >= 0, got -2."),
        (
            ("--path", ".", "--json", "/nowhere/copy.json"),
            "json: expected a file that can be written, got '/nowhere/copy.json'. The system says: No such file",
        ),
        (("--config", "/nowhere/config.toml"), "config: expected the config.toml of an earlier run, got no such file."),
    ],
)
def test_bad_input_is_one_line_and_status_2(
    monkeypatch: pytest.MonkeyPatch, refusal: Any, arguments: tuple[str, ...], message: str
) -> None:
    """Argument, what was expected, what came and the cure on one line of stderr, without a traceback."""
    monkeypatch.delenv("VSLAM_DATA", raising=False)
    assert refusal("replay", "mrclam", *arguments).startswith(f"error {message}")


def test_a_fault_of_the_program_keeps_its_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    """A ValueError that is not in the project's form is no bad input."""

    def broken(prog_name: str) -> None:
        raise ValueError("operands could not be broadcast together")

    monkeypatch.setattr(cli, "app", broken)
    with pytest.raises(ValueError, match="broadcast"):
        cli.main()


def test_numbers_with_commas() -> None:
    """Blanks do not matter; what is no number is refused by the option's name, and what is not given stays so."""
    assert numbers("robots", "1, 4,2") == (1, 4, 2)
    assert numbers("length", "1, 2.5", float) == (1.0, 2.5)
    assert words("a, b") == ("a", "b")
    assert numbers("robots", None) is words(None) is None
    with pytest.raises(ValueError, match="robots: expected numbers with commas between, got '1-3'"):
        numbers("robots", "1-3")


@pytest.mark.parametrize("module", ["training", "training.cli"])
def test_modules_are_the_command(module: str) -> None:
    """`python -m training` and `python -m training.cli` say what `vslam` says, with its exit status."""
    for arguments, status, says in ((["--help"], 0, "Usage: vslam"), (["run", "--robots", "0"], 2, "robots: expected")):
        done = subprocess.run([sys.executable, "-m", module, *arguments], capture_output=True, text=True)
        assert done.returncode == status
        assert says in done.stdout + done.stderr


def test_help_needs_no_heavy_import() -> None:
    """The command line is built without numba, OpenCV, matplotlib or torch, so that --help answers at once."""
    heavy = "{'numba', 'cv2', 'matplotlib', 'torch', 'scipy'}"
    code = f"import sys, training.cli; print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("arguments", [("run", "--max-cycles", "3"), ("worlds", "preview", "fig5")])
def test_a_deleted_folder_is_one_line(arguments: tuple[str, ...], tmp_path: Path) -> None:
    """A command that is called in a folder that is gone says so; --help works there."""
    gone = tmp_path / "gone"
    gone.mkdir()
    shell = ["sh", "-c", 'rmdir "$0"; exec "$@"', str(gone), sys.executable, "-m", "training"]
    environment = os.environ | {"PYTHONPATH": str(Path(cli.__file__).parents[1])}
    done = subprocess.run([*shell, *arguments], cwd=gone, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (2, "")
    told = "error folder: expected a current folder, got a deleted one. Change into one that exists."
    assert done.stderr.splitlines() == [told]
    gone.mkdir()
    assert subprocess.run([*shell, "--help"], cwd=gone, env=environment, capture_output=True).returncode == 0
