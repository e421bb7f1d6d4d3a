"""The landmarks of new measurements: which of the known ones they are, and where new ones are put."""

import math

import numpy as np

from slam_backend._jit import device, in_place, jit
from slam_backend.errors import FloatArray, IntArray


@in_place
def rename(names: IntArray, aliases: IntArray) -> None:
    """Give landmarks the names by which they go, in place: (n,) int64, and rows (name, name it goes by) in order."""
    for row in range(len(aliases)):
        old, new = aliases[row, 0], aliases[row, 1]
        for n in range(len(names)):
            if names[n] == old:
                names[n] = new


@device
@in_place
def number(names: IntArray, order: IntArray, ids: IntArray, first: IntArray) -> int:
    """Number the landmarks of measurements; those that are new come after the known ones.

    Args:
        names: (n,) int64. Of each measurement's landmark; changed: its row of `ids`.
        order: (l,) int64. Rows of the known landmarks by ascending name.
        ids: (l + n,) int64. Their names, each once; those of the new ones are written from row l on.
        first: (n,) int64, result, of which the first rows are written: the first measurement of each new one.

    Returns:
        How many landmarks there are then.
    """
    known, num = len(order), len(order)
    for n in range(len(names)):
        name, low, high = names[n], 0, known
        while low < high:
            middle = (low + high) // 2
            if ids[order[middle]] < name:
                low = middle + 1
            else:
                high = middle
        row = order[low] if low < known and ids[order[low]] == name else known
        if row == known:
            while row < num and ids[row] != name:
                row += 1
            if row == num:
                ids[num], first[num - known] = name, n
                num += 1
        names[n] = row
    return num


@device
@in_place
def place(
    poses: FloatArray, frame_keys: IntArray, offsets: FloatArray, frames: IntArray, points: FloatArray,
    chosen: IntArray, mount: FloatArray, places: FloatArray,
) -> None:  # fmt: skip
    """Write where some measured points lie in the map.

    Args:
        poses: (k, 3) float64 [m, m, rad]. Of the keys, map frame.
        frame_keys, offsets: (f,), (f, 3) key of each frame, and the frame seen from it.
        frames, points: (n,), (n, 3) [m] frame of each point, and the point, robot axes, from the camera centre.
        chosen: (m,) which of them.
        mount: (3,) [m] of the camera on the robot.
        places: (m, 3) [m], map frame, result.
    """
    for i in range(len(chosen)):
        point, frame = points[chosen[i]], frames[chosen[i]]
        pose, offset = poses[frame_keys[frame]], offsets[frame]
        c, s = math.cos(pose[2]), math.sin(pose[2])
        x, y = pose[0] + c * offset[0] - s * offset[1], pose[1] + s * offset[0] + c * offset[1]
        c, s = math.cos(pose[2] + offset[2]), math.sin(pose[2] + offset[2])
        ahead, left = point[0] + mount[0], point[1] + mount[1]
        places[i, 0], places[i, 1] = x + c * ahead - s * left, y + s * ahead + c * left
        places[i, 2] = point[2] + mount[2]


@device
@jit
def start_anew(
    frozen_landmarks: IntArray, counts: IntArray, point_landmarks: IntArray, new_landmarks: IntArray, names: IntArray,
    held: IntArray, means: FloatArray, landmarks: FloatArray,
) -> None:  # fmt: skip
    """Put those landmarks where a filter holds them to be that have more new measurements than old ones.

    Args:
        frozen_landmarks, counts: (s,) landmark of each frozen sighting, and the measurements in it.
        point_landmarks: (n,) of each old raw measurement.
        new_landmarks: (m,) of each new one.
        names: (l,) int64. Of the landmarks.
        held, means: (h,) int64, ascending, (h, 3) [m]. Names of those that the filter holds, and where.
        landmarks: (l, 3) float64 [m], map frame; changed.
    """
    more = np.zeros(len(names), dtype=np.int64)
    for n in range(len(frozen_landmarks)):
        more[frozen_landmarks[n]] -= counts[n]
    for landmark in point_landmarks:
        more[landmark] -= 1
    for landmark in new_landmarks:
        more[landmark] += 1
    for landmark in range(len(names)):
        if more[landmark] > 0:
            at = np.searchsorted(held, names[landmark])
            if at < len(held) and held[at] == names[landmark]:
                landmarks[landmark] = means[at]


@jit
def settle(
    aliases: IntArray, known: int, names: IntArray, points: FloatArray, frames: IntArray, poses: FloatArray,
    frame_keys: IntArray, offsets: FloatArray, mount: FloatArray, anew: bool, frozen_landmarks: IntArray,
    counts: IntArray, point_landmarks: IntArray, held: IntArray, means: FloatArray, ids: IntArray,
    landmarks: FloatArray,
) -> int:  # fmt: skip
    """Number the landmarks of new measurements, and say where those are that are new, or have more new ones than old.

    Args:
        aliases: As of `rename`.
        known: How many landmarks there are before.
        names, points, frames: (n,), (n, 3), (n,) of the new measurements, as of `number` and `place`; names change.
        poses, frame_keys, offsets, mount: As of `place`.
        anew: Whether landmarks `start_anew`.
        frozen_landmarks, counts, point_landmarks, held, means: As of that.
        ids, landmarks: (l + n,), (l + n, 3) names and places; those of the new ones are written from row l on.

    Returns:
        How many landmarks there are then.
    """
    rename(names, aliases)
    first = np.empty(len(names), dtype=np.int64)
    num = number(names, np.argsort(ids[:known]), ids, first)
    place(poses, frame_keys, offsets, frames, points, first[: num - known], mount, landmarks[known:num])
    if anew:
        start_anew(frozen_landmarks, counts, point_landmarks, names, ids[:num], held, means, landmarks[:num])
    return num
