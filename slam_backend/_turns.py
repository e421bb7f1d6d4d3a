"""The turns of a step: what each robot did and saw goes into all particles, and what became of it into a report."""

import math
from collections.abc import Sequence
from dataclasses import astuple
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from slam_backend import _kernels
from slam_backend._filter_arrays import FilterArrays
from slam_backend._kernels.layout import ASSOCIATED, CREATED, REJECTED
from slam_backend._particle_maps import ParticleMaps
from slam_backend.errors import BoolArray, FloatArray, IntArray
from slam_backend.filter_options import FilterOptions
from slam_backend.geometry import compose
from slam_backend.input_log import UNHEARD, StepInput
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
    low: int, high: int, now: int, numbers: FloatArray, arrays: FilterArrays, maps: ParticleMaps,
    inputs: StepInput, rows: tuple[int, ...], normals: FloatArray, found: NDArray[np.int32], distances: FloatArray,
    told: IntArray, estimates: PoseEstimates,
) -> Summary:  # fmt: skip
    """Move robots `low` to `high` - 1 in all particles, match what they saw, weigh and update (Algorithm 1, l. 6-8).

    Args:
        low, high: Whose turns are taken; with the last one the particles are weighed, and the step is summed up.
        now: Number of the step for the smoother, 0 if there is none.
        numbers: What the filter assumes.
        arrays: Its poses and weights, changed; robots that were told their poses are `place`d already.
        maps: Of all particles, changed; there is room for all that may start.
        inputs: What these robots, and perhaps others, read.
        rows: Of each robot there; -1: none.
        normals: (k, M, 3) standard normal draws, for the k robots that are not idle.
        found: (n, P) int32, written: slot to which each particle gave each measurement, -1 = none.
        distances: (n, P), written: squared Mahalanobis distances of matches, else NaN.
        told: (3, n) int64, written: what becomes of the measurements.
        estimates: Of the robots' poses, written with the last turn.
    """
    return _kernels.take_turns(
        low, high, now, numbers, _as_array(rows), inputs.table, inputs.moves, normals,
        arrays._of_robots, arrays._blind, arrays._of_particles, arrays._frame,
        maps.values, maps.counts, maps.odds, maps.table, maps.maps, maps.users,
        maps.free_rows, maps.tops, maps.descriptors, maps.heads,
        inputs.sightings, inputs.descriptors, inputs.names,
        found, distances, told, *estimates,
    )  # fmt: skip


@lru_cache(maxsize=256)
def _as_array(rows: tuple[int, ...]) -> IntArray:
    """Return the rows of robots as kernels take them."""
    array = np.array(rows, np.int64)
    array.setflags(write=False)
    return array


def report_of(inputs: StepInput, rows: Sequence[int], told: IntArray, summary: Summary, threshold: float) -> StepReport:
    """Return the report of a step.

    Args:
        inputs: What the robots read.
        rows: Of each robot there; -1: none.
        told: (3, n) int64. What became of it; the report shares it.
        summary: Of `take_turns`.
        threshold: Particles are to be resampled where the effective sample size is not above it.
    """
    ess, _, num_created, num_new, num_matched, _, squares, judged = summary
    associated, created, given, used = [], [], 0, 0
    for row in rows:
        _, begin, end, _, _, count = inputs.turns[row] if row >= 0 else UNHEARD
        found, made = told[ASSOCIATED, begin:end], told[CREATED, begin:end]
        if row in inputs.masks:
            found, made = _unmasked(found, inputs.masks[row]), _unmasked(made, inputs.masks[row])
        associated.append(found)
        created.append(made)
        given, used = given + max(count, 0), used + end - begin
    nis = squares / judged if judged else math.nan
    return StepReport(
        tuple(associated), tuple(created), num_created, num_new, num_matched, given - num_new - num_matched,
        ess, nis, used > 0 and ess <= threshold,
    )  # fmt: skip


def _unmasked(used: IntArray, mask: BoolArray) -> IntArray:
    """Return what became of all of a robot's measurements (n,), -1 for those that were not used."""
    every: IntArray = np.full(len(mask), REJECTED)
    every[mask] = used
    return every
