"""Lost particles: counted where measurements contradict the pose, tried with a wide prior, acquitted."""

import numpy as np

from slam_backend._jit import device, lanes
from slam_backend._kernels.layout import (
    BEST,
    C00,
    C01,
    C10,
    C11,
    C20,
    C21,
    C22,
    CHOSEN,
    CONTRADICT,
    COS,
    KEPT00,
    KEPT01,
    KEPT10,
    KEPT11,
    KEPT20,
    KEPT21,
    KEPT22,
    KEPT_WIDE,
    LANES,
    LOST,
    Q_D,
    Q_FIRST_D,
    Q_HELD,
    SECOND,
    SIN,
    SURE,
    WIDE,
)
from slam_backend.errors import FloatArray

MIN_CONTRADICTIONS = 3.0  # three points fix a pose with one to spare


@device
@lanes
def begin_judging(work: FloatArray) -> None:
    for i in range(LANES):
        work[SURE + i] = 0.0
        work[CONTRADICT + i] = 0.0


@device
@lanes
def nearest(work: FloatArray, record: FloatArray, begin: bool) -> None:
    """Fold candidate after candidate: BEST = least D at hand of those held, SECOND = least of the D kept before."""
    for i in range(LANES):
        held = record[Q_HELD + i] > 0.0
        now, before = record[Q_D + i] if held else np.inf, record[Q_FIRST_D + i] if held else np.inf
        work[BEST + i] = now if begin or now < work[BEST + i] else work[BEST + i]
        work[SECOND + i] = before if begin or before < work[SECOND + i] else work[SECOND + i]
        work[CHOSEN + i] = 1.0 if held else (0.0 if begin else work[CHOSEN + i])


@device
@lanes
def count_unexplained(work: FloatArray, gate: float) -> None:
    """Count a measurement that has candidates, none of which explains it at the predicted pose."""
    for i in range(LANES):
        work[CONTRADICT + i] += 1.0 if work[CHOSEN + i] > 0.0 and not work[BEST + i] <= gate else 0.0


@device
@lanes
def count_explained(work: FloatArray, gate: float) -> None:
    """Count a measurement that the wide prior explains, and whether the narrow one did not."""
    for i in range(LANES):
        sure = work[BEST + i] <= gate
        work[SURE + i] += 1.0 if sure else 0.0
        work[CONTRADICT + i] += 1.0 if sure and not work[SECOND + i] <= gate else 0.0


@device
@lanes
def any_suspect(work: FloatArray) -> int:
    """Return in how many lanes enough is unexplained."""
    count = 0
    for i in range(LANES):
        count += 1 if work[CONTRADICT + i] >= MIN_CONTRADICTIONS else 0
    return count


@device
@lanes
def widen_suspects(work: FloatArray, recovery: FloatArray) -> None:
    """Keep the factor C, and where enough is unexplained try T diag(recovery), T the turn by the predicted heading."""
    for i in range(LANES):
        work[KEPT00 + i], work[KEPT01 + i] = work[C00 + i], work[C01 + i]
        work[KEPT10 + i], work[KEPT11 + i] = work[C10 + i], work[C11 + i]
        work[KEPT20 + i], work[KEPT21 + i], work[KEPT22 + i] = work[C20 + i], work[C21 + i], work[C22 + i]
        work[KEPT_WIDE + i] = work[WIDE + i]
        suspect = work[CONTRADICT + i] >= MIN_CONTRADICTIONS
        c, s = work[COS + i], work[SIN + i]
        work[LOST + i] = 1.0 if suspect else 0.0
        work[WIDE + i] = 1.0 if suspect else work[WIDE + i]
        work[C00 + i] = c * recovery[0] if suspect else work[C00 + i]
        work[C01 + i] = -s * recovery[1] if suspect else work[C01 + i]
        work[C10 + i] = s * recovery[0] if suspect else work[C10 + i]
        work[C11 + i] = c * recovery[1] if suspect else work[C11 + i]
        work[C20 + i] = 0.0 if suspect else work[C20 + i]
        work[C21 + i] = 0.0 if suspect else work[C21 + i]
        work[C22 + i] = recovery[2] if suspect else work[C22 + i]


@device
@lanes
def acquit(work: FloatArray) -> int:
    """Give the kept factor back to suspects that are not lost after all; return how many those are."""
    count = 0
    for i in range(LANES):
        lost = work[CONTRADICT + i] >= MIN_CONTRADICTIONS and 2.0 * work[CONTRADICT + i] > work[SURE + i]
        back = work[LOST + i] > 0.0 and not lost
        work[C00 + i] = work[KEPT00 + i] if back else work[C00 + i]
        work[C01 + i] = work[KEPT01 + i] if back else work[C01 + i]
        work[C10 + i] = work[KEPT10 + i] if back else work[C10 + i]
        work[C11 + i] = work[KEPT11 + i] if back else work[C11 + i]
        work[C20 + i] = work[KEPT20 + i] if back else work[C20 + i]
        work[C21 + i] = work[KEPT21 + i] if back else work[C21 + i]
        work[C22 + i] = work[KEPT22 + i] if back else work[C22 + i]
        work[WIDE + i] = work[KEPT_WIDE + i] if back else work[WIDE + i]
        count += 1 if back else 0
    return count
