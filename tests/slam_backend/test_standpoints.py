"""Where robots stand: what kernels are handed is what the attributes show."""

import copy
import pickle
from collections.abc import Callable

import numpy as np
import pytest

from slam_backend.fastslam.relative_poses import SIGMAS, Standpoints, members_of


@pytest.mark.parametrize(("rows", "robots"), [(3, None), (1, 4)])
def test_all_that_is_believed_lies_in_one_array(rows: int, robots: int | None) -> None:
    """What is written by name is in the rows that kernels take, once, and nothing else is."""
    points = Standpoints(rows, robots)
    points.beliefs.fill(-1.0)
    named = points.own, points.starts, points.ess, points.covariances, points.sigmas
    known = rows if robots is None else robots
    assert points.poses.shape == (rows, known, 3)
    shapes = [(rows, 3), (rows, 3), (rows,), (rows, 3, 3), (rows, known)]
    assert [array.shape for array in named] == shapes
    numbers = iter(range(rows * (SIGMAS + known)))
    for array in named:
        array[...] = np.fromiter(numbers, np.float64, array.size).reshape(array.shape)
    assert sorted(points.beliefs.ravel()) == list(range(rows * (SIGMAS + known)))
    assert points.beliefs[:, 7:16].tobytes() == points.covariances.tobytes()


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda points: pickle.loads(pickle.dumps(points))])
def test_the_views_of_a_copy_are_of_its_own_beliefs(copied: Callable[[Standpoints], Standpoints]) -> None:
    """What kernels write into a copy is what it tells."""
    points = Standpoints(2)
    points.beliefs[:], points.poses[:] = 1.0, 2.0
    other = copied(points)
    assert (other.beliefs.tobytes(), other.poses.tobytes()) == (points.beliefs.tobytes(), points.poses.tobytes())
    other.beliefs[:] = 5.0
    for array in (other.own, other.starts, other.ess, other.covariances, other.sigmas):
        assert (array == 5.0).all()


def test_members_say_who_goes_by_a_filter() -> None:
    """The robots of the filter, and of each whether it does."""
    assert members_of((1, 2, 4), (4, 1)).tolist() == [[1, 2, 4], [1, 0, 1]]
