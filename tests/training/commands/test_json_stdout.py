"""With `--json -` only the metrics are on stdout, whatever a command and its processes print."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer.main
from builders.bags import write_circle
from small_logs import small_graph, write_drive, write_log, write_park

from slam_backend.readers.pose_graphs import write_graph
from training import cli

SEED = ("--first-seed", "100")
# Minimal arguments of each command with --json, in a folder with logs and a model.
LEAST = {
    "run": ("--world", "fig5", "--robots", "1", "--max-cycles", "3", "--particles", "5", "--no-video"),
    "record": (
        "--world", "fig5", "--robots", "1", "--max-cycles", "3", "--particles", "5", "--episodes", "2", *SEED,
    ),
    "train": ("--preset", "smoke", "--robots", "1", "--workers", "0", "--steps", "24"),
    "evaluate": ("trained", "--seeds", "2", "--policies", "random_goals", *SEED),
    "replay mrclam": ("--path", "robots", "--duration", "5", "--particles", "3"),
    "replay victoria": ("--path", "park", "--duration", "6", "--particles", "3"),
    "replay kitti": ("--path", "drive", "--duration", "6", "--particles", "3"),
    "replay graph": ("--path", "graph.g2o", "--duration", "6", "--particles", "3"),
    "replay stereo": (),
    "replay bag": (
        "--path", "circle.mcap", "--odometry", "/odom", "--landmarks", "/tags", "--duration", "3", "--particles", "3",
    ),
    "bench speed filter": (
        "--particles", "5", "--landmarks", "40", "--measurements", "3", "--robots", "1", "--steps", "2",
    ),
    "bench speed env": (
        "--robots", "1", "--particles", "5", "--worlds", "fig5", "--modes", "flat", "--steps", "2", "--no-peer",
    ),
    "bench exploration": (
        "--policies", "frontier", "--worlds", "fig5", "--robots", "1", "--oracles", "none", "--max-seconds", "2",
        "--particles", "5", "--seeds", "1", *SEED,
    ),
    "bench speed start": ("--parts", "count", "--repeats", "1"),
    "paper fig1": ("--length", "3", "--particles", "5", "--every", "2"),
    "paper fig2": ("--seeds", "1", "--length", "5", "--every", "5", "--particles", "5", *SEED),
    "paper fig3": ("--seed", "100", "--length", "20", "--particles", "20"),
    "paper fig4": ("--seed", "100", "--length", "20", "--particles", "20"),
    "paper fig5": ("--robots", "1", "--max-seconds", "1"),
    "paper fig6": ("--seeds", "1", "--robots", "1", "--particles", "3", "--length", "2", "--regimes", "good", *SEED),
}  # fmt: skip
LEARNING = ("train", "evaluate")


def _commands(group: Any, name: str = "") -> Iterator[str]:
    """Return the names of all commands with the option --json."""
    for part, command in group.commands.items():
        path = f"{name} {part}".strip()
        if hasattr(command, "commands"):
            yield from _commands(command, path)
        elif any("--json" in option.opts for option in command.params):
            yield path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with a log of each kind."""
    made: Path = tmp_path_factory.mktemp("logs")
    for name in ("robots", "park", "drive"):
        (made / name).mkdir()
    write_log(made / "robots", noise=1.0)
    write_park(made / "park")
    write_drive(made / "drive")
    write_circle(made / "circle.mcap", seconds=5.0)
    write_graph(small_graph()[0], made / "graph.g2o")
    return made


def test_all_commands_with_json_are_covered() -> None:
    """The table has each command with the option but those that are tested elsewhere."""
    elsewhere = {"compare", "score", "merge", "replay MODULE:FUNCTION", "train-batched", "bench speed batched"}
    assert set(_commands(typer.main.get_command(cli.app))) == set(LEAST) | elsewhere


@pytest.mark.slow
@pytest.mark.parametrize("command", LEAST)
def test_stdout_is_json(
    command: str,
    vslam: Any,
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest,
) -> None:
    """The stdout of each command is the content of its `metrics.json`; other output is on stderr."""
    if command in LEARNING:
        pytest.importorskip("sb3_contrib")
    arguments = LEAST[command]
    if command == "replay stereo":
        arguments = ("--path", str(request.getfixturevalue("data_dir") / "euroc_pairs"))
    monkeypatch.chdir(folder)
    if command == "evaluate" and not Path("trained").exists():
        assert vslam("train", *LEAST["train"], "--out", "trained").status == 0
    said = vslam(*command.split(), *arguments, "--out", str(tmp_path / "run"), "--json", "-")
    assert said.status == 0, said.err
    assert json.loads(said.out) == json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert "Run folder:" in said.err
    assert not Path("-").exists()


LOUD = """
import os

class Loud:
    def reset(self):
        print("printed")
        os.write(1, b"written")

    def act(self, observation, belief, rng):
        return 0
"""


@pytest.mark.slow
@pytest.mark.parametrize("closed", [False, True])
def test_output_of_workers_goes_to_stderr(closed: bool, tmp_path: Path) -> None:
    """Output of a policy in a worker process, by print or to the descriptor of stdout, goes to stderr."""
    (tmp_path / "loud.py").write_text(LOUD)
    arguments = ["--policies", "frontier,loud:Loud", "--workers", "2", "--json", "-", "--out", str(tmp_path / "run")]
    few = [
        "--worlds", "fig5", "--robots", "1", "--oracles", "none", "--max-seconds", "2", "--particles", "5",
        "--seeds", "1",
    ]  # fmt: skip
    command = [sys.executable, "-m", "training", "bench", "exploration", *arguments, *few]
    shell = ["sh", "-c", 'exec "$@" 2>&-', "sh", *command] if closed else command
    environment = os.environ | {"PYTHONPATH": str(Path(cli.__file__).parents[1])}
    done = subprocess.run(shell, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == json.loads((tmp_path / "run" / "metrics.json").read_text())
    if not closed:
        assert "printed" in done.stderr
        assert "written" in done.stderr


@pytest.mark.slow
def test_a_closed_stdout_gives_a_one_line_error(tmp_path: Path) -> None:
    """If stdout is closed, the command has a one-line error, and its folder is complete."""
    few = "--world fig5 --robots 1 --max-cycles 3 --particles 5 --no-video --out run --json -"
    shell = f"{sys.executable} -m training run {few} 2>err | true; echo ${{PIPESTATUS[0]}}"
    environment = os.environ | {"PYTHONPATH": str(Path(cli.__file__).parents[1])}
    done = subprocess.run(["bash", "-c", shell], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.stdout == "2\n"
    last = (tmp_path / "err").read_text().splitlines()[-1]
    assert last == "error json: expected a file that can be written, got 'stdout'. The system says: Broken pipe."
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["complete"] is True
