"""The compiled part of the landmark sensor: what is measured of the landmarks that are reported."""

import numpy as np
from numpy.typing import NDArray

from slam_backend._jit import jit
from slam_backend.errors import FloatArray, IntArray


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
        counts: (K,) int64. How many each robot reports; changed to where those of each robot that are written end.
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
        counts[k] = kept
