"""Simulated readings of robots on circles, and runs of the Gaussian belief of batched teams on them."""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pytest

from slam_backend.fastslam.options import FilterOptions
from slam_backend.geometry import compose, inverse, transform_points
from slam_backend.models.camera import StereoCamera
from slam_backend.models.odometry import OdometryModel

jax = pytest.importorskip("jax", reason="jax, an optional extra, is not installed: pip install vslam-env[jax]")
jnp = jax.numpy
bf = pytest.importorskip("vslam_env.batched.belief")

MOTION = OdometryModel(bias_scale=0.02, bias_heading=0.01)
OPTIONS = FilterOptions(motion=MOTION, camera=StereoCamera(mount=(0.1, -0.05, 0.4)))
MOST, TICKS, SIZE = 5, 150, 16


class Drive(NamedTuple):
    """Readings of robots on circles in T ticks, and their true paths (T, K, 3), each in its own start frame."""

    odometry: np.ndarray
    frames: Any
    paths: np.ndarray


def drive(seed: int, num_robots: int = 1, most: int = MOST, noise: float = 1.0) -> Drive:
    """Return simulated readings; landmarks stand on a circle around that of the robots."""
    rng, camera = np.random.default_rng(seed), OPTIONS.camera
    angles = np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False)
    marks = np.column_stack([5.0 * np.cos(angles), 5.0 * np.sin(angles) + 2.5, rng.uniform(0.1, 1.0, 40)])
    of_marks = rng.normal(size=(40, SIZE)) / np.sqrt(SIZE)
    shape = (TICKS, num_robots)
    points, descriptors = np.zeros((*shape, most, 3)), np.zeros((*shape, most, SIZE))
    points[..., 2] = 1.0
    true_ids, valid = np.full((*shape, most), -1), np.zeros((*shape, most), bool)
    odometry, paths = np.zeros((*shape, 3)), np.zeros((*shape, 3))
    bias = noise * rng.normal(size=(num_robots, 3)) * [MOTION.bias_scale, MOTION.bias_heading, 0.0]
    for t in range(TICKS):
        for k in range(num_robots):
            if t:
                move = np.array([0.1, 0.0, 0.04])
                paths[t, k] = compose(paths[t - 1, k], move)
                read = move + OdometryModel.bias_jacobians(move[None])[0] @ bias[k]
                odometry[t, k] = read + noise * rng.normal(size=3) * np.sqrt(MOTION.variances(read[None])[0])
            local = np.column_stack([transform_points(inverse(paths[t, k]), marks[:, :2]), marks[:, 2]])
            seen = camera.camera_from_robot(local)
            near = rng.permutation(np.flatnonzero(camera.sees(seen)))[:MOST]
            sigmas = [camera.sigma_px, camera.sigma_px, camera.sigma_disparity_px]
            pixels = camera.project(seen[near]) + noise * rng.normal(size=(len(near), 3)) * sigmas
            points[t, k, : len(near)] = camera.triangulate(pixels)
            descriptors[t, k, : len(near)] = of_marks[near] + 0.01 * rng.normal(size=(len(near), SIZE))
            true_ids[t, k, : len(near)], valid[t, k, : len(near)] = near, True
    frames = bf.Frame(jnp.asarray(points), jnp.asarray(descriptors), jnp.asarray(true_ids), jnp.asarray(valid))
    return Drive(odometry, frames, paths)


@partial(jax.jit, static_argnames=("assumed",))
def run(belief: Any, odometry: Any, frames: Any, assumed: Any) -> Any:
    """Return the belief at the end, and the robots and their covariances after each tick."""

    def tick(so_far: Any, reading: Any) -> Any:
        after = bf.step(so_far, *reading, assumed)
        size = after.robots.size
        return after, (after.robots, after.covariance[:size, :size])

    return jax.lax.scan(tick, belief, (odometry, frames))


def stacked(drives: Sequence[Drive]) -> tuple[Any, Any]:
    """Return odometry and frames of several drives as a batch."""
    frames = jax.tree.map(lambda *values: jnp.stack(values), *[each.frames for each in drives])
    return jnp.stack([jnp.asarray(each.odometry) for each in drives]), frames


ASSUMED = bf.Assumed.of(OPTIONS)


def started(num_robots: int = 1, rows: int = 64) -> Any:
    """Return the belief at the start."""
    return bf.start(num_robots, rows, SIZE, ASSUMED)
