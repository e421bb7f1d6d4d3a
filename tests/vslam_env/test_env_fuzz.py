"""Whatever an environment is made of: it is refused before the first step, as documented, or it plays.

A failure prints the case in one line: `check(Case(...))` repeats it.
"""

from collections.abc import Iterable

import pytest
from fuzzed import Case, check, drawn

LONG_SIGHTED = {"sigma_disparity_px": 0.5, "max_range": 30.0}
UNSURE = {"proposal": "fastslam1", "rejuvenate_every": 7, "motion": {"sigma_across": 3.0, "sigma_heading": 3.0}}
FOUND = {
    "points beyond all that filters take": Case(
        seed=0, preset="standard", sensor="landmark", world=(60.0, 60.0), steps=40,
        changes={
            "landmark_sensor": {"camera": LONG_SIGHTED},
            "belief": {"filter": {"camera": LONG_SIGHTED | {"sigma_px": 0.4, "sigma_disparity_px": 1.0}}},
        },
    ),
    "paths drawn before any landmark": Case(
        seed=1192, preset="standard", sensor="landmark", world=(176.97753639403135, 133.34862938553124), steps=10,
        changes={
            "num_robots": 1, "action_type": "goal", "odometry": {"bias_heading_per_metre": 5.0},
            "landmark_sensor": {"false_points": 0.0}, "scan": {"max_range": 50.0}, "belief": {"filter": UNSURE},
        },
    ),
    "depths that are all but unknown": Case(
        seed=2, preset="standard", sensor="landmark", world="fig5", steps=12,
        changes={
            "num_robots": 1, "action_type": "goal", "odometry": {"bias_distance": 0.5},
            "belief": {"filter": {"rejuvenate_every": 5, "camera": {"sigma_disparity_px": 50.0}}},
        },
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", FOUND.values(), ids=FOUND)
def test_what_once_broke_plays(case: Case) -> None:
    """Environments in which an episode once broke, found by trials."""
    assert check(case)


def played(seeds: Iterable[int]) -> float:
    """Check the cases of some seeds; return the share of those that were played and not refused."""
    checked = [check(drawn(seed)) for seed in seeds]
    return sum(checked) / len(checked)


def test_random_environments_play() -> None:
    """Nothing is raised in a step, nothing is NaN or outside its space, and all bytes repeat; most cases are played."""
    assert played(range(40)) > 0.5


@pytest.mark.slow
@pytest.mark.parametrize("first", range(1000, 1400, 50))
def test_many_random_environments_play(first: int) -> None:
    """The same holds of many more, of which some fifty can be refused more often than played."""
    assert played(range(first, first + 50)) > 0.3
