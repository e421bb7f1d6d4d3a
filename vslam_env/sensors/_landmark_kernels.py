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
) -> int:
    """Detect landmarks and choose among the detected ones.

    A landmark with a uniform key in [0, 1) is detected if the key is below the probability. The detected ones with the
    smallest keys are then a uniform choice in uniformly random order.

    Args:
        visible: (K, N) bool.
        keys: (K, N) float64, uniform.
        detection_probability: Of a visible landmark.
        num_false: (K,) int64. Places that false points take in the frame of each robot.
        most: Places in each frame.
        chosen: (K most,) int64. Written to: the chosen landmarks of all robots one after the other.
        counts: (K,) int64. Written to: the number for each robot.

    Returns:
        How many are chosen.
    """
    total = 0
    for k in range(len(visible)):
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
    return total


@jit
def measure(
    ids: IntArray,
    counts: IntArray,
    poses: FloatArray,
    mount: FloatArray,
    positions: FloatArray,
    descriptors: FloatArray,
    false_points: FloatArray,
    false_descriptors: FloatArray,
    noise: FloatArray,
    stereo: FloatArray,
    descriptor_noise: float,
    points: FloatArray,
    looks: NDArray[np.float32],
    sharp: BoolArray,
) -> int:
    """Measure points and descriptors.

    Points are projected, their image coordinates and disparities disturbed, and triangulated again.

    Args:
        ids: (n,) int64. Landmarks that the robots report, one robot after the other; -1 - j for false point j.
        counts: (K,) int64. How many each robot reports.
        poses: (K, 3) float64 [m, m, rad], world frame. Robots.
        mount: (3,) float64 [m], robot frame. Place of the camera.
        positions: (N, 3) float64 [m], world frame. Of the landmarks.
        descriptors: (N, d) float64, unit vectors. Of the landmarks.
        false_points: (m, 3) float64 [m], camera frame.
        false_descriptors: (m, d) float64, unit vectors.
        noise: (n, 3 + d) float64, standard normal.
        stereo: (4,) float64. Focal length [px], baseline [m], sigmas of image coordinates and disparity [px].
        descriptor_noise: Root mean square length of the noise of a descriptor.
        points: (n, 3) float64 [m], camera frame. Written to, as what follows.
        looks: (n, d) float32, unit vectors.
        sharp: (n,) bool. False where the disparity vanishes in the noise: no matcher reports such a point.

    Returns:
        How many are sharp.
    """
    focal, baseline, sigma, sigma_disparity = stereo
    size = descriptors.shape[1]
    each = descriptor_noise / np.sqrt(size)
    look = np.empty(size)
    i = num_sharp = 0
    for k in range(len(poses)):
        cosine, sine = np.cos(poses[k, 2]), np.sin(poses[k, 2])
        for _ in range(counts[k]):
            if ids[i] >= 0:
                dx, dy = positions[ids[i], 0] - poses[k, 0], positions[ids[i], 1] - poses[k, 1]
                right = mount[1] - (cosine * dy - sine * dx)
                down = mount[2] - positions[ids[i], 2]
                ahead = cosine * dx + sine * dy - mount[0]
                look[:] = descriptors[ids[i]]
            else:
                right, down, ahead = false_points[-1 - ids[i]]
                look[:] = false_descriptors[-1 - ids[i]]
            scale = focal / ahead
            disparity = baseline * scale + sigma_disparity * noise[i, 2]
            sharp[i] = disparity > 0.0
            num_sharp += sharp[i]
            if sharp[i]:
                points[i, 0] = (right * scale + sigma * noise[i, 0]) * baseline / disparity
                points[i, 1] = (down * scale + sigma * noise[i, 1]) * baseline / disparity
                points[i, 2] = focal * baseline / disparity
            square = 0.0
            for j in range(size):
                look[j] += each * noise[i, 3 + j]
                square += look[j] ** 2
            length = np.sqrt(square)
            for j in range(size):
                looks[i, j] = look[j] / length
            i += 1
    return num_sharp
