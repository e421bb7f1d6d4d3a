"""Records of arrays that kernels take and return together: parts of a graph, its sightings, equations and factor."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.validation import BoolArray, FloatArray, IntArray

NONE: Final = -1  # no key, no robot
BIAS: Final = -2  # in place of the robot of a key that holds an odometry bias
FREE: Final = -1  # column of a pose that is given, not sought
LEVER: Final = 3.0  # [m]; where an error of the heading between two keys is felt


class Keys(NamedTuple):
    """Columns of `SlamGraph` with one row for each of k keys."""

    robots: IntArray
    poses: FloatArray
    parents: IntArray
    odometry: FloatArray
    odometry_covariances: FloatArray
    bias_jacobians: FloatArray
    transition_variances: FloatArray
    rigid_variances: FloatArray


class Frames(NamedTuple):
    """Columns of `SlamGraph` with one row for each of f frames."""

    frame_keys: IntArray
    frame_offsets: FloatArray


class Points(NamedTuple):
    """Columns of `SlamGraph` with one row for each of n raw measurements."""

    points: FloatArray
    point_noises: FloatArray
    has_covariance: BoolArray
    point_frames: IntArray
    point_landmarks: IntArray


class Condensed(NamedTuple):
    """Columns of `SlamGraph` with one row for each frozen sighting."""

    condensed_keys: IntArray
    condensed_landmarks: IntArray
    linearisation_points: FloatArray
    information: FloatArray
    gradients: FloatArray
    counts: IntArray


class Landmarks(NamedTuple):
    """Columns of `SlamGraph` with one row for each of l landmarks."""

    landmark_ids: IntArray
    landmarks: FloatArray


class Log(NamedTuple):
    """T steps of one robot.

    Attributes:
        steps, kinds, motions, given, starts, points, ids: Columns of `LogArrays`.
        covariances: (n, 6) [m^2] of the measured points, (0, 6) where there are none at all.
        variances: (T, 3) [m^2, m^2, rad^2] of the parts of each motion.
        jacobians: (T, 3, 3) derivative of each motion by the robot's odometry bias; (0, 3, 3) without a bias.
        bias: (3,) [m/m, rad/m, rad/rad] bias about which odometry is chained.
    """

    steps: IntArray
    kinds: NDArray[np.int8]
    motions: FloatArray
    given: BoolArray
    starts: IntArray
    points: FloatArray
    ids: IntArray
    covariances: FloatArray
    variances: FloatArray
    jacobians: FloatArray
    bias: FloatArray


class LandmarkFactors(NamedTuple):
    """Forms of s sightings, by landmark; those of raw measurements change with the point of linearisation.

    Attributes:
        keys, landmarks: (s,) int64.
        starts: (l + 1,) int64. Offsets: factors of landmark i are starts[i] to starts[i + 1].
        condensed: (s,) bool.
        linearisation_points, information, gradients: (s, 3), (s, 6), (s, 3) float64. See `_kernels.factors`.
        counts: (s,) int64. Measurements in each.
        of_points: (n,) int64. Sighting of each raw measurement.
        squares: (n,) float64. Squared Mahalanobis distance of each, where it was last linearised.
    """

    keys: IntArray
    landmarks: IntArray
    starts: IntArray
    condensed: BoolArray
    linearisation_points: FloatArray
    information: FloatArray
    gradients: FloatArray
    counts: IntArray
    of_points: IntArray
    squares: FloatArray


class EquationBlocks(NamedTuple):
    """Normal equations of n poses that are sought and l landmarks; nodes are the poses, then the landmarks.

    Attributes:
        turns: (k, 2) cosine and sine of each heading.
        blocks: (n + l, 6) second derivatives by each node.
        links: (k, 3, 3) by a key (rows) and the one before (columns), where both are sought.
        cross: (s, 3, 3) by pose (rows) and landmark (columns) of each sighting, where the pose is sought.
        bias_links: (k, 3, 3) by a key (rows) and the odometry bias of its robot (columns); (0, 3, 3) without biases.
        vector: (n + l, 3) slope of the cost.
    """

    turns: FloatArray
    blocks: FloatArray
    links: FloatArray
    cross: FloatArray
    bias_links: FloatArray
    vector: FloatArray


class SymbolicFactor(NamedTuple):
    """Places of the blocks of a factor of N nodes: column by column, in each by ascending rows.

    Attributes:
        order: (N,) nodes in the order of elimination.
        ranks: (N,) place of each node in that order.
        tops, rows: (N + 1,), (filled,) blocks of column j are tops[j] to tops[j + 1], and their rows.
        link_places, cross_places, bias_places: (k,), (s,), (k,) 1 + place of each block of `links`, `cross` and
            `bias_links`, negative if it is transposed there, 0 if there is none.
        row_tops, row_columns, row_places: (N + 1,), (filled,), (filled,) the same blocks row by row.
        drawn: Number of nodes that `draw` samples.
    """

    order: IntArray
    ranks: IntArray
    tops: IntArray
    rows: IntArray
    link_places: IntArray
    cross_places: IntArray
    bias_places: IntArray
    row_tops: IntArray
    row_columns: IntArray
    row_places: IntArray
    drawn: int


class CholeskyFactor(NamedTuple):
    """Blocks of a factor of N nodes, nine numbers row by row, where a `SymbolicFactor` says.

    Attributes:
        pivots: (N, 6) lower triangles by rows, with the reciprocals of their diagonals.
        values: (filled, 9) blocks off the diagonal.
        where: (N,) room.
    """

    pivots: FloatArray
    values: FloatArray
    where: IntArray
