"""What nothing is left of goes, where it lies: raw measurements, and then frames and landmarks."""

import numpy as np

from slam_backend._jit import jit
from slam_backend.errors import BoolArray, FloatArray, IntArray

NONE = -1


@jit
def drop_unused(
    kept: BoolArray, frozen_landmarks: IntArray, points: FloatArray, point_noises: FloatArray, given: BoolArray,
    point_frames: IntArray, point_landmarks: IntArray, frame_keys: IntArray, frame_offsets: FloatArray,
    landmark_ids: IntArray, landmarks: FloatArray,
) -> tuple[int, int, int]:  # fmt: skip
    """Leave some raw measurements, and those frames and landmarks of which anything is left that was measured.

    Args:
        kept: (n,) which raw measurements are left.
        frozen_landmarks: (s,) of the frozen sightings; changed: where these are then.
        points, point_noises, given, point_frames, point_landmarks, frame_keys, frame_offsets, landmark_ids, landmarks:
            Columns of `PathGraph`. Changed: what is left are the first rows, which name each other by where they are.

    Returns:
        How many measurements, frames and landmarks are left.
    """
    num = 0
    frame_numbers, landmark_numbers = np.full(len(frame_keys), NONE), np.full(len(landmark_ids), NONE)
    for n in range(len(kept)):
        if kept[n]:
            frame_numbers[point_frames[n]], landmark_numbers[point_landmarks[n]] = 0, 0
            points[num], point_noises[num], given[num] = points[n], point_noises[n], given[n]
            point_frames[num], point_landmarks[num] = point_frames[n], point_landmarks[n]
            num += 1
    for landmark in frozen_landmarks:
        landmark_numbers[landmark] = 0
    frames = 0
    for f in range(len(frame_keys)):
        if frame_numbers[f] != NONE:
            frame_keys[frames], frame_offsets[frames], frame_numbers[f] = frame_keys[f], frame_offsets[f], frames
            frames += 1
    left = 0
    for row in range(len(landmark_ids)):
        if landmark_numbers[row] != NONE:
            landmark_ids[left], landmarks[left], landmark_numbers[row] = landmark_ids[row], landmarks[row], left
            left += 1
    for n in range(num):
        point_frames[n] = frame_numbers[point_frames[n]]
        point_landmarks[n] = landmark_numbers[point_landmarks[n]]
    for s in range(len(frozen_landmarks)):
        frozen_landmarks[s] = landmark_numbers[frozen_landmarks[s]]
    return num, frames, left
