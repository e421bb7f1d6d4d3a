"""The log-likelihood of a frame, summed match by match without a logarithm (Eq. 11)."""

from slam_backend._jit import device, lanes, lanes_inlined
from slam_backend._kernels.lane_math import log_of, mantissa_exponent
from slam_backend._kernels.layout import (
    CLUTTER,
    DEPTHS,
    DEPTHS_EXP,
    DET,
    DET_EXP,
    LANES,
    LN2,
    LOG_2PI,
    MATCHED,
    Q_DEPTH,
    Q_DET,
    Q_SQUARE,
    SUM_D,
)
from slam_backend.errors import FloatArray


@lanes_inlined
def count_likelihood(work: FloatArray, i: int, on: bool, square: float, det: float, depth: float) -> None:
    """Where `on`, add a match's part of the log-likelihood: r^T S^-1 r, and |S| and the depth as products."""
    work[SUM_D + i] += square if on else 0.0
    work[MATCHED + i] += 1.0 if on else 0.0
    mantissa, exponent = mantissa_exponent(work[DET + i] * (det if on else 1.0))
    work[DET + i] = mantissa
    work[DET_EXP + i] += exponent
    mantissa, exponent = mantissa_exponent(work[DEPTHS + i] * (depth if on else 1.0))
    work[DEPTHS + i] = mantissa
    work[DEPTHS_EXP + i] += exponent


@device
@lanes
def add_likelihood(work: FloatArray, record: FloatArray, mask: FloatArray) -> None:
    """Add a match's part of the log-likelihood where `mask` is 1."""
    for i in range(LANES):
        count_likelihood(work, i, mask[i] > 0.0, record[Q_SQUARE + i], record[Q_DET + i], record[Q_DEPTH + i])


@device
@lanes
def clear_likelihood(work: FloatArray) -> None:
    for i in range(LANES):
        work[SUM_D + i] = 0.0
        work[MATCHED + i] = 0.0
        work[DET + i] = 1.0
        work[DET_EXP + i] = 0.0
        work[DEPTHS + i] = 1.0
        work[DEPTHS_EXP + i] = 0.0
        work[CLUTTER + i] = 0.0


@lanes_inlined
def total_log_likelihood(work: FloatArray, i: int) -> float:
    """Return a lane's sum over matches of log N(r; 0, S) + 4 log depth (Eq. 11), and that of the unmatched."""
    log_det = log_of(work[DET + i]) + LN2 * work[DET_EXP + i]
    log_depth = log_of(work[DEPTHS + i]) + LN2 * work[DEPTHS_EXP + i]
    matched: float = work[SUM_D + i] + 3.0 * LOG_2PI * work[MATCHED + i] + log_det
    unmatched: float = work[CLUTTER + i]
    total: float = -0.5 * matched + 4.0 * log_depth + unmatched
    return total
