"""What few frames need: a wide prior tried where poses are in doubt, and more than one step of Gauss-Newton."""

from slam_backend._jit import device, lanes
from slam_backend._kernels.choices import mark_held, mask_of
from slam_backend._kernels.first_pass import keep_distance
from slam_backend._kernels.innovations import evaluate, innovate
from slam_backend._kernels.layout import LANES
from slam_backend._kernels.places import tile_of
from slam_backend._kernels.pose_system import clear_sums, place, robust_weights, step_pose, sum_matches
from slam_backend._kernels.recovery import acquit, begin_judging, count_explained, nearest, widen_suspects
from slam_backend.errors import FloatArray, Int32Array, IntArray

MORE_STEPS = 3  # a wide prior is a long way for one iteration


@device
@lanes
def try_wide_prior(
    work: FloatArray, records: FloatArray, values: FloatArray, counts: Int32Array, row_of: IntArray, block: int,
    points: FloatArray, noises: FloatArray, given: bool, camera: FloatArray, starts: IntArray, slots: IntArray,
    same: IntArray, position_gate: float, one_to_one: bool, recovery: FloatArray,
) -> None:  # fmt: skip
    """Give suspects of one block a wide prior, and keep it where it explains what the stated uncertainty does not."""
    padded, first = counts.shape[1], block * LANES
    widen_suspects(work, recovery)
    begin_judging(work)
    for b in range(len(starts) - 1):
        for q in range(starts[b], starts[b + 1]):
            row = row_of[slots[q]]
            tile = values[tile_of(padded, row, block)]
            if starts[b + 1] - starts[b] > 1 or not (same[q] < 0 or not one_to_one):
                keep_distance(records[q])
            mark_held(records[q], counts[row, first : first + LANES])
            innovate(work, tile, points, noises, b, given, camera)
            evaluate(work, tile, records[q], False)
            nearest(work, records[q], q == starts[b])
        if starts[b] < starts[b + 1]:
            count_explained(work, position_gate)
    acquit(work)


@device
@lanes
def refine_wide(
    work: FloatArray, records: FloatArray, match: FloatArray, mask: FloatArray, values: FloatArray, counts: Int32Array,
    row_of: IntArray, block: int, points: FloatArray, noises: FloatArray, given: bool, camera: FloatArray,
    starts: IntArray, slots: IntArray, position_gate: float,
) -> None:  # fmt: skip
    """Take more steps of Gauss-Newton in the lanes of one block whose prior is wide, with the matches as they are."""
    padded = counts.shape[1]
    for _ in range(MORE_STEPS):
        place(work)
        clear_sums(work)
        for b in range(len(starts) - 1):
            for q in range(starts[b], starts[b + 1]):
                if mask_of(match[b], float(q), mask) > 0:
                    tile = values[tile_of(padded, row_of[slots[q]], block)]
                    innovate(work, tile, points, noises, b, given, camera)
                    evaluate(work, tile, records[q], True)
                    robust_weights(records[q], match[b], float(q), position_gate, mask)
                    sum_matches(work, records[q], mask)
        step_pose(work, True)
