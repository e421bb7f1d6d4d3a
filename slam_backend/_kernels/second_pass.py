"""Pass B of FastSLAM 2.0: at the refined pose each measurement is matched, rejected, or starts a landmark."""

import math

from slam_backend._jit import device, lanes
from slam_backend._kernels.choices import (
    begin_choice,
    clear_taken,
    consider_again,
    decide,
    decide_alone,
    mark_taken,
    mask_of,
)
from slam_backend._kernels.innovations import evaluate, innovate
from slam_backend._kernels.layout import FARTHEST, LANES, REJECTED
from slam_backend._kernels.likelihoods import add_likelihood
from slam_backend._kernels.places import tile_of
from slam_backend._kernels.pose_system import clear_sums, sum_matches
from slam_backend.errors import FloatArray, Int32Array, IntArray


@device
@lanes
def match_again(
    work: FloatArray, records: FloatArray, match: FloatArray, mask: FloatArray, values: FloatArray, counts: Int32Array,
    row_of: IntArray, block: int, points: FloatArray, noises: FloatArray, given: bool, camera: FloatArray,
    starts: IntArray, slots: IntArray, looks: FloatArray, owners: IntArray, same: IntArray, named: bool,
    position_gate: float, dead_zone: float, dead_radius: float, ambiguity: float, log_p0: float, one_to_one: bool,
) -> None:  # fmt: skip
    """Pass B for one block: decide on all measurements, and sum what they say of the pose and of its likelihood."""
    padded, first = counts.shape[1], block * LANES
    reach, cap = (FARTHEST, position_gate) if named else (position_gate, FARTHEST)
    clear_sums(work)
    for b in range(len(starts) - 1):
        low, high = starts[b], starts[b + 1]
        log_clutter = log_p0 + (0.0 if given else 4.0 * math.log(points[b, 0]))
        if high - low == 1:
            row = row_of[slots[low]]
            tile = values[tile_of(padded, row, block)]
            _mark_all_taken(work, match, owners, same, low, one_to_one)
            innovate(work, tile, points, noises, b, given, camera)
            decide_alone(
                work, tile, counts[row, first : first + LANES], match[b], float(low), reach,
                FARTHEST if named else dead_zone, dead_radius, log_clutter,
            )  # fmt: skip
            continue
        begin_choice(work)
        for q in range(low, high):
            _mark_all_taken(work, match, owners, same, q, one_to_one)
            tile = values[tile_of(padded, row_of[slots[q]], block)]
            innovate(work, tile, points, noises, b, given, camera)
            evaluate(work, tile, records[q], True)
            consider_again(work, records[q], float(q), looks[q], cap, position_gate, dead_zone, dead_radius)
        decide(work, match[b], ambiguity, log_clutter)
        for q in range(low, high):
            if mask_of(match[b], float(q), mask) > 0:
                sum_matches(work, records[q], mask)
                add_likelihood(work, records[q], mask)


@device
@lanes
def _mark_all_taken(
    work: FloatArray, match: FloatArray, owners: IntArray, same: IntArray, q: int, one_to_one: bool
) -> None:
    """Write row TAKEN: where an earlier measurement has taken the landmark that is candidate q."""
    clear_taken(work)
    p = same[q] if one_to_one else REJECTED
    while p >= 0:
        mark_taken(work, match[owners[p]], float(p))
        p = same[p]
