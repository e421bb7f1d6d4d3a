"""Commands `vslam worlds`: output, files, and refusals."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from training.cli import app
from training.episodes.world_survey import TILE, TITLE_PX, contact_sheet, survey
from vslam_env import vslam_v0
from vslam_env.rendering import draw_frame
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


def test_preview_draws_one_tile_per_seed(tmp_path: Path) -> None:
    """Three worlds give two by two tiles, the last one blank; the same seeds give the same picture."""
    sheet = contact_sheet("fig5", 3, 3, 2)
    assert sheet.shape == (960 + 2 * TITLE_PX, 1280, 3)
    below = 480 + TITLE_PX
    assert (sheet[below:, 640:] == 255).all()
    env = vslam_v0.parallel_env(world="fig5", num_robots=2)
    env.reset(seed=3, options={"world_seed": 3})
    np.testing.assert_array_equal(sheet[TITLE_PX:below, :640], draw_frame(env.scene(), TILE))  # no title on it
    assert 0 < (sheet[:TITLE_PX, :640] < 128).sum() < 3000
    out = tmp_path / "worlds.png"
    result = runner.invoke(app, ["worlds", "preview", "fig5", "--first-seed", "3", "--seeds", "3", "--robots", "2",
                                 "--out", str(out)])  # fmt: skip
    assert result.exit_code == 0
    np.testing.assert_array_equal(cv2.imread(str(out))[:, :, ::-1], sheet)


def test_import_and_validate(tmp_path: Path) -> None:
    """A plan becomes a valid .json of the same walls in metres; start distances are as requested."""
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
    assert "2 of 2 worlds are valid" in result.output


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["validate", "fig5", "--robots", "40"], "num_robots"),
        (["validate", "fig5", "--robots", "40", "--first-seed", "4"], "world seed 4, after 0 valid ones"),
        (["import", "PLAN", "plan.txt"], "out: expected a name that ends in .json"),
    ],
)
def test_impossible_worlds_are_refused(arguments: list[str], says: str, tmp_path: Path) -> None:
    """Too many robots for a world, and unknown worlds, are refused; see test_bad_input for other errors."""
    plan = str(_plan(tmp_path))
    result = runner.invoke(app, ["worlds", *(plan if word == "PLAN" else word for word in arguments)])
    assert isinstance(result.exception, ValueError)
    assert says in str(result.exception)
