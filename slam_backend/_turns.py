"""The turns of a step: what each robot did and saw goes into all particles, and what became of it into a report."""

import math
from collections.abc import Sequence
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from slam_backend import _kernels
from slam_backend._frame_buffers import FrameBuffers, Turn
from slam_backend._particle_maps import ParticleMaps
from slam_backend.errors import FloatArray, IntArray
from slam_backend.filter_options import FilterOptions
from slam_backend.geometry import compose
from slam_backend.reports import PoseEstimate, StepReport

NOTHING = np.zeros(3)
NO_NAMES = np.zeros(0, dtype=np.int64)


class Assumed(NamedTuple):
    """What a filter assumes, with that which the kernels take in another form.

    Attributes:
        options: Of the filter.
        sighting: Whether measurements shape the sampled pose (FastSLAM 2.0).
        camera: (7,) focal length [px], baseline [m], sigmas of image coordinates and of the disparity [px], mount [m].
        gates: What that kernel takes between its readings and `recovery`.
        recovery: (3,) [m, m, rad]. Sigmas of the prior of a lost pose.
        log_p0: Logarithm of the density of new landmarks [1/m^3] (Algorithm 1, l. 32).
        walk: Variance [m^2] by which a landmark may move between two sightings.
    """

    options: FilterOptions
    sighting: bool
    camera: FloatArray
    gates: tuple[float, float, float, float, float, float]
    recovery: FloatArray
    log_p0: float
    walk: float

    @classmethod
    def by(cls, options: FilterOptions) -> "Assumed":
        """Return what these options say."""
        camera = options.camera
        return cls(
            options,
            options.proposal == "fastslam2",
            np.array([camera.focal_px, camera.baseline, camera.sigma_px, camera.sigma_disparity_px, *camera.mount]),
            (
                options.descriptor_gate**2, options.descriptor_sigma**2, options.position_gate, options.dead_zone,
                options.dead_radius, options.ambiguity,
            ),
            np.array([options.recovery_position, options.recovery_position, options.recovery_heading]),
            float(np.log(options.new_landmark_density)),
            options.landmark_walk,
        )  # fmt: skip


class RobotParticles(NamedTuple):
    """One robot's part of the particles, P with the lanes that mean nothing; a turn writes all but the starts.

    Attributes:
        starts: (3, P) float64 [m, m, rad], map frame. Where it started.
        poses: (3, P) likewise. Where it is (x_t^[m]).
        means: (3, P) likewise, with `covariances` (6, P) N(x^, P^) of each particle before sampling.
        blind: Whether that was propagated since the last sighting.
    """

    starts: FloatArray
    poses: FloatArray
    means: FloatArray
    covariances: FloatArray
    blind: bool


def take_turn(
    assumed: Assumed,
    own: RobotParticles,
    maps: ParticleMaps,
    buffers: FrameBuffers,
    turn: Turn,
    move: FloatArray | None,
    exact: FloatArray | None,
    normals: FloatArray,
) -> bool:
    """Move one robot in all particles, match what it saw, weigh and update the landmarks (Algorithm 1, l. 6-8).

    Args:
        assumed: By the filter.
        own: The robot's part of the particles, changed.
        maps: Of all particles, changed.
        buffers: Their `log_likelihood` grows by that of the turn.
        turn: What it saw; `found`, `distances` and `new_slots` are written.
        move: (3,) odometry [m, m, rad]; None: it stood.
        exact: (3,) pose in its start frame [m, m, rad], taken as exact, instead; or None.
        normals: (M, 3) standard normal draws.

    Returns:
        Whether the robot's N(x^, P^) is now propagated since the last sighting.
    """
    options, (starts, poses, means, covariances, blind) = assumed.options, own
    num = len(turn.points)
    sigmas = NOTHING if move is None else options.motion.sigmas(move)
    move = NOTHING if move is None else move
    if exact is not None:
        count = maps.num_particles
        poses[:, :count] = compose(starts[:, :count].T.copy(), exact).T
        move, sigmas, blind = NOTHING, NOTHING, False
    if num == 0 and assumed.sighting:
        if exact is None:
            _kernels.move_blind(poses, means, covariances, blind, move, sigmas, normals, buffers.work)
            return True
        means[:], covariances[:] = poses, 0.0
        return False
    if num:
        maps.make_room(num, turn.descriptors.shape[1])
    named = turn.names is not None
    store = (
        maps.values, maps.counts, maps.odds, maps.row_of, maps.map_of, maps.maps, maps.users,
        maps.free_rows, maps.free_slots, maps.tops, maps.ids, maps.identities, maps.descriptors, maps.heads,
    )  # fmt: skip
    names = NO_NAMES if turn.names is None else turn.names
    readings = (turn.points, turn.noises, turn.given, assumed.camera, turn.descriptors, names, named)
    results = (buffers.work, buffers.records, turn.found, turn.distances, turn.new_slots, buffers.log_likelihood)
    if not assumed.sighting:
        _kernels.update_fastslam1(
            poses, means, covariances, exact is None, move, sigmas, normals, *store, *readings,
            options.descriptor_gate**2, options.position_gate, assumed.log_p0, assumed.walk,
            options.one_to_one, *results,
        )  # fmt: skip
        return blind
    _kernels.update_fastslam2(
        poses, means, covariances, blind, move, sigmas, normals, *store, *readings,
        *assumed.gates, NOTHING if exact is not None else assumed.recovery,
        assumed.log_p0, assumed.walk, options.one_to_one, *results,
    )  # fmt: skip
    return False


def conclude(
    turns: Sequence[Turn],
    buffers: FrameBuffers,
    ids: IntArray,
    weights: tuple[FloatArray, FloatArray, FloatArray],
    believed: tuple[FloatArray, FloatArray],
    threshold: float,
) -> tuple[StepReport, list[PoseEstimate]]:
    """Weigh the particles after all turns, and return the report of the step and each robot's pose.

    Args:
        turns: Of all robots.
        buffers: In which they were taken.
        ids: (slots,) int64. Names of the landmarks.
        weights: Log-weights, log-weights along the path, and weights (M,), changed.
        believed: (K, 3, P), (K, 6, P). N(x^, P^) of each robot and particle.
        threshold: Particles are to be resampled where the effective sample size is not above it.
    """
    robots = len(turns)
    given = turns[0].size if robots == 1 else sum([turn.size for turn in turns])
    associations, created = np.empty(given, np.int64), np.empty(given, np.int64)
    means, covariances = np.empty((robots, 3)), np.empty((robots, 3, 3))
    found, distances, new_slots, rows = buffers.outcome(turns)
    ess, num_new, num_matched, squares, judged = _kernels.conclude(
        buffers.log_likelihood, *weights, *believed, means, covariances, found, distances, new_slots, rows, ids,
        associations, created,
    )  # fmt: skip
    nis = squares / judged if judged else math.nan
    rest = (num_new, num_matched, given - num_new - num_matched, ess, nis, buffers.used > 0 and ess <= threshold)
    if robots == 1:
        return StepReport((associations,), (created,), *rest), [PoseEstimate(means[0], covariances[0])]
    ends = list(accumulate([turn.size for turn in turns[:-1]]))
    report = StepReport(tuple(_split(associations, ends)), tuple(_split(created, ends)), *rest)
    return report, list(map(PoseEstimate, means, covariances))


def _split(values: IntArray, ends: Sequence[int]) -> list[IntArray]:
    """Return the parts of an array that end before these places, and what is left."""
    return [values[first:end] for first, end in zip([0, *ends], [*ends, len(values)], strict=True)]
