"""The landmarks' own EKFs at a known pose, for all lanes of a block (Eqs. 5-10; Algorithm 1, l. 30-37).

`tests/slam_backend/fastslam/test_filter_known_path.py` compares them with textbook EKFs.
"""

import numpy as np

from slam_backend.core.jit import device, simd, simd_inline, stack_array
from slam_backend.core.simd_math import Symmetric, inverted, inverted_by_parts, quadratic_form
from slam_backend.core.validation import FloatArray, Int32Array, IntArray
from slam_backend.fastslam._kernels import layout as L
from slam_backend.fastslam._kernels.association.candidates import mask_of
from slam_backend.fastslam._kernels.layout import LANES, TILE
from slam_backend.fastslam._kernels.measurement.measurement_model import accumulate_likelihood, innovate
from slam_backend.fastslam._kernels.particles.map_storage import tile_of
from slam_backend.fastslam._kernels.records import Candidates, Frame, MapArrays, Space

FLAT = 1e-12  # where cofactors keep less, S has eigenvalues in a ratio of a million, and K R loses its digits
RELINEARISE_UP_TO = 4  # a landmark seen up to so many times is updated by the iterated EKF: its depth is still vague

Matrix = tuple[float, float, float, float, float, float, float, float, float]  # by rows


@simd_inline
def _congruent(m: Matrix, a: Symmetric) -> Symmetric:
    """Return M A M^T of a symmetric A."""
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = m
    a00, a01, a02, a11, a12, a22 = a
    h00, h01, h02 = m00 * a00 + m01 * a01 + m02 * a02, m00 * a01 + m01 * a11 + m02 * a12, (
        m00 * a02 + m01 * a12 + m02 * a22
    )  # fmt: skip
    h10, h11, h12 = m10 * a00 + m11 * a01 + m12 * a02, m10 * a01 + m11 * a11 + m12 * a12, (
        m10 * a02 + m11 * a12 + m12 * a22
    )  # fmt: skip
    h20, h21, h22 = m20 * a00 + m21 * a01 + m22 * a02, m20 * a01 + m21 * a11 + m22 * a12, (
        m20 * a02 + m21 * a12 + m22 * a22
    )  # fmt: skip
    return (
        h00 * m00 + h01 * m01 + h02 * m02, h00 * m10 + h01 * m11 + h02 * m12, h00 * m20 + h01 * m21 + h02 * m22,
        h10 * m10 + h11 * m11 + h12 * m12, h10 * m20 + h11 * m21 + h12 * m22, h20 * m20 + h21 * m21 + h22 * m22,
    )  # fmt: skip


@simd_inline
def _correct_lane(
    work: FloatArray, tile: FloatArray, i: int, inverse: Symmetric, match: bool, walk: float, flat: bool
) -> None:
    """Correct a landmark where `match`, by S^-1 (Eqs. 8-10), and let it walk: Sigma + walk I.

    `flat` (a constant) says that K has lost digits which K R cannot do without: then by Joseph's form.
    """
    i00, i01, i02, i11, i12, i22 = inverse
    p00, p01, p02 = tile[3 * LANES + i], tile[4 * LANES + i], tile[5 * LANES + i]
    p11, p12, p22 = tile[6 * LANES + i], tile[7 * LANES + i], tile[8 * LANES + i]
    n00, n01, n02 = work[L.N00 + i], work[L.N01 + i], work[L.N02 + i]
    n11, n12, n22 = work[L.N11 + i], work[L.N12 + i], work[L.N22 + i]
    rx, ry, rz = work[L.INNOV0 + i], work[L.INNOV1 + i], work[L.INNOV2 + i]
    k00, k01, k02 = p00 * i00 + p01 * i01 + p02 * i02, p00 * i01 + p01 * i11 + p02 * i12, (
        p00 * i02 + p01 * i12 + p02 * i22
    )  # Eq. 8  # fmt: skip
    k10, k11, k12 = p01 * i00 + p11 * i01 + p12 * i02, p01 * i01 + p11 * i11 + p12 * i12, (
        p01 * i02 + p11 * i12 + p12 * i22
    )  # fmt: skip
    k20, k21, k22 = p02 * i00 + p12 * i01 + p22 * i02, p02 * i01 + p12 * i11 + p22 * i12, (
        p02 * i02 + p12 * i12 + p22 * i22
    )  # fmt: skip
    tile[i] += k00 * rx + k01 * ry + k02 * rz if match else 0.0  # Eq. 9
    tile[LANES + i] += k10 * rx + k11 * ry + k12 * rz if match else 0.0
    tile[2 * LANES + i] += k20 * rx + k21 * ry + k22 * rz if match else 0.0
    if flat:
        rest = 1.0 - k00, -k01, -k02, -k10, 1.0 - k11, -k12, -k20, -k21, 1.0 - k22
        gain = k00, k01, k02, k10, k11, k12, k20, k21, k22
        a00, a01, a02, a11, a12, a22 = _congruent(rest, (p00, p01, p02, p11, p12, p22))
        b00, b01, b02, b11, b12, b22 = _congruent(gain, (n00, n01, n02, n11, n12, n22))
        tile[3 * LANES + i] = a00 + b00 + walk if match else p00
        tile[4 * LANES + i] = a01 + b01 if match else p01
        tile[5 * LANES + i] = a02 + b02 if match else p02
        tile[6 * LANES + i] = a11 + b11 + walk if match else p11
        tile[7 * LANES + i] = a12 + b12 if match else p12
        tile[8 * LANES + i] = a22 + b22 + walk if match else p22
        return
    # Eq. 10, (I - K) Sigma, written as K R: no difference of nearly equal numbers, and made symmetric.
    q01 = 0.5 * (k00 * n01 + k01 * n11 + k02 * n12 + k10 * n00 + k11 * n01 + k12 * n02)
    q02 = 0.5 * (k00 * n02 + k01 * n12 + k02 * n22 + k20 * n00 + k21 * n01 + k22 * n02)
    q12 = 0.5 * (k10 * n02 + k11 * n12 + k12 * n22 + k20 * n01 + k21 * n11 + k22 * n12)
    tile[3 * LANES + i] = k00 * n00 + k01 * n01 + k02 * n02 + walk if match else p00
    tile[4 * LANES + i] = q01 if match else p01
    tile[5 * LANES + i] = q02 if match else p02
    tile[6 * LANES + i] = k10 * n01 + k11 * n11 + k12 * n12 + walk if match else p11
    tile[7 * LANES + i] = q12 if match else p12
    tile[8 * LANES + i] = k20 * n02 + k21 * n12 + k22 * n22 + walk if match else p22


@simd_inline
def _sum(work: FloatArray, tile: FloatArray, i: int) -> Symmetric:
    """Return S = Sigma + R (Eq. 7)."""
    return (
        tile[3 * LANES + i] + work[L.N00 + i], tile[4 * LANES + i] + work[L.N01 + i],
        tile[5 * LANES + i] + work[L.N02 + i], tile[6 * LANES + i] + work[L.N11 + i],
        tile[7 * LANES + i] + work[L.N12 + i], tile[8 * LANES + i] + work[L.N22 + i],
    )  # fmt: skip


@device
@simd
def _any_flat(work: FloatArray, tile: FloatArray) -> bool:
    """Tell whether S is so flat and so turned in any lane that the digits of its cofactors are lost.

    The determinant that they give is then much less than the product of the diagonal.
    """
    count = 0
    for i in range(LANES):
        a, b, c, d, e, f = _sum(work, tile, i)
        det = a * (d * f - e * e) + b * (c * e - b * f) + c * (b * e - c * d)
        count += 1 if det < FLAT * a * d * f else 0
    return count > 0


@device
@simd
def correct(work: FloatArray, tile: FloatArray, mask: FloatArray, walk: float) -> None:
    """Correct the landmark at a known pose where `mask` is 1 and it lies ahead of the camera (Eqs. 5-10).

    Args:
        work: Rows of the block.
        tile: Values of the landmark there.
        mask: (LANES,) 1 where it was measured.
        walk: Variance [m^2] by which the landmark may have moved, along each axis, when it is seen the next time.
    """
    if _any_flat(work, tile):
        for i in range(LANES):
            inverse, _ = inverted_by_parts(_sum(work, tile, i))
            _correct_lane(work, tile, i, inverse, mask[i] > 0.0 and work[L.DEPTH + i] >= L.MIN_DEPTH, walk, True)
    else:
        for i in range(LANES):
            inverse, _ = inverted(_sum(work, tile, i))
            _correct_lane(work, tile, i, inverse, mask[i] > 0.0 and work[L.DEPTH + i] >= L.MIN_DEPTH, walk, False)


@simd_inline
def _gate_and_update(
    work: FloatArray, tile: FloatArray, record: FloatArray, chosen: FloatArray, seen: Int32Array, q: float,
    gate: float, walk: float, flat: bool,
) -> None:  # fmt: skip
    """Do what `gate_and_update` does; `flat` is a constant."""
    for i in range(LANES):
        s = _sum(work, tile, i)
        inverse, det = inverted_by_parts(s) if flat else inverted(s)
        distance = quadratic_form(inverse, work[L.INNOV0 + i], work[L.INNOV1 + i], work[L.INNOV2 + i])
        depth = work[L.DEPTH + i]
        admitted = chosen[i] == L.NEW_LANDMARK and seen[i] > 0 and work[L.TAKEN + i] == 0.0
        match = admitted and distance <= gate and depth >= L.MIN_DEPTH
        _correct_lane(work, tile, i, inverse, match, walk, flat)
        accumulate_likelihood(work, i, match, distance, det, depth)
        record[L.Q_D + i] = distance
        chosen[i] = q if match else chosen[i]
        seen[i] += np.int32(1) if match else np.int32(0)


@device
@simd
def gate_and_update(
    work: FloatArray, tile: FloatArray, record: FloatArray, chosen: FloatArray, seen: Int32Array, q: float,
    gate: float, walk: float,
) -> None:  # fmt: skip
    """Weigh and update the landmark at a known pose where it is admitted and inside the gate (Eqs. 5-11).

    A lane admits it if it holds it, the measurement is still without a match, and row TAKEN does not say that an
    earlier measurement has taken it.

    Args:
        work: Rows of the block.
        tile: Values of the landmark there.
        record: Rows of the candidate, of which Q_D is written.
        chosen: (LANES,) match of the measurement, written: q where it is this candidate.
        seen: (LANES,) counts of the landmark, raised there.
        q: Number of the candidate.
        gate: D0.
        walk: See `correct`.
    """
    if _any_flat(work, tile):
        _gate_and_update(work, tile, record, chosen, seen, q, gate, walk, True)
    else:
        _gate_and_update(work, tile, record, chosen, seen, q, gate, walk, False)


@device
@simd
def correct_matched(
    space: Space, block: int, maps: MapArrays, frame: Frame, candidates: Candidates, walk: float
) -> None:
    """Correct at a known pose the landmarks that the lanes of one block matched, young ones by the iterated EKF."""
    work, match, mask, row_of = space.work, space.match, space.mask, maps.table[L.ROW_OF]
    padded, first = maps.counts.shape[1], block * LANES
    young, before = stack_array(LANES), stack_array(TILE)
    for b in range(len(match)):
        for q in range(candidates.starts[b], candidates.starts[b + 1]):
            if mask_of(match[b], float(q), mask) == 0:
                continue
            row = row_of[candidates.slots[q]]
            tile, seen = maps.values[tile_of(padded, row, block)], maps.counts[row, first : first + LANES]
            num_young = 0
            for i in range(len(seen)):
                on = mask[i] > 0.0
                is_young = on and seen[i] <= RELINEARISE_UP_TO
                young[i] = 1.0 if is_young else 0.0
                num_young += 1 if is_young else 0
                seen[i] += np.int32(1) if on else np.int32(0)
            innovate(work, tile, frame, b)
            if num_young > 0:
                for j in range(TILE):
                    before[j] = tile[j]
                correct(work, tile, young, 0.0)
                innovate(work, tile, frame, b)
                for i in range(LANES):  # the innovation at the new means is referred to those before
                    work[L.INNOV0 + i] += tile[i] - before[i]
                    work[L.INNOV1 + i] += tile[LANES + i] - before[LANES + i]
                    work[L.INNOV2 + i] += tile[2 * LANES + i] - before[2 * LANES + i]
                for j in range(TILE):
                    tile[j] = before[j]
            correct(work, tile, mask, walk)


@device
@simd
def new_landmark(
    space: Space, block: int, maps: MapArrays, frame: Frame, n: int, new_slots: IntArray, walk: float
) -> None:
    """Start a landmark from a known pose in the lanes of one block where the mask is 1 (Algorithm 1, l. 30-31 *).

    The first block gives it a free slot and row. All lanes of a block are written; those that do not hold the landmark
    get a count of 0.

    Args:
        space, block: Working space, and the block.
        maps: Landmarks.
        frame, n: Measurements of the robot, and the one that starts the landmark.
        new_slots: (B,) slots of the landmarks that measurements started, -1 = none; written.
        walk: See `correct`.
    """
    work, row_of, tops = space.work, maps.table[L.ROW_OF], maps.tops
    if new_slots[n] == L.REJECTED:
        tops[0] -= 1
        tops[1] -= 1
        row, slot = maps.free_rows[tops[0]], maps.table[L.FREE_SLOTS, tops[1]]
        size = 9 * maps.counts.shape[1]
        maps.counts[row, :] = 0
        maps.values[row * size : (row + 1) * size] = 0.0
        row_of[slot], maps.table[L.MAP_OF, slot], new_slots[n] = row, 0, slot
    row, points, camera = row_of[new_slots[n]], frame.points, frame.camera
    tile = maps.values[tile_of(maps.counts.shape[1], row, block)]
    seen = maps.counts[row, block * LANES : (block + 1) * LANES]
    ahead, left, up = camera[4] + points[n, 0], camera[5] + points[n, 1], camera[6] + points[n, 2]
    for i in range(LANES):
        c, s = work[L.COS + i], work[L.SIN + i]
        tile[i] = work[L.X + i] + c * ahead - s * left
        tile[LANES + i] = work[L.Y + i] + s * ahead + c * left
        tile[2 * LANES + i] = up
    innovate(work, tile, frame, n)
    for i in range(LANES):  # l. 31 *: G^-1 R G^-T
        tile[3 * LANES + i] = work[L.N00 + i] + walk
        tile[4 * LANES + i] = work[L.N01 + i]
        tile[5 * LANES + i] = work[L.N02 + i]
        tile[6 * LANES + i] = work[L.N11 + i] + walk
        tile[7 * LANES + i] = work[L.N12 + i]
        tile[8 * LANES + i] = work[L.N22 + i] + walk
    for i in range(len(seen)):
        seen[i] = np.int32(1) if space.mask[i] > 0.0 else np.int32(0)
