"""How many particles the next resampling shall draw: as many as the spread of the poses asks for (KLD-sampling).

Fox (2003), "Adapting the Sample Size in Particle Filters Through KLD-Sampling", Int. J. Robotics Research 22(12): if n
samples are drawn from a distribution with k occupied bins, then with probability `quantile` the Kullback-Leibler
divergence between the histogram of the samples and the distribution is at most `error` once

    n >= chi^2_{k-1, quantile} / (2 error).

Weighted particles are worth fewer samples: M of them stand for ESS = 1 / sum w^2. So that ESS, and not M, reaches the
bound, M / ESS times as many are drawn: the variance of importance sampling over that of sampling the target, by which
Soto (2005), "Self Adaptive Particle Filter", IJCAI, corrects the bound.
"""

from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from slam_backend.errors import FloatArray, bad_argument, check_float, check_int
from slam_backend.geometry import wrap_angle
from slam_backend.resampling import effective_sample_size

FARTHEST_BIN = 2**20 - 1  # bins are counted up to here on each axis, so that three indices fit one integer

MOST_PARTICLES = 1_000_000  # memory ends before


@dataclass(frozen=True, slots=True, kw_only=True)
class AdaptiveParticles:
    """When to use many particles, and when few.

    Attributes:
        min_particles: Never fewer.
        max_particles: Never more.
        error: Largest Kullback-Leibler divergence between particles and posterior, up to the width of a bin [nat].
        quantile: Probability with which it stays below `error`.
        bin_position: Width of a bin in x and y [m]; differences within a bin do not matter.
        bin_heading: Width of a bin in theta [rad].
        effective: Whether the bound is for the effective number of particles rather than for their number.
    """

    min_particles: int = 50
    max_particles: int = 1000
    error: float = 0.05
    quantile: float = 0.99
    bin_position: float = 0.1
    bin_heading: float = 0.05
    effective: bool = True

    def __post_init__(self) -> None:
        check_int("adaptive.min_particles", self.min_particles, 1, "Use at least one particle.")
        cure = "Give at least min_particles."
        check_int("adaptive.max_particles", self.max_particles, self.min_particles, cure, MOST_PARTICLES)
        check_float("adaptive.error", self.error, "Fox uses 0.05.", above=0.0)
        check_float("adaptive.quantile", self.quantile, "Fox uses 0.99.", at_least=0.5, at_most=1.0 - 1e-9)
        check_float("adaptive.bin_position", self.bin_position, "Give a width in metres.", above=0.0)
        check_float("adaptive.bin_heading", self.bin_heading, "Give a width in radians.", above=0.0)
        if not isinstance(self.effective, bool):
            raise bad_argument("adaptive.effective", "a bool", self.effective, "Say True or False.")


def kld_bound(num_bins: int, error: float, quantile: float) -> float:
    """Return the number of samples that k occupied bins ask for (Fox 2003), by the Wilson-Hilferty approximation.

    chi^2_{d, q} = d (1 - 2 / (9 d) + sqrt(2 / (9 d)) z_q)^3 with d = k - 1 degrees of freedom. One bin asks for none.

    Args:
        num_bins: k >= 1.
        error: Largest divergence [nat].
        quantile: Probability of staying below it, at least 0.5.

    >>> round(kld_bound(50, 0.05, 0.99))    # 49 degrees of freedom: 74.9 / 0.1
    749
    """
    d = num_bins - 1
    if d <= 0:
        return 0.0
    part = 2.0 / (9.0 * d)
    return float(d * (1.0 - part + np.sqrt(part) * NormalDist().inv_cdf(quantile)) ** 3 / (2.0 * error))


def occupied_bins(
    poses: FloatArray, weights: FloatArray, bin_position: float, bin_heading: float, least_weight: float = 0.0
) -> int:
    """Count the bins of a grid that hold particles; the mean pose is the centre of one: a tight cloud fills just one.

    Args:
        poses: (M, 3) float64 [m, m, rad].
        weights: (M,) float64 [-], summing to 1.
        bin_position: Width of a bin in x and y [m].
        bin_heading: Width of a bin in theta [rad].
        least_weight: Bins whose particles have less weight than this in all do not count, nor do those without any.

    Returns:
        k, at least 1.
    """
    headings = poses[:, 2]
    mean_heading = np.arctan2(weights @ np.sin(headings), weights @ np.cos(headings))
    offsets = np.empty(poses.shape)
    offsets[:, :2] = (poses[:, :2] - weights @ poses[:, :2]) / bin_position
    offsets[:, 2] = wrap_angle(headings - mean_heading) / bin_heading
    cells = np.clip(np.floor(offsets + 0.5), -FARTHEST_BIN, FARTHEST_BIN).astype(np.int64) + FARTHEST_BIN
    _, owners = np.unique((cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2], return_inverse=True)
    held = np.bincount(owners, weights=weights)
    return max(1, int(np.count_nonzero((held > 0.0) & (held >= least_weight * (1.0 - 1e-9)))))


def next_num_particles(options: AdaptiveParticles, poses: FloatArray, weights: FloatArray) -> int:
    """Return how many particles to draw at this resampling.

    The distribution of each robot's pose has its own bins; the robot that asks for most decides. A bin counts if it
    holds at least the weight of one particle among as many as may be: those with less are not expected to survive.

    Args:
        options: Bounds, bins and the error admitted.
        poses: (K, M, 3) float64 [m, m, rad]. Poses of the K robots in the M particles, before resampling.
        weights: (M,) float64 [-], summing to 1. Before resampling.

    Returns:
        The number, from `min_particles` to `max_particles`.

    Raises:
        ValueError: If the shapes disagree.
    """
    if poses.ndim != 3 or poses.shape[1:] != (len(weights), 3):
        cure = "Give one pose per robot and particle."
        raise bad_argument("poses", f"an array of shape (n, {len(weights)}, 3)", f"shape {poses.shape}", cure)
    least = 1.0 / max(options.max_particles, len(weights))
    bins = [occupied_bins(robot, weights, options.bin_position, options.bin_heading, least) for robot in poses]
    wanted = kld_bound(max(bins), options.error, options.quantile)
    if options.effective:
        wanted *= len(weights) / effective_sample_size(weights)
    return int(np.clip(np.ceil(wanted), options.min_particles, options.max_particles))
