"""A step of Gauss and Newton: what the equations ask for, and where it leads."""

from slam_backend._jit import jit
from slam_backend.errors import FloatArray, IntArray
from slam_backend.smoothing._kernels.equations import advance
from slam_backend.smoothing._kernels.factoring import solve


@jit
def step(
    pivots: FloatArray, values: FloatArray, order: IntArray, tops: IntArray, rows: IntArray, vector: FloatArray,
    columns: IntArray, poses: FloatArray, landmarks: FloatArray, new_poses: FloatArray, new_landmarks: FloatArray,
) -> tuple[float, float]:  # fmt: skip
    """Write where the factored equations lead.

    Args:
        pivots, values, order, tops, rows: As of `solve`.
        vector, columns, poses, landmarks, new_poses, new_landmarks: As of `advance`.

    Returns:
        As `advance`.
    """
    change = solve(pivots, values, order, tops, rows, -vector)
    return advance(change, vector, columns, poses, landmarks, new_poses, new_landmarks)
