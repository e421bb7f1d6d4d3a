"""`vslam paper fig5`: walls restrict the view, in the data and in the picture."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from training.cli import app
from training.paper.config import Fig5Config
from training.paper.fig5 import STATES, TABLE, Fig5, simulate_fig5

runner = CliRunner()


@pytest.fixture(scope="module")
def found() -> Fig5:
    """Return a figure in which some landmarks are hidden."""
    return simulate_fig5(Fig5Config(seed=1, decisions=6))


def _crossed(found: Fig5, robot: int, mark: int) -> bool:
    """Return whether a wall, shortened at the landmark, or another robot stands between a robot and a landmark."""
    eye, target = found.poses[robot, :2], found.landmarks[mark, :2]
    sight = 0.999 * (target - eye)
    for wall in found.walls:
        along = wall[2:] - wall[:2]
        cross = sight[0] * along[1] - sight[1] * along[0]
        if abs(cross) > 1e-12:
            offset = wall[:2] - eye
            t = (offset[0] * along[1] - offset[1] * along[0]) / cross
            u = (offset[0] * sight[1] - offset[1] * sight[0]) / cross
            if 0.0 < t < 1.0 and 0.0 <= u <= 1.0:
                return True
    for other in np.delete(found.poses, robot, axis=0):
        along_sight = np.clip((other[:2] - eye) @ sight / (sight @ sight), 0.0, 1.0)
        if np.linalg.norm(eye + along_sight * sight - other[:2]) < 0.2:
            return True
    return False


def test_walls_restrict_the_view(found: Fig5) -> None:
    """The paper's claim: of the landmarks in view exactly those behind walls or robots are not seen."""
    hidden = found.in_view & ~found.seen
    assert hidden.sum() >= 5
    assert not (found.seen & ~found.in_view).any()
    for robot, mark in np.argwhere(found.in_view):
        assert _crossed(found, robot, mark) == hidden[robot, mark]


def test_measured_landmarks_are_visible(found: Fig5) -> None:
    """Each robot measures at most B landmarks, all of which it sees."""
    assert not (found.measured & ~found.seen).any()
    assert (found.measured.sum(axis=1) <= 5).all()
    assert found.paths.shape == (3, 61, 2)


def test_the_table_matches_the_figure(found: Fig5) -> None:
    """There is a row for each landmark in a robot's view, with its state, and a line for each robot and for all."""
    rows = found.rows()
    assert len(rows) == found.in_view.sum()
    counts = {state: sum(row["state"] == state for row in rows) for state in STATES}
    assert counts["hidden"] == (found.in_view & ~found.seen).sum()
    assert counts["measured"] == found.measured.sum()
    *robots, whole = TABLE.lines(rows)
    assert whole["in view"].value == len(rows) == sum(line["in view"].value for line in robots)
    assert whole["seen"].value == found.seen.sum()
    row = rows[0]
    np.testing.assert_allclose(float(row["landmark_x"]), found.landmarks[int(row["landmark"]), 0], atol=1e-4)


def test_the_command_writes_picture_and_table(tmp_path: Path) -> None:
    """The run folder has a PNG with the robots' colours, the CSV, and numbers per robot."""
    out = tmp_path / "run"
    arguments = ["--robots", "2", "--max-seconds", "2", "--seed", "3", "--out", str(out)]
    result = runner.invoke(app, ["paper", "fig5", *arguments])
    assert result.exit_code == 0, result.output
    picture = cv2.imread(str(out / "fig5.png"))
    assert picture.shape[1] > 900
    assert np.ptp(picture.reshape(-1, 3).astype(int), axis=0).min() > 150
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["tables"]["robots"][-1]["in view"] == len(metrics["trials"]) > 0
    assert (out / "trials.csv").read_text().startswith("robot,x,y,theta,landmark")
