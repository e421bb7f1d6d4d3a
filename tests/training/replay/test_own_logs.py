"""Logs of readers of users: `vslam replay MODULE:FUNCTION`, and what a `Log` refuses."""

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_logs import write_log

from slam_backend.models.measurements import Measurements
from training.replay.config import LogConfig
from training.replay.core import make_filters
from training.replay.log import Log, RobotLog
from training.replay.readers import read_mrclam

EXAMPLES = Path(__file__).parents[3] / "examples"


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Write a module of the user, `mine`, into the current folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "mine", raising=False)

    def write(body: str) -> None:
        (tmp_path / "mine.py").write_text("from training.replay.log import Log, RobotLog\n" + body)

    return write


def test_the_example_is_replayed_and_repeats_itself(
    vslam: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The reader of the example maps a log of the user with all results of a replay; config.toml repeats them."""
    monkeypatch.chdir(EXAMPLES)
    monkeypatch.syspath_prepend(str(EXAMPLES))
    import own_log  # type: ignore[import-not-found]

    own_log.make_log(tmp_path)
    run, again = tmp_path / "run", tmp_path / "again"
    command = ("replay", "own_reader:read")
    said = vslam(*command, "--path", str(tmp_path), "--duration", "60", "--particles", "20", "--out", str(run))
    assert said.status == 0, said.err
    assert vslam(*command, "--config", str(run), "--out", str(again)).status == 0
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics == json.loads((again / "metrics.json").read_text())
    (row,) = metrics["robots"]
    assert metrics["duration_s"] == pytest.approx(60.0)
    assert row["ate_aligned_m"] < 0.2 < row["dead_reckoning_ate_start_m"]
    assert row["map_rmse_m"] < 0.2
    assert row["map_recall"] == row["map_precision"] == 1.0
    assert {file.name for file in run.iterdir()} == {
        "config.toml", "metrics.json", "replay.png", "timing.json", "estimate.tum", "dead_reckoning.tum", "truth.tum",
        "map_1.npz", "map_1.csv", "map_1.ply", "recording.npz", "report.html",
    }  # fmt: skip


def test_a_team_of_the_user_is_a_team(module: Any, vslam: Any, tmp_path: Path) -> None:
    """Two robots of a reader of the user end in one group, as those of MR.CLAM do."""
    write_log(tmp_path, noise=0.0)
    module("from training.replay.readers import read_mrclam\n\ndef read(path):\n    return read_mrclam(path)\n")
    said = vslam("replay", "mine:read", "--path", ".", "--particles", "7", "--out", "run")
    assert said.status == 0, said.err
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["groups"] == [[2, 5]]


@pytest.mark.parametrize(
    ("name", "body", "says"),
    [
        ("other:read", "", "reader: expected MODULE:NAME of a reader, got \"no module 'other'\". Name an installed"),
        ("mine:reda", "def read(path): ...", "got \"no class or function 'reda' in mine\". Did you mean 'read'?"),
        ("mine:read", "def read(path): ...", "reader: expected a Log, got None. Let mine:read return a training."),
        ("mine:read", "def read(path):\n    return open(path / 'none')", "got FileNotFoundError: "),
        ("mine:read", "def read(): ...", "got TypeError: read() takes 0 positional arguments"),
        ("mine:read", "import nothing_here", "reader 'mine': expected it to be imported and called, got ModuleNot"),
        ("mine:read", "def read(path):\n    return Log(times=[], robots=[])", "times: expected two steps or more"),
        (
            "mine:read",
            "def read(path):\n    own = RobotLog(odometry=[[0, 0, 0]] * 2, measurements=[None])\n"
            "    return Log(times=[0, 1], robots=[own])",
            "measurements: expected a list of 2 entries, one for each step, got 'a list of 1'. Give None where",
        ),
    ],
)  # fmt: skip
def test_bad_readers_are_refused_in_one_line(name: str, body: str, says: str, module: Any, refusal: Any) -> None:
    """A missing module or function, a function that raises or returns another thing, and an empty or ragged log."""
    module(body)
    shown = refusal("replay", name, "--path", ".")
    assert says.replace('"', "").replace("'", "") in shown.replace('"', "").replace("'", "")


FRAME = Measurements([[0.0, 0.0, 2.0]], [[1.0]])
ROBOT = RobotLog(odometry=np.zeros((3, 3)), measurements=[None, FRAME, None])
LOG = Log(times=np.arange(3.0), robots=[ROBOT])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"times": [0.0, 2.0, 1.0]}, r"times: expected strictly increasing times, got '?1\.0 s after 2\.0 s'?\. Sort"),
        ({"times": [0.0, np.nan, 1.0]}, r"times: expected finite numbers, got '?NaN or infinity at index \(1,\)"),
        ({"robots": []}, r"robots: expected 1 to 1000 robots, got '?a list of 0'?\. Give a RobotLog for each robot"),
        ({"robots": [FRAME]}, r"robots: expected a RobotLog, got"),
        ({"options": {"motoin": 1}}, r"options: expected names of options, got 'motoin'\. Did you mean 'motion'\?"),
        ({"landmarks": [[0.0, 1.0, 2.0]]}, r"landmarks: expected an array of shape \(n, 2\), got '?shape \(1, 3\)"),
    ],
)  # fmt: skip
def test_bad_logs_are_refused(changes: dict[str, Any], message: str) -> None:
    """Times that go back or are not finite, no robots, unknown options, and landmarks of another shape are refused."""
    with pytest.raises(ValueError, match=message):
        replace(LOG, **changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"odometry": np.zeros((2, 3))}, r"odometry: expected an array of shape \(3, 3\), got"),
        ({"odometry": np.full((3, 3), np.nan)}, r"odometry: expected finite numbers, got"),
        ({"measurements": [None, 1.0, None]}, r"measurements\[1\]: expected Measurements or None, got 1\.0\. Build"),
        ({"identities": [[], [], []]}, r"identities\[1\]: expected an array of shape \(1,\), got"),
        ({"identities": [[], [7], []]}, r"identities\[1\]: expected rows of landmarks, got \[7\]\. Give the landmark"),
        ({"truth": np.zeros((2, 4))}, r"truth: expected an array of shape \(n, 3\), got"),
        ({"truth": "poses.txt"}, r"truth: expected a Trajectory, got 'poses\.txt'"),
    ],
)
def test_bad_readings_are_refused(changes: dict[str, Any], message: str) -> None:
    """Readings that are ragged, not finite or of another kind are refused by name and step."""
    with pytest.raises(ValueError, match=message):
        replace(LOG, robots=[replace(ROBOT, **changes)], landmarks=np.zeros((5, 2)))


def test_options_of_the_command_have_priority_over_those_of_the_log() -> None:
    """The log sets defaults; without one a filter has 100 particles per robot of the team."""
    log = replace(LOG, options={"num_particles": 9, "rejuvenate_every": 5})
    options = make_filters(log, LogConfig(path="log")).filter.options
    assert (options.num_particles, options.rejuvenate_every) == (9, 5)
    options = make_filters(log, LogConfig(path="log", particles=7, rejuvenate_every=0)).filter.options
    assert (options.num_particles, options.rejuvenate_every) == (7, None)
    assert make_filters(LOG, LogConfig(path="log")).filter.options.num_particles == 100


def test_readers_do_not_need_the_command(tmp_path: Path) -> None:
    """A reader's log has the arrays of the log: a row of odometry and a frame for each step of each robot."""
    write_log(tmp_path, noise=0.0)
    log = read_mrclam(tmp_path)
    for robot in log.robots:
        assert np.shape(robot.odometry) == (len(log.times), 3)
        assert len(list(robot.steps())) == len(log.times)
