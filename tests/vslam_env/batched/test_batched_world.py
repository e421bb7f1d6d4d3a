"""The world in arrays of fixed shape, beside that of the environment: motion, odometry, sight, frames and scans."""

from functools import lru_cache, partial
from typing import Any

import numpy as np
import pytest
from builders.batched import jax, jnp
from scipy.stats import chi2, norm

from slam_backend.geometry import wrap_angle
from vslam_env import vslam_v1
from vslam_env.config import EnvConfig
from vslam_env.presets import preset_config
from vslam_env.world.odometry import read_odometry
from vslam_env.world.simulator import SKIN, Simulator
from vslam_env.world.spec import World

world = pytest.importorskip("vslam_env.batched.world")
ROBOTS = 3


@lru_cache
def scenario(name: str = "office", preset: str = "standard") -> tuple[EnvConfig, Any]:
    """Return an environment's configuration, and the scenario of an episode."""
    config = preset_config(preset).replace(world=name, num_robots=ROBOTS, action_type="continuous")
    env = vslam_v1.parallel_env(config=config)
    env.reset(seed=5)
    return env.config, env.episode.scenario


def exported(name: str = "office", preset: str = "standard") -> tuple[Any, Any, Any]:
    """Return a scene with more room than it needs, its hardware and the scenario."""
    config, drawn = scenario(name, preset)
    room = len(drawn.world.walls) + 7, len(drawn.world.landmarks) + 9
    return world.Scene.of(drawn, *room), world.Hardware.of(config), drawn


def somewhere(drawn: Any, seed: int) -> np.ndarray:
    """Return poses (K, 3) on the free floor."""
    rng = np.random.default_rng(seed)
    cells = drawn.cells[rng.integers(len(drawn.cells), size=ROBOTS)]
    return np.column_stack([cells, rng.uniform(-np.pi, np.pi, ROBOTS)])


@pytest.mark.parametrize("name", ["office", "maze", "loops", "hall", "rooms"])
def test_cameras_see_the_same_landmarks(name: str) -> None:
    """In forty places of each family, but for what rounding decides; what fills the arrays is not seen."""
    scene, hardware, drawn = exported(name)
    see = jax.jit(jax.vmap(partial(world.visible, hardware=hardware), (None, 0, None)))
    different = seen = 0
    for seed in range(40):
        poses = somewhere(drawn, seed)
        found = np.asarray(see(jnp.asarray(poses), jnp.arange(ROBOTS), scene))
        expected = drawn.sensor.visible(poses)
        assert not found[:, expected.shape[1] :].any()
        different += (found[:, : expected.shape[1]] != expected).sum()
        seen += expected.sum()
    assert seen > 200
    assert different <= 0.005 * seen


def test_scans_are_the_same() -> None:
    """Without noise all ranges agree, also those to other robots."""
    scene, hardware, drawn = exported()
    hardware = hardware._replace(scan_sigma=0.0)
    read = jax.jit(jax.vmap(partial(world.scan, hardware=hardware), (None, 0, None, None)))
    off = []
    for seed in range(40):
        poses = somewhere(drawn, seed)
        poses[1, :2] = poses[0, :2] + [0.6, 0.1]
        exact = drawn.scan.measure(poses, np.random.default_rng(0))
        found = read(jnp.asarray(poses), jnp.arange(ROBOTS), scene, jnp.zeros(len(hardware.rays)))
        off.append(np.abs(np.asarray(found) - exact) / exact)
    assert np.median(off) < 0.01  # the exact ones have noise of one per cent
    assert (np.array(off) < 0.06).mean() > 0.998


def test_free_robots_drive_as_in_the_environment() -> None:
    """Along arcs in the open both poses agree to a tenth of a millimetre, and nothing is blocked."""
    scene, hardware, _ = exported()
    empty = np.array([[40.0, 40.0, 41.0, 40.0]])
    scene = scene._replace(walls=jnp.asarray(empty, jnp.float32))
    rng, poses = np.random.default_rng(1), np.array([[0.0, 0.0, 0.1], [5.0, 5.0, 2.0], [-5.0, 3.0, -3.0]])
    simulator = Simulator(World("empty", empty), poses, hardware.radius)
    for _ in range(20):
        commands = rng.uniform([-0.5, -1.5], [0.5, 1.5], (ROBOTS, 2))
        simulator.step(commands)
        after, blocked = world.drive(jnp.asarray(poses), jnp.asarray(commands), scene, hardware)
        poses = np.asarray(after, np.float64)
        assert not np.asarray(blocked).any()
    np.testing.assert_allclose(poses[:, :2], simulator.poses[:, :2], atol=1e-4)
    np.testing.assert_allclose(wrap_angle(poses[:, 2] - simulator.poses[:, 2]), 0.0, atol=1e-4)


def test_blocked_robots_stay_out_of_walls_and_of_each_other() -> None:
    """Robots that drive anywhere for a minute never enter a wall by more than the skin, and are blocked at times."""
    scene, hardware, drawn = exported("maze")
    rng, poses = np.random.default_rng(2), jnp.asarray(drawn.true_starts, jnp.float32)
    drive = jax.jit(partial(world.drive, hardware=hardware))
    walls, ever = np.asarray(drawn.world.walls), np.zeros(ROBOTS, bool)
    for tick in range(600):
        if tick % 30 == 0:
            commands = np.column_stack([np.full(ROBOTS, 0.5), rng.uniform(-0.4, 0.4, ROBOTS)])
        poses, blocked = drive(poses, jnp.asarray(commands), scene)
        ever |= np.asarray(blocked)
        places = np.asarray(poses, np.float64)[:, :2]
        along = walls[:, 2:] - walls[:, :2]
        away = places[:, None] - walls[:, :2]
        share = np.clip((away * along).sum(-1) / (along**2).sum(-1), 0.0, 1.0)
        gaps = np.linalg.norm(away - share[..., None] * along, axis=-1)
        assert gaps.min() > hardware.radius - SKIN
        between = np.linalg.norm(places[:, None] - places, axis=-1) + 10.0 * np.eye(ROBOTS)
        assert between.min() > 2.0 * (hardware.radius - SKIN)
    assert ever.all()


def test_odometry_is_that_of_the_environment() -> None:
    """Given the same draws readings agree; their errors have the variance and the bias of the configuration."""
    scene, hardware, drawn = exported()
    rng = np.random.default_rng(3)
    config, _ = scenario()
    for _ in range(20):
        before = rng.normal(size=(ROBOTS, 3))
        after = before + rng.normal(size=(ROBOTS, 3)) * 0.1
        seed = int(rng.integers(1000))
        expected = read_odometry(before, after, drawn.bias, config.odometry, np.random.default_rng(seed))
        draws = np.random.default_rng(seed).standard_normal((ROBOTS, 2))
        found = world.read_odometry(*map(jnp.asarray, (before, after)), scene, jnp.asarray(draws), hardware)
        np.testing.assert_allclose(found, expected, atol=1e-5)


def test_frames_have_the_noise_of_the_camera() -> None:
    """Measured points are chi-square about the truth, at most B, of what is seen; shares are those asked for."""
    scene, hardware, drawn = exported()
    take = jax.jit(
        jax.vmap(jax.vmap(partial(world.measure, hardware=hardware), (None, 0, None, 0)), (0, None, None, 0))
    )
    poses = np.array([somewhere(drawn, 100 + seed) for seed in range(60)])
    keys = jax.random.split(jax.random.key(1), (60, ROBOTS))
    frames = take(jnp.asarray(poses), jnp.arange(ROBOTS), scene, keys)
    config, _ = scenario()
    camera, landmarks = config.landmark_sensor.camera, drawn.world.landmarks
    squares, false, used = 0.0, 0, 0
    for place, robot in np.ndindex(60, ROBOTS):
        frame = jax.tree.map(lambda values, at=(place, robot): np.asarray(values[at]), frames)
        seen = drawn.sensor.visible(poses[place])[robot]
        false += int((frame.valid & (frame.true_ids < 0)).sum())
        pose = poses[place, robot]
        for row in np.flatnonzero(frame.valid & (frame.true_ids >= 0)):
            name = frame.true_ids[row]
            assert seen[name]
            x, y = landmarks.positions[name, :2] - pose[:2]
            c, s = np.cos(pose[2]), np.sin(pose[2])
            local = np.array([c * x + s * y, c * y - s * x, landmarks.positions[name, 2]])
            expected = camera.project(camera.camera_from_robot(local))
            found = camera.project(frame.points[row].astype(np.float64))
            sigmas = [camera.sigma_px, camera.sigma_px, camera.sigma_disparity_px]
            squares += (((found - expected) / sigmas) ** 2).sum()
            used += 1
            assert np.linalg.norm(frame.descriptors[row] - landmarks.descriptors[name]) < 0.5
            np.testing.assert_allclose(np.linalg.norm(frame.descriptors[row]), 1.0, atol=1e-5)
    assert used > 200
    assert chi2.ppf(0.0005, 3 * used) < squares < chi2.ppf(0.9995, 3 * used)
    expected_false = config.landmark_sensor.false_points * 60 * ROBOTS
    assert false <= expected_false + norm.ppf(0.9999) * np.sqrt(expected_false) + 1.0


def test_scenes_need_room() -> None:
    """Too few walls or landmarks are refused by name."""
    _, drawn = scenario()
    with pytest.raises(ValueError, match="num_landmarks: expected at least"):
        world.Scene.of(drawn, 500, 3)
    with pytest.raises(ValueError, match="num_walls: expected at least"):
        world.Scene.of(drawn, 2, 5000)
