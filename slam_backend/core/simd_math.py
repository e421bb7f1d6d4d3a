"""Arithmetic of one lane, for loops over lanes."""

import math

from slam_backend.core.jit import bits_float, float_bits, simd_inline
from slam_backend.core.validation import FloatArray

LN2 = math.log(2.0)
HALF_PI_HIGH = 1.5707963267341256  # pi / 2 in two parts: the first has 33 bits, so that small multiples are exact
HALF_PI_LOW = 6.077100506506192e-11
# Number of terms that a sum adds in parallel. It is fixed, as with the width of the processor's vector registers the
# last bits would differ between processors.
WIDE, NARROW = 32, 8
ROUND = 6755399441055744.0  # 1.5 * 2^52: adding and subtracting it rounds to the nearest integer


Symmetric = tuple[float, float, float, float, float, float]  # upper triangle of a 3 x 3 matrix, by rows


@simd_inline
def inverted(matrix: Symmetric) -> tuple[Symmetric, float]:
    """Return the inverse of a symmetric matrix, by cofactors, and its determinant."""
    a, b, c, d, e, f = matrix
    p = d * f - e * e
    q = c * e - b * f
    r = b * e - c * d
    det = a * p + b * q + c * r
    g = 1.0 / det
    return (p * g, q * g, r * g, (a * f - c * c) * g, (b * c - a * e) * g, (a * d - b * b) * g), det


@simd_inline
def inverted_by_parts(matrix: Symmetric) -> tuple[Symmetric, float]:
    """Return the inverse of a positive definite matrix, by L D L^T, and its determinant: the inverse stays definite.

    Errors grow with the ratio of the extreme eigenvalues, those of `inverted` with its square.
    """
    a, b, c, d, e, f = matrix
    per_a = 1.0 / a
    m10, m20 = b * per_a, c * per_a
    d1, n = d - m10 * b, e - m10 * c
    per_d1 = 1.0 / d1
    m21 = n * per_d1
    d2 = f - m20 * c - m21 * n
    per_d2, k = 1.0 / d2, m10 * m21 - m20
    inverse = (
        per_a + m10 * m10 * per_d1 + k * k * per_d2, -m10 * per_d1 - k * m21 * per_d2, k * per_d2,
        per_d1 + m21 * m21 * per_d2, -m21 * per_d2, per_d2,
    )  # fmt: skip
    return inverse, a * d1 * d2


@simd_inline
def quadratic_form(matrix: Symmetric, x: float, y: float, z: float) -> float:
    """Return the quadratic form of (x, y, z)."""
    m00, m01, m02, m11, m12, m22 = matrix
    return m00 * x * x + m11 * y * y + m22 * z * z + 2.0 * (m01 * x * y + m02 * x * z + m12 * y * z)


@simd_inline
def sine_cosine(angle: float) -> tuple[float, float]:
    """Return sine and cosine within two units in the last place, for up to some thousand turns, without a branch.

    The angle is reduced to [-pi/4, pi/4]; Taylor series follow.
    """
    quarter = (angle * (2.0 / math.pi) + ROUND) - ROUND
    x = (angle - quarter * HALF_PI_HIGH) - quarter * HALF_PI_LOW
    z = x * x
    s = -1.0 / 1307674368000.0
    s = s * z + 1.0 / 6227020800.0
    s = s * z - 1.0 / 39916800.0
    s = s * z + 1.0 / 362880.0
    s = s * z - 1.0 / 5040.0
    s = s * z + 1.0 / 120.0
    s = s * z - 1.0 / 6.0
    s = x + x * z * s
    c = 1.0 / 20922789888000.0
    c = c * z - 1.0 / 87178291200.0
    c = c * z + 1.0 / 479001600.0
    c = c * z - 1.0 / 3628800.0
    c = c * z + 1.0 / 40320.0
    c = c * z - 1.0 / 720.0
    c = c * z + 1.0 / 24.0
    c = c * z - 0.5
    c = 1.0 + z * c
    turn = quarter - 4.0 * math.floor(0.25 * quarter)  # 0, 1, 2 or 3
    odd = turn == 1.0 or turn == 3.0
    sine = c if odd else s
    cosine = s if odd else c
    sine = -sine if turn >= 2.0 else sine
    cosine = -cosine if turn == 1.0 or turn == 2.0 else cosine
    return sine, cosine


@simd_inline
def log_of(x: float) -> float:
    """Return the natural logarithm of a positive normal number, without a branch, by x = 2^e m and the atanh series."""
    bits = float_bits(x)
    exponent = float((bits >> 52) - 1023)
    m = bits_float((bits & 0x000FFFFFFFFFFFFF) | 0x3FF0000000000000)
    big = m > 1.4142135623730951
    m = 0.5 * m if big else m
    exponent = exponent + 1.0 if big else exponent
    f = (m - 1.0) / (m + 1.0)
    z = f * f
    s = 1.0 / 21.0
    s = s * z + 1.0 / 19.0
    s = s * z + 1.0 / 17.0
    s = s * z + 1.0 / 15.0
    s = s * z + 1.0 / 13.0
    s = s * z + 1.0 / 11.0
    s = s * z + 1.0 / 9.0
    s = s * z + 1.0 / 7.0
    s = s * z + 0.2
    s = s * z + 1.0 / 3.0
    return exponent * LN2 + 2.0 * (f + f * z * s)


@simd_inline
def mantissa_exponent(x: float) -> tuple[float, float]:
    """Return mantissa in [1, 2) and exponent of a positive normal number, so that long products never overflow."""
    bits = float_bits(x)
    return bits_float((bits & 0x000FFFFFFFFFFFFF) | 0x3FF0000000000000), float((bits >> 52) - 1023)


@simd_inline
def wrapped(angle: float) -> float:
    """Return the angle in [-pi, pi)."""
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))


@simd_inline
def added_up(sums: FloatArray) -> float:
    """Return the pairwise sum of `WIDE` numbers; the first `NARROW` of them are overwritten."""
    for i in range(NARROW):
        sums[i] = (sums[i] + sums[i + NARROW]) + (sums[i + 2 * NARROW] + sums[i + 3 * NARROW])
    return added_up_narrow(sums)


@simd_inline
def added_up_narrow(sums: FloatArray) -> float:
    """Return the pairwise sum of the first `NARROW` numbers."""
    even = (sums[0] + sums[4]) + (sums[2] + sums[6])
    odd = (sums[1] + sums[5]) + (sums[3] + sums[7])
    total: float = even + odd
    return total
