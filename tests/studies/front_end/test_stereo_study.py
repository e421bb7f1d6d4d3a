"""Study of stereo measurements: scenes, errors, real images, and the program."""

import json
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from slam_backend.frontend import DESCRIPTOR_TYPES, MATCH_CHECKS, StereoFrontEnd
from studies.front_end.real_images import WAYS, aloe_disparities, chessboard, find_images, match_planar, measure_rig
from studies.front_end.rendered import CHECKS, Disparities, map_wall, office_disparities, repeat_views, retrieve
from studies.front_end.scenes import WALL, Scene, panel_hall, wall_pose
from studies.front_end.stereo import STUDY, Config, Trial, camera_of, play, real_trials, trials


def test_timed_pairs_have_the_requested_load() -> None:
    """At 320 x 240 px with 40 walls there are 100 landmarks in the image, and both parts of a pair are timed."""
    trial = Trial(kind="speed", width=320, wanted=100, walls=40, descriptor="usurf")
    row = play(Config(steps=2), trial)
    assert row["landmarks"] == 100
    for part in ("render", "front_end"):
        assert 0.0 < row[f"{part}_least_ms"] <= row[f"{part}_ms"]
        assert row[f"{part}_processor_ms"] > 0.0


def test_halls_have_the_requested_walls() -> None:
    """Four walls are the hall, the others are panels inside it."""
    for count in (4, 10, 40):
        world = panel_hall(count)
        assert len(world.walls) == count
        assert world.bounds == (0.0, 0.0, 8.0, 6.0)


def test_match_checks_are_counted_cumulatively() -> None:
    """Each check leaves the matches that pass all so far; patches are used from the second check on."""
    passed = np.ones((5, 4), dtype=bool)
    passed[0, 0] = passed[3, 1] = False
    found = Disparities(np.array([5.0, 0.5, -0.5, 0.1]), np.array([0.0, 3.0, 0.2, -0.1]), passed)
    rows = [found.after(check) for check in CHECKS]
    assert [row["matches"] for row in rows] == [4, 3, 3, 3, 2, 2]
    assert rows[0]["outlier_share"] == 0.25
    assert rows[1]["outlier_share"] == 0.0
    assert rows[2]["outlier_share"] == pytest.approx(1 / 3)
    assert rows[4]["rms_px"] == pytest.approx(np.sqrt(0.025))
    assert rows[4]["bias_px"] == pytest.approx(0.05)


def test_rendered_pairs_have_few_outliers() -> None:
    """In an office patches measure disparities to a tenth of a pixel, and checks reject most outliers."""
    found = office_disparities("usurf", 12, 101)
    first, last = found.after(CHECKS[0]), found.after(CHECKS[-1])
    assert last["matches"] > 150
    assert last["rms_px"] < 0.12
    assert abs(last["bias_px"]) < 0.03
    assert last["outlier_share"] < 0.05
    assert last["outlier_share"] < first["outlier_share"]
    assert last["rms_px"] < first["rms_px"]


def recalls(window: float | None, style: str, *views: tuple[float, float]) -> list[dict[str, Any]]:
    """Return the retrieval of u-SURF from some angles and distances."""
    known = map_wall("usurf", window, style, 101)
    return [retrieve(known, DESCRIPTOR_TYPES["usurf"].gate, angle, ratio, 101) for angle, ratio in views]


def test_repetitive_walls_are_not_retrieved() -> None:
    """Frontally nearly all landmarks are retrieved; at an angle fewer; among equal bricks almost none."""
    front, aside, far_aside = recalls(None, "distinct", (0.0, 1.0), (30.0, 1.0), (60.0, 1.0))
    assert front["recall"] > 0.95
    assert front["recall"] > aside["recall"] > far_aside["recall"]
    (alike,) = recalls(None, "bricks_alike", (15.0, 1.0))
    assert alike["precision"] is None or alike["precision"] < 0.15


def test_metric_windows_are_retrieved_from_afar() -> None:
    """From twice the distance, windows in metres retrieve at least twice as many landmarks as windows in pixels."""
    (fixed,), (sized,) = (recalls(window, "distinct", (0.0, 2.0)) for window in (None, 0.6))
    assert sized["recall"] > 2.0 * fixed["recall"]


def test_repeated_views_agree_with_the_camera_model() -> None:
    """NEES of two views of a landmark is near 1 with the default noise, and smaller with twice this noise."""
    usual, twice = (repeat_views(101, noise) for noise in (1.0, 2.0))
    assert usual["pairs"] == twice["pairs"] > 500
    assert 0.6 < usual["anees"] < 1.6
    assert usual["within"] > 0.85
    assert twice["anees"] < usual["anees"]


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
    assert find_images(tmp_path) == [("planar", tmp_path / "house_model.txt"), ("rig", tmp_path / "rig")]
    played = real_trials(tmp_path, ("usurf", "orb"))
    assert [trial.descriptor for trial in played] == [*WAYS, "usurf", "orb"]
    rows = [asdict(trial) | play(Config(), trial) for trial in played]
    assert rows[0]["right"] > 0.8 * rows[0]["matches"] > 40
    for row in rows[-2:]:
        assert row["pairs"] == 1
        assert row["depth_m"] == pytest.approx(3.0, abs=0.02)
        assert row["points"] > 50
        left = [row["matches"], *(row[check] for check in MATCH_CHECKS)]
        assert left == sorted(left, reverse=True)
    planar = next(table for table in STUDY.tables if table.name == "planar")
    *each, pooled = (line for line in planar.lines(rows) if line["descriptor"] == "usurf")
    assert pooled == each[0] | {"images": "all"}


def test_images_that_cannot_be_measured_leave_their_error(tmp_path: Path) -> None:
    """A broken model file, a missing image and a rig without images each fail separately."""
    _write_pairs(tmp_path)
    (tmp_path / "a_model.txt").write_text("1 2 three")
    (tmp_path / "b_model.txt").write_text("1 0 0 0 1 0 0 0 1")
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "calib.txt").write_text("")
    for file, match in (
        ("a_model.txt", "real: expected a_model.txt with a 3 x 3 homography, got a diff"),
        ("b_model.txt", "real: expected an image bA.png, .jpg, ..., got no such file"),
        ("empty", "real: expected as many left as right images"),
    ):
        (trial, *_) = (trial for trial in real_trials(tmp_path, ("usurf",)) if trial.images.endswith(file))
        assert match in play(Config(), trial)["failed"]


def test_the_program_keeps_results_beside_failures(tmp_path: Path) -> None:
    """The program writes its tables and a chart; images that cannot be measured give status 2 and one line."""
    _write_pairs(tmp_path)
    (tmp_path / "broken_model.txt").write_text("no numbers")
    out = tmp_path / "out"
    program = [sys.executable, "-m", "studies.front_end.stereo", "--quick", "--steps", "2", "--views", "2"]
    program += ["--descriptors", "orb", "--real", str(tmp_path), "--out", str(out)]
    done = subprocess.run(program, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stdout.count("real: expected broken_model.txt with a 3 x 3 homography") == 1
    tables = (out / "tables.md").read_text()
    for title in ("Time on one thread", "Matches that remain", "Retrieval by", "Repeated views", "Planar pairs"):
        assert title in tables
    assert "Chessboard" not in tables
    metrics = json.loads((out / "metrics.json").read_text())
    assert len(metrics["trials"]) == len(trials(Config.from_mapping(metrics["config"]))) - len(WAYS)
    assert (out / "stereo.png").stat().st_size > 5_000


def test_folders_without_images_are_refused(tmp_path: Path) -> None:
    """The error names what a folder may have."""
    with pytest.raises(ValueError, match="real: expected a folder of real images, got no such folder"):
        Config(real="none")
    with pytest.raises(ValueError, match="real: expected a folder with pairs with a model file"):
        trials(Config(real=str(tmp_path)))


@pytest.mark.slow
def test_real_images(data_dir: Path) -> None:
    """On real pairs checks leave at most 2 % outliers; boards are flat; planar pairs are matched."""
    found = aloe_disparities(data_dir / "opencv_samples", "usurf")
    assert found.after(CHECKS[-1])["outlier_share"] < 0.02
    assert found.after(CHECKS[0])["outlier_share"] > 5.0 * found.after(CHECKS[-1])["outlier_share"]
    board = chessboard(data_dir / "opencv_samples")
    assert board["pairs"] >= 10
    assert board["median_percent_of_depth"] < 0.2
    assert board["within_20th"] > 0.95
    assert match_planar(data_dir / "homogr" / "adam_model.txt", "usurf")["right"] > 100
    assert measure_rig(data_dir / "euroc_pairs", "usurf")["points"] > 50
