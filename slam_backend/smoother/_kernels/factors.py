"""What was measured of landmarks from key poses: linearised, and condensed to one quadratic form for each pair.

A *sighting* says what was measured of one landmark from one key pose, as a quadratic form of c = R(theta)^T (l - p),
the landmark in the frame of the key:  E(c) = 1/2 (c - c0)^T L (c - c0) - g^T (c - c0) + const.  It needs no inverse,
and sightings of one landmark from frames that stand rigidly to each other add up. Symmetric 3 x 3 matrices are stored
as their upper triangles by rows (6).
"""

import math

from slam_backend.core.jit import in_place, inline, stack_array
from slam_backend.core.validation import FloatArray
from slam_backend.smoother._kernels.records import Frames, LandmarkFactors, Points

MIN_DEPTH = 0.05  # [m]; a landmark predicted nearer than this to the camera plane is linearised where it was measured


@inline
def _rotate_in_plane(c: float, s: float, a: FloatArray, out: FloatArray) -> None:
    """Write R A R^T (6) for the rotation (c, s) about the vertical."""
    a00, a01, a02, a11, a12, a22 = a[0], a[1], a[2], a[3], a[4], a[5]
    out[0] = c * c * a00 - 2.0 * c * s * a01 + s * s * a11
    out[1] = c * s * (a00 - a11) + (c * c - s * s) * a01
    out[2] = c * a02 - s * a12
    out[3] = s * s * a00 + 2.0 * c * s * a01 + c * c * a11
    out[4] = s * a02 + c * a12
    out[5] = a22


@inline
def _inverse(a: FloatArray, out: FloatArray) -> float:
    """Write the inverse of a symmetric matrix (6); return its determinant."""
    p = a[3] * a[5] - a[4] * a[4]
    q = a[2] * a[4] - a[1] * a[5]
    r = a[1] * a[4] - a[2] * a[3]
    det: float = a[0] * p + a[1] * q + a[2] * r
    if det <= 0.0:
        return det
    out[0], out[1], out[2] = p / det, q / det, r / det
    out[3] = (a[0] * a[5] - a[2] * a[2]) / det
    out[4] = (a[1] * a[2] - a[0] * a[4]) / det
    out[5] = (a[0] * a[3] - a[1] * a[1]) / det
    return det


@inline
def invert(matrix: FloatArray, inverse: FloatArray) -> None:
    """Write the inverse (3, 3) of a symmetric matrix (3, 3)."""
    upper, result, at = stack_array(6), stack_array(6), 0
    for r in range(3):
        for c in range(r, 3):
            upper[at] = matrix[r, c]
            at += 1
    _inverse(upper, result)
    at = 0
    for r in range(3):
        for c in range(r, 3):
            inverse[r, c] = inverse[c, r] = result[at]
            at += 1


@in_place
def condense(
    raw: Points, frames: Frames, seen: LandmarkFactors, poses: FloatArray, landmarks: FloatArray, camera: FloatArray,
    scale: float, kernel: float,
) -> float:  # fmt: skip
    """Write centre, information and slope of all sightings that are not frozen, from their measurements.

    Stereo: an error of (u, v, disparity) at the predicted point e is, in metres, that of y = e + k (v - e),
    k = e_x / v_x, under the information J^T diag(1/su^2, 1/su^2, 1/sd^2) J with J = d(u, v, d)/de. Where the sensor
    gave a covariance, y is the measured point, and the information the inverse of that.

    Args:
        raw, frames: Measurements, and the frames that they were taken from.
        seen: Sightings of these; `centres`, `infos`, `slopes` and `squares` are written.
        poses, landmarks: (k, 3), (l, 3) where to linearise, map frame.
        camera: (focal, baseline, sigma_px, sigma_disparity, mount (3)).
        scale: Factor on all measurement covariances.
        kernel: Squared distance above which Geman and McClure's kernel, scaled to leave the rest alone, sets in; 0:
            none.

    Returns:
        Half the sum of the (robust) squared distances.
    """
    keys, frozen, centres, infos, slopes = (
        seen.keys,
        seen.condensed,
        seen.linearisation_points,
        seen.information,
        seen.gradients,
    )
    point_frames, offsets = raw.point_frames, frames.frame_offsets
    e, y, d = stack_array(3), stack_array(3), stack_array(3)
    info, turned = stack_array(6), stack_array(6)
    for s in range(len(keys)):
        if frozen[s]:
            continue
        pose, landmark = poses[keys[s]], landmarks[seen.landmarks[s]]
        c, sn = math.cos(pose[2]), math.sin(pose[2])
        dx, dy = landmark[0] - pose[0], landmark[1] - pose[1]
        centres[s, 0], centres[s, 1], centres[s, 2] = c * dx + sn * dy, -sn * dx + c * dy, landmark[2]
        infos[s] = 0.0
        slopes[s] = 0.0
    total, frame, c, sn = 0.0, -1, 1.0, 0.0
    for n in range(len(point_frames)):
        s = seen.of_points[n]
        if frozen[s]:
            continue
        offset = offsets[point_frames[n]]
        if frame != point_frames[n]:  # they come one after the other
            frame, c, sn = point_frames[n], math.cos(offset[2]), math.sin(offset[2])
        dx, dy = centres[s, 0] - offset[0], centres[s, 1] - offset[1]
        e[0] = c * dx + sn * dy - camera[4]
        e[1] = -sn * dx + c * dy - camera[5]
        e[2] = centres[s, 2] - camera[6]
        point = raw.points[n]
        if raw.has_covariance[n]:
            _inverse(raw.point_noises[n], info)
            y[0], y[1], y[2] = point[0], point[1], point[2]
        else:
            ahead = e[0] >= MIN_DEPTH
            x0, x1, x2 = (e[0], e[1], e[2]) if ahead else (point[0], point[1], point[2])
            k = x0 / point[0] if ahead else 1.0
            for i in range(3):
                y[i] = e[i] + k * (point[i] - e[i]) if ahead else point[i]  # (3)
            pixel = (camera[0] / (camera[2] * x0)) ** 2
            disparity = (camera[0] * camera[1] / (camera[3] * x0 * x0)) ** 2
            across, up = x1 / x0, x2 / x0
            info[0] = pixel * (across * across + up * up) + disparity
            info[1], info[2] = -pixel * across, -pixel * up
            info[3], info[4], info[5] = pixel, 0.0, pixel
        for i in range(3):
            d[i] = y[i] - e[i]
        v0 = (info[0] * d[0] + info[1] * d[1] + info[2] * d[2]) / scale
        v1 = (info[1] * d[0] + info[3] * d[1] + info[4] * d[2]) / scale
        v2 = (info[2] * d[0] + info[4] * d[1] + info[5] * d[2]) / scale
        square = d[0] * v0 + d[1] * v1 + d[2] * v2
        seen.squares[n] = square
        weight, loss = 1.0, square
        if 0.0 < kernel < square:
            weight = (2.0 * kernel / (kernel + square)) ** 2
            loss = kernel * (3.0 * square - kernel) / (kernel + square)
        total += 0.5 * loss
        _rotate_in_plane(c, sn, info, turned)
        for i in range(6):
            infos[s, i] += weight / scale * turned[i]
        slopes[s, 0] += weight * (c * v0 - sn * v1)
        slopes[s, 1] += weight * (sn * v0 + c * v1)
        slopes[s, 2] += weight * v2
    return total
