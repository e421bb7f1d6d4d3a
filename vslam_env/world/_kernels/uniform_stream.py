"""Single numbers of a stream of uniform draws, without drawing those before them.

The state of numpy's PCG64 is a number s of 128 bits, and a draw replaces it with a s + c. After n draws it is
a^n s + (1 + a + ... + a^(n-1)) c; both factors, which depend on n alone, are tabulated. A number of 128 bits is kept
as two of 64, the higher one first.
"""

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.jit import device, in_place, inline
from slam_backend.core.read_only import as_read_only
from slam_backend.core.validation import FloatArray, IntArray

UInt64Array = NDArray[np.uint64]
MULTIPLIER = 0x2360ED051FC65DA44385DF649FCCF645  # a
HALF_BITS, HALF = np.uint64(32), np.uint64(0xFFFFFFFF)
TURNED_BY, BITS, LAST = np.uint64(58), np.uint64(64), np.uint64(63)
UNUSED_BITS, UNIT = np.uint64(11), 2.0**-53  # of a draw from [0, 1)
NO_STREAM = np.zeros(4, np.uint64), as_read_only(np.empty((0, 4), np.uint64))


def _halves(number: int) -> tuple[int, int]:
    """Return the upper and lower 64 bits of a number, modulo 2^128."""
    return number >> 64 & 2**64 - 1, number & 2**64 - 1


def jump_table(count: int) -> UInt64Array:
    """Return the two factors of n (count, 4), for n from 1; read-only."""
    table, power, total = np.empty((count, 4), np.uint64), 1, 0
    for row in table:
        power, total = power * MULTIPLIER % 2**128, (total * MULTIPLIER + 1) % 2**128
        row[:2], row[2:] = _halves(power), _halves(total)
    return as_read_only(table)


def stream_state(generator: np.random.PCG64) -> UInt64Array:
    """Return s and c (4,) of a generator."""
    numbers = generator.state["state"]
    return np.array([*_halves(numbers["state"]), *_halves(numbers["inc"])], np.uint64)


@inline
def _product(a_high: np.uint64, a_low: np.uint64, b_high: np.uint64, b_low: np.uint64) -> tuple[np.uint64, np.uint64]:
    """Return the product of two numbers, modulo 2^128."""
    a1, a0, b1, b0 = a_low >> HALF_BITS, a_low & HALF, b_low >> HALF_BITS, b_low & HALF
    low, cross = a0 * b0, a1 * b0
    middle = (low >> HALF_BITS) + (cross & HALF) + a0 * b1
    high = a1 * b1 + (cross >> HALF_BITS) + (middle >> HALF_BITS)
    return high + a_high * b_low + a_low * b_high, a_low * b_low


@inline
def _after(stream: UInt64Array, factors: UInt64Array) -> tuple[np.uint64, np.uint64]:
    """Return the state s of a stream (4,) after the draws of a row of `jump_table`."""
    s_high, s_low = _product(stream[0], stream[1], factors[0], factors[1])
    c_high, c_low = _product(stream[2], stream[3], factors[2], factors[3])
    low = s_low + c_low
    return s_high + c_high + (np.uint64(1) if low < s_low else np.uint64(0)), low


@device
@in_place
def jump(stream: UInt64Array, factors: UInt64Array) -> None:
    """Make the draws of a row of `jump_table`."""
    stream[0], stream[1] = _after(stream, factors)


@device
@in_place
def uniform_at(stream: UInt64Array, jumps: UInt64Array, places: IntArray, draws: FloatArray) -> None:
    """Write the uniform draws in [0, 1) at places (m,) of a stream, counted from 0, into the first m of `draws`."""
    for i in range(len(places)):
        high, low = _after(stream, jumps[places[i]])
        bits, turn = high ^ low, high >> TURNED_BY
        turned = (bits >> turn) | (bits << ((BITS - turn) & LAST))
        draws[i] = np.float64(turned >> UNUSED_BITS) * UNIT
