"""Means over seeds and their intervals, as evaluations and the bench of exploration show them."""

import numpy as np
import pytest

from training.experiments.statistics import ahead_by, mean_of, shown


def test_seeds_without_a_figure_do_not_count() -> None:
    """The mean is over the seeds that have the figure; nobody's figure is None."""
    found = mean_of("way", [1.0, None, 3.0, 5.0])
    assert found["way"] == pytest.approx(3.0)
    low, high = found["way_low"], found["way_high"]
    assert low is not None
    assert high is not None
    assert 1.0 <= low < 3.0 < high <= 5.0
    assert mean_of("way", [None, None]) == {"way": None, "way_low": None, "way_high": None}


def test_seeds_are_paired_whatever_their_order() -> None:
    """Differences are taken seed by seed, in the order of the seeds, on those that both have."""
    own, other = {7: 1.0, 2: 4.0, 5: 9.0}, {5: 8.0, 7: 3.0, 1: 0.0}
    np.testing.assert_array_equal(ahead_by(own, other), [1.0, -2.0])
    np.testing.assert_array_equal(ahead_by(other, own), [-1.0, 2.0])


def test_means_are_shown_as_far_as_they_are_known() -> None:
    """With the interval on the same line or below; without it; and a dash."""
    line = {"a": 0.5, "a_low": 0.25, "a_high": 0.75} | mean_of("b", [2.0]) | mean_of("c", [])
    assert shown(line, "a", 1, 100.0) == "50.0 (25.0 .. 75.0)"
    assert shown(line, "a", 1, 100.0, stacked=True) == "50.0\n25.0..75.0"
    assert shown(line, "b", 1, stacked=True) == "2.0"
    assert shown(line, "c") == "-"
    assert shown(mean_of("d", [-1e-9]), "d") == "0.000"  # no sign where nothing is left to sign
