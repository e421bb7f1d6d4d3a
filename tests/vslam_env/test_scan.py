"""Scans measure how far one can look."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vslam_env.sensors import Scan, ScanConfig
from vslam_env.world import make_world

BOX = np.array([[-3.0, -2.0, 5.0, -2.0], [5.0, -2.0, 5.0, 4.0], [5.0, 4.0, -3.0, 4.0], [-3.0, 4.0, -3.0, -2.0]])
EXACT = ScanConfig(sigma=0.0)


def plain_range(origin: np.ndarray, angle: float, walls: np.ndarray, limit: float) -> float:
    """The textbook intersection of one ray with all walls, by solving 2 x 2 systems."""
    direction = np.array([np.cos(angle), np.sin(angle)])
    best = limit
    for wall in walls:
        system = np.column_stack([direction, wall[:2] - wall[2:]])
        if abs(np.linalg.det(system)) > 1e-12:
            t, u = np.linalg.solve(system, wall[:2] - origin)
            if t >= 0 and 0 <= u <= 1:
                best = min(best, t)
    return best


@pytest.mark.parametrize("seed", range(4))
def test_rays_agree_with_the_plain_form(seed: int) -> None:
    """Compiled rays, with their culling, equal one 2 x 2 system per ray and wall."""
    rng = np.random.default_rng(seed)
    walls = make_world("office", rng).walls
    config = ScanConfig(sigma=0.0, num_rays=7, half_fov=(0.4636, 1.2, 2.0, np.pi)[seed])
    poses = np.column_stack([rng.uniform(1, 18, 9), rng.uniform(1, 12, 9), rng.uniform(-np.pi, np.pi, 9)])
    for pose in poses:
        ranges = Scan(config, walls).measure(pose[None], rng)[0]
        plain = [plain_range(pose[:2], pose[2] + a, walls, 8.0) for a in config.ray_angles]
        np.testing.assert_allclose(ranges, plain, atol=1e-9)


@given(st.floats(-2.5, 4.5), st.floats(-1.5, 3.5), st.floats(-np.pi, np.pi))
def test_rays_end_on_the_walls_of_a_box(x: float, y: float, heading: float) -> None:
    """From anywhere in a convex room each ray ends on its boundary, exactly; none slips through a corner."""
    scan = Scan(EXACT, BOX)
    ranges = scan.measure(np.array([[x, y, heading]]), np.random.default_rng(0))[0]
    hits_x = x + ranges * np.cos(heading + scan.ray_angles)
    hits_y = y + ranges * np.sin(heading + scan.ray_angles)
    gaps = np.minimum.reduce([np.abs(hits_x + 3), np.abs(hits_x - 5), np.abs(hits_y + 2), np.abs(hits_y - 4)])
    assert np.all((gaps < 1e-9) | (ranges == 8.0))
    assert np.all(ranges > 0.4)


def test_rays_see_the_other_robots() -> None:
    """A robot 2 m ahead stops the middle rays at its edge; nobody sees itself."""
    poses = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 1.0]])
    scan = Scan(ScanConfig(sigma=0.0, num_rays=33), BOX, robot_radius=0.25)
    ranges = scan.measure(poses, np.random.default_rng(0))
    assert ranges.shape == (2, 33)
    assert ranges[0, 16] == pytest.approx(1.75)
    assert ranges[0, 0] == pytest.approx(2.0 / np.sin(0.463648), rel=1e-5)
    assert ranges[1].min() > 2.0


def test_noise_grows_with_distance_and_spares_what_is_out_of_range() -> None:
    """Readings scatter by 1 % of the distance (within 5 %, 5 sigma); a ray into the void reads exactly 8 m."""
    rng = np.random.default_rng(1)
    scan = Scan(ScanConfig(num_rays=3), np.array([[4.0, -0.5, 4.0, 0.5]]))
    ranges = np.array([scan.measure(np.zeros((1, 3)), rng)[0] for _ in range(5000)])
    assert ranges[:, 1].std() == pytest.approx(0.04, rel=0.05)
    assert ranges[:, 1].mean() == pytest.approx(4.0, abs=5 * 0.04 / np.sqrt(5000))
    np.testing.assert_array_equal(ranges[:, [0, 2]], 8.0)


def test_readings_stay_in_their_interval() -> None:
    """Even absurd noise gives readings in [0, 8] m."""
    scan = Scan(ScanConfig(sigma=3.0), BOX)
    ranges = scan.measure(np.zeros((1, 3)), np.random.default_rng(2))
    assert ranges.min() >= 0.0
    assert ranges.max() <= 8.0


def test_bad_configurations_are_refused() -> None:
    """Numbers out of range are refused by name."""
    with pytest.raises(ValueError, match=r"scan\.num_rays: expected an int >= 2, got 1"):
        ScanConfig(num_rays=1)
    with pytest.raises(ValueError, match=r"scan\.sigma: expected a finite number >= 0"):
        ScanConfig(sigma=-0.1)
