"""All that `coarsened` does with keys and what was seen from them, step by step."""

import numpy as np

from slam_backend._jit import jit
from slam_backend.errors import BoolArray, FloatArray, IntArray
from slam_backend.smoothing._kernels.coarsening import add_sightings, join_keys, look_at_keys, to_freeze


@jit
def coarsen(
    share: int, most_frames: int, most_keys: int, frame_keys: IntArray, keys: IntArray, landmarks: IntArray,
    frozen: BoolArray, centres: FloatArray, infos: FloatArray, slopes: FloatArray, counts: IntArray, raw: BoolArray,
    numbers: IntArray, new_keys: IntArray, new_landmarks: IntArray, new_centres: FloatArray, new_infos: FloatArray,
    new_slopes: FloatArray, new_counts: IntArray, robots: IntArray, poses: FloatArray, previous: IntArray,
    motions: FloatArray, noises: FloatArray, costs: FloatArray, slack: FloatArray,
) -> tuple[int, int]:  # fmt: skip
    """Leave few enough keys, and freeze what was seen from old ones.

    Args:
        share, most_frames, frame_keys: As of `look_at_keys`.
        most_keys: As of `join_keys`.
        keys, landmarks, frozen, centres, infos, slopes, counts: (s, ...) of all sightings.
        raw: (k,), result of `look_at_keys`.
        numbers: (k,), result of `join_keys`.
        new_keys, new_landmarks, new_centres, new_infos, new_slopes, new_counts: (s, ...), results of `add_sightings`.
        robots, poses, previous, motions, noises, costs, slack: (k, ...) as of `join_keys`, changed likewise.

    Returns:
        How many keys are left, and how many frozen sightings there are.
    """
    k = len(robots)
    fresh, sighted, rows = np.empty(k, np.bool_), np.empty(k, np.bool_), np.empty(len(keys), np.int64)
    roots, offsets = np.empty(k, np.int64), np.empty((k, 3))
    look_at_keys(robots, frame_keys, share, most_frames, fresh, raw)
    rows = rows[: to_freeze(frozen, keys, raw, rows, sighted)]
    left = join_keys(
        fresh, sighted, most_keys, roots, numbers, offsets, robots, poses, previous, motions, noises, costs, slack
    )
    num = add_sightings(
        rows, keys, landmarks, centres, infos, slopes, counts, roots, numbers, offsets, new_keys, new_landmarks,
        new_centres, new_infos, new_slopes, new_counts,
    )  # fmt: skip
    return left, num
