"""What a step of the filter must cost at least: bytes that have to move, and multiply-adds that its equations need.

Counted are the landmarks that are measured, and they alone, once per particle and measurement. A filter that reaches a
bound keeps nothing else in memory, wastes no lane of a vector instruction, and its surroundings are free.
"""

from training.filter_load import DESCRIPTOR_SIZE, FilterLoad
from training.machine_rates import copy_rate, multiply_add_rate

LANDMARK_BYTES = 9 * 8 + 4  # mean (3), covariance (6) and the count of its measurements

# Per particle and measurement; a product, a sum or both fused count one, logarithms and roots nothing.
INNOVATION = 3 + 2 + 1 + 4 + 6 + 16 + 6  # e = l - p, depth, k, R v, r = k (R v - e), covariance R, S = Sigma + R
INVERSE = 22  # of a symmetric 3 x 3 matrix, with its determinant
DISTANCE = 9 + 3  # S^-1 r, r^T S^-1 r
UPDATE = 27 + 9 + 18  # K = Sigma S^-1, mu + K r, the symmetric K R
EVALUATION = INNOVATION + INVERSE + DISTANCE + 2 + 6 + 24 + 6  # H, A = H C (two rows), J = A^T S^-1 A, g = A^T S^-1 r
GATE = 6 + INVERSE + 12  # Lambda + J, its inverse, the quadratic form of g
MULTIPLY_ADDS = {
    "fastslam1": INNOVATION + INVERSE + DISTANCE + UPDATE,
    # gated at the predicted pose and again at the refined one; J and g summed for either; updated at the sampled one
    "fastslam2": 2 * (EVALUATION + GATE) + 2 * 10 + INNOVATION + INVERSE + UPDATE,
}


def bytes_moved(load: FilterLoad) -> int:
    """Return how many bytes a step reads and writes at least."""
    return 2 * load.measurements * load.particles * LANDMARK_BYTES


def map_bytes(load: FilterLoad) -> int:
    """Return how many bytes the maps of all particles take at least: what a step's accesses are spread over."""
    return load.landmarks * load.particles * LANDMARK_BYTES


def copy_bound_ms(load: FilterLoad) -> float:
    """Return how long numpy's copy takes to move a step's bytes in a working set as large as the maps [ms]."""
    return 1e3 * bytes_moved(load) / copy_rate(map_bytes(load))


def arithmetic_bound_ms(load: FilterLoad) -> float:
    """Return how long a step's multiply-adds take one core at the rate of a matrix product [ms].

    Those of the particles are in float64; each descriptor is compared with all of the map in float32, once for all.
    """
    particles = load.measurements * load.particles * MULTIPLY_ADDS[load.proposal] / multiply_add_rate("float64")
    descriptors = load.measurements * load.landmarks * DESCRIPTOR_SIZE / multiply_add_rate("float32")
    return 1e3 * (particles + descriptors)
