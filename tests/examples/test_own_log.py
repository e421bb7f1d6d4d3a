from pathlib import Path

import cv2
import pytest
from builders.scripts import load_script

PATH = Path(__file__).parents[2] / "examples" / "own_log.py"
example = load_script(PATH)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Simulated log of the example."""
    folder = tmp_path_factory.mktemp("log")
    example.make_log(folder)
    return folder


def test_a_log_gives_an_accurate_map(log: Path, tmp_path: Path) -> None:
    """Path and map are accurate to a decimetre, dead reckoning to most of a metre; a picture is drawn."""
    errors = example.run(log, tmp_path / "own.png")
    assert errors["path"].aligned < 0.1
    assert errors["map"].aligned < 0.05
    assert errors["odometry"].aligned > 0.5
    picture = cv2.imread(str(tmp_path / "own.png"))
    assert picture is not None
    assert picture.std() > 10.0


def test_without_truth_nothing_is_scored(log: Path, tmp_path: Path) -> None:
    """Odometry and measurements suffice for a map and a picture."""
    for name in ("odometry.csv", "sightings.csv"):
        (tmp_path / name).write_text((log / name).read_text())
    assert example.run(tmp_path, tmp_path / "own.png") == {}
    assert (tmp_path / "own.png").stat().st_size > 1000


def test_bad_input_gives_a_one_line_error(log: Path, tmp_path: Path) -> None:
    """Bad input ends the program with one line that gives file, line and column."""
    (tmp_path / "odometry.csv").write_text("time,v,omega\n0.0,0.1,fast\n")
    message = (
        r"^error path: expected a finite number in column 'omega', got 'fast'\. Correct line 2 of .*odometry\.csv\.$"
    )
    with pytest.raises(SystemExit, match=message):
        example.main(tmp_path, tmp_path / "own.png")
    for name in ("odometry.csv", "sightings.csv"):
        (tmp_path / name).write_text((log / name).read_text())
    (tmp_path / "truth.csv").write_text("time,x,y,theta\n900,0,0,0\n901,0,0,0\n")
    with pytest.raises(SystemExit, match=r"^truth\.csv and the log do not overlap: 900\.0 to 901\.0 s"):
        example.main(tmp_path, tmp_path / "own.png")


def test_the_program_simulates_a_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Without a folder the program simulates a log, and prints three errors."""
    example.main(None, tmp_path / "own.png")
    printed = capsys.readouterr().out
    assert "Simulated a log in " in printed
    assert "RMS errors after the best rigid fit: path 0.0" in printed
