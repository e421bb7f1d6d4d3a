"""Bad input of every command gives one line on stderr and exit status 2, before any computation or output."""

from pathlib import Path
from typing import Any

import pytest
import typer

from training.cli import app

MRCLAM = "path: expected a folder of the MR.CLAM log, with Barcodes.dat, Landmark_Groundtruth.dat and Robot*.dat"
ROBOTS = "robots: expected an int from 1 to 8, got"
LIST = "expected comma-separated numbers, got"
# Bad arguments of each command, with the beginning of the error. Ranges: tests/training/experiments/test_configs.py.
BAD: dict[str, dict[str, str]] = {
    "run": {
        "--world nowhere": "world: expected one of 'office', 'maze', 'loops', 'hall', 'fig5', 'rooms', 'campus', or",
        "--world broken.json": "world: expected",
        "--policy unknown": "policy: expected one of 'frontier', 'random_goals', 'random_walk',",
        "--policy random_walk --action-type goal": "action_type: expected 'continuous' or 'discrete'",
        "--robots 9": f"{ROBOTS} 9. Use 1 to 8 robots.", "--robots 0 --json -": f"{ROBOTS} 0.",
        "--action-type fly": "action_type: expected one of 'continuous', 'discrete', 'goal', got 'fly'.",
        "--json full": "json: expected a file, got a folder. Name a file in 'full'.",
        "--mcap run.bag": "mcap: expected a name that ends in .mcap, got 'run.bag'.",
        "--world fig5 --out full": "out: expected a new or empty folder",
        "--world fig5 --out /proc/version/run": "out: expected a folder that can be written",
    },
    "record": {
        "--episodes 0": "episodes: expected an int >= 1, got 0. Record at least one episode.",
        "--observations some": "observations: expected one of 'driver', 'goal', 'all', got 'some'.",
        "--policy unknown": "policy: expected one of 'frontier', 'random_goals', 'random_walk',",
        "--world fig5 --out full": "out: expected a new or empty folder",
        "--workers 0": "workers: expected an int >= 1, got 0.",
        "--verify full": "verify: expected the config.toml of an earlier run, got no such file.",
    },
    "train": {
        "--robots 9": f"{ROBOTS} 9.",
        "--world castle": "world: expected one of 'office'",
        "--ray auto --workers 0": "workers: expected an int >= 1 with --ray, got 0.",
        "--ray 127.0.0.1:1": "ray: expected the address of a Ray cluster that runs, got '127.0.0.1:1'.",
    },
    "train-batched": {
        "--robots 9": f"{ROBOTS} 9.",
        "--world castle": "world: expected one of 'office'",
        "--rows 3": "rows: expected an int >= 16, got 3. Use 16 rows or more.",
        "--decision-ticks 0": "decision_ticks: expected an int >= 1, got 0.",
        "--resume . --robots 2": "resume: expected no options that change the training, got ['robots'].",
        "--resume full": "resume: expected the config.toml of an earlier run, got no such file.",
    },
    "bench speed batched": {
        "--robots 9": f"{ROBOTS} 9.",
        "--world castle": "world: expected one of 'office'",
        "--batches 0": "batches: expected",
        "--beside -1": "beside: expected an int >= 0, got -1. Use 0 for none.",
    },
    "evaluate": {
        "": "model: expected a model that vslam train wrote, got no model",
        "none.npz": "model: expected a model that vslam train wrote, got no such file",
        "none.npz --policies best": "policy: expected one of 'frontier'",
        "none.npz --policies random_walk": "action_type: expected 'continuous' or 'discrete' for policy",
        "none.npz --workers 0": "workers: expected an int >= 1, got 0.",
    },
    "bench submit": {
        "nowhere": "folders: expected the config.toml of an earlier run, got no such file.",
    },
    "bench leaderboard": {
        "none": "folders: expected the config.toml of an earlier run, got no such file. Check 'none'.",
        "full": "folders: expected the config.toml of an earlier run, got no such file. Check 'full",
    },
    "warm-up": {"--workers 0": "workers: expected an int >= 1, got 0."},
    "replay mrclam": {
        "--path /nowhere": MRCLAM + ", got no such file. Check '/nowhere'. Without --path it is ",
        "": MRCLAM + ", got no --path. Give --path, or set VSLAM_DATA.",
        "--path . --robots 1;2": f"robots: {LIST} '1;2'.",
        "--path . --robots 7": "robots: expected different numbers from 1 to 5, got (7,).",
        "--path . --duration -1": "duration: expected a finite number > 0, got -1.0.",
        "--path . --rejuvenate-every -1": "rejuvenate_every: expected an int >= 0, got -1. Give a number of steps,",
    },
    "replay victoria": {
        "--path . --particles 0": "particles: expected an int >= 1, got 0.",
        "": "path: expected a folder of the Victoria Park log, with ",
    },
    "replay kitti": {
        "--path . --proposal ekf": "proposal: expected one of 'fastslam2', 'fastslam1', got 'ekf'.",
        "": "path: expected an archive (.npz) of KITTI features, ",
    },
    "replay stereo": {"--path none": "path: expected a folder with two stereo pairs (left_img_0.png, "},
    "replay bag": {
        "": "path: expected a value, got 'none'. Give --path.",
        "--path none.bag": "path: expected a bag (.bag, .mcap, .db3, or a folder with metadata.yaml), got no such file",
        "--path broken.json": "path: expected a bag (.bag, .mcap, .db3, or a folder with metadata.yaml), got '",
        "--path full --odometry /odom --landmarks /tags": "path: expected a bag (.bag, .mcap, .db3, or a folder with ",
        "--path . --dt 0": "dt: expected a finite number > 0, got 0.0. Give seconds, near those between two frames.",
        "--path . --odometry /odom,/odom": "odometry: expected at least one value, each once, got ",
    },
    "replay graph": {
        "": "path: expected a value, got 'none'. Give --path.",
        "--path none.g2o": "path: expected a pose graph (.g2o, .pyfg, .fg), got no such file. Check '",
        "--path broken.json": "path: expected a pose graph (.g2o, .pyfg, .fg), got '",
    },
    "replay MODULE:FUNCTION": {
        "": "path: expected a value, got 'none'. Give --path.",
        "--path .": "reader: expected MODULE:NAME of a reader, got ",
    },
    "bench speed filter": {
        "--particles 10;20": f"particles: {LIST} '10;20'. Write them like",
        "--landmarks 20": "landmarks: expected an int >= 30, got 20.",
    },
    "bench speed env": {"--robots 9": f"{ROBOTS} 9", "--worlds castle": "world: expected one of 'office'"},
    "bench speed start": {
        "--parts imports": "parts: expected one of 'demo', 'kernels', 'steps', 'wheel', 'import', 'count'",
        "--parts wheel": "wheel: expected the wheel that `make kernels-wheel` writes, got None.",
    },
    "bench exploration": {
        "--plan none.toml": "plan: expected the path of a TOML file, got no such file. Check 'none.toml'.",
        "--plan vslam-bench": "plan: expected one of 'vslam-bench-v1', or the path of a TOML file, got 'vslam-bench'.",
        "--policies unknown": "policy: expected one of 'frontier', 'random_goals', 'random_walk',",
        "--policies no_module:Missing": "policy: expected MODULE:NAME of a policy, got no module 'no_module'.",
        "--policies random_walk@goal": "random_walk@: expected one of 'continuous', 'discrete', 'team', got 'goal'.",
        "--policies none.npz": "policy: expected a model that vslam train wrote, got no such file.",
        "--worlds nowhere": "world: expected",
        "--robots 9": f"{ROBOTS} 9.",
    },
    "paper fig1": {"--robots 10": "robots: expected at most 9, got 10."},
    "paper fig2": {"--length 2": "length: expected a finite number >= 5, got 2.0"},
    "paper fig3": {"--length 1 --particles 5 --seed 101": "length: expected maps that can be aligned, got a refusal: "},
    "paper fig4": {"--landmarks 0": "landmarks: expected an int >= 1, got 0."},
    "paper fig5": {"--max-seconds 0": "max_seconds: expected an int >= 1, got 0."},
    "paper fig6": {"--robots 16": "measurements: expected an int >= 16, got 15.", "--robots a": f"robots: {LIST} 'a'."},
    "report": {"nowhere": "folder: expected the folder of a run, with config.toml, got no such folder."},
    "score": {
        "--truth none.txt --estimate none.txt": "truth: expected a TUM trajectory file, got no such file.",
    },
    "merge": {"none.npz none.npz": "one: expected a map (.npz) that LandmarkMap.save wrote, got no such file."},
    "compare": {"nowhere elsewhere": "folder: expected the folder of a run, with config.toml, got no such folder."},
    "worlds validate": {
        "castle": "world: expected one of 'office'",
        "fig5 --first-seed -1": "first_seed: expected an int >= 0",
        "fig5 --seeds 0": "seeds: expected an int >= 1",
    },
    "worlds list": {"--seeds 0": "seeds: expected an int >= 1"},
    "worlds preview": {"fig5 --out worlds.txt": "out: expected a name that ends in .png, got 'worlds.txt'"},
    "worlds import": {
        "gone.png plan.json": "world: expected a file",
        "gone.yaml plan.json --metres-per-pixel 0.1": "metres_per_pixel: expected no value for a ROS map",
    },
}  # fmt: skip
ROWS = [(command, arguments, begins) for command, rows in BAD.items() for arguments, begins in rows.items()]


def _commands(command: Any, path: str = "") -> dict[str, Any]:
    """Return all commands by their words."""
    inner = getattr(command, "commands", None)
    if inner is None:
        return {path: command}
    return {
        name: each for word, below in inner.items() for name, each in _commands(below, f"{path} {word}".strip()).items()
    }


COMMANDS = _commands(typer.main.get_command(app))
WITH_FOLDER = [name for name, each in COMMANDS.items() if any("--config" in param.opts for param in each.params)]


def _need_learner(command: str) -> None:
    if command.endswith("train"):
        pytest.importorskip("sb3_contrib", reason="torch is not installed")


@pytest.mark.parametrize(("command", "arguments", "begins"), ROWS, ids=lambda value: value.split(":")[0])
def test_bad_input_is_one_line_and_status_2(
    command: str, arguments: str, begins: str, refusal: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """One line on stderr has name, expected and actual value and a hint; nothing is written."""
    _need_learner(command)
    monkeypatch.delenv("VSLAM_DATA", raising=False)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    (tmp_path / "broken.json").write_text("{walls: [1, 2")
    assert refusal(*command.split(), *arguments.split()).startswith(f"error {begins}")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["broken.json", "full"]


@pytest.mark.parametrize("command", WITH_FOLDER)
def test_bad_files_are_refused_by_every_command(command: str, refusal: Any) -> None:
    """A missing configuration, and a path at which metrics cannot be written, are detected before any work."""
    _need_learner(command)
    missing = refusal(*command.split(), "--config", "/nowhere")
    assert missing.startswith("error config: expected the config.toml of an earlier run, got no such file.")
    unwritable = refusal(*command.split(), "--json", "none/copy.json")
    assert unwritable.startswith("error json: expected a file that can be written, got 'none/copy.json'. The system")


def test_every_command_has_bad_arguments() -> None:
    """Each command has bad arguments above, except the one that needs a display."""
    assert BAD.keys() == COMMANDS.keys() - {"drive"}
