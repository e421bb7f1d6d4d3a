import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from slam_backend.frontend import MATCH_CHECKS, StereoFrontEnd
from training.bench.stereo.bench import camera_of, speed_row
from training.bench.stereo.quality import guard_rows, quality_row, retrieval, second_looks
from training.bench.stereo.real_images import aloe_rows, chessboard, find_parts, measure_parts, planar_rows, rig_rows
from training.bench.stereo.report import markdown
from training.bench.stereo.scenes import WALL, Scene, panel_hall, wall_pose
from training.cli import app


def test_speed_rows_have_the_requested_load() -> None:
    """At 320 x 240 px with 40 walls there are 100 landmarks in the image, and both parts of a pair are timed."""
    row = speed_row(320, 100, 40, "usurf", 2, 3)
    assert row["landmarks"] == row["wanted"] == 100
    assert (row["width"], row["height"], row["walls"]) == (320, 240, 40)
    for part in ("render", "front_end"):
        assert row[part]["calls"] == 2
        assert 0.0 < row[part]["min_ms"] <= row[part]["median_ms"]
        assert row[part]["processor_ms"] > 0.0


def test_halls_have_the_requested_walls() -> None:
    """Four walls are the hall, the others are panels inside it."""
    for count in (4, 10, 40):
        world = panel_hall(count)
        assert len(world.walls) == count
        assert world.bounds == (0.0, 0.0, 8.0, 6.0)


def test_match_checks_are_counted_cumulatively() -> None:
    """Each row has the matches that pass all checks so far; patches are used from the second check on."""
    passed = np.ones((5, 4), dtype=bool)
    passed[0, 0] = passed[3, 1] = False
    rows = guard_rows(np.array([5.0, 0.5, -0.5, 0.1]), np.array([0.0, 3.0, 0.2, -0.1]), passed)
    assert [row["name"] for row in rows] == ["all matches", *(f"+ {name}" for name in MATCH_CHECKS)]
    assert [row["matches"] for row in rows] == [4, 3, 3, 3, 2, 2]
    assert rows[0]["outliers"] == 0.25
    assert rows[1]["outliers"] == 0.0
    assert rows[2]["outliers"] == pytest.approx(1 / 3)
    assert rows[4]["rms_px"] == pytest.approx(np.sqrt(0.025))
    assert rows[4]["bias_px"] == pytest.approx(0.05)


def test_rendered_pairs_have_few_outliers() -> None:
    """In an office patches measure disparities to a tenth of a pixel, and checks reject most outliers."""
    row = quality_row("usurf", 12, 101)
    first, last = row["guards"][0], row["guards"][-1]
    assert last["matches"] > 150
    assert last["rms_px"] < 0.12
    assert abs(last["bias_px"]) < 0.03
    assert last["outliers"] < 0.05
    assert last["outliers"] < first["outliers"]
    assert last["rms_px"] < first["rms_px"]


def test_repetitive_walls_are_not_retrieved() -> None:
    """Frontally nearly all landmarks are retrieved; at an angle fewer; among equal bricks almost none."""
    distinct, alike = (retrieval("usurf", None, style, 101) for style in ("distinct", "bricks_alike"))
    assert distinct["angles"]["0"]["recall"] > 0.95
    assert distinct["angles"]["0"]["recall"] > distinct["angles"]["30"]["recall"] > distinct["angles"]["60"]["recall"]
    assert alike["angles"]["15"]["precision"] < 0.1


def test_metric_windows_are_retrieved_from_afar() -> None:
    """From twice the distance, windows in metres retrieve at least twice as many landmarks as windows in pixels."""
    fixed, sized = (retrieval("usurf", window, "distinct", 101)["ratios"]["2"]["recall"] for window in (None, 0.6))
    assert sized > 2.0 * fixed


def test_repeated_views_agree_with_the_camera_model() -> None:
    """NEES of two views of a landmark is near 1 with the default noise, and smaller with twice this noise."""
    rows = second_looks(101)
    assert rows["1"]["pairs"] > 500
    assert 0.6 < rows["1"]["anees"] < 1.6
    assert rows["1"]["within"] > 0.85
    assert rows["2"]["anees"] < rows["1"]["anees"]


def test_wall_poses_have_the_requested_geometry() -> None:
    """The optical axis meets the wall at the requested position, distance and angle."""
    scene = Scene(WALL, camera_of(320), 1)
    for distance, angle in ((2.5, 0.0), (3.0, 0.7), (2.0, -0.5)):
        traced = scene.eye.trace(wall_pose(6.0, distance, angle)[None], 0, np.array([159.5]))
        assert traced.walls.tolist() == [0]
        assert traced.along[0] * 14.0 == pytest.approx(6.0)
        assert traced.depths[0] == pytest.approx(distance)


def test_points_have_true_landmarks_and_disparities(tmp_path: Path) -> None:
    """Points with a true landmark are near it, and true disparities agree with ray casting."""
    scene = Scene(WALL, camera_of(320), 2)
    front_end = StereoFrontEnd(scene.camera)
    corners = scene.corners(front_end)
    view = scene.look(wall_pose(6.0, 2.5, 0.2), np.random.default_rng(3))
    named = scene.named(view, front_end, corners)
    known = named.names >= 0
    away = np.linalg.norm(named.world[known] - corners.landmarks.positions[named.names[known]], axis=1)
    assert known.mean() > 0.7
    assert np.median(away) < 0.06
    assert np.median(np.abs(named.frame.pixels[:, 2] - named.true_disparities)) < 0.06


HOMOGRAPHY = np.array([[1.0, 0.02, 5.0], [-0.01, 1.0, 3.0], [0.0, 0.0, 1.0]])


def _photograph(shape: tuple[int, int] = (240, 320)) -> np.ndarray:
    """Return an image full of corners."""
    rng, image = np.random.default_rng(4), np.full(shape, 128, np.uint8)
    for _ in range(250):
        x, y = rng.integers(0, shape[1] - 10), rng.integers(0, shape[0] - 10)
        image[y : y + rng.integers(6, 30), x : x + rng.integers(6, 30)] = rng.integers(10, 245)
    return image


def _write_pairs(folder: Path) -> None:
    """Write a planar pair with an arbitrary name, and in a subfolder a rectified stereo pair of a wall 3 m ahead."""
    photograph = _photograph()
    warp = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    cv2.imwrite(str(folder / "houseA.jpg"), photograph)
    cv2.imwrite(str(folder / "houseB.bmp"), cv2.warpPerspective(photograph, HOMOGRAPHY, (320, 240), flags=warp))
    np.savetxt(folder / "house_model.txt", HOMOGRAPHY)
    (folder / "rig").mkdir()
    cv2.imwrite(str(folder / "rig" / "left0.png"), photograph[:, :300])
    cv2.imwrite(str(folder / "rig" / "right0.png"), photograph[:, 10:310])  # 10 px of disparity
    rows = [f"300 0 150 {shift} 0 300 120 0 0 0 1 0" for shift in (0.0, -30.0)]
    (folder / "rig" / "calib.txt").write_text("\n".join(rows))


def test_any_pairs_with_a_model_file_are_measured(tmp_path: Path) -> None:
    """Planar pairs are found by their homography, stereo pairs by their calibration, whatever their names."""
    _write_pairs(tmp_path)
    parts = find_parts(tmp_path, ("usurf", "orb"))
    assert [part.name for part in parts] == ["planar pair house", "stereo pairs in rig"]
    result: dict[str, Any] = {"speed": [], "quality": [], "retrieval": []}
    measure_parts(parts, result)
    assert "failed" not in result
    rows = {row["way"]: row for row in result["planar"]}
    assert rows["usurf"]["right"] > 0.8 * rows["usurf"]["matches"] > 40
    assert [row["descriptor"] for row in result["rigs"]] == ["usurf", "orb"]
    for row in result["rigs"]:
        assert row["pairs"] == 1
        assert row["depth_m"] == pytest.approx(3.0, abs=0.02)
        assert row["points"] > 50
        left = [row["matches"], *row["left"].values()]
        assert left == sorted(left, reverse=True)
    text = markdown(result)
    assert "| u-SURF | " in text
    assert "| rig | ORB | 1 | " in text


def test_failed_parts_are_recorded_and_others_continue(tmp_path: Path) -> None:
    """A broken model file, a missing image and a rig without images each fail separately."""
    _write_pairs(tmp_path)
    (tmp_path / "a_model.txt").write_text("1 2 three")
    (tmp_path / "b_model.txt").write_text("1 0 0 0 1 0 0 0 1")
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "calib.txt").write_text("")
    result: dict[str, Any] = {"speed": [], "quality": [], "retrieval": []}
    names: list[str] = []
    measure_parts(find_parts(tmp_path, ("usurf",)), result, names.append)
    assert names == [
        "planar pair a",
        "planar pair b",
        "planar pair house",
        "stereo pairs in empty",
        "stereo pairs in rig",
    ]
    assert set(result["failed"]) == {"planar pair a", "planar pair b", "stereo pairs in empty"}
    assert result["failed"]["planar pair a"].startswith(
        "real: expected a_model.txt with a 3 x 3 homography, got a diff"
    )
    assert result["failed"]["planar pair b"].startswith("real: expected an image bA.png, .jpg, ..., got no such file")
    assert result["failed"]["stereo pairs in empty"].startswith("real: expected as many left as right images")
    assert len(result["rigs"]) == 1
    assert "**Failed**" in markdown(result)
    with pytest.raises(ValueError, match="real: expected as many left as right images"):
        rig_rows(tmp_path / "empty", ("usurf",))


def test_the_command_keeps_results_beside_failures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, vslam: Any) -> None:
    """A real part that fails gives exit status 2 and one line, and keeps the results of the others."""
    rendered: dict[str, Any] = {"speed": [], "quality": [], "retrieval": []}
    monkeypatch.setattr("training.bench.stereo.bench._run_rendered", lambda *arguments: dict(rendered))
    _write_pairs(tmp_path)
    (tmp_path / "broken_model.txt").write_text("no numbers")
    run = tmp_path / "out"
    said = vslam("bench", "stereo", "--real", str(tmp_path), "--descriptors", "usurf", "--out", str(run))
    assert said.status == 2
    assert said.err.startswith("error planar pair broken: real: expected broken_model.txt with a 3 x 3 homography")
    assert said.err.count("\n") == 1
    metrics = json.loads((run / "metrics.json").read_text())
    assert len(metrics["planar"]) == 5
    assert len(metrics["rigs"]) == 1
    assert list(metrics["failed"]) == ["planar pair broken"]
    assert "Planar pairs" in (run / "tables.md").read_text()


@pytest.mark.slow
def test_the_command_writes_its_tables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`vslam bench stereo --quick` writes tables, a picture and metrics; without real data it has no real part."""
    monkeypatch.delenv("VSLAM_DATA", raising=False)
    arguments = ["bench", "stereo", "--quick", "--steps", "2", "--views", "3", "--descriptors", "usurf"]
    done = CliRunner().invoke(app, [*arguments, "--out", str(tmp_path / "run")])
    assert done.exit_code == 0, done.output
    tables = (tmp_path / "run" / "tables.md").read_text()
    for title in ("Time on one thread", "Rendered pairs", "Retrieval by descriptor", "Repeated views"):
        assert title in tables
    assert "Aloe" not in tables
    assert (tmp_path / "run" / "stereo.png").stat().st_size > 10_000
    assert "Time on one thread" in done.output


@pytest.mark.slow
def test_real_images(data_dir: Path) -> None:
    """On real pairs checks leave at most 2 % outliers; boards are flat; planar pairs are matched."""
    rows = aloe_rows(data_dir / "opencv_samples", "usurf")
    assert rows[-1]["outliers"] < 0.02
    assert rows[0]["outliers"] > 5.0 * rows[-1]["outliers"]
    board = chessboard(data_dir / "opencv_samples")
    assert board["pairs"] >= 10
    assert board["median_percent_of_depth"] < 0.2
    assert board["within_20th"] > 0.95
    planar = [row for model in sorted((data_dir / "homogr").glob("*_model.txt")) for row in planar_rows(model)]
    own = {row["pair"]: row["right"] for row in planar if row["way"] == "usurf"}
    assert own["adam"] > 100
    result: dict[str, Any] = {"speed": [], "quality": [], "retrieval": [], "aloe": {"usurf": rows}}
    assert "Chessboard rig" in markdown(result | {"chessboard": board, "planar": planar})
