"""The turns of a step: what each robot did and saw goes into all particles, and what became of it into a report."""

import math
from dataclasses import astuple
from typing import Final

import numpy as np

from slam_backend import _kernels
from slam_backend._filter_arrays import FilterArrays
from slam_backend._frame_buffers import FrameBuffers, Frames
from slam_backend._kernels.layout import ASSOCIATED, CREATED, REJECTED
from slam_backend._particle_maps import ParticleMaps
from slam_backend.errors import FloatArray, IntArray
from slam_backend.filter_options import FilterOptions
from slam_backend.geometry import compose
from slam_backend.reports import PoseEstimates, StepReport

# What `_kernels.take_turns` returns; `report_of` takes it apart.
Summary = tuple[float, int, int, int, int, int, float, int]
BEST: Final = 1
LONG_UNSEEN: Final = 5


def assumed(options: FilterOptions) -> FloatArray:
    """Return what a filter assumes, (27,) float64, as `_kernels.layout` names the numbers.

    The noise of the odometry (6,), see `OdometryModel`; of the camera (7,) the focal length [px], the baseline [m], the
    sigmas of image coordinates and of the disparity [px], and the mount [m]; the sigmas (3,) [m, m, rad] of the prior
    of a lost pose; then one number each.
    """
    camera = options.camera
    return np.array([
        *astuple(options.motion),
        camera.focal_px, camera.baseline, camera.sigma_px, camera.sigma_disparity_px, *camera.mount,
        options.recovery_position, options.recovery_position, options.recovery_heading,
        options.descriptor_gate**2, options.descriptor_sigma**2, options.position_gate, options.dead_zone,
        options.dead_radius, options.ambiguity,
        np.log(options.new_landmark_density), options.landmark_walk,
        options.proposal == "fastslam2", options.one_to_one,
        options.smoothing.closure_after,
    ])  # fmt: skip


def place(arrays: FilterArrays, robot: int, exact: FloatArray) -> None:
    """Put a robot, in all particles, where it is told that it is: (3,) [m, m, rad] in its own start frame."""
    count = arrays.num_particles
    arrays._poses[robot, :, :count] = compose(arrays._starts[robot, :, :count].T.copy(), exact).T
    arrays._frame.fill(0.0)  # it is known now


def take_turns(
    low: int, high: int, now: int, numbers: FloatArray, arrays: FilterArrays, maps: ParticleMaps, buffers: FrameBuffers,
    frames: Frames, normals: FloatArray, told: IntArray, estimates: PoseEstimates,
) -> Summary:  # fmt: skip
    """Move robots `low` to `high` - 1 in all particles, match what they saw, weigh and update (Algorithm 1, l. 6-8).

    Args:
        low, high: Whose turns are taken; with the last one the particles are weighed, and the step is summed up.
        now: Number of the step for the smoother, 0 if there is none.
        numbers: What the filter assumes.
        arrays: Its poses and weights, changed; robots that were told their poses are `place`d already.
        maps: Of all particles, changed; there is room for all that may start.
        buffers: Which took the frames.
        frames: What the robots saw.
        normals: (k, M, 3) standard normal draws, for the k robots that are not idle.
        told: (3, n) int64, written: what becomes of the measurements.
        estimates: Of the robots' poses, written with the last turn.
    """
    return _kernels.take_turns(
        low, high, now, numbers, buffers.turns, buffers.moves, normals,
        arrays._of_robots, arrays._blind, arrays._of_particles, arrays._frame,
        maps.values, maps.counts, maps.odds, maps.table, maps.maps, maps.users,
        maps.free_rows, maps.tops, maps.descriptors, maps.heads,
        frames.points, frames.covariances, frames.descriptors, frames.names,
        buffers.sightings, buffers.space, buffers.found, buffers.distances, told, *estimates,
    )  # fmt: skip


def report_of(frames: Frames, told: IntArray, summary: Summary, threshold: float) -> StepReport:
    """Return the report of a step.

    Args:
        frames: What the robots saw.
        told: (3, n) int64. What became of it; the report shares it.
        summary: Of `take_turns`.
        threshold: Particles are to be resampled where the effective sample size is not above it.
    """
    ess, _, num_created, num_new, num_matched, _, squares, judged = summary
    associated, created = told[ASSOCIATED], told[CREATED]
    alone = len(frames.ends) == 1 and not frames.masks
    nis = squares / judged if judged else math.nan
    num_rejected = frames.given - num_new - num_matched
    resampled = frames.ends[-1] > 0 and ess <= threshold
    return StepReport(
        (associated,) if alone else _by_robot(associated, frames),
        (created,) if alone else _by_robot(created, frames),
        num_created, num_new, num_matched, num_rejected, ess, nis, resampled,
    )  # fmt: skip


def _by_robot(values: IntArray, frames: Frames) -> tuple[IntArray, ...]:
    """Return what became of each robot's measurements (n_i,), -1 for those that were not used."""
    own, first = [], 0
    for robot, end in enumerate(frames.ends):
        used, mask, first = values[first:end], frames.masks.get(robot), end
        if mask is not None:
            used, rest = np.full(len(mask), REJECTED), used
            used[mask] = rest
        own.append(used)
    return tuple(own)
