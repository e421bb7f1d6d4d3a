"""Particles of the reference filter, and the input of one robot in one step."""

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
NEW = -2  # minus b: the landmark that measurement b starts, until all particles have decided and it gets its name

Landmarks = dict[int, Landmark]  # one particle's map, by name
Candidates = list[list[tuple[float, int]]]  # per measurement (squared descriptor distance E, landmark), nearest first


@dataclass(frozen=True)
class RobotUpdate:
    """What one particle made of one robot's step.

    Attributes:
        posterior: Of the pose, before it was sampled.
        pose: (3,) the sample [m, m, rad].
        chosen: Per measurement the landmark to which it was given, `REJECTED`, or `NEW` minus its number.
        distances: Per measurement the squared Mahalanobis distance of its match at the predicted pose, infinite
            where the match could not be seen from there; NaN where nothing was matched.
        log_likelihood: Of the measurements, given the particle's past.
    """

    posterior: GaussianPose
    pose: FloatArray
    chosen: list[int]
    distances: list[float]
    log_likelihood: float


def is_held(b: int, possible: Sequence[tuple[float, int]], chosen: Sequence[int], names: Sequence[int]) -> bool:
    """Tell whether a particle has a landmark of a measurement's name: then it starts no second one.

    Args:
        b: The measurement.
        possible: The landmarks of the particle that have its name.
        chosen: Outcome of the measurements before it.
        names: The caller's names of all measurements of the frame.
    """
    return bool(possible) or any(chosen[a] == NEW - a and names[a] == names[b] for a in range(b))


class RobotStep:
    """What one robot's step came to: per measurement of its frame (n) and per particle (M).

    Attributes:
        associations: (n, M) int64. The landmark to which the particle gave the measurement; -1: to none.
        distances: (n, M) float64. Squared Mahalanobis distance of the match; NaN where there is none.
        created: (n,) int64. The landmark that the measurement started in at least one particle; -1: none.
        log_likelihoods: (M,) float64. What the particle's weight is multiplied by.
        measured: Whether a measurement was used.
    """

    def __init__(self, size: int, num_particles: int) -> None:
        self.associations = np.full((size, num_particles), -1, np.int64)
        self.distances = np.full((size, num_particles), np.nan)
        self.created = np.full(size, -1, np.int64)
        self.log_likelihoods = np.zeros(num_particles)
        self.measured = False


def report_of(records: Sequence[RobotStep], best: int, weights: FloatArray, resample_threshold: float) -> StepReport:
    """Tell what one particle did in a step, and whether the particles are to be resampled (l. 10).

    Args:
        records: Of all robots.
        best: The most probable particle.
        weights: (M,) float64, summing to 1, after the step.
        resample_threshold: Share of M below which the effective sample size asks for it.
    """
    associations = tuple(record.associations[:, best] for record in records)
    created = tuple(record.created for record in records)
    given, started = np.concatenate(associations), np.concatenate(created)
    num_new = int(np.sum((given >= 0) & (given == started)))
    num_rejected = int(np.sum(given < 0))
    distances = np.concatenate([record.distances[:, best] for record in records])
    judged = distances[distances < np.inf]  # neither NaN nor infinite
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
        nis=float(judged.mean()) if len(judged) else float("nan"),
        resampled=measured and ess <= threshold,
    )


@dataclass
class Particle:
    """One hypothesis (Eq. 19): the poses of the K robots and the map conditioned on their paths.

    Attributes:
        poses: Of each robot (3,) [m, m, rad], map frame.
        posteriors: Of these poses, before they were sampled.
        starts: Of each robot (3,) [m, m, rad], map frame.
        log_weight: Since the last resampling, normalised.
        path_log_weight: Accumulated along the ancestral line (Eq. 12).
        landmarks: The map, by name.
    """

    poses: list[FloatArray]
    posteriors: list[GaussianPose]
    starts: list[FloatArray]
    log_weight: float
    path_log_weight: float = 0.0
    landmarks: Landmarks = field(default_factory=dict)


def keep_survivors_in_place(ancestors: IntArray) -> IntArray:
    """Reorder ancestors (M,) so that every particle that is drawn keeps its own place.

    The surplus copies, by ascending parent, fill the places of those that were not drawn, in ascending order.

    >>> keep_survivors_in_place(np.array([3, 3, 3, 1])).tolist()
    [3, 1, 3, 3]
    """
    copies = np.bincount(ancestors, minlength=len(ancestors))
    parents = np.arange(len(ancestors))
    parents[copies == 0] = np.repeat(parents, np.maximum(copies - 1, 0))
    return parents


def descendants(particles: list[Particle], ancestors: IntArray) -> list[Particle]:
    """Return the particles that were drawn, equally weighted; no two of them share anything that a step writes.

    Args:
        particles: M; those that keep their place are used again.
        ancestors: (M,) int64, the index of each one's ancestor, in any order.
    """
    parents = keep_survivors_in_place(ancestors)
    drawn = [
        particles[parent] if parent == place else copy.deepcopy(particles[parent])
        for place, parent in enumerate(parents)
    ]
    for particle in drawn:
        particle.log_weight = -float(np.log(len(drawn)))
    return drawn
