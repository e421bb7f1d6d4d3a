"""How robots truly move and bump, and what odometry and scan say of it."""

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from slam_backend.geometry import compose, wrap_angle
from slam_backend.state import restore, take
from vslam_env.sensors import RangeFinder, ScanConfig
from vslam_env.world import FreeSpace, OdometryNoise, Simulator, World, draw_bias, make_world, read_odometry
from vslam_env.world.clearance import distances_to_walls

RADIUS = 0.2
# Thin walls with free ends, a slit narrower than a robot, and an acute corner.
MAZE = World(
    "maze",
    [
        [0, 0, 7, 0],
        [7, 0, 7, 5],
        [7, 5, 0, 5],
        [0, 5, 0, 0],
        [2, 0, 2, 2],
        [2, 2.3, 2, 3.5],
        [2, 3.5, 3.5, 3.7],
        [4, 1, 5.5, 1],
        [5.5, 1, 4.2, 1.6],
        [5, 5, 5.2, 3],
    ],
)
OPEN = World("open", [[-50, -50, 50, -50], [50, -50, 50, 50], [50, 50, -50, 50], [-50, 50, -50, -50]])


@given(
    st.floats(-0.3, 1.0),
    st.floats(-1.5, 1.5),
    st.floats(-3.1, 3.1),
)
@example(1.0, 5e-323, 0.3)  # in a tick the least turn that there is, half of which is none
def test_a_free_robot_follows_the_arc(speed: float, turn: float, heading: float) -> None:
    """What nothing stops ends where the unicycle's arc does, after 1 s."""
    simulator = Simulator(OPEN, [[1.0, -2.0, heading]])
    for _ in range(10):
        simulator.step([[speed, turn]])
    if abs(turn) > 1e-6:
        local = np.array([np.sin(turn) / turn, (1.0 - np.cos(turn)) / turn]) * speed
    else:
        local = np.array([speed, 0.5 * speed * turn])
    np.testing.assert_allclose(simulator.poses[0], compose([1.0, -2.0, heading], [*local, turn]), atol=1e-6)
    assert not simulator.bumped.any()
    assert np.all((simulator.poses[:, 2] >= -np.pi) & (simulator.poses[:, 2] < np.pi))


@pytest.mark.parametrize("seed", range(6))
def test_no_robot_enters_a_wall_or_another(seed: int) -> None:
    """Over 400 ticks of wild driving no disc is more than 5 mm inside a wall or another disc, and none escapes."""
    rng = np.random.default_rng(seed)
    world = MAZE if seed % 2 else make_world("office", rng)
    free = FreeSpace(world)
    simulator = Simulator(world, free.draw_starts(4, rng, 0.5))
    bumps = 0
    for tick in range(400):
        if tick % 20 == 0:
            commands = np.column_stack([rng.choice([-0.3, 0.0, 0.5, 1.0, 1.0], 4), rng.uniform(-1.5, 1.5, 4)])
            commands[rng.random(4) < 0.5, 1] = 0.0
        before = simulator.poses
        touched = simulator.step(commands)
        assert touched or not simulator.bumped.any()
        poses = simulator.poses
        gaps = np.linalg.norm(poses[:, None, :2] - poses[None, :, :2], axis=2)[np.triu_indices(4, 1)]
        assert distances_to_walls(poses[:, :2], world.walls).min() > RADIUS - 0.005
        assert gaps.min() > 2 * RADIUS - 0.005
        assert np.linalg.norm(poses[:, :2] - before[:, :2], axis=1).max() < 0.13
        bumps += int(simulator.bumped.sum())
    assert free.contains(simulator.poses[:, :2]).all()
    assert bumps > 20


def test_a_robot_pressing_against_a_wall_rests() -> None:
    """A robot that presses straight into a wall stands still beside it, reports bumps, and leaves when it backs up."""
    simulator = Simulator(MAZE, [[6.0, 2.0, 0.0]])
    for _ in range(20):
        simulator.step([[1.0, 0.0]])
    resting = simulator.poses[0]
    assert RADIUS <= 7.0 - resting[0] < RADIUS + 0.015
    for _ in range(100):
        simulator.step([[1.0, 0.0]])
        assert simulator.bumped[0]
        np.testing.assert_allclose(simulator.poses[0], resting, atol=1e-6)
    simulator.step([[-0.3, 0.0]])
    assert simulator.poses[0, 0] == pytest.approx(resting[0] - 0.03, abs=1e-4)
    assert not simulator.bumped[0]


def test_a_robot_slides_along_a_wall() -> None:
    """Pressing into a wall at 45 degrees moves a robot along it at cos 45 of its speed: there is no friction."""
    simulator = Simulator(OPEN, [[0.0, 49.5, np.pi / 4]])
    for _ in range(10):
        simulator.step([[1.0, 0.0]])
    before = simulator.poses[0]
    for _ in range(20):
        simulator.step([[1.0, 0.0]])
    assert simulator.poses[0, 0] - before[0] == pytest.approx(2.0 * np.cos(np.pi / 4), rel=1e-3)
    assert simulator.bumped[0]


def test_a_standing_robot_is_not_pushed_away() -> None:
    """A robot that stands stops one that drives into it; only the driver reports a bump."""
    simulator = Simulator(OPEN, [[0.0, 0.0, 0.0], [2.0, 0.02, 1.0]])
    for _ in range(25):
        simulator.step([[1.0, 0.0], [0.0, 0.0]])
    np.testing.assert_allclose(simulator.poses[1, :2], [2.0, 0.02], atol=1e-4)
    assert simulator.poses[0, 0] < 1.65
    assert simulator.bumped.tolist() == [True, False]


def test_state_continues_bit_by_bit() -> None:
    """A fresh simulator that takes over in the middle of contacts goes on exactly as the first for 300 ticks."""
    rng = np.random.default_rng(4)
    starts = FreeSpace(MAZE).draw_starts(3, rng, 0.6)
    first, second = Simulator(MAZE, starts), Simulator(MAZE, starts[::-1])
    commands = np.stack([rng.uniform(-0.3, 1.0, (600, 3)), rng.uniform(-1.0, 1.0, (600, 3))], axis=2)
    for command in np.repeat(commands[:30], 10, axis=0):
        first.step(command)
    assert first.bumped.any()
    restore(second, take(first))
    np.testing.assert_array_equal(first.bumped, second.bumped)
    bumps = 0
    for command in np.repeat(commands[30:60], 10, axis=0):
        first.step(command)
        second.step(command)
        assert first.poses.tobytes() == second.poses.tobytes()
        assert first.bumped.tobytes() == second.bumped.tobytes()
        bumps += int(first.bumped.sum())
    assert bumps > 100


def test_poses_share_no_memory() -> None:
    """What was handed in can be changed without touching the simulator; poses seen stay as they were."""
    starts = np.array([[1.0, 1.0, 0.0]])
    simulator = Simulator(MAZE, starts)
    starts[:] = 3.0
    np.testing.assert_array_equal(simulator.poses, [[1.0, 1.0, 0.0]])
    seen, bumped = [], []
    for _ in range(200):  # into a wall, where it stays
        seen.append((simulator.poses, simulator.poses.copy()))
        bumped.append((simulator.bumped, simulator.bumped.copy()))
        simulator.step([[1.0, 0.0]])
    assert simulator.bumped.all()
    for now, then in seen + bumped:
        np.testing.assert_array_equal(now, then)


def test_bias_has_the_stated_size() -> None:
    """Over 20,000 robots the spread of both biases is the stated one within 3 % (6 sigma)."""
    bias = draw_bias(OdometryNoise(), 20_000, np.random.default_rng(4))
    np.testing.assert_allclose(bias.std(axis=0), [0.02, np.radians(0.5)], rtol=0.03)


def test_readings_are_the_noisy_motions() -> None:
    """The compiled reading is the formula on arrays: stretched and turned motion in the previous frame; ways add up."""
    rng = np.random.default_rng(5)
    before, after = rng.uniform(-3.0, 3.0, (2, 40, 3))
    bias, noise = rng.normal(0.0, 0.02, (40, 2)), OdometryNoise()
    travelled = np.ones(40)
    read = read_odometry(before, after, bias, noise, np.random.default_rng(8), travelled)
    draws = np.random.default_rng(8).standard_normal((40, 2))
    moved = after - before
    distance = np.hypot(moved[:, 0], moved[:, 1])
    stretch = 1.0 + bias[:, 0] + noise.sigma_distance * draws[:, 0]
    turn = distance * (bias[:, 1] + noise.sigma_heading_per_metre * draws[:, 1])
    angle = 0.5 * turn - before[:, 2]
    x, y = moved[:, 0], moved[:, 1]
    expected = np.stack([np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y], axis=1)
    np.testing.assert_allclose(read[:, :2], stretch[:, None] * expected, atol=1e-12)
    np.testing.assert_allclose(read[:, 2], wrap_angle(moved[:, 2] + turn), atol=1e-12)
    np.testing.assert_allclose(travelled, 1.0 + distance, atol=1e-12)


BOX = np.array([[-3.0, -2.0, 5.0, -2.0], [5.0, -2.0, 5.0, 4.0], [5.0, 4.0, -3.0, 4.0], [-3.0, 4.0, -3.0, -2.0]])


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
        ranges = RangeFinder(config, walls).measure(pose[None], rng)[0]
        plain = [plain_range(pose[:2], pose[2] + a, walls, 8.0) for a in config.ray_angles]
        np.testing.assert_allclose(ranges, plain, atol=1e-9)


def test_rays_see_the_other_robots() -> None:
    """A robot 2 m ahead stops the middle rays at its edge; no robot sees itself."""
    poses = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 1.0]])
    scan = RangeFinder(ScanConfig(sigma=0.0, num_rays=33), BOX, robot_radius=0.25)
    ranges = scan.measure(poses, np.random.default_rng(0))
    assert ranges.shape == (2, 33)
    assert ranges[0, 16] == pytest.approx(1.75)
    assert ranges[0, 0] == pytest.approx(2.0 / np.sin(0.463648), rel=1e-5)
    assert ranges[1].min() > 2.0


def test_noise_grows_with_distance_and_spares_what_is_out_of_range() -> None:
    """Readings scatter by 1 % of the distance (within 5 %, 5 sigma); a ray into the void reads exactly 8 m."""
    rng = np.random.default_rng(1)
    scan = RangeFinder(ScanConfig(num_rays=3), np.array([[4.0, -0.5, 4.0, 0.5]]))
    ranges = np.array([scan.measure(np.zeros((1, 3)), rng)[0] for _ in range(5000)])
    assert ranges[:, 1].std() == pytest.approx(0.04, rel=0.05)
    assert ranges[:, 1].mean() == pytest.approx(4.0, abs=5 * 0.04 / np.sqrt(5000))
    np.testing.assert_array_equal(ranges[:, [0, 2]], 8.0)


def test_readings_stay_in_their_interval() -> None:
    """Even absurd noise gives readings in [0, 8] m."""
    scan = RangeFinder(ScanConfig(sigma=3.0), BOX)
    ranges = scan.measure(np.zeros((1, 3)), np.random.default_rng(2))
    assert ranges.min() >= 0.0
    assert ranges.max() <= 8.0


HELD = """
import sys
import numpy as np
from vslam_env.world import Simulator, World

walls = np.array([[0.0, 0.0, 6.0, 0.0], [6.0, 0.0, 6.0, 5.0], [6.0, 5.0, 0.0, 5.0], [0.0, 5.0, 0.0, 0.0]])
simulator = Simulator(World("room", walls), np.array([[0.3, 0.5, 3.1], [3.0, 3.0, 0.0]]))
for _ in range(5):
    simulator.step([[0.5, 0.0], [0.5, 0.1]])
assert simulator.bumped[0]

def hook(event, arguments):
    simulator

sys.addaudithook(hook)
"""


def test_a_simulator_held_to_the_end_of_python_ends_with_it() -> None:
    """Python frees objects that audit hooks hold when nothing of it is left; the process ends quietly all the same."""
    ended = subprocess.run([sys.executable, "-c", HELD], capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (0, "")
