"""What the backend offers refuses arguments of another kind, and names that it does not have, in one form."""

import inspect
from collections.abc import Callable
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import slam_backend
from slam_backend import FastSlam, FilterOptions, LandmarkMap, TeamSlam, Trajectory, fuse_maps
from slam_backend.core.validation import is_built_in, known_names
from slam_backend.frontend import CornerOptions, FrontEndOptions
from slam_backend.maps.fusion import fuse_landmarks
from slam_backend.readers.kitti import load_kitti
from slam_backend.readers.kitti_images import load_kitti_images
from slam_backend.readers.mrclam import load_mrclam
from slam_backend.readers.victoria import load_victoria
from slam_backend.reference.filter import PlainFastSlam

OFFERED = [getattr(slam_backend, name) for name in slam_backend.__all__]
# All classes that can be made without arguments are options, models or filters.
OPTIONS = [
    kind
    for kind in (*OFFERED, CornerOptions, FrontEndOptions)
    if isinstance(kind, type)
    and (is_dataclass(kind) or kind is FastSlam)
    and all(p.default is not p.empty for p in inspect.signature(kind).parameters.values())
]
WRONG = [None, 3, "x", [None], object()]
EMPTY = LandmarkMap.empty(4)
TWO = (np.zeros(3), np.eye(3), np.zeros(3), np.eye(3))
CALLS: dict[str, Callable[[Any], Any]] = {
    "alignment": lambda wrong: fuse_maps(EMPTY, EMPTY, wrong),
    "map_a": lambda wrong: fuse_maps(wrong, EMPTY, None),  # type: ignore[arg-type]
    "map_b": lambda wrong: fuse_maps(EMPTY, wrong, None),  # type: ignore[arg-type]
    "mean1": lambda wrong: fuse_landmarks(wrong, *TWO[1:]),
    "cov1": lambda wrong: fuse_landmarks(TWO[0], wrong, *TWO[2:]),
    "mean2": lambda wrong: fuse_landmarks(*TWO[:2], wrong, TWO[3]),
    "cov2": lambda wrong: fuse_landmarks(*TWO[:3], wrong),
    "options, plain": lambda wrong: PlainFastSlam(1, wrong),
    "merge": lambda wrong: TeamSlam(2, num_particles=2).merged_maps(wrong),
    "descriptor_size": lambda wrong: LandmarkMap.empty(-7 if wrong == 3 else wrong),
    "path, map": lambda wrong: LandmarkMap.load(wrong),
    "path, saved map": lambda wrong: EMPTY.save(3 if wrong == "x" else wrong),
    "path, tum": lambda wrong: Trajectory.load_tum(wrong),
    "path, mrclam": lambda wrong: load_mrclam(wrong),
    "path, victoria": lambda wrong: load_victoria(wrong),
    "path, kitti": lambda wrong: load_kitti(wrong),
    "path, images": lambda wrong: load_kitti_images(wrong),
    "times": lambda wrong: Trajectory([0.0, 1.0], np.zeros((2, 3))).at(wrong),
}


def test_the_options_are_looked_at() -> None:
    """The list holds what a user configures filters, teams, alignments and cameras by."""
    names = {kind.__name__ for kind in OPTIONS}
    assert names >= {"FastSlam", "FilterOptions", "AlignmentOptions", "AttemptOptions", "MergeOptions", "StereoCamera"}


@pytest.mark.parametrize("kind", OPTIONS, ids=lambda kind: kind.__name__)
def test_unknown_names_are_refused(kind: type[Any]) -> None:
    """The line names what is unknown, and lists what there is."""
    with pytest.raises(ValueError, match=rf"^foo: expected a known argument, got a name that {kind.__name__} does not"):
        kind(foo=1)
    first = next(iter(inspect.signature(kind).parameters))
    with pytest.raises(ValueError, match=rf"It has (.*, )?{first}(,|\.)"):
        kind(foo=1)


def test_unknown_names_of_a_team_are_refused() -> None:
    """A team takes the options of its filters too."""
    with pytest.raises(ValueError, match=r"^foo: expected a known argument"):
        TeamSlam(2, foo=1)


def test_what_is_known_goes_through() -> None:
    """Names, places and defaults are as without the check."""

    @known_names
    class Gate:
        def __init__(self, width: float, *, height: float = 2.0) -> None:
            self.area = width * height

    assert (Gate(3.0).area, Gate(width=3.0, height=1.0).area) == (6.0, 3.0)
    assert list(inspect.signature(FilterOptions).parameters)[:1] == ["num_particles"]
    with pytest.raises(TypeError, match="width"):
        Gate()  # type: ignore[call-arg]


@pytest.mark.parametrize("call", CALLS)
@pytest.mark.parametrize("wrong", WRONG, ids=lambda wrong: type(wrong).__name__)
def test_wrong_kinds_are_named(call: str, wrong: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`None`, a number, a text, a list and an object in the place of something else: the line names the argument."""
    monkeypatch.chdir(tmp_path)
    if call == "times" and wrong == 3:
        wrong = 3.5  # a number is a time, and this one was not recorded
    with pytest.raises(ValueError, match=rf"^{call.split(',')[0]}: expected "):
        CALLS[call](wrong)


def test_built_in_callables_are_known() -> None:
    """What Python or an extension brings is distinguished from what is written in Python."""

    class Mine:
        """A class."""

    assert all(map(is_built_in, (print, int, np.zeros, dict)))
    assert not any(map(is_built_in, (Mine, lambda: None, inspect.signature, Mine())))
