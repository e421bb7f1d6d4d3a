"""Which of the frontiers found now are candidates that there were already: those of the least total distance."""

import numpy as np
from python_entry import python_entry
from scipy.optimize import linear_sum_assignment

from vslam_env.navigation._planning_kernels import SAME_GOAL, weigh_pairs
from vslam_env.navigation.candidate_slots import NUM_SLOTS, _of_least_total

weigh_pairs = python_entry(weigh_pairs)


def test_pairs_that_are_clear_are_those_of_the_least_total() -> None:
    """Whatever lies how close together; what is not clear is left to the search over all pairs."""
    rng = np.random.default_rng(11)
    found = {True: 0, False: 0}
    for _ in range(400):
        goals, places = rng.uniform(0.0, 12.0, (NUM_SLOTS, 5)), rng.uniform(0.0, 12.0, (rng.integers(0, 20), 5))
        again = rng.random(len(places)) < 0.3
        places[again, :2] = goals[rng.integers(0, NUM_SLOTS, again.sum()), :2] + rng.normal(0.0, 0.3, (again.sum(), 2))
        goals[rng.random(NUM_SLOTS) < 0.5] = np.nan
        costs = np.empty((NUM_SLOTS, len(places)))
        is_clear = weigh_pairs(goals, places, costs)
        apart = np.linalg.norm(goals[:, None, :2] - places[None, :, :2], axis=2)
        expected = np.where(apart < SAME_GOAL, apart, SAME_GOAL)  # NaN is no less
        np.testing.assert_allclose(costs, expected, rtol=1e-15)
        slots, sources = linear_sum_assignment(expected)
        near = expected[slots, sources] < SAME_GOAL
        chosen = costs if is_clear else _of_least_total(costs)
        kept = np.argwhere(chosen < SAME_GOAL)
        np.testing.assert_array_equal(kept, np.column_stack([slots, sources])[near])
        is_alone = [(expected < SAME_GOAL).sum(axis=axis).max(initial=0) <= 1 for axis in (0, 1)]
        assert is_clear == all(is_alone)
        found[is_clear] += 1
    assert min(found.values()) > 40
