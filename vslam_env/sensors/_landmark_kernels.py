"""The compiled part of the landmark sensor: false points, and what is measured of all points that are reported."""

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.jit import in_place
from slam_backend.core.validation import FloatArray, IntArray

NEAREST_FALSE_POINT = 0.5  # [m]
NEAREST = 0.05  # [m] no matcher reports smaller depths, and filters take none
FARTHEST, BEYOND = 1e3, 1.2  # [m], and in ranges of the camera: no camera reports points farther than either


@in_place
def measure(
    ids: IntArray,
    counts: IntArray,
    poses: FloatArray,
    landmarks: FloatArray,
    false_points: FloatArray,
    noise: FloatArray,
    optics: FloatArray,
    points: FloatArray,
    looks: NDArray[np.float32],
) -> int:
    """Measure points and descriptors.

    Points are projected, their image coordinates and disparities disturbed, and triangulated again. Where the disparity
    vanishes in the noise, or is that of a point before the lens or far out of range, no camera reports a point: the
    later ones move up.

    Args:
        ids: (K, B) int64. Landmarks that each robot reports, -1 - j for false point j; changed to those of the
            written points, -1 for a false point.
        counts: (K,) int64. Number of points that each robot reports; changed to where the written ones of each robot
            end.
        poses: (K, 3) float64 [m, m, rad], world frame. Robots.
        landmarks: (N, 3 + d) float64. Positions [m], world frame, and descriptors, unit vectors.
        false_points: (m, 3 + d) float64. Positions [m], camera frame, and descriptors.
        noise: (n, 3 + d) float64, standard normal. Overwritten.
        optics: (9,) float64. Place of the camera in the robot frame [m], its focal length [px] and baseline [m], its
            sigmas of image coordinates and disparity [px], largest distance of a measured point [m], and root mean
            square length of the noise of a descriptor.
        points: (n, 3) float64 [m], camera frame. Written to.
        looks: (n, d) float32, unit vectors. Written to.

    Returns:
        Number of points written.
    """
    forward, aside, height, focal, baseline, sigma, sigma_disparity, farthest, descriptor_noise = optics
    size = looks.shape[1]
    each = descriptor_noise / np.sqrt(size)
    i = kept = 0
    for k in range(len(poses)):
        cosine, sine = np.cos(poses[k, 2]), np.sin(poses[k, 2])
        num_kept = 0
        for name in ids[k, : counts[k]]:
            if name >= 0:
                row = landmarks[name]
                dx, dy = row[0] - poses[k, 0], row[1] - poses[k, 1]
                right = aside - (cosine * dy - sine * dx)
                down = height - row[2]
                ahead = cosine * dx + sine * dy - forward
            else:
                row = false_points[-1 - name]
                right, down, ahead = row[:3]
            scale = focal / ahead
            disparity = baseline * scale + sigma_disparity * noise[i, 2]
            reported = False
            if disparity > 0.0:
                across = (right * scale + sigma * noise[i, 0]) * baseline / disparity
                below = (down * scale + sigma * noise[i, 1]) * baseline / disparity
                depth = focal * baseline / disparity
                points[kept, 0], points[kept, 1], points[kept, 2] = across, below, depth
                reported = depth >= NEAREST and across**2 + below**2 + depth**2 <= farthest**2
            if reported:
                look, square = noise[i, 3:], 0.0
                for j in range(size):
                    look[j] = row[3 + j] + each * look[j]
                    square += look[j] ** 2
                length = np.sqrt(square)
                for j in range(size):
                    looks[kept, j] = look[j] / length
                ids[k, num_kept] = max(name, -1)
                num_kept, kept = num_kept + 1, kept + 1
            i += 1
        counts[k] = kept
    return kept
