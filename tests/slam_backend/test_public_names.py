"""The package itself gives all that its filters take and hand back."""

from types import UnionType
from typing import Any, get_args, get_type_hints

import pytest

import slam_backend
from slam_backend import FastSlam, FilterOptions, StepReport, TeamReport, TeamSlam


def classes_of(hint: Any) -> set[type]:
    """Return the project's own classes that an annotation names."""
    if isinstance(hint, type) and not isinstance(hint, UnionType):
        return {hint} if hint.__module__.startswith("slam_backend.") else set()
    return set().union(*(classes_of(part) for part in get_args(hint)))


@pytest.mark.parametrize(
    "described",
    [FastSlam.__init__, FastSlam.step, FastSlam.rejuvenate, FilterOptions, StepReport, TeamSlam.__init__],
)
def test_what_a_filter_takes_and_tells_needs_no_inner_module(described: Any) -> None:
    """Whatever is to be built, or comes back, is a name of `slam_backend`."""
    found = set().union(*(classes_of(hint) for hint in get_type_hints(described).values()))
    assert found
    assert {kind.__name__ for kind in found} <= set(slam_backend.__all__)


def test_all_public_names_are_there() -> None:
    """Nothing is promised that is missing, and the list is in order."""
    assert all(hasattr(slam_backend, name) for name in slam_backend.__all__)
    assert slam_backend.__all__ == sorted(slam_backend.__all__)


def test_a_team_report_holds_reports_by_their_public_name() -> None:
    """What a team tells of rejuvenations is the class that the package names."""
    assert slam_backend.RejuvenationReport in classes_of(get_type_hints(TeamReport)["rejuvenations"])
