"""What robots did, what they measured and what was made of it is noted, to be written into their logs later."""

from slam_backend._jit import device, in_place
from slam_backend._kernels.layout import (
    ACT,
    ASSOCIATED,
    BEGIN,
    COUNT,
    COVERED,
    DID,
    END,
    GIVEN,
    IDLE,
    LOGGED,
    MOTION,
    NAME,
    THOUGHT,
    USED,
)
from slam_backend.errors import FloatArray, IntArray


@device
@in_place
def note_turns(
    rows: IntArray, turns: IntArray, moves: FloatArray, sightings: FloatArray, told: IntArray, means: FloatArray,
    noted: FloatArray, measured: FloatArray, first: int,
) -> None:  # fmt: skip
    """Note the turns of a step.

    Args:
        rows, turns, moves, sightings: As of `take_turns`.
        told: (2, n) what became of the measurements, as in `Findings`.
        means: (K, 3) [m, m, rad] where the robots are thought to be now.
        noted: (K, 10) of the step, see `layout`; written.
        measured: (>= first + used, 10): sightings, and the landmarks that they were taken for; written from `first` on.
        first: Measurements that were noted before.
    """
    for robot in range(len(rows)):
        row, note = rows[robot], noted[robot]
        note[:] = 0.0
        if row < 0:
            continue
        turn = turns[row]
        note[LOGGED] = 1.0 if turn[ACT] != IDLE or turn[COUNT] > 0 else 0.0
        note[COVERED] = 1.0 if turn[GIVEN] > 0 and turn[COUNT] > 0 else 0.0
        note[DID], note[USED] = turn[ACT], turn[END] - turn[BEGIN]
        for axis in range(3):
            note[MOTION + axis], note[THOUGHT + axis] = moves[row, axis], means[robot, axis]
        for b in range(turn[BEGIN], turn[END]):
            for c in range(NAME if turn[GIVEN] > 0 else 3):
                measured[first, c] = sightings[b, c]
            measured[first, NAME] = told[ASSOCIATED, b]
            first += 1
