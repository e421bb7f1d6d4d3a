"""The table of matched landmarks that alignment reads, one row of `COLUMNS` numbers for each match.

Columns 0-2 and 3-5 hold the means of a and b [m], 6-11 and 12-17 the upper triangles of their covariances [m^2] by
rows, each in the frame of its map.
"""

import numpy as np

from slam_backend.core.packed_symmetric import OF_NINE, UNPACK_INDEX, UPPER
from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.maps.landmark_map import LandmarkMap

COLUMNS = 18


def match_table(map_a: LandmarkMap, map_b: LandmarkMap, matches: IntArray) -> FloatArray:
    """Return the table (k, 18) of matched landmarks.

    Args:
        map_a, map_b: Both maps.
        matches: (k, 2) int64 rows (row in a, row in b).
    """
    rows_a, rows_b = matches.T
    table = np.empty((len(matches), COLUMNS))
    table[:, :3], table[:, 3:6] = map_a.means[rows_a], map_b.means[rows_b]
    table[:, 6:12] = map_a.covariances[rows_a].reshape(-1, 9).take(OF_NINE, axis=1)
    table[:, 12:] = map_b.covariances[rows_b].reshape(-1, 9).take(OF_NINE, axis=1)
    return table


def planar_points(table: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return where the landmarks of a and b lie in the plane, both (k, 2) [m]; views."""
    return table[:, :2], table[:, 3:5]


def planar_variances(table: FloatArray) -> FloatArray:
    """Return the variance (k,) [m^2] of the difference of both sides along an axis of the plane, the mean of both."""
    return np.asarray((table[:, 6] + table[:, 9] + table[:, 12] + table[:, 15]) / 2.0)


def mirrored(table: FloatArray, centre: FloatArray, axis: FloatArray) -> FloatArray:
    """Return the table with b mirrored about the line through `centre` (2,) along the unit vector `axis`."""
    x, y = axis.tolist()
    mirror = np.array([[2.0 * x * x - 1.0, 2.0 * x * y, 0.0], [2.0 * x * y, 2.0 * y * y - 1.0, 0.0], [0.0, 0.0, 1.0]])
    image = table.copy()
    image[:, 3:5] = centre + (table[:, 3:5] - centre) @ mirror[:2, :2]
    image[:, 12:] = (mirror @ table[:, 12:][:, UNPACK_INDEX] @ mirror)[:, *UPPER]
    return image
