"""A full disk ends a command with one line and status 2, and finished results are kept."""

import errno
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders.full_disk import files_up_to

from training import cli
from training.episodes.video import VideoWriter
from training.experiments.trial_store import open_folder, run_trials

SHORT = ("--world", "fig5", "--robots", "1", "--particles", "5", "--max-cycles", "20", "--out", "run")
FULL = Path("/dev/full")


@pytest.mark.parametrize(
    ("options", "size", "file", "kept"),
    [
        (("--no-video",), 1_000, "environment.toml", {"config.toml"}),
        (
            ("--no-video",),
            10_000,
            "map.png",
            {"config.toml", "environment.toml", "metrics.json"}
            | {f"map_0.{kind}" for kind in ("npz", "csv", "ply")}
            | {"grid_0.yaml", "grid_0.pgm"},
        ),
        ((), 4_000, "video.mp4", {"config.toml", "environment.toml"}),
    ],
)
def test_a_full_disk_gives_a_one_line_error(
    options: tuple[str, ...],
    size: int,
    file: str,
    kept: set[str],
    vslam: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The line gives the file and the reason; earlier files are complete, and no partial file is left."""
    monkeypatch.chdir(tmp_path)
    with files_up_to(size):
        said = vslam("run", *SHORT, *options)
    assert said.status == 2
    last = said.err.splitlines()[-1]
    assert f"expected a file that can be written, got 'run/{file}'. The " in last
    assert ("File too large" in last) == (file != "video.mp4")
    assert "Traceback" not in said.err
    found = {path.name for path in Path("run").iterdir() if path.suffix != ".tum"}
    assert found == kept
    if "metrics.json" in kept:
        assert json.loads(Path("run/metrics.json").read_text())["complete"] is True


def test_a_video_that_cannot_be_written_leaves_no_file(tmp_path: Path) -> None:
    """A video with missing frames is refused when it is closed; an older file is kept."""
    path = tmp_path / "film.mp4"
    path.write_bytes(b"older")
    frames = np.random.default_rng(0).integers(0, 256, (20, 64, 64, 3), dtype=np.uint8)

    def film() -> None:
        with files_up_to(3_000), VideoWriter(path, (64, 64)) as video:
            for frame in frames:
                video.add(frame)

    with pytest.raises(ValueError, match=r"path: expected a file that can be written, got .*film\.mp4"):
        film()
    assert [(file.name, file.read_bytes()) for file in tmp_path.iterdir()] == [("film.mp4", b"older")]


def _row(trial: Any) -> dict[str, Any]:
    return {"seed": trial, "text": "x" * 400}


def test_finished_trials_survive_a_full_disk(tmp_path: Path) -> None:
    """Trials written before the disk was full are kept as complete lines."""
    folder = open_folder(tmp_path / "run", "count", {}, 0)
    with files_up_to(1_000), pytest.raises(ValueError, match=r"out: expected a file .* says: File too large\."):
        run_trials(folder, "trials.jsonl", _row, range(9), 1, lambda: False, lambda row: None)
    rows = [json.loads(line) for line in (folder.path / "trials.jsonl").read_text().splitlines()]
    assert [row["seed"] for row in rows] == [0, 1]


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_write_errors_of_libraries_are_one_line(number: int, refusal: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """An error about space or memory, from any library, is reported; any other error keeps its traceback."""

    def app(raised: Exception) -> Callable[[str], None]:
        def fail(prog_name: str) -> None:
            raise raised

        return fail

    monkeypatch.setattr(cli, "app", app(OSError(number, os.strerror(number), "events")))
    text = f"output: expected a disk with free space, got 'events'. The system says: {os.strerror(number)}."
    assert refusal("anything") == f"error {text}\n"
    monkeypatch.setattr(cli, "app", app(MemoryError()))
    assert refusal("anything") == "error memory: expected more of it, got none left. Use less, or raise ulimit -v.\n"
    monkeypatch.setattr(cli, "app", app(ConnectionError("another")))
    with pytest.raises(ConnectionError, match="another"):
        cli.main()


@pytest.mark.skipif(not FULL.is_char_device(), reason="there is no device that is always full")
def test_a_full_stdout_is_one_line() -> None:
    """Tables that cannot be printed end the command with one line, without further output at exit."""
    environment = os.environ | {"PYTHONPATH": str(Path(cli.__file__).parents[1])}
    with FULL.open("w") as full:
        command = [sys.executable, "-m", "training", "worlds", "list", "--seeds", "1"]
        done = subprocess.run(command, env=environment, stdout=full, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 2
    expected = "error output: expected a disk with free space, got stdout. The system says: No space left on device.\n"
    assert done.stderr == expected
