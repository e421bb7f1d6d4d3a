"""The compiled inner loops of a merge: the motion between the maps of two particles, for many pairs of them at once.

Pairs are taken in blocks of `WIDTH`, of which all that is read lies together: one record of `RECORD` rows per landmark,
each row one number of each pair. Loops over a row are plain arithmetic, which the compiler turns into vector
instructions. What `merging` says of chi^2 and tau^2 holds here; the plain form of it all stands in the tests.
"""

import math

import numpy as np

from slam_backend.core.jit import device, in_place, jit, simd
from slam_backend.core.validation import BoolArray, FloatArray, IntArray

WIDTH = 16  # pairs in a block
MIN_PAIRS = 3  # landmarks; fewer in a particle do not fix a motion better than the consensus does
RECORD = 19  # rows of a landmark: x, y, z, Sxx, Sxy, Sxz, Syy, Syz, Szz of a, the same of b, 1 where both hold it
HELD = 18 * WIDTH
# Rows of a block's state: its motions and tau^2, then sums over landmarks.
X, Y, COS, SIN, EXTRA = (WIDTH * k for k in range(5))
N00, N01, N02, N11, N12, N22, G0, G1, G2 = (WIDTH * k for k in range(5, 14))  # of Gauss and Newton
CHI2, SLOPE, DET = (WIDTH * k for k in range(14, 17))  # chi^2, how fast it falls with tau^2; |S| of the last landmark
STATE = 17
LOG_2PI = math.log(2.0 * math.pi)


@device
@simd
def _add(record: FloatArray, state: FloatArray) -> None:
    """Add a landmark to the sums of all pairs of a block.

    Indices that begin with the first lane are known not to be negative, so that the loop becomes vector instructions.
    """
    for i in range(WIDTH):
        c, s = state[COS + i], state[SIN + i]
        bx, by = record[9 * WIDTH + i], record[10 * WIDTH + i]
        bxx, bxy, bxz = record[12 * WIDTH + i], record[13 * WIDTH + i], record[14 * WIDTH + i]
        byy, byz, bzz = record[15 * WIDTH + i], record[16 * WIDTH + i], record[17 * WIDTH + i]
        held, extra = record[HELD + i], state[EXTRA + i]
        ux, uy = c * bx - s * by, s * bx + c * by
        rx = record[i] - ux - state[X + i]
        ry = record[WIDTH + i] - uy - state[Y + i]
        rz = record[2 * WIDTH + i] - record[11 * WIDTH + i]
        sxx = record[3 * WIDTH + i] + c * c * bxx - 2.0 * c * s * bxy + s * s * byy + extra  # Eq. 16 *
        sxy = record[4 * WIDTH + i] + c * s * (bxx - byy) + (c * c - s * s) * bxy
        sxz = record[5 * WIDTH + i] + c * bxz - s * byz
        syy = record[6 * WIDTH + i] + s * s * bxx + 2.0 * c * s * bxy + c * c * byy + extra
        syz = record[7 * WIDTH + i] + s * bxz + c * byz
        szz = record[8 * WIDTH + i] + bzz + extra
        wxx, wxy, wxz = syy * szz - syz * syz, sxz * syz - sxy * szz, sxy * syz - sxz * syy
        det = sxx * wxx + sxy * wxy + sxz * wxz
        scale = held / det
        wxx, wxy, wxz = scale * wxx, scale * wxy, scale * wxz
        wyy, wyz = scale * (sxx * szz - sxz * sxz), scale * (sxy * sxz - sxx * syz)
        wzz = scale * (sxx * syy - sxy * sxy)
        vx, vy, vz = wxx * rx + wxy * ry + wxz * rz, wxy * rx + wyy * ry + wyz * rz, wxz * rx + wyz * ry + wzz * rz
        tx, ty = wxy * ux - wxx * uy, wyy * ux - wxy * uy  # S^-1 times dR/dtheta p_b = (-uy, ux)
        state[N00 + i] += wxx
        state[N01 + i] += wxy
        state[N02 + i] += tx
        state[N11 + i] += wyy
        state[N12 + i] += ty
        state[N22 + i] += ux * ty - uy * tx
        state[G0 + i] += vx
        state[G1 + i] += vy
        state[G2 + i] += ux * vy - uy * vx
        state[CHI2 + i] += vx * rx + vy * ry + vz * rz
        state[SLOPE + i] += vx * vx + vy * vy + vz * vz
        state[DET + i] = det


@device
@in_place
def _gather(
    landmarks_a: FloatArray, held_a: BoolArray, landmarks_b: FloatArray, held_b: BoolArray, from_a: IntArray,
    from_b: IntArray, first: int, records: FloatArray, shared: IntArray,
) -> None:  # fmt: skip
    """Write the records of the block of pairs that begins with `first`, and how many landmarks each pair shares.

    A block that lacks pairs is filled up with the last one.
    """
    last = len(from_a) - 1
    shared[first : first + WIDTH] = 0
    for k in range(landmarks_a.shape[1]):
        record = records[k * RECORD * WIDTH : (k + 1) * RECORD * WIDTH]
        for p in range(WIDTH):
            pair = min(first + p, last)
            m, n = from_a[pair], from_b[pair]
            one, two, both = landmarks_a[m, k], landmarks_b[n, k], held_a[m, k] and held_b[n, k]
            if first + p <= last:
                shared[pair] += both
            record[HELD + p] = 1.0 if both else 0.0
            for c in range(9):
                record[c * WIDTH + p] = one[c] if both else (1.0 if c == 3 or c == 6 or c == 8 else 0.0)
                record[(9 + c) * WIDTH + p] = two[c] if both else 0.0


@device
@in_place
def _sum(records: FloatArray, motions: FloatArray, first: int, state: FloatArray, log_dets: FloatArray) -> None:
    """Sum over all landmarks of a block at its motions; add the logs of |2 pi S| where `log_dets` has rows."""
    for p in range(WIDTH):
        motion = motions[min(first + p, len(motions) - 1)]
        state[X + p], state[Y + p] = motion[0], motion[1]
        state[COS + p], state[SIN + p] = math.cos(motion[2]), math.sin(motion[2])
    state[N00:] = 0.0
    for at in range(0, len(records), RECORD * WIDTH):
        _add(records[at : at + RECORD * WIDTH], state)
        if len(log_dets):
            for p in range(WIDTH):
                if records[at + HELD + p] > 0.0 and first + p < len(log_dets):
                    log_dets[first + p] += math.log(state[DET + p]) + 3.0 * LOG_2PI


@device
@in_place
def _step(state: FloatArray, first: int, shared: IntArray, motions: FloatArray) -> None:
    """Do a Gauss-Newton step with the pairs of a block that share enough landmarks."""
    for p in range(min(WIDTH, len(motions) - first)):
        xx, xy, yy, xt, yt = state[N00 + p], state[N01 + p], state[N11 + p], state[N02 + p], state[N12 + p]
        det = xx * yy - xy * xy
        if shared[first + p] >= MIN_PAIRS and det > 0.0:
            ux, uy = (yy * xt - xy * yt) / det, (xx * yt - xy * xt) / det  # the translation is eliminated first
            vx, vy = (yy * state[G0 + p] - xy * state[G1 + p]) / det, (xx * state[G1 + p] - xy * state[G0 + p]) / det
            rest = state[N22 + p] - xt * ux - yt * uy
            turn = (state[G2 + p] - xt * vx - yt * vy) / rest if rest > 1e-12 * state[N22 + p] else 0.0
            motion = motions[first + p]
            motion[0], motion[1], motion[2] = motion[0] + vx - ux * turn, motion[1] + vy - uy * turn, motion[2] + turn


@jit
def fit(
    landmarks_a: FloatArray, held_a: BoolArray, landmarks_b: FloatArray, held_b: BoolArray,
    from_a: IntArray, from_b: IntArray, start: FloatArray, extra: float, iterations: int,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, IntArray]:  # fmt: skip
    """Fit the motions of pairs of particles to the landmarks that both of each hold.

    Args:
        landmarks_a, landmarks_b: (M_a, k, 9), (M_b, k, 9) shared landmarks of both filters, in the same order.
        held_a, held_b: (M_a, k), (M_b, k) whether each particle has them.
        from_a, from_b: (c,) particles of each pair.
        start: (3,) motion from which all begin.
        extra: tau^2, added to the variances of all differences [m^2].
        iterations: Number of Gauss-Newton steps.

    Returns:
        Motions (c, 3), information matrices (c, 3, 3), chi^2 (c,), sums of log|2 pi S| (c,), and how many landmarks
        both particles of a pair hold (c,).
    """
    count = len(from_a)
    motions, information = np.empty((count, 3)), np.empty((count, 3, 3))
    chi2, log_dets, shared = np.empty(count), np.zeros(count), np.empty(count, np.int64)
    records, state = np.empty(landmarks_a.shape[1] * RECORD * WIDTH), np.empty(STATE * WIDTH)
    motions[:] = start
    state[EXTRA : EXTRA + WIDTH] = extra
    for first in range(0, count, WIDTH):
        _gather(landmarks_a, held_a, landmarks_b, held_b, from_a, from_b, first, records, shared)
        for _ in range(iterations):
            _sum(records, motions, first, state, log_dets[:0])
            _step(state, first, shared, motions)
        _sum(records, motions, first, state, log_dets)
        for p in range(min(WIDTH, count - first)):
            h, pair = information[first + p], first + p
            h[0, 0], h[1, 1], h[2, 2] = state[N00 + p], state[N11 + p], state[N22 + p]
            h[0, 1], h[0, 2], h[1, 2] = state[N01 + p], state[N02 + p], state[N12 + p]
            h[1, 0], h[2, 0], h[2, 1] = h[0, 1], h[0, 2], h[1, 2]
            chi2[pair] = state[CHI2 + p]
    return motions, information, chi2, log_dets, shared


@jit
def reduced_chi2(
    landmarks_a: FloatArray, held_a: BoolArray, landmarks_b: FloatArray, held_b: BoolArray,
    from_a: IntArray, from_b: IntArray, start: FloatArray, rounds: int,
) -> tuple[FloatArray, IntArray]:  # fmt: skip
    """Seek tau^2 (c,) [m^2] of each pair of particles for which chi^2 is its degrees of freedom, at least 0.

    By Newton's method on the latter over the former, which is concave in tau^2: it rises to the root and not beyond.

    The arguments are those of `fit`.

    Returns:
        tau^2, and how many landmarks both particles of a pair hold (c,).
    """
    count = len(from_a)
    extra, shared, motions = np.zeros(count), np.empty(count, np.int64), np.empty((count, 3))
    records, state = np.empty(landmarks_a.shape[1] * RECORD * WIDTH), np.empty(STATE * WIDTH)
    motions[:] = start
    for first in range(0, count, WIDTH):
        _gather(landmarks_a, held_a, landmarks_b, held_b, from_a, from_b, first, records, shared)
        state[EXTRA : EXTRA + WIDTH] = 0.0
        for _ in range(rounds):
            _sum(records, motions, first, state, extra[:0])
            _step(state, first, shared, motions)
            _sum(records, motions, first, state, extra[:0])
            for p in range(min(WIDTH, count - first)):
                chi2, freedom = state[CHI2 + p], max(3.0 * shared[first + p] - 3.0, 1.0)
                beyond = chi2 * (chi2 - freedom) / max(freedom * state[SLOPE + p], 1e-300)
                state[EXTRA + p] = extra[first + p] = max(state[EXTRA + p] + beyond, 0.0)
    return extra, shared
