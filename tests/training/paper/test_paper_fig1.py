"""Fig. 1: particles start at a point, spread by the motion model, and converge with measurements."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from training.paper.config import Fig1Config
from training.paper.fig1 import Clouds, draw_clouds, path_errors, simulate_fig1
from training.paper.fig6.trials import FILTER_OPTIONS
from training.stereo_runs.runs import PRESETS, STEP, StereoRun

SMALL = Fig1Config(robots=2, particles=50, length=12.0, every=3.0, seed=60)


@pytest.fixture(scope="module")
def run() -> StereoRun:
    """Two robots for 12 m."""
    return simulate_fig1(SMALL)


@pytest.fixture(scope="module")
def moved(run: StereoRun) -> Clouds:
    """Particles with odometry only."""
    return draw_clouds(run, SMALL, measured=False)


@pytest.fixture(scope="module")
def measured(run: StereoRun) -> Clouds:
    """Particles with measurements."""
    return draw_clouds(run, SMALL, measured=True)


def test_measurements_limit_the_spread_of_particles(run: StereoRun, moved: Clouds, measured: Clouds) -> None:
    """All particles start at the true pose; with odometry only they keep spreading, with measurements far less."""
    assert moved.steps.tolist() == [0, 12, 24, 36, 48]
    assert moved.poses.shape == measured.poses.shape == (5, 2, 50, 3)
    for robot in range(2):
        assert (moved.poses[0, robot] == run.true_paths[robot, 0]).all()
    assert (np.diff(moved.spreads(), axis=0) > 0.0).all()
    assert (measured.spreads()[-1] < 0.5 * moved.spreads()[-1]).all()
    assert len(moved.landmarks) == 0
    assert len(measured.landmarks) > 20


def test_paths_are_of_odometry_and_of_the_filter(run: StereoRun, moved: Clouds, measured: Clouds) -> None:
    """Without measurements the dashed path is the measured odometry; with them it is the filter's estimate."""
    last, step = moved.paths[1, -2], run.odometry[-1, 1]
    c, s = np.cos(last[2]), np.sin(last[2])
    expected = last[0] + c * step[0] - s * step[1], last[1] + s * step[0] + c * step[1]
    np.testing.assert_allclose(moved.paths[1, -1, :2], expected, atol=1e-12)
    slam = run.build_filter(50, "fastslam1", seed=60, **FILTER_OPTIONS["fastslam1"])
    for reading in run.readings():
        slam.step(**reading)
    np.testing.assert_array_equal(measured.paths[1, -1], slam.pose(1).mean)
    for clouds in (moved, measured):
        own = path_errors(run, clouds, "path")
        apart = np.linalg.norm((clouds.paths[0, -1] - run.true_paths[0, -1])[:2])
        assert own[0]["end_error_m"] == pytest.approx(apart)
        assert own[0]["end_spread_m"] == clouds.spreads()[-1, 0]


def test_one_step_spreads_by_the_motion_model() -> None:
    """Eq. 4: the variance after one step is that of the odometry along and across, to 4 sigma of 4000 draws."""
    config = Fig1Config(robots=1, particles=4000, length=STEP, every=STEP, seed=61)
    run = simulate_fig1(config)
    spread = draw_clouds(run, config, measured=False).spreads()[1, 0]
    along, across, _ = PRESETS["paper"].motion.sigmas(run.odometry[1, 0])
    assert spread**2 == pytest.approx(along**2 + across**2, rel=4.0 * np.sqrt(2.0 / 4000))


def test_the_command_writes_figure_and_errors(vslam: Any, tmp_path: Path) -> None:
    """The command writes a PNG file and the errors of each robot as JSON, and its config repeats them."""
    first, again = tmp_path / "first", tmp_path / "again"
    arguments = ["paper", "fig1", "--length", "6", "--particles", "30", "--every", "2", "--seed", "62"]
    for rest in ([*arguments, "--out", str(first)], ["paper", "fig1", "--config", str(first), "--out", str(again)]):
        said = vslam(*rest)
        assert said.status == 0
        assert "final spread" in said.out
    assert (first / "fig1.png").read_bytes().startswith(b"\x89PNG")
    found = [json.loads((out / "metrics.json").read_text()) for out in (first, again)]
    assert found[0] == found[1]
    rows = [(row["path"], row["robot"]) for row in found[0]["trials"]]
    assert rows == [(path, robot) for path in ("odometry", "estimate") for robot in (1, 2, 3)]
