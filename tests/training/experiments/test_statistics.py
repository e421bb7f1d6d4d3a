"""Means over seeds and their intervals, as shown by evaluations and the exploration benchmark."""

import numpy as np
import pytest

from training.experiments.statistics import format_ci, mean_ci, paired_difference


def test_seeds_without_a_value_do_not_count() -> None:
    """The mean is over the seeds with a value; without any it is None."""
    found = mean_ci("way", [1.0, None, 3.0, 5.0])
    assert found["way"] == pytest.approx(3.0)
    low, high = found["way_low"], found["way_high"]
    assert low is not None
    assert high is not None
    assert 1.0 <= low < 3.0 < high <= 5.0
    assert mean_ci("way", [None, None]) == {"way": None, "way_low": None, "way_high": None}


def test_seeds_are_paired_whatever_their_order() -> None:
    """Differences are seed by seed, in the order of the seeds, on common seeds."""
    own, other = {7: 1.0, 2: 4.0, 5: 9.0}, {5: 8.0, 7: 3.0, 1: 0.0}
    np.testing.assert_array_equal(paired_difference(own, other), [1.0, -2.0])
    np.testing.assert_array_equal(paired_difference(other, own), [-1.0, 2.0])


def test_means_are_formatted_with_known_intervals() -> None:
    """Means have the interval on the same line or below, no interval, or are a dash."""
    line = {"a": 0.5, "a_low": 0.25, "a_high": 0.75} | mean_ci("b", [2.0]) | mean_ci("c", [])
    assert format_ci(line, "a", 1, 100.0) == "50.0 (25.0 .. 75.0)"
    assert format_ci(line, "a", 1, 100.0, stacked=True) == "50.0\n25.0..75.0"
    assert format_ci(line, "b", 1, stacked=True) == "2.0"
    assert format_ci(line, "c") == "-"
    assert format_ci(mean_ci("d", [-1e-9]), "d") == "0.000"  # no sign for a rounded zero
