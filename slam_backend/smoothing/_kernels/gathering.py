"""Sightings in the order of landmarks and keys: which measurements go into each."""

import numpy as np

from slam_backend._jit import device, in_place, jit
from slam_backend.errors import BoolArray, FloatArray, IntArray


@device
@jit
def _sorted_by(codes: IntArray, order: IntArray, num_codes: int) -> IntArray:
    """Return an order (n,) by codes in [0, num_codes), that of equal ones as it was."""
    tops, result = np.zeros(num_codes + 1, dtype=np.int64), np.empty(len(order), dtype=np.int64)
    for item in order:
        tops[codes[item] + 1] += 1
    for code in range(num_codes):
        tops[code + 1] += tops[code]
    for item in order:
        result[tops[codes[item]]] = item
        tops[codes[item]] += 1
    return result


@jit
def gather(
    frozen_keys: IntArray, frozen_landmarks: IntArray, frozen_centres: FloatArray, frozen_infos: FloatArray,
    frozen_slopes: FloatArray, frozen_counts: IntArray, point_frames: IntArray, point_landmarks: IntArray,
    frame_keys: IntArray, num_keys: int, keys: IntArray, landmarks: IntArray, starts: IntArray, frozen: BoolArray,
    centres: FloatArray, infos: FloatArray, slopes: FloatArray, counts: IntArray, of_points: IntArray,
) -> int:  # fmt: skip
    """Write the sightings of a graph by landmark and key, frozen ones before the others of a pair.

    Args:
        frozen_keys, frozen_landmarks, frozen_centres, frozen_infos, frozen_slopes, frozen_counts: Of f frozen ones.
        point_frames, point_landmarks: (n,) of the raw measurements.
        frame_keys: (F,) key of each frame.
        num_keys: k.
        keys, landmarks, frozen, centres, infos, slopes, counts: (f + n, ...), results, of which the first rows are
            written; forms of raw measurements are zeros.
        starts: (l + 1,), result: first row of each landmark.
        of_points: (n,), result: row of each raw measurement.

    Returns:
        How many rows there are.
    """
    num_frozen, num_points = len(frozen_keys), len(point_frames)
    of_key, of_landmark = np.empty(num_frozen + num_points, np.int64), np.empty(num_frozen + num_points, np.int64)
    of_key[:num_frozen], of_landmark[:num_frozen] = frozen_keys, frozen_landmarks
    for n in range(num_points):
        of_key[num_frozen + n], of_landmark[num_frozen + n] = frame_keys[point_frames[n]], point_landmarks[n]
    order = _sorted_by(of_key, np.arange(num_frozen + num_points), num_keys)
    order = _sorted_by(of_landmark, order, len(starts) - 1)
    num = 0
    starts[:] = 0
    for item in order:
        key, landmark = of_key[item], of_landmark[item]
        again = item >= num_frozen and num > 0 and not frozen[num - 1]
        if again and keys[num - 1] == key and landmarks[num - 1] == landmark:
            counts[num - 1] += 1
            of_points[item - num_frozen] = num - 1
            continue
        keys[num], landmarks[num], frozen[num] = key, landmark, item < num_frozen
        if item < num_frozen:
            centres[num], infos[num], slopes[num] = frozen_centres[item], frozen_infos[item], frozen_slopes[item]
            counts[num] = frozen_counts[item]
        else:
            centres[num] = 0.0
            infos[num] = 0.0
            slopes[num] = 0.0
            counts[num] = 1
            of_points[item - num_frozen] = num
        starts[landmark + 1] += 1
        num += 1
    for landmark in range(len(starts) - 1):
        starts[landmark + 1] += starts[landmark]
    return num


@in_place
def count(
    starts: IntArray, counts: IntArray, point_landmarks: IntArray, totals: IntArray, in_view: BoolArray
) -> None:  # fmt: skip
    """Say how often each landmark was measured, and which of them have raw measurements.

    Args:
        starts, counts: (l + 1,), (s,) as of `gather`.
        point_landmarks: (n,) of the raw measurements.
        totals, in_view: (l,), results.
    """
    for landmark in range(len(totals)):
        totals[landmark] = 0
        for q in range(starts[landmark], starts[landmark + 1]):
            totals[landmark] += counts[q]
    in_view[:] = False
    for landmark in point_landmarks:
        in_view[landmark] = True
