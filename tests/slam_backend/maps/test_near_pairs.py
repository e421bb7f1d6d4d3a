"""Near pairs of growing maps give the candidates that a comparison of all descriptors gives."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slam_backend.maps.alignment_types import AlignmentOptions
from slam_backend.maps.correspondences import candidates, has_enough_candidates
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.maps.near_pairs import Appearance, near_pairs


def a_map(rng: np.random.Generator, classes: np.ndarray, size: int) -> LandmarkMap:
    """Return a map of up to `size` landmarks that look like some of the classes (c, d), with ids that have gaps."""
    looks = classes[rng.integers(0, len(classes), size)]
    looks = looks + rng.normal(0.0, 0.3 / np.sqrt(looks.shape[1]), looks.shape)
    ids = np.sort(rng.choice(5 * size + 1, size, replace=False))
    return LandmarkMap(
        rng.normal(0.0, 2.0, (size, 3)), np.tile(np.eye(3), (size, 1, 1)), looks.astype(np.float32), ids=ids
    )


def appearance(landmarks: LandmarkMap) -> Appearance:
    """Return the ids and descriptors of a map."""
    return Appearance(landmarks.ids, landmarks.descriptors)


@given(
    st.integers(0, 2**32), st.integers(0, 60), st.integers(1, 70), st.sampled_from([3, 42, 64]), st.integers(0, 6),
    st.sampled_from([0.7, 0.8, 1.0]),
)  # fmt: skip
def test_candidates_of_growing_maps_are_those_of_whole_comparisons(
    seed: int, size_a: int, size_b: int, length: int, similar: int, ratio: float
) -> None:
    """Candidates, distinctive ones and their number are the same, with all pairs new and with some taken over.

    In between some landmarks appear, some vanish, and some change their looks, as in a merge.
    """
    rng = np.random.default_rng(seed)
    classes = rng.normal(size=(50, length)) / np.sqrt(length)
    options = AlignmentOptions(max_similar=similar, descriptor_ratio=ratio)
    a, b = a_map(rng, classes, size_a), a_map(rng, classes, size_b)
    looks = a.descriptors.copy()
    looks[rng.random(size_a) < 0.2] += 0.1
    before_a, before_b = (
        replace(a, descriptors=looks).subset(rng.random(size_a) < 0.8),
        b.subset(rng.random(size_b) < 0.7),
    )
    gone = LandmarkMap(
        np.zeros((1, 3)), np.eye(3)[None], classes[:1].astype(np.float32), ids=np.array([5 * size_b + 9])
    )  # fmt: skip
    old_b = Appearance(
        np.concatenate([before_b.ids, gone.ids]), np.concatenate([before_b.descriptors, gone.descriptors])
    )  # fmt: skip
    known = near_pairs(appearance(before_a), old_b, options)
    expected = candidates(a, b, options)
    for earlier in (None, known):
        near = near_pairs(appearance(a), appearance(b), options, earlier)
        if near is None:  # too many look alike
            continue
        for found, wanted in zip(candidates(a, b, options, near), expected, strict=True):
            np.testing.assert_array_equal(found, wanted)
        enough = has_enough_candidates(a.descriptors, b.descriptors, options)
        assert has_enough_candidates(a.descriptors, b.descriptors, options, near) == enough


def test_only_new_landmarks_are_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    """With known pairs the new landmarks alone are compared; with other gates all are."""
    from slam_backend.maps import near_pairs as module

    rng = np.random.default_rng(1)
    classes = rng.normal(size=(50, 64)) / 8.0
    a, b, options = a_map(rng, classes, 90), a_map(rng, classes, 80), AlignmentOptions()
    known = near_pairs(appearance(a.subset(np.arange(90) < 70)), appearance(b.subset(np.arange(80) < 75)), options)
    compared = []
    compare = module.descriptor_matching.near
    monkeypatch.setattr(
        module.descriptor_matching,
        "near",
        lambda *args: compared.append(len(args[0]) * args[1].shape[1]) or compare(*args),
    )
    near_pairs(appearance(a), appearance(b), options, known)
    assert compared == [20 * 80, 70 * 5]
    near_pairs(appearance(a), appearance(b), replace(options, descriptor_gate=0.4), known)
    assert compared[2:] == [90 * 80]


def test_maps_of_look_alikes_have_no_near_pairs() -> None:
    """Where nearly all landmarks look alike, near pairs would need the memory of all pairs; without appearance, too."""
    rng = np.random.default_rng(2)
    a, b = a_map(rng, np.ones((1, 64)), 200), a_map(rng, np.ones((1, 64)), 300)
    assert near_pairs(appearance(a), appearance(b), AlignmentOptions()) is None
    few = appearance(a.subset(np.arange(200) < 5)), appearance(b)
    assert near_pairs(*few, AlignmentOptions()) is not None
    assert near_pairs(*few, AlignmentOptions(appearance=False)) is None


def test_pairs_with_a_map_that_was_empty_are_found_again() -> None:
    """An empty map has descriptors of width 0; what was known of two of them is dropped once they have landmarks."""
    options, rng = AlignmentOptions(), np.random.default_rng(0)
    empty = Appearance(np.empty(0, np.int64), np.empty((0, 0), np.float32))
    look = rng.normal(size=(3, 64)).astype(np.float32)
    full = Appearance(np.arange(3), look / np.linalg.norm(look, axis=1, keepdims=True))
    known = near_pairs(empty, empty, options)
    assert known is not None
    found = near_pairs(full, full, options, known)
    assert found is not None
    assert {(0, 0), (1, 1), (2, 2)} <= set(map(tuple, found.rows.tolist()))
