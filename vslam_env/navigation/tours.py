"""Open tours through places: one robot's way through all of them, and the division of places among robots.

A tour starts at a robot, visits each of its places once and does not return. Tours are improved by 2-opt (Croes 1958)
and by moving single places (or-opt), starting from the tour that always goes to the nearest place.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from slam_backend.core.jit import in_place, jit
from slam_backend.core.validation import FloatArray, IntArray, argument_error

FAR = 1e6  # [m] stands for the length of a path that does not exist


def open_tour(first: ArrayLike, between: ArrayLike) -> IntArray:
    """Return a short open tour through all places.

    Args:
        first: (n,) float64 [m]. Lengths of the paths from the robot to the places; infinite: no path.
        between: (n, n) float64 [m]. Lengths of the paths between the places, symmetric.

    Returns:
        (n,) int64. Places in the order of the tour. It is never longer than the tour to the nearest place each time.

    Raises:
        ValueError: If the shapes do not match, or a length is NaN.

    >>> open_tour([5.0, 1.0, 2.0], [[0, 9, 3], [9, 0, 4], [3, 4, 0]]).tolist()
    [1, 2, 0]
    """
    return np.asarray(_open_tour(*_checked(first, between, 1)))


def tour_length(tour: IntArray, first: ArrayLike, between: ArrayLike) -> float:
    """Return the length [m] of an open tour, see `open_tour`; 0 for an empty one."""
    return float(_tour_length(np.asarray(tour, dtype=np.int64), *_checked(first, between, 1)))


def share_places(first: ArrayLike, between: ArrayLike) -> IntArray:
    """Divide places among robots so that the longest tour is short (multiple travelling salesmen, min-max).

    Each place first belongs to its nearest robot. Then places move from the robot with the longest tour to another
    one, as long as the longer of the two tours becomes shorter.

    Args:
        first: (K, n) float64 [m]. Lengths of the paths from the robots to the places; infinite: no path.
        between: (n, n) float64 [m]. Lengths of the paths between the places, symmetric.

    Returns:
        (n,) int64. Robot of each place.

    Raises:
        ValueError: If the shapes do not match, or a length is NaN.
    """
    return np.asarray(_share_places(*_checked(first, between, 2)))


def _checked(first: ArrayLike, between: ArrayLike, dimensions: int) -> tuple[FloatArray, FloatArray]:
    """Return both arrays with `FAR` for missing paths, or raise."""
    ways, pairs = np.array(first, dtype=np.float64), np.array(between, dtype=np.float64)
    n = ways.shape[-1] if ways.ndim == dimensions else -1
    if pairs.shape != (n, n) or np.isnan(ways).any() or np.isnan(pairs).any():
        expected = "lengths of paths between the n places of `first`, in an array of shape (n, n) without NaN"
        got = f"shape {pairs.shape} with `first` of shape {ways.shape}"
        raise argument_error("between", expected, got, "Use infinity where there is no path.")
    return np.minimum(ways, FAR), np.minimum(pairs, FAR)


@in_place
def _tour_length(tour: Any, first: Any, between: Any) -> float:
    length = 0.0
    for i in range(len(tour)):
        length += first[tour[i]] if i == 0 else between[tour[i - 1], tour[i]]
    return length


@in_place
def _improve(tour: Any, first: Any, between: Any) -> None:
    """Reverse parts of a tour and move single places, as long as it becomes shorter."""
    n = len(tour)
    is_better = True
    while is_better:
        is_better = False
        for i in range(n - 1):
            for j in range(i + 1, n):  # reverse the part from i to j
                before = first[tour[i]] if i == 0 else between[tour[i - 1], tour[i]]
                after = first[tour[j]] if i == 0 else between[tour[i - 1], tour[j]]
                if j + 1 < n:
                    before += between[tour[j], tour[j + 1]]
                    after += between[tour[i], tour[j + 1]]
                if after < before - 1e-9:
                    for k in range((j - i + 1) // 2):
                        tour[i + k], tour[j - k] = tour[j - k], tour[i + k]
                    is_better = True
        old = _tour_length(tour, first, between)
        for i in range(n):
            for j in range(n):
                if i == j:
                    continue
                _move(tour, i, j)
                new = _tour_length(tour, first, between)
                if new < old - 1e-9:
                    old, is_better = new, True
                else:
                    _move(tour, j, i)


@in_place
def _move(tour: Any, source: int, target: int) -> None:
    """Move one entry to another index; those between move up or down."""
    step = 1 if target > source else -1
    place = tour[source]
    for k in range(source, target, step):
        tour[k] = tour[k + step]
    tour[target] = place


@jit
def _open_tour(first: Any, between: Any) -> Any:
    n = len(first)
    tour, is_left = np.empty(n, np.int64), np.ones(n, np.bool_)
    for i in range(n):
        nearest, best = -1, np.inf
        for place in range(n):
            length = first[place] if i == 0 else between[tour[i - 1], place]
            if is_left[place] and length < best:
                nearest, best = place, length
        tour[i] = nearest
        is_left[nearest] = False
    _improve(tour, first, between)
    return tour


@jit
def _share_places(first: Any, between: Any) -> Any:
    num_robots, n = first.shape
    owner = np.zeros(n, np.int64)
    for place in range(n):
        for robot in range(num_robots):
            if first[robot, place] < first[owner[place], place]:
                owner[place] = robot
    lengths = np.empty(num_robots)
    for robot in range(num_robots):
        lengths[robot] = _length_of(robot, owner, first, between)
    is_better = True
    while is_better:
        is_better = False
        longest: Any = np.argmax(lengths)
        best, best_place, best_robot, best_own, best_other = lengths[longest] - 1e-9, -1, -1, 0.0, 0.0
        for place in range(n):
            if owner[place] != longest:
                continue
            for robot in range(num_robots):
                if robot == longest:
                    continue
                owner[place] = robot
                own, other = _length_of(longest, owner, first, between), _length_of(robot, owner, first, between)
                owner[place] = longest
                if max(own, other) < best:
                    best, best_place, best_robot, best_own, best_other = max(own, other), place, robot, own, other
        if best_place >= 0:
            owner[best_place], lengths[longest], lengths[best_robot] = best_robot, best_own, best_other
            is_better = True
    return owner


@jit
def _length_of(robot: int, owner: Any, first: Any, between: Any) -> float:
    """Return the length of the tour of one robot through its places."""
    stops = np.flatnonzero(owner == robot)
    if len(stops) == 0:
        return 0.0
    ways, pairs = np.empty(len(stops)), np.empty((len(stops), len(stops)))
    for i in range(len(stops)):
        ways[i] = first[robot, stops[i]]
        for j in range(len(stops)):
            pairs[i, j] = between[stops[i], stops[j]]
    return _tour_length(_open_tour(ways, pairs), ways, pairs)
