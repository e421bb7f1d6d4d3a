"""Particles of the reference filter, and the results of one robot's step."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.fastslam.reports import Associations, StepReport
from slam_backend.reference.measurement_model import Landmark
from slam_backend.reference.pose_gaussian import GaussianPose
from slam_backend.resampling import effective_sample_size

REJECTED = -1
NEW = -2  # minus b: provisional name of the landmark that measurement b starts

Landmarks = dict[int, Landmark]  # one particle's map, by name
Candidates = list[list[tuple[float, int]]]  # by measurement (squared descriptor distance E, landmark), nearest first


@dataclass(frozen=True)
class RobotUpdate:
    """Result of one robot's step in one particle.

    Attributes:
        posterior: Distribution from which the pose was sampled.
        pose: (3,) the sample [m, m, rad].
        chosen: Landmark associated with each measurement, `REJECTED`, or `NEW` minus its number.
        distances: Squared Mahalanobis distance of each match at the predicted pose, infinite if it was not visible from
            there; NaN without a match.
        log_likelihood: Log-likelihood of the measurements, given the particle's past.
    """

    posterior: GaussianPose
    pose: FloatArray
    chosen: list[int]
    distances: list[float]
    log_likelihood: float


def is_held(b: int, possible: Sequence[tuple[float, int]], chosen: Sequence[int], identities: Sequence[int]) -> bool:
    """Return whether a particle has a landmark with the identity of a measurement, which then starts no other.

    Args:
        b: Number of the measurement.
        possible: Landmarks of the particle with this identity.
        chosen: Associations of the measurements before it.
        identities: The caller's identities of all measurements of the frame.
    """
    return bool(possible) or any(chosen[a] == NEW - a and identities[a] == identities[b] for a in range(b))


class RobotStep:
    """Result of one robot's step, per measurement of its frame (n) and per particle (M).

    Attributes:
        associations: (n, M) int64. Landmark that the particle associated with the measurement, -1 = none.
        distances: (n, M) float64. Squared Mahalanobis distance of the match; NaN where there is none.
        created: (n,) int64. Landmark that the measurement started in at least one particle, -1 = none.
        log_likelihoods: (M,) float64. Log of the factor of the particle's weight.
        measured: Whether a measurement was used.
    """

    def __init__(self, size: int, num_particles: int) -> None:
        self.associations = np.full((size, num_particles), -1, np.int64)
        self.distances = np.full((size, num_particles), np.nan)
        self.created = np.full(size, -1, np.int64)
        self.log_likelihoods = np.zeros(num_particles)
        self.measured = False


def report_of(records: Sequence[RobotStep], best: int, weights: FloatArray, resample_threshold: float) -> StepReport:
    """Return the report of a step for one particle, with the decision to resample (l. 10).

    Args:
        records: Results of all robots.
        best: Index of the most probable particle.
        weights: (M,) float64, summing to 1, after the step.
        resample_threshold: Share of M at or below which the effective sample size triggers resampling.
    """
    associations = tuple(record.associations[:, best] for record in records)
    created = tuple(record.created for record in records)
    given, started = np.concatenate(associations), np.concatenate(created)
    num_new = int(np.sum((given >= 0) & (given == started)))
    num_rejected = int(np.sum(given < 0))
    distances = np.concatenate([record.distances[:, best] for record in records])
    finite = distances[distances < np.inf]  # neither NaN nor infinite
    ess = effective_sample_size(weights)
    threshold = resample_threshold * len(weights) * (1.0 + 1e-9)  # rounding must not decide
    measured = any(record.measured for record in records)
    return StepReport(
        all_associations=Associations.from_arrays(associations, created),
        rows=tuple(range(len(records))),
        num_created=int(np.sum(started >= 0)),
        num_new=num_new,
        num_matched=len(given) - num_new - num_rejected,
        num_rejected=num_rejected,
        ess=ess,
        nis=float(finite.mean()) if len(finite) else float("nan"),
        resampled=measured and ess <= threshold,
    )


@dataclass
class Particle:
    """Hypothesis (Eq. 19): poses of the K robots and the map conditioned on their paths.

    Attributes:
        poses: Pose of each robot (3,) [m, m, rad], map frame.
        posteriors: Distributions from which these poses were sampled.
        starts: Start pose of each robot (3,) [m, m, rad], map frame.
        biases: Mean of each robot's odometry bias (3,) [m/m, rad/m, rad/rad], given the path.
        log_weight: Log-weight since the last resampling, normalised.
        path_log_weight: Log-weight accumulated along the ancestral line (Eq. 12).
        landmarks: Map, by name.
        predicted: Pose of the robot that moved last, before its measurements.
    """

    poses: list[FloatArray]
    posteriors: list[GaussianPose]
    starts: list[FloatArray]
    biases: list[FloatArray]
    log_weight: float
    path_log_weight: float = 0.0
    landmarks: Landmarks = field(default_factory=dict)
    predicted: GaussianPose = field(default_factory=lambda: GaussianPose.known(np.zeros(3)))


def keep_survivors_in_place(ancestors: IntArray) -> IntArray:
    """Reorder ancestors (M,) so that each surviving particle keeps its place.

    Additional copies, by ascending parent, fill the places of the other particles, in ascending order.

    >>> keep_survivors_in_place(np.array([3, 3, 3, 1])).tolist()
    [3, 1, 3, 3]
    """
    copies = np.bincount(ancestors, minlength=len(ancestors))
    parents = np.arange(len(ancestors))
    parents[copies == 0] = np.repeat(parents, np.maximum(copies - 1, 0))
    return parents


def descendants(particles: list[Particle], ancestors: IntArray) -> list[Particle]:
    """Return the resampled particles, equally weighted, without shared mutable parts.

    Args:
        particles: M; those that keep their place are reused.
        ancestors: (M,) int64. Index of the ancestor of each new particle, in any order.
    """
    parents = keep_survivors_in_place(ancestors)
    drawn = [
        particles[parent] if parent == place else copy.deepcopy(particles[parent])
        for place, parent in enumerate(parents)
    ]
    for particle in drawn:
        particle.log_weight = -float(np.log(len(drawn)))
    return drawn
