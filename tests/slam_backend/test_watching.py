"""What a watched merge rests on is weighed against what tells against it."""

import numpy as np
import pytest
from mapped_once import looks

from slam_backend.maps.alignment import Alignment, AlignmentOptions
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.team.merge_monitor import Watch
from slam_backend.team.options import MergeOptions

TWICE = 12  # landmarks that the joint map holds a second time, a metre away


def joined_map(count: int, turned: int = 0) -> LandmarkMap:
    """Return so many landmarks that a merge joined, under ids of their own; what each looks like may be turned."""
    means = np.column_stack([20.0 + np.arange(count), np.zeros(count), np.zeros(count)])
    names = looks((np.arange(count) + turned) % 13)
    return LandmarkMap(means, np.tile(1e-3 * np.eye(3), (count, 1, 1)), names, ids=100 + np.arange(count))


def watched(joined: int, turned: int = 0) -> tuple[Watch, LandmarkMap]:
    """Return the watch of a merge that joined so many pairs, and the joint map, which holds some landmarks twice."""
    rng = np.random.default_rng(3)
    places = np.column_stack([rng.uniform(0.0, 12.0, (TWICE, 2)), np.full(TWICE, 0.5)])
    means = np.concatenate([places, places + np.array([1.0, 0.0, 0.0])])
    names = looks(np.tile(np.arange(TWICE), 2))
    joint = LandmarkMap(means, np.tile(1e-3 * np.eye(3), (2 * TWICE, 1, 1)), names)
    alignment = Alignment(True, "", 0.0, 0.0, 0.0, 1e-4 * np.eye(3), np.empty((0, 2), np.int64), 0.0)
    own, before = (set(range(TWICE)), set(range(TWICE, 2 * TWICE))), (joined_map(joined), joined_map(joined, turned))
    return Watch(2, alignment, (None, None), before, own), joint  # type: ignore[arg-type]


@pytest.mark.parametrize(("joined", "contradicted"), [(0, True), (7, True), (8, False), (60, False)])
def test_a_merge_stands_that_rests_on_more_than_tells_against_it(joined: int, contradicted: bool) -> None:
    """Landmarks mapped twice undo a merge only if the pairs that it joined are no more than 0.6 times as many."""
    watch, joint = watched(joined)
    assert watch.is_contradicted(joint, MergeOptions(), AlignmentOptions(max_ratio=0.6)) == contradicted


def test_pairs_that_do_not_look_alike_are_no_evidence() -> None:
    """However many a merge joined by chance, landmarks mapped twice undo it."""
    watch, joint = watched(60, turned=1)
    assert watch.is_contradicted(joint, MergeOptions(), AlignmentOptions())
