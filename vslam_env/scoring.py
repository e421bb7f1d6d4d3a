"""How wrong the maps and poses of a team are, in a table that one kernel writes."""

import math
from typing import Any

import numpy as np

from slam_backend.core.jit import in_place, inlined
from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.fastslam.relative_poses import OWN, SIGMAS, START

FALSE, UNCOUNTED = -1, -2  # claims of landmarks that are no true one, or one that does not matter
PLACED = 0.5  # [m] a landmark held nearer than this is well placed


@inlined
def pose_error(start: FloatArray, estimated: FloatArray, true: FloatArray) -> tuple[float, float]:
    """Return how far an estimated pose, laid at the true start, is from the true one.

    Args:
        start: (3,) float64 [m, m, rad], world frame. True start pose.
        estimated: (3,) float64 [m, m, rad], own start frame.
        true: (3,) float64 [m, m, rad], world frame.

    Returns:
        The distance [m], and the difference of the headings [rad] in [0, pi].
    """
    c, s = math.cos(start[2]), math.sin(start[2])
    dx = start[0] + c * estimated[0] - s * estimated[1] - true[0]
    dy = start[1] + s * estimated[0] + c * estimated[1] - true[1]
    turn = start[2] + estimated[2] - true[2]
    return math.hypot(dx, dy), abs((turn + math.pi) % (2.0 * math.pi) - math.pi)


@inlined
def _score_map(
    places: FloatArray, names: IntArray, book: IntArray, x0: float, y0: float, turn: float, truths: FloatArray,
    cutoff: float, least: FloatArray,
) -> tuple[float, float, float, float, float]:  # fmt: skip
    """Return the scores of a robot's map, in the order of `score_team`.

    Args:
        places, names: (n, 4), (n, 2) int64. Of its landmarks, as in `OutlineRows`.
        book: What the landmark of each name claims.
        x0, y0, turn: The motion [m, m, rad] of the places to the frame of the truths.
        truths: (N, 3) [m], N >= 1.
        cutoff: c of the map error [m].
        least: (N,) overwritten: the squared distance of the nearest landmark that claims each, else infinite.
    """
    least[:] = np.inf
    c, s = math.cos(turn), math.sin(turn)
    estimated = surplus = 0
    for i in range(len(places)):
        claim = book[names[i, 1]]
        estimated += claim != UNCOUNTED
        if claim == FALSE:
            surplus += 1
        elif claim >= 0:
            x = x0 + c * places[i, 0] - s * places[i, 1] - truths[claim, 0]
            y = y0 + s * places[i, 0] + c * places[i, 1] - truths[claim, 1]
            z = places[i, 2] - truths[claim, 2]
            surplus += least[claim] < np.inf
            least[claim] = min(least[claim], x * x + y * y + z * z)
    matched = placed = 0
    squares = 0.0
    total = 0.5 * cutoff * cutoff * surplus
    for square in least:
        if square < np.inf:
            matched += 1
            placed += square < PLACED * PLACED
            squares += square
            total += min(square, cutoff * cutoff)
        else:
            total += 0.5 * cutoff * cutoff
    count = len(truths)
    rmse = math.sqrt(squares / matched) if matched else cutoff
    return math.sqrt(total / count), rmse, matched / count, matched / max(estimated, 1), placed / count


@in_place
def score_team(
    places: Any, names: Any, parts: Any, books: Any, book_of: Any, truths: Any, cutoff: float, beliefs: Any,
    true_starts: Any, true_poses: Any, scores: Any, least: Any,
) -> None:  # fmt: skip
    """Write how wrong the robots' maps and poses are, in their own start frames and without fitting.

    Args:
        places, names, parts: (N, 4), (N, 2) int64, (K, 2) int64. Of `TeamOutlines`.
        books: (B, n) int64. What the landmark of each name claims, map by map: a row of truths, or as above.
        book_of: (K,) int64. Which book is that of each robot's map.
        truths: (N', 3) [m], world frame. The landmarks that count, N' >= 1.
        cutoff: c of the map error [m].
        beliefs: (K, 16 + K). Of `Standpoints`.
        true_starts, true_poses: (K, 3) [m, m, rad], world frame.
        scores: (8 or more, K) float64. Written to: per robot the map error E of the contract [m]; the RMSE [m] of the
            matched landmarks, the cutoff where nothing is matched; matched landmarks over the true ones, and over
            those of the map; matched ones nearer than 0.5 m over the true ones; errors of position [m] and heading
            [rad]; and what the robot believes of the former, one sigma [m].
        least: (N',) room to work in.
    """
    for robot in range(len(beliefs)):
        held, belief = slice(parts[robot, 0], parts[robot, 1]), beliefs[robot]
        x, y, theta = belief[START], belief[START + 1], belief[START + 2]
        c, s = math.cos(true_starts[robot, 2]), math.sin(true_starts[robot, 2])
        x0 = true_starts[robot, 0] + c * x - s * y
        y0 = true_starts[robot, 1] + s * x + c * y
        turn, book = true_starts[robot, 2] + theta, books[book_of[robot]]
        of_map = _score_map(places[held], names[held], book, x0, y0, turn, truths, cutoff, least)
        scores[0, robot], scores[1, robot], scores[2, robot], scores[3, robot], scores[4, robot] = of_map
        scores[5, robot], scores[6, robot] = pose_error(true_starts[robot], belief[OWN : OWN + 3], true_poses[robot])
        scores[7, robot] = belief[SIGMAS + robot]
