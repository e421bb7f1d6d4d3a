"""Tours and shares of places, against brute force."""

from itertools import pairwise, permutations, product

import numpy as np
import pytest

from slam_backend.core.validation import FloatArray
from vslam_env.navigation import open_tour, share_places, tour_length


def _places(rng: np.random.Generator, robots: int, n: int) -> tuple[FloatArray, FloatArray]:
    """Return straight distances from robots to places, and between places."""
    starts, places = rng.uniform(0.0, 11.0, (robots, 2)), rng.uniform(0.0, 9.0, (n, 2))
    return (
        np.linalg.norm(starts[:, None] - places[None], axis=-1),
        np.linalg.norm(places[:, None] - places[None], axis=-1),
    )


def _plain_length(order: tuple[int, ...], first: FloatArray, between: FloatArray) -> float:
    return float(first[order[0]] + sum(between[a, b] for a, b in pairwise(order))) if order else 0.0


def _shortest(first: FloatArray, between: FloatArray, own: list[int]) -> float:
    return min(_plain_length(order, first, between) for order in permutations(own)) if own else 0.0


def test_tours_are_permutations_and_not_longer_than_going_to_the_nearest() -> None:
    """A tour visits each place once and is never longer than the tour that always goes to the nearest place."""
    rng = np.random.default_rng(0)
    for n in (1, 2, 5, 12, 24):
        for _ in range(20):
            (first,), between = _places(rng, 1, n)
            tour = open_tour(first, between)
            assert sorted(tour) == list(range(n))
            left, greedy = set(range(n)), []
            while left:
                near = min(left, key=lambda p: first[p] if not greedy else between[greedy[-1], p])
                greedy.append(near)
                left.remove(near)
            assert tour_length(tour, first, between) <= _plain_length(tuple(greedy), first, between) + 1e-9
            assert tour_length(tour, first, between) == pytest.approx(_plain_length(tuple(tour), first, between))


def test_tours_of_few_places_are_nearly_the_shortest() -> None:
    """Of six places, tours are within 2 % of the shortest in the mean of 40 draws, and never 20 % longer."""
    rng = np.random.default_rng(1)
    ratios = []
    for _ in range(40):
        (first,), between = _places(rng, 1, 6)
        best = _shortest(first, between, list(range(6)))
        ratios.append(tour_length(open_tour(first, between), first, between) / best)
    assert min(ratios) >= 1.0 - 1e-9
    assert np.mean(ratios) < 1.02
    assert max(ratios) < 1.2


def test_shares_are_nearly_the_best() -> None:
    """For two and three robots and five places the longest tour is within 10 % of the best in the mean, never 70 %."""
    rng, ratios = np.random.default_rng(2), []
    for robots in (2, 3):
        for _ in range(12):
            first, between = _places(rng, robots, 5)

            def longest(owners: tuple[int, ...], first: FloatArray = first, between: FloatArray = between) -> float:
                shares = [[p for p, owner in enumerate(owners) if owner == robot] for robot in range(len(first))]
                return max(_shortest(ways, between, own) for ways, own in zip(first, shares, strict=True))

            best = min(map(longest, product(range(robots), repeat=5)))
            ratios.append(longest(tuple(share_places(first, between))) / best)
    assert np.mean(ratios) < 1.1
    assert max(ratios) < 1.7


def test_unreachable_places_come_last() -> None:
    """Places without a path come last and belong to the robot that has a path."""
    between = np.array([[0.0, np.inf, 2.0], [np.inf, 0.0, np.inf], [2.0, np.inf, 0.0]])
    assert open_tour([3.0, np.inf, 4.0], between).tolist() == [0, 2, 1]
    assert share_places([[np.inf, 1.0, np.inf], [3.0, np.inf, 4.0]], between).tolist() == [1, 0, 1]
    assert open_tour([], np.empty((0, 0))).tolist() == []


def test_lengths_that_do_not_match_are_refused() -> None:
    """Arrays of other shapes and NaN are refused."""
    with pytest.raises(ValueError, match=r"between: expected lengths of paths .* got shape \(2, 2\) with `first` of"):
        open_tour([1.0, 2.0, 3.0], np.zeros((2, 2)))
    with pytest.raises(ValueError, match="between: expected lengths of paths"):
        share_places([1.0, 2.0], np.zeros((2, 2)))
    with pytest.raises(ValueError, match="without NaN"):
        open_tour([np.nan, 2.0], np.zeros((2, 2)))
