"""Guesses of poses are a dictionary by step."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from slam_backend.smoother.graph_building import Guesses

STEPS = st.lists(st.integers(0, 30), unique=True).map(sorted)


@given(STEPS, STEPS, st.integers(-1, 31))
def test_guesses_are_looked_up_and_forgotten_by_step(known, asked, last):
    """What was said of a step comes back, NaN of any other; after a step only later ones are known."""
    by_step = {step: np.random.default_rng(step).normal(size=3) for step in known}
    guesses, half = Guesses.none(), len(known) // 2
    for part in (known[:half], known[half:]):
        poses = np.array([by_step[step] for step in part]).reshape(-1, 3)
        guesses = guesses.with_later(np.array(part, dtype=np.int64), poses)
    for left, first in ((guesses, -1), (guesses.after(last), last)):
        expected = [by_step[step] if step in by_step and step > first else np.full(3, np.nan) for step in asked]
        found = left.at(np.array(asked, dtype=np.int64))
        np.testing.assert_array_equal(found, np.array(expected).reshape(-1, 3))
        assert left.steps.tolist() == [step for step in known if step > first]
