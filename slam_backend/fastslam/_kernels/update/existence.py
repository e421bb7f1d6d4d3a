"""Compiled: what a robot's frame says of the existence of the landmarks around it, in all particles.

`odds[slot, particle]` are the log-odds of existence. Slots are brought up to date before they are written: then each
particle's values stand at its own place.
"""

import numpy as np

from slam_backend.core.jit import device, in_place, jit, jit_fma, simd, simd_inline
from slam_backend.core.validation import FloatArray, Int32Array, IntArray
from slam_backend.fastslam._kernels import layout as L
from slam_backend.fastslam._kernels.layout import LANES
from slam_backend.fastslam._kernels.records import MapArrays, ViewBounds, Viewpoint

ROUNDED = 1.0 + 1e-9  # no rounding decides what is looked at in detail


@simd_inline
def in_view(depth: float, lateral: float, vertical: float, view: ViewBounds) -> bool:
    """Tell whether a predicted point is expected in view: inside the image less its margin, and near enough.

    Args:
        depth, lateral, vertical: Place of the point relative to the camera centre [m], robot axes (ahead, left, up).
        view: Bounds.
    """
    return (
        (depth > view.nearest)
        & (abs(lateral) <= view.side * depth)
        & (abs(vertical) <= view.rise * depth)
        & (depth * depth + lateral * lateral + vertical * vertical <= view.reach_squared)
    )


@simd_inline
def updated_log_odds(log_odds: float, seen: bool, expected: bool, sighting: float, miss: float, cap: float) -> float:
    """Return a landmark's log-odds after a frame: Bayes' rule in logarithms, up to the cap.

    Args:
        log_odds: Log-odds before the frame.
        seen: Whether it was matched.
        expected: Whether it was expected in view.
        sighting, miss: Increments, see `ExistenceModel.increments`.
        cap: See `ExistenceModel.log_odds_cap`.
    """
    return min(cap, log_odds + seen * sighting + (expected & (not seen)) * miss)


@jit
def landmarks_in_view(
    maps: MapArrays, num_particles: int, best: int, camera: Viewpoint, view: ViewBounds, near: float, found: Int32Array,
    new_slots: IntArray,
) -> IntArray:  # fmt: skip
    """Return the slots of the landmarks that a frame may tell something of, without those that it started.

    They are those that some particle has matched, and of those near the robot the ones that some particle expects in
    view, heights apart.

    Args:
        maps: Landmarks; they need not be up to date.
        num_particles: M.
        best: The particle whose map says what is near; what it lacks is where the first particle that holds it says.
        camera, view: The camera, and where landmarks are expected to be seen.
        near: Distance [m, in the plane] from the robot beyond which landmarks are not near.
        found: (n, P) slots to which the particles gave the measurements, negative = none.
        new_slots: (n,) slots of the landmarks that the frame started, -1 = none.
    """
    row_of, map_of, ids = maps.table[L.ROW_OF], maps.table[L.MAP_OF], maps.table[L.IDS]
    counts, poses = maps.counts, camera.poses
    values = maps.values.reshape((-1, counts.shape[1] // LANES, 9, LANES))
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
        is_included = matched[slot]
        if not is_included:
            row = row_of[slot]
            places = maps.maps[map_of[slot]] if map_of[slot] > 0 else in_place
            place, m = np.int64(places[best]), 0
            while counts[row, place] == 0 and m < num_particles:
                place = np.int64(places[m])
                m += 1
            if counts[row, place] > 0:
                dx = values[row, place // LANES, 0, place % LANES] - poses[0, best]
                dy = values[row, place // LANES, 1, place % LANES] - poses[1, best]
                is_included = dx * dx + dy * dy <= near * near and _is_expected(
                    places[:num_particles], values[row], counts[row], camera, view
                )
        if is_included:
            slots[num] = slot
            num += 1
    return slots[:num]


@device
@simd
def _is_expected(
    places: Int32Array, values: FloatArray, counts: Int32Array, camera: Viewpoint, view: ViewBounds
) -> bool:
    """Tell whether some particle may expect a landmark in view, heights apart.

    Args:
        places: (M,) where each particle's values stand in the landmark's row.
        values, counts: (blocks, 9, lanes) and (P,) that row.
        camera, view: See `landmarks_in_view`.
    """
    poses, cosines, sines, m0, m1 = camera.poses, camera.cosines, camera.sines, camera.mount[0], camera.mount[1]
    wider = ViewBounds(view.nearest / ROUNDED, view.side * ROUNDED, 0.0, view.reach_squared * ROUNDED)
    for first in range(0, len(places), LANES):
        num = 0
        for m in range(first, min(first + LANES, len(places))):
            place = np.uint32(places[m])
            block, lane = np.int64(place // L.BLOCK), np.int64(place % L.BLOCK)
            dx, dy = values[block, 0, lane] - poses[0, m], values[block, 1, lane] - poses[1, m]
            depth, lateral = cosines[m] * dx + sines[m] * dy - m0, cosines[m] * dy - sines[m] * dx - m1
            num += 1 if in_view(depth, lateral, 0.0, wider) and counts[place] > 0 else 0
        if num > 0:
            return True
    return False


@in_place
def count_expected(
    slots: IntArray, maps: MapArrays, m: int, pose: FloatArray, mount: FloatArray, view: ViewBounds
) -> int:
    """Return how many of the landmarks particle m holds and expects in view.

    Args:
        slots: The landmarks, up to date.
        maps: Storage of the landmarks.
        m: The particle.
        pose: (3,) pose of the robot in it [m, m, rad], map frame.
        mount: (3,) place of the camera on the robot [m].
        view: Field of view in which landmarks are expected to be detected.
    """
    c, s = np.cos(pose[2]), np.sin(pose[2])
    values = maps.values.reshape((-1, maps.counts.shape[1] // LANES, 9, LANES))
    block, lane = m // LANES, m % LANES
    num = 0
    for k in range(len(slots)):
        row = maps.table[L.ROW_OF, slots[k]]
        if maps.counts[row, m] > 0:
            dx, dy = values[row, block, 0, lane] - pose[0], values[row, block, 1, lane] - pose[1]
            depth, lateral = c * dx + s * dy - mount[0], c * dy - s * dx - mount[1]
            num += 1 if in_view(depth, lateral, values[row, block, 2, lane] - mount[2], view) else 0
    return num


@jit_fma
def update_existence(
    slots: IntArray, found: Int32Array, maps: MapArrays, camera: Viewpoint, view: ViewBounds, sighting: float,
    miss: float, floor: float, cap: float,
) -> IntArray:  # fmt: skip
    """Update the log-odds of landmarks in all particles that hold them, and drop those that have become improbable.

    Args:
        slots: (n,) the landmarks, up to date.
        found: (B, P) slots to which the particles gave the measurements, negative = none.
        maps: Storage of the landmarks; a count becomes 0 where a particle drops one.
        camera, view: The camera, and where landmarks are expected to be seen.
        sighting, miss, floor, cap: Numbers of an `ExistenceModel`.

    Returns:
        The slots that no particle holds any more.
    """
    m0, m1, m2 = camera.mount[0], camera.mount[1], camera.mount[2]
    num_blocks = maps.counts.shape[1] // LANES
    values = maps.values.reshape((-1, num_blocks, 9, LANES))
    seen, rank = np.zeros((len(slots), found.shape[1]), np.int32), np.full(maps.table.shape[1], -1)
    for k in range(len(slots)):
        rank[slots[k]] = k
    for b in range(found.shape[0]):
        for m in range(found.shape[1]):
            if found[b, m] >= 0 and rank[found[b, m]] >= 0:
                seen[rank[found[b, m]], m] = 1
    expected = np.empty(LANES, dtype=np.bool_)
    deserted = np.empty(len(slots), dtype=np.int64)
    num = 0
    for k in range(len(slots)):
        slot = slots[k]
        row = maps.table[L.ROW_OF, slot]
        holders = 0
        for block in range(num_blocks):
            first, last = block * LANES, (block + 1) * LANES
            x, y = camera.poses[0, first:last], camera.poses[1, first:last]
            c, s, mean = camera.cosines[first:last], camera.sines[first:last], values[row, block]
            for i in range(LANES):
                dx, dy = mean[0, i] - x[i], mean[1, i] - y[i]
                depth, lateral = c[i] * dx + s[i] * dy - m0, c[i] * dy - s[i] * dx - m1
                expected[i] = in_view(depth, lateral, mean[2, i] - m2, view)
            held, own, hit = maps.counts[row, first:last], maps.odds[slot, first:last], seen[k, first:last]
            for i in range(LANES):
                after = updated_log_odds(own[i], hit[i] > 0, expected[i], sighting, miss, cap)
                after = after if held[i] > 0 else own[i]
                own[i] = after
                held[i] = 0 if after < floor else held[i]
                holders += 1 if held[i] > 0 else 0
        if holders == 0:
            deserted[num] = slot
            num += 1
    return deserted[:num]
