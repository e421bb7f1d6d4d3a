"""The compiled part of the landmark sensor: which visible landmarks are reported, and what is measured of them."""

import numpy as np
from numpy.typing import NDArray

from slam_backend._jit import jit
from slam_backend.errors import BoolArray, FloatArray, IntArray


@jit
def choose(
    visible: BoolArray,
    keys: FloatArray,
    detection_probability: float,
    num_false: IntArray,
    most: int,
    chosen: IntArray,
    counts: IntArray,
) -> tuple[int, int]:
    """Detect landmarks and choose among the detected ones.

    A landmark with a uniform key in [0, 1) is detected if the key is below the probability. The detected ones with the
    smallest keys are then a uniform choice in uniformly random order.

    Args:
        visible: (K, N) bool.
        keys: (K, N) float64, uniform.
        detection_probability: Of a visible landmark.
        num_false: (K,) int64. Places that false points take in the frame of each robot; changed to `most` where larger.
        most: Places in each frame.
        chosen: (K most,) int64. Written to: the chosen landmarks of all robots one after the other.
        counts: (K,) int64. Written to: the number for each robot.

    Returns:
        How many are chosen, and how many false points there are.
    """
    total = extra = 0
    for k in range(len(visible)):
        num_false[k] = min(num_false[k], most)
        extra += num_false[k]
        begin, places = total, most - num_false[k]
        for n in range(visible.shape[1]):
            if not visible[k, n] or keys[k, n] >= detection_probability:
                continue
            if total - begin < places:
                at = total
                total += 1
            elif total > begin and keys[k, n] < keys[k, chosen[total - 1]]:
                at = total - 1
            else:
                continue
            while at > begin and keys[k, chosen[at - 1]] > keys[k, n]:
                chosen[at] = chosen[at - 1]
                at -= 1
            chosen[at] = n
        counts[k] = total - begin
    return total, extra


@jit
def measure(
    ids: IntArray,
    counts: IntArray,
    poses: FloatArray,
    landmarks: FloatArray,
    false_points: FloatArray,
    noise: FloatArray,
    optics: FloatArray,
    descriptor_noise: float,
    points: FloatArray,
    looks: NDArray[np.float32],
) -> None:
    """Measure points and descriptors.

    Points are projected, their image coordinates and disparities disturbed, and triangulated again. Where the disparity
    vanishes in the noise, no matcher reports a point: the later ones move up.

    Args:
        ids: (n,) int64. Landmarks that the robots report, one robot after the other; -1 - j for false point j. Changed
            to those behind what is written, -1 for a false point.
        counts: (K,) int64. How many each robot reports; likewise.
        poses: (K, 3) float64 [m, m, rad], world frame. Robots.
        landmarks: (N, 3 + d) float64. Their positions [m], world frame, and descriptors, unit vectors.
        false_points: (m, 3 + d) float64. Likewise, but in the camera frame.
        noise: (n, 3 + d) float64, standard normal.
        optics: (7,) float64. Place of the camera in the robot frame [m], its focal length [px] and baseline [m], and
            its sigmas of image coordinates and disparity [px].
        descriptor_noise: Root mean square length of the noise of a descriptor.
        points: (n, 3) float64 [m], camera frame. Written to, as what follows.
        looks: (n, d) float32, unit vectors.
    """
    forward, aside, height, focal, baseline, sigma, sigma_disparity = optics
    size = looks.shape[1]
    each = descriptor_noise / np.sqrt(size)
    look = np.empty(size)
    i = kept = 0
    for k in range(len(poses)):
        cosine, sine = np.cos(poses[k, 2]), np.sin(poses[k, 2])
        first = kept
        for _ in range(counts[k]):
            if ids[i] >= 0:
                row = landmarks[ids[i]]
                dx, dy = row[0] - poses[k, 0], row[1] - poses[k, 1]
                right = aside - (cosine * dy - sine * dx)
                down = height - row[2]
                ahead = cosine * dx + sine * dy - forward
            else:
                row = false_points[-1 - ids[i]]
                right, down, ahead = row[:3]
            scale = focal / ahead
            disparity = baseline * scale + sigma_disparity * noise[i, 2]
            if disparity > 0.0:
                points[kept, 0] = (right * scale + sigma * noise[i, 0]) * baseline / disparity
                points[kept, 1] = (down * scale + sigma * noise[i, 1]) * baseline / disparity
                points[kept, 2] = focal * baseline / disparity
                square = 0.0
                for j in range(size):
                    look[j] = row[3 + j] + each * noise[i, 3 + j]
                    square += look[j] ** 2
                length = np.sqrt(square)
                for j in range(size):
                    looks[kept, j] = look[j] / length
                ids[kept] = max(ids[i], -1)
                kept += 1
            i += 1
        counts[k] = kept - first
