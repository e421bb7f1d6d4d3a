"""The turns of a step: what each robot did and saw goes into all particles, and what became of it into a report."""

import math
from collections.abc import Sequence
from dataclasses import astuple
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from slam_backend import _kernels
from slam_backend._frame_buffers import FrameBuffers, Frames
from slam_backend._particle_maps import ParticleMaps
from slam_backend.errors import BoolArray, FloatArray, IntArray
from slam_backend.filter_options import FilterOptions
from slam_backend.geometry import compose
from slam_backend.reports import PoseEstimates, StepReport


class Assumed(NamedTuple):
    """What a filter assumes, with that which the kernels take in another form.

    Attributes:
        options: Of the filter.
        sighting: Whether measurements shape the sampled pose (FastSLAM 2.0).
        noise: (6,) of the odometry, see `OdometryModel`.
        camera: (7,) focal length [px], baseline [m], sigmas of image coordinates and of the disparity [px], mount [m].
        gates: What the kernel takes between the camera and `recovery`.
        recovery: (3,) [m, m, rad]. Sigmas of the prior of a lost pose.
        log_p0: Logarithm of the density of new landmarks [1/m^3] (Algorithm 1, l. 32).
        walk: Variance [m^2] by which a landmark may move between two sightings.
    """

    options: FilterOptions
    sighting: bool
    noise: FloatArray
    camera: FloatArray
    gates: tuple[float, float, float, float, float, float]
    recovery: FloatArray
    log_p0: float
    walk: float

    @classmethod
    def by(cls, options: FilterOptions) -> "Assumed":
        """Return what these options say."""
        camera, motion = options.camera, options.motion
        return cls(
            options,
            options.proposal == "fastslam2",
            np.array(astuple(motion)),
            np.array([camera.focal_px, camera.baseline, camera.sigma_px, camera.sigma_disparity_px, *camera.mount]),
            (
                options.descriptor_gate**2, options.descriptor_sigma**2, options.position_gate, options.dead_zone,
                options.dead_radius, options.ambiguity,
            ),
            np.array([options.recovery_position, options.recovery_position, options.recovery_heading]),
            float(np.log(options.new_landmark_density)),
            options.landmark_walk,
        )  # fmt: skip


class PoseParticles(NamedTuple):
    """The robots' part of the particles, P with the lanes that mean nothing; turns write all but the starts.

    Attributes:
        starts: (K, 3, P) float64 [m, m, rad], map frame. Where each robot started.
        poses: (K, 3, P) likewise. Where it is (x_t^[m]).
        means: (K, 3, P) likewise, with `covariances` (K, 6, P) N(x^, P^) of each particle before sampling.
        blind: (K,) bool. Whether that was propagated since the last sighting.
    """

    starts: FloatArray
    poses: FloatArray
    means: FloatArray
    covariances: FloatArray
    blind: BoolArray


def place(particles: PoseParticles, count: int, robot: int, exact: FloatArray) -> None:
    """Put a robot, in all `count` particles, where it is told that it is: (3,) [m, m, rad] in its own start frame."""
    particles.poses[robot, :, :count] = compose(particles.starts[robot, :, :count].T.copy(), exact).T


def take_turns(
    assumed: Assumed, particles: PoseParticles, maps: ParticleMaps, buffers: FrameBuffers, frames: Frames,
    normals: FloatArray, low: int, high: int,
) -> None:  # fmt: skip
    """Move robots `low` to `high` - 1 in all particles, match what they saw, weigh and update (Algorithm 1, l. 6-8).

    Args:
        assumed: By the filter.
        particles: Of all robots, changed; robots that were told their poses are `place`d already.
        maps: Of all particles, changed.
        buffers: Which took the frames; `log_likelihood` grows, and what becomes of measurements is written.
        frames: What the robots saw.
        normals: (k, M, 3) standard normal draws, for the k robots that are not idle.
        low, high: Whose turns are taken.
    """
    num = len(frames.points)
    if num:
        maps.make_room(num, frames.descriptors.shape[1])
    _, poses, means, covariances, blind = particles
    _kernels.take_turns(
        low, high, assumed.sighting, buffers.acts, buffers.moves, assumed.noise, normals,
        poses, means, covariances, blind,
        maps.values, maps.counts, maps.odds, maps.row_of, maps.map_of, maps.maps, maps.users,
        maps.free_rows, maps.free_slots, maps.tops, maps.ids, maps.identities, maps.descriptors, maps.heads,
        buffers.firsts, frames.points, frames.covariances, buffers.given, frames.descriptors,
        frames.names, buffers.named, assumed.camera, *assumed.gates, assumed.recovery, assumed.log_p0, assumed.walk,
        assumed.options.one_to_one, buffers.points, buffers.noises, buffers.work, buffers.records, buffers.found,
        buffers.distances, buffers.new_slots, buffers.log_likelihood,
    )  # fmt: skip


def conclude(
    frames: Frames,
    buffers: FrameBuffers,
    ids: IntArray,
    weights: tuple[FloatArray, FloatArray, FloatArray],
    believed: tuple[FloatArray, FloatArray],
    threshold: float,
) -> tuple[StepReport, PoseEstimates]:
    """Weigh the particles after all turns, and return the report of the step and the robots' poses.

    Args:
        frames: What the robots saw.
        buffers: In which their turns were taken.
        ids: (slots,) int64. Names of the landmarks.
        weights: Log-weights, log-weights along the path, and weights (M,), changed.
        believed: (K, 3, P), (K, 6, P). N(x^, P^) of each robot and particle.
        threshold: Particles are to be resampled where the effective sample size is not above it.
    """
    robots, used = len(frames.sizes), len(frames.points)
    given = sum(frames.sizes)
    associations, created = np.empty(given, np.int64), np.empty(given, np.int64)
    means, covariances = np.empty((robots, 3)), np.empty((robots, 3, 3))
    ess, num_created, num_new, num_matched, squares, judged = _kernels.conclude(
        buffers.log_likelihood, *weights, *believed, means, covariances,
        buffers.found, buffers.distances, buffers.new_slots, buffers.rows_used(frames), ids, associations, created,
    )  # fmt: skip
    nis = squares / judged if judged else math.nan
    num_rejected = given - num_new - num_matched
    rest = (num_created, num_new, num_matched, num_rejected, ess, nis, used > 0 and ess <= threshold)
    if robots == 1:
        return StepReport((associations,), (created,), *rest), PoseEstimates(means, covariances)
    ends = list(accumulate(frames.sizes))
    report = StepReport(tuple(_split(associations, ends)), tuple(_split(created, ends)), *rest)
    return report, PoseEstimates(means, covariances)


def _split(values: IntArray, ends: Sequence[int]) -> list[IntArray]:
    """Return the parts of an array that end at these places."""
    return [values[first:end] for first, end in zip([0, *ends], ends, strict=False)]
