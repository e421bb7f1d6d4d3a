"""One particle of the plain filter, and where the copies of particles stand after resampling."""

import copy
from dataclasses import dataclass, field

import numpy as np

from slam_backend.errors import FloatArray, IntArray
from slam_backend.plain.pose_belief import PoseBelief
from slam_backend.plain.turn import Landmarks


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
    posteriors: list[PoseBelief]
    starts: list[FloatArray]
    log_weight: float
    path_log_weight: float = 0.0
    landmarks: Landmarks = field(default_factory=dict)


def settled(ancestors: IntArray) -> IntArray:
    """Reorder ancestors (M,) so that every particle that is drawn keeps its own place.

    The surplus copies, by ascending parent, fill the places of those that were not drawn, in ascending order.

    >>> settled(np.array([3, 3, 3, 1])).tolist()
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
    parents = settled(ancestors)
    drawn = [
        particles[parent] if parent == place else copy.deepcopy(particles[parent])
        for place, parent in enumerate(parents)
    ]
    for particle in drawn:
        particle.log_weight = -float(np.log(len(drawn)))
    return drawn
