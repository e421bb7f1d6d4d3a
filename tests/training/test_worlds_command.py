"""The commands `vslam worlds`: what they print and write, and how they refuse."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from training.cli import app
from training.episodes.world_survey import contact_sheet, survey
from vslam_env.world import WORLD_FAMILIES, load_walls_json

runner = CliRunner()


def _plan(folder: Path) -> Path:
    image = np.zeros((140, 180), np.uint8)
    image[10:130, 10:170] = 255
    path = folder / "plan.png"
    cv2.imwrite(str(path), image)
    return path


def test_list_names_all_families() -> None:
    """The list has a row for each family, and the ranges of the splits."""
    result = runner.invoke(app, ["worlds", "list", "--seeds", "1"])
    assert result.exit_code == 0
    assert all(name in result.output for name in WORLD_FAMILIES)
    assert "test: world seeds 0 to 9999" in result.output


def test_preview_draws_one_tile_a_seed(tmp_path: Path) -> None:
    """Three worlds make two by two tiles, the last one blank; the same seeds give the same picture."""
    sheet = contact_sheet("fig5", 3, 3, 2)
    assert sheet.shape == (960, 1280, 3)
    assert (sheet[480:, 640:] == 255).all()
    assert sheet[:480, :640].std() > 5.0
    out = tmp_path / "worlds.png"
    result = runner.invoke(app, ["worlds", "preview", "fig5", "--first-seed", "3", "--seeds", "3", "--robots", "2",
                                 "--out", str(out)])  # fmt: skip
    assert result.exit_code == 0
    np.testing.assert_array_equal(cv2.imread(str(out))[:, :, ::-1], sheet)


def test_import_and_validate(tmp_path: Path) -> None:
    """A plan becomes a .json of the same walls in metres, which validates; starts are as far apart as asked."""
    out = tmp_path / "plan.json"
    result = runner.invoke(app, ["worlds", "import", str(_plan(tmp_path)), str(out), "--metres-per-pixel", "0.1"])
    assert result.exit_code == 0
    assert "4 walls, 16.0 x 12.0 m" in result.output
    assert len(json.loads(out.read_text())["walls"]) == 4
    assert load_walls_json(out).bounds == pytest.approx((1.0, 1.0, 17.0, 13.0))
    found = survey(str(out), 0, 2)
    assert found.start_gap_m >= 5.0
    assert found.floor_m2 == pytest.approx(16.0 * 12.0, rel=0.05)
    result = runner.invoke(app, ["worlds", "validate", str(out), "--seeds", "2", "--robots", "2"])
    assert result.exit_code == 0
    assert "2 of 2 worlds are sound" in result.output


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["validate", "castle"], "world: expected one of 'office'"),
        (["validate", "fig5", "--robots", "40"], "num_robots"),
        (["validate", "fig5", "--robots", "40", "--first-seed", "4"], "world seed 4, after 0 sound ones"),
        (["validate", "fig5", "--first-seed", "-1"], "first_seed: expected an int >= 0"),
        (["preview", "fig5", "--out", "worlds.txt"], "out: expected a name that ends in .png, got 'worlds.txt'"),
        (["validate", "fig5", "--seeds", "0"], "seeds: expected an int >= 1"),
        (["list", "--seeds", "0"], "seeds: expected an int >= 1"),
        (["import", "PLAN", "plan.txt"], "out: expected a name that ends in .json"),
        (["import", "gone.png", "plan.json"], "world: expected a file"),
        (["import", "gone.yaml", "plan.json", "--metres-per-pixel", "0.1"], "metres_per_pixel: expected none beside"),
    ],
)
def test_bad_input_is_refused(arguments: list[str], says: str, tmp_path: Path) -> None:
    """Unknown worlds, senseless numbers and unreadable files are refused in one line that says what would do."""
    plan = str(_plan(tmp_path))
    result = runner.invoke(app, ["worlds", *(plan if word == "PLAN" else word for word in arguments)])
    assert isinstance(result.exception, ValueError)
    assert says in str(result.exception)
