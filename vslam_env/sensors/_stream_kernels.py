"""Uniform keys of the landmarks in view: the values that a PCG64 stream gives when it draws a key for every landmark.

PCG64 steps s -> a s + c modulo 2^128, and gives a permutation (XSL-RR) of each state (O'Neill 2014, "PCG: A family of
simple fast space-efficient statistically good algorithms for random number generation"). Any number of steps is such a
map as well, composed of those of 1, 2, 4, ... steps (Brown 1994, "Random number generation with arbitrary strides").
A number of 128 bits is four limbs of 32 bits in uint64, the lowest first, so that no product overflows.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.jit import inline, jit
from slam_backend.core.validation import FloatArray
from vslam_env.world._kernels import rows_in_view

UInt64Array = NDArray[np.uint64]
Limbs = tuple[np.uint64, np.uint64, np.uint64, np.uint64]
NUM_LIMBS = 4
ZERO, LIMB_MASK, LIMB_BITS = np.uint64(0), np.uint64(0xFFFFFFFF), np.uint64(32)
ROTATION_SHIFT, MANTISSA_SHIFT, WORD_BITS, ROTATION_MASK = np.uint64(26), np.uint64(11), np.uint64(64), np.uint64(63)
UNIT = 2.0**-53  # a float64 has 53 bits: the lowest 11 of 64 are unused


def limbs(number: int) -> UInt64Array:
    """Return the limbs (4,) of a number of 128 bits."""
    return np.array([number >> 32 * k & 0xFFFFFFFF for k in range(NUM_LIMBS)], np.uint64)


MULTIPLIER: Limbs = tuple(limbs(0x2360ED051FC65DA44385DF649FCCF645))  # a of numpy's PCG64


@inline
def _multiply_add(a: Limbs, b: Limbs, c: Limbs) -> Limbs:
    """Return a b + c modulo 2^128."""
    a0, a1, a2, a3 = a
    b0, b1, b2, b3 = b
    p00, p01, p10, p02, p11, p20 = a0 * b0, a0 * b1, a1 * b0, a0 * b2, a1 * b1, a2 * b0
    r0 = c[0] + (p00 & LIMB_MASK)
    r1 = c[1] + (p01 & LIMB_MASK) + (p10 & LIMB_MASK) + (p00 >> LIMB_BITS) + (r0 >> LIMB_BITS)
    r2 = (
        c[2]
        + (p02 & LIMB_MASK)
        + (p11 & LIMB_MASK)
        + (p20 & LIMB_MASK)
        + (p01 >> LIMB_BITS)
        + (p10 >> LIMB_BITS)
        + (r1 >> LIMB_BITS)
    )
    r3 = c[3] + ((a0 * b3) & LIMB_MASK) + ((a1 * b2) & LIMB_MASK) + ((a2 * b1) & LIMB_MASK) + ((a3 * b0) & LIMB_MASK)
    r3 += (p02 >> LIMB_BITS) + (p11 >> LIMB_BITS) + (p20 >> LIMB_BITS) + (r2 >> LIMB_BITS)
    return r0 & LIMB_MASK, r1 & LIMB_MASK, r2 & LIMB_MASK, r3 & LIMB_MASK


@inline
def _uniform(state: Limbs) -> float:
    """Return the number in [0, 1) that `numpy.random.Generator.random` makes of a state."""
    mixed = ((state[3] << LIMB_BITS) | state[2]) ^ ((state[1] << LIMB_BITS) | state[0])
    rotation = state[3] >> ROTATION_SHIFT
    mixed = (mixed >> rotation) | (mixed << ((WORD_BITS - rotation) & ROTATION_MASK))
    return np.float64(mixed >> MANTISSA_SHIFT) * UNIT


@jit
def draw_keys_in_view(
    poses: FloatArray, sight: tuple[Any, ...], increment: UInt64Array, state: UInt64Array, keys: FloatArray
) -> None:
    """Write the keys of the landmarks in view of each camera, ignoring occlusion.

    Args:
        poses: (K, 3) float64 [m, m, rad], world frame. Robots.
        sight: Landmarks and limits of view, see `detect`.
        increment, state: (4,) limbs of c and s of the stream.
        keys: (K, N) float64. Output, in these places: the numbers that all landmarks' keys, drawn robot by robot, have
            there.
    """
    marks, bounds, _, _, _, limits = sight
    forward, aside, num_landmarks = limits[0], limits[1], keys.shape[1]
    bits = 1
    while keys.size >> bits > 0:
        bits += 1
    factors, summands = np.empty((bits, NUM_LIMBS), np.uint64), np.empty((bits, NUM_LIMBS), np.uint64)  # of 2^j steps
    factor = MULTIPLIER
    summand = increment[0], increment[1], increment[2], increment[3]
    for j in range(bits):
        factors[j, 0], factors[j, 1], factors[j, 2], factors[j, 3] = factor
        summands[j, 0], summands[j, 1], summands[j, 2], summands[j, 3] = summand
        summand = _multiply_add(factor, summand, summand)
        factor = _multiply_add(factor, factor, (ZERO, ZERO, ZERO, ZERO))
    now, taken = (state[0], state[1], state[2], state[3]), 0
    rows = np.empty(num_landmarks, np.int64)
    for k in range(len(poses)):
        c, s = np.cos(poses[k, 2]), np.sin(poses[k, 2])
        x, y = poses[k, 0] + c * forward - s * aside, poses[k, 1] + s * forward + c * aside
        for i in range(rows_in_view(x, y, c, s, marks, bounds, limits, rows)):
            steps = k * num_landmarks + rows[i] + 1 - taken  # a state steps before it gives a number
            taken += steps
            j = 0
            while steps > 0:
                if steps & 1:
                    factor = factors[j, 0], factors[j, 1], factors[j, 2], factors[j, 3]
                    summand = summands[j, 0], summands[j, 1], summands[j, 2], summands[j, 3]
                    now = _multiply_add(factor, now, summand)
                steps >>= 1
                j += 1
            keys[k, rows[i]] = _uniform(now)
