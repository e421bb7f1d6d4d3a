"""Landmark maps as texts and clouds of points for other programs; `LandmarkMap.save` writes them."""

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from slam_backend.maps.landmark_map import LandmarkMap

UPPER = ("xx", "xy", "xz", "yy", "yz", "zz")
CSV_COLUMNS = ("id", "count", "x_m", "y_m", "z_m", *(f"cov_{pair}_m2" for pair in UPPER))
PLY_PROPERTIES = ("x", "y", "z", "count", "sigma")


def to_csv(landmarks: "LandmarkMap") -> str:
    """Return a map as CSV, without descriptors; numbers have the shortest form that is exact."""
    upper = landmarks.covariances[:, *np.triu_indices(3)]
    rows = zip(landmarks.ids, landmarks.counts, landmarks.means, upper, strict=True)
    lines = [
        ",".join(map(repr, [int(name), int(count), *mean.tolist(), *own.tolist()])) for name, count, mean, own in rows
    ]
    return "\n".join([",".join(CSV_COLUMNS), *lines]) + "\n"


def to_ply(landmarks: "LandmarkMap") -> bytes:
    """Return a map as PLY, a binary cloud of points for MeshLab, CloudCompare or Open3D, without descriptors.

    Each vertex has x, y and z [m], the number of measurements `count`, and `sigma` [m], the root of the trace of the
    covariance; all are float32.
    """
    sigma = np.sqrt(landmarks.summary.variances)
    rows = np.column_stack([landmarks.means, landmarks.counts, sigma]).astype("<f4")
    properties = "".join(f"property float {name}\n" for name in PLY_PROPERTIES)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{properties}end_header\n"
    return header.encode() + rows.tobytes()
