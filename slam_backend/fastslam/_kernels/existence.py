"""Compiled: what a robot's frame says of the existence of the landmarks around it, in all particles.

Landmarks are stored as `ParticleMaps` has it; `odds[slot, particle]` are their log-odds of existence. Slots are brought
up to date before they are written: then each particle's values stand at its own place.

`values` come as (rows, blocks, 9, lanes), so that nothing that another module defines is compiled into these kernels:
their cache would not notice a change of it.
"""

import numpy as np

from slam_backend.core.jit import device, in_place, jit, jit_fma, simd, simd_inline
from slam_backend.core.validation import Float32Array, FloatArray, Int32Array, IntArray

ROUNDED = 1.0 + 1e-9  # no rounding decides what is looked at in detail


@simd_inline
def in_view(
    depth: float, lateral: float, vertical: float, nearest: float, side: float, rise: float, reach_squared: float
) -> bool:
    """Tell whether a predicted point is expected in view: inside the image less its margin, and near enough.

    Args:
        depth, lateral, vertical: The point relative to the camera centre [m], robot axes (ahead, left, up).
        nearest, side, rise, reach_squared: A `View`, one by one: scalars stay in registers over a loop.
    """
    return (
        (depth > nearest)
        & (abs(lateral) <= side * depth)
        & (abs(vertical) <= rise * depth)
        & (depth * depth + lateral * lateral + vertical * vertical <= reach_squared)
    )


@simd_inline
def updated_log_odds(log_odds: float, seen: bool, expected: bool, sighting: float, miss: float, cap: float) -> float:
    """Return a landmark's log-odds after a frame: Bayes' rule in logarithms, up to the cap.

    Args:
        log_odds: Before the frame.
        seen: Whether it was matched.
        expected: Whether it was expected in view.
        sighting, miss: From `ExistenceModel.increments`.
        cap: `ExistenceModel.log_odds_cap`.
    """
    return min(cap, log_odds + seen * sighting + (expected & (not seen)) * miss)


@jit
def landmarks_in_view(
    ids: IntArray, row_of: IntArray, map_of: IntArray, maps: Int32Array, values: FloatArray, counts: Int32Array,
    num_particles: int, best: int, poses: FloatArray, cosines: FloatArray, sines: FloatArray, mount: FloatArray,
    near: float, nearest: float, side: float, reach_squared: float, found: Int32Array, new_slots: IntArray,
) -> IntArray:  # fmt: skip
    """Return the slots of the landmarks that a frame may tell something of, without those that it started.

    They are those that some particle has matched, and of those near the robot the ones that some particle expects in
    view, heights apart.

    Args:
        ids, row_of, map_of, maps, values, counts: The store, see `ParticleMaps`; it need not be up to date.
        num_particles: M.
        best: The particle whose map says what is near; what it lacks is where the first particle that holds it says.
        poses: (3, P) of the robot [m, m, rad], map frame, with the `cosines` and `sines` (P,) of its headings.
        mount: (3,) of the camera on the robot [m].
        near: Landmarks farther from the robot than this [m, in the plane] are not near.
        nearest, side, reach_squared: Of a `View`.
        found: (n, P) slots to which the particles gave the measurements, negative = none.
        new_slots: (n,) slots of the landmarks that the frame started, -1 = none.
    """
    lanes = values.shape[3]
    matched = np.zeros(len(ids), dtype=np.bool_)
    started = np.zeros(len(ids), dtype=np.bool_)
    for b in range(len(new_slots)):
        for m in range(num_particles):
            if found[b, m] >= 0:
                matched[found[b, m]] = True
        if new_slots[b] >= 0:
            started[new_slots[b]] = True
    in_place = np.arange(counts.shape[1]).astype(np.int32)
    slots = np.empty(len(ids), dtype=np.int64)
    num = 0
    for slot in range(len(ids)):
        if ids[slot] < 0 or started[slot]:
            continue
        is_told = matched[slot]
        if not is_told:
            row = row_of[slot]
            places = maps[map_of[slot]] if map_of[slot] > 0 else in_place
            place, m = np.int64(places[best]), 0
            while counts[row, place] == 0 and m < num_particles:
                place = np.int64(places[m])
                m += 1
            if counts[row, place] > 0:
                dx = values[row, place // lanes, 0, place % lanes] - poses[0, best]
                dy = values[row, place // lanes, 1, place % lanes] - poses[1, best]
                is_told = dx * dx + dy * dy <= near * near and _is_expected(
                    places[:num_particles], values[row], counts[row], poses, cosines, sines, mount, nearest, side,
                    reach_squared,
                )  # fmt: skip
        if is_told:
            slots[num] = slot
            num += 1
    return slots[:num]


@device
@simd
def _is_expected(
    places: Int32Array, values: FloatArray, counts: Int32Array, poses: FloatArray, cosines: FloatArray,
    sines: FloatArray, mount: FloatArray, nearest: float, side: float, reach_squared: float,
) -> bool:  # fmt: skip
    """Tell whether some particle may expect a landmark in view, heights apart.

    Args:
        places: (M,) where each particle's values stand in the landmark's row.
        values, counts: (blocks, 9, lanes) and (P,) that row.
        poses and the following: See `landmarks_in_view`.
    """
    size = values.shape[2]  # a power of two
    shift = 0
    while 1 << shift < size:
        shift += 1
    m0, m1 = mount[0], mount[1]
    nearest, side, reach_squared = nearest / ROUNDED, side * ROUNDED, reach_squared * ROUNDED
    for first in range(0, len(places), size):
        num = 0
        for m in range(first, min(first + size, len(places))):
            place = np.int64(places[m])
            block, lane = place >> shift, place & (size - 1)
            dx, dy = values[block, 0, lane] - poses[0, m], values[block, 1, lane] - poses[1, m]
            depth, lateral = cosines[m] * dx + sines[m] * dy - m0, cosines[m] * dy - sines[m] * dx - m1
            seen = in_view(depth, lateral, 0.0, nearest, side, 0.0, reach_squared)
            num += 1 if seen and counts[place] > 0 else 0
        if num > 0:
            return True
    return False


@in_place
def count_expected(
    slots: IntArray, row_of: IntArray, values: FloatArray, counts: Int32Array, m: int, pose: FloatArray,
    mount: FloatArray, nearest: float, side: float, rise: float, reach_squared: float,
) -> int:  # fmt: skip
    """Return how many of the landmarks particle m holds and expects in view.

    Args:
        slots: The landmarks, up to date.
        row_of, values, counts: The store, see `ParticleMaps`.
        m: The particle.
        pose: (3,) of the robot in it [m, m, rad], map frame.
        mount: (3,) of the camera on the robot [m].
        nearest, side, rise, reach_squared: A `View`.
    """
    c, s = np.cos(pose[2]), np.sin(pose[2])
    block, lane = m // values.shape[3], m % values.shape[3]
    num = 0
    for k in range(len(slots)):
        row = row_of[slots[k]]
        if counts[row, m] > 0:
            dx, dy = values[row, block, 0, lane] - pose[0], values[row, block, 1, lane] - pose[1]
            depth, lateral = c * dx + s * dy - mount[0], c * dy - s * dx - mount[1]
            vertical = values[row, block, 2, lane] - mount[2]
            num += 1 if in_view(depth, lateral, vertical, nearest, side, rise, reach_squared) else 0
    return num


@jit
def mark_seen(slots: IntArray, num_slots: int, found: Int32Array) -> Int32Array:
    """Return (n, P) 1 where a particle matched landmark `slots[k]` with any measurement, else 0."""
    seen = np.zeros((len(slots), found.shape[1]), dtype=np.int32)
    rank = np.full(num_slots, -1, dtype=np.int64)
    for k in range(len(slots)):
        rank[slots[k]] = k
    for b in range(found.shape[0]):
        for m in range(found.shape[1]):
            if found[b, m] >= 0 and rank[found[b, m]] >= 0:
                seen[rank[found[b, m]], m] = 1
    return seen


@jit_fma
def update_existence(
    slots: IntArray, seen: Int32Array, odds: FloatArray, row_of: IntArray, values: FloatArray, counts: Int32Array,
    poses: FloatArray, cosines: FloatArray, sines: FloatArray, mount: FloatArray, nearest: float, side: float,
    rise: float, reach_squared: float, sighting: float, miss: float, floor: float, cap: float,
) -> IntArray:  # fmt: skip
    """Update the log-odds of landmarks in all particles that hold them, and drop those that have become improbable.

    Args:
        slots: (n,) the landmarks, up to date.
        seen: (n, P) from `mark_seen`.
        odds: (slots, P), updated.
        row_of, values: The store, see `ParticleMaps`.
        counts: (rows, P); 0 where a particle drops a landmark.
        poses: (3, P) of the robot [m, m, rad], map frame, with the `cosines` and `sines` (P,) of its headings.
        mount: (3,) of the camera on the robot [m].
        nearest, side, rise, reach_squared: A `View`.
        sighting, miss, floor, cap: Of an `ExistenceModel`.

    Returns:
        The slots that no particle holds any more.
    """
    m0, m1, m2 = mount[0], mount[1], mount[2]
    size = values.shape[3]
    expected = np.empty(size, dtype=np.bool_)
    deserted = np.empty(len(slots), dtype=np.int64)
    num = 0
    for k in range(len(slots)):
        slot = slots[k]
        row = row_of[slot]
        holders = 0
        for block in range(values.shape[1]):
            first, last = block * size, (block + 1) * size
            x, y, c, s = poses[0, first:last], poses[1, first:last], cosines[first:last], sines[first:last]
            mean = values[row, block]
            for i in range(size):
                dx, dy = mean[0, i] - x[i], mean[1, i] - y[i]
                depth, lateral = c[i] * dx + s[i] * dy - m0, c[i] * dy - s[i] * dx - m1
                expected[i] = in_view(depth, lateral, mean[2, i] - m2, nearest, side, rise, reach_squared)
            held, own, hit = counts[row, first:last], odds[slot, first:last], seen[k, first:last]
            for i in range(size):
                after = updated_log_odds(own[i], hit[i] > 0, expected[i], sighting, miss, cap)
                after = after if held[i] > 0 else own[i]
                own[i] = after
                held[i] = 0 if after < floor else held[i]
                holders += 1 if held[i] > 0 else 0
        if holders == 0:
            deserted[num] = slot
            num += 1
    return deserted[:num]


@in_place
def delete_landmarks(
    slots: IntArray, ids: IntArray, row_of: IntArray, heads: Float32Array, free_rows: IntArray, free_slots: IntArray,
    tops: IntArray, far: np.float32,
) -> None:  # fmt: skip
    """Free slots, up to date, that no particle holds, and their rows; see `ParticleMaps`. Heads become `far`."""
    for k in range(len(slots)):
        ids[slots[k]] = -1
        for j in range(heads.shape[0]):
            heads[j, slots[k]] = far
        free_rows[tops[0]] = row_of[slots[k]]
        free_slots[tops[1]] = slots[k]
        tops[0] += 1
        tops[1] += 1
