"""Study of the Gaussian belief: its path beside that of the filter."""

import pytest

from studies.gaussian import STUDY, Config, play
from studies.losses import trials

SMALL = Config(worlds=("fig5",), presets=("standard",), duration=6.0, particles=(12,), policies=("frontier",), seeds=1)


def test_a_trial_has_both_errors() -> None:
    """Both estimates stay near the truth for a few seconds, and no landmark is held twice."""
    (trial,) = trials(SMALL)
    row = play(SMALL, trial)
    assert 0.0 < row["filter"] < 0.2
    assert 0.0 < row["gaussian"] < 0.2
    assert row["ratio"] == pytest.approx(row["gaussian"] / row["filter"])
    assert row["copies"] == 1.0
    (line,) = STUDY.tables[0].lines([{"preset": "standard", "world": "fig5"} | row])
    assert line["ratio"].value == pytest.approx(row["ratio"])
