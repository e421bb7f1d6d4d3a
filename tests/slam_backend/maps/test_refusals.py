"""Why maps are not merged, or a merge does not stand."""

import numpy as np
import pytest
from builders.filters import looks
from builders.teams import driven

from slam_backend.core.validation import FloatArray
from slam_backend.geometry import rotate_covariances, rotation, transform_points
from slam_backend.maps.alignment import REASONS, Alignment, AlignmentOptions, align_maps
from slam_backend.maps.alignment_types import BOUNDS, HINTS
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.team.merge_monitor import MergeMonitor, deformed_fraction
from slam_backend.team.merge_scheduler import AttemptOptions
from slam_backend.team.options import MergeOptions
from slam_backend.team.reports import MergeEvent, count_attempts, refusals_of

FOUND = Alignment(True, "", 1.0, 2.0, 0.1, 1e-3 * np.eye(3), np.zeros((1, 2), np.int64), 0.0)


def refused(step: int, a: tuple[int, ...], b: tuple[int, ...], *told: object) -> MergeEvent:
    """Return a refused attempt; `told` are the arguments of the refusal."""
    return MergeEvent(step, "attempt", a, b, Alignment.refused(*told))  # type: ignore[arg-type]


def test_each_pair_has_its_attempts_and_the_last_refusal() -> None:
    """Attempts and refusals count by pair and reason; merges and undos do not count, nor does a success as refused."""
    events = [
        refused(24, (0,), (1,), "ambiguous", 0.7),
        refused(49, (0,), (2,), "too few inliers"),
        refused(74, (0,), (1,), "too uncertain", 0.1, "paths", 2.5),
        refused(99, (0,), (1,), "too uncertain", 0.1, "rotation", 1.5),
        MergeEvent(124, "attempt", (0,), (1,), FOUND),
        MergeEvent(124, "merge", (0,), (1,), FOUND),
        MergeEvent(180, "undo", (0,), (1,), FOUND),
    ]
    first, second = count_attempts(events)
    assert (first.robots_a, first.robots_b, first.attempts) == ((0,), (1,), 4)
    assert list(first.refusals.items()) == [("ambiguous", 1), ("too uncertain", 2)]
    assert (first.last_reason, first.last_step, first.missed, first.excess) == ("too uncertain", 99, "rotation", 1.5)
    assert (second.attempts, second.last_reason, second.last_step, second.missed) == (1, "too few inliers", 49, "")
    rows = [refusals_of(events, robot) for robot in range(3)]
    assert [row["attempts"] for row in rows] == [5.0, 4.0, 1.0]
    assert [row["refused_too_uncertain"] for row in rows] == [2.0, 2.0, 0.0]
    assert {len(row) for row in rows} == {1 + len(REASONS)}


def test_every_refusal_reason_has_a_hint() -> None:
    """Each reason of the closed list has a hint, and nothing else has."""
    assert set(HINTS) == set(REASONS)


def blurred(sigma: float, count: int = 12, spread: float = 3.0) -> tuple[LandmarkMap, LandmarkMap]:
    """Return a map twice: so many landmarks that all look different, each as uncertain as `sigma` [m]."""
    rng = np.random.default_rng(5)
    means = np.column_stack([rng.uniform(0.0, spread, (count, 2)), np.ones(count)])
    looks = np.eye(count, dtype=np.float32)
    covariances = np.repeat(sigma**2 * np.eye(3)[None], count, axis=0)
    twin = LandmarkMap(means, covariances, looks, np.full(count, 9), np.arange(count))
    return twin, twin


@pytest.mark.parametrize(
    ("limits", "missed"),
    [({"max_sigma_position": 0.001}, "translation"), ({"max_sigma_heading": 0.0001}, "rotation")],
)
def test_an_alignment_that_is_too_uncertain_says_which_bound_it_misses(limits: dict[str, float], missed: str) -> None:
    """The bound that is missed most is named; raised to just beyond the excess it is kept, to just below it is not."""
    maps = blurred(0.01)
    found = align_maps(*maps, options=AlignmentOptions(**limits))
    assert (found.reason, found.missed) == ("too uncertain", missed)
    assert found.missed in BOUNDS
    assert found.excess > 1.0
    ((name, limit),) = limits.items()
    assert align_maps(*maps, options=AlignmentOptions(**{name: 1.01 * found.excess * limit})).success
    assert align_maps(*maps, options=AlignmentOptions(**{name: 0.99 * found.excess * limit})).missed == missed


def test_a_refusal_for_path_uncertainty_names_the_paths() -> None:
    """If the particles of a merge differ too much, the refusal names the paths, and the event has the uncertainty."""
    _, team = driven(2, 112, 100, attempts=AttemptOptions(every=10), merging=MergeOptions(min_sigmas=1e4))
    event = next(event for event in team.events if event.alignment.reason == "too uncertain")
    assert event.alignment.missed == "paths"
    assert event.alignment.excess == event.uncertainty > 1.0
    pair = next(pair for pair in team.pair_attempts if "too uncertain" in pair.refusals)
    assert team.diagnostics[0]["refused_too_uncertain"] == pair.refusals["too uncertain"]


TWICE = 12  # landmarks that the joint map holds a second time, a metre away


def joined_map(count: int, turned: int = 0) -> LandmarkMap:
    """Return so many landmarks that a merge joined, under ids of their own; what each looks like may be turned."""
    means = np.column_stack([20.0 + np.arange(count), np.zeros(count), np.zeros(count)])
    names = looks((np.arange(count) + turned) % 13)
    return LandmarkMap(means, np.tile(1e-3 * np.eye(3), (count, 1, 1)), names, ids=100 + np.arange(count))


def watched(joined: int, turned: int = 0) -> tuple[MergeMonitor, LandmarkMap]:
    """Return the watch of a merge that joined so many pairs, and the joint map, which holds some landmarks twice."""
    rng = np.random.default_rng(3)
    places = np.column_stack([rng.uniform(0.0, 12.0, (TWICE, 2)), np.full(TWICE, 0.5)])
    means = np.concatenate([places, places + np.array([1.0, 0.0, 0.0])])
    names = looks(np.tile(np.arange(TWICE), 2))
    joint = LandmarkMap(means, np.tile(1e-3 * np.eye(3), (2 * TWICE, 1, 1)), names)
    own, before = (set(range(TWICE)), set(range(TWICE, 2 * TWICE))), (joined_map(joined), joined_map(joined, turned))
    return MergeMonitor(2, ((0,), (1,)), before, own), joint


@pytest.mark.parametrize(("joined", "contradicted"), [(0, True), (7, True), (8, False), (60, False)])
def test_a_merge_with_more_evidence_than_contradictions_stands(joined: int, contradicted: bool) -> None:
    """Landmarks mapped twice undo a merge only if the pairs that it joined are no more than 0.6 times as many."""
    watch, joint = watched(joined)
    assert watch.is_inconsistent(joint, MergeOptions(), AlignmentOptions(max_ratio=0.6)) == contradicted


def test_pairs_that_do_not_look_alike_are_no_evidence() -> None:
    """However many a merge joined by chance, landmarks mapped twice undo it."""
    watch, joint = watched(60, turned=1)
    assert watch.is_inconsistent(joint, MergeOptions(), AlignmentOptions())


FITS = 10


def plain_share(old: LandmarkMap, joint: LandmarkMap, options: AlignmentOptions) -> float:
    """Return the share of landmarks beyond the gate, by matrices and ten fits whatever the set of those within it."""
    _, rows, places = np.intersect1d(old.ids, joint.ids, return_indices=True)
    if len(rows) < options.min_inliers:
        return 0.0
    points, targets = old.means[rows], joint.means[places]
    inside, outside = np.ones(len(rows)), np.zeros(len(rows), np.bool_)
    for _ in range(FITS):
        motion = rigid_motion(points, targets, inside)
        covariances = rotate_covariances(motion[2], old.covariances[rows]) + joint.covariances[places]
        residuals = targets - transform_points(motion, points)
        widened = covariances + options.position_floor**2 * np.eye(3)
        squares = np.einsum("ni,ni->n", residuals, np.linalg.solve(widened, residuals[..., None])[..., 0])
        outside = squares > options.position_gate
        inside = np.where(outside, 1e-3, 1.0)
    return float(np.mean(outside))


def rigid_motion(points: FloatArray, targets: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the planar motion (3,) that takes points (n, 3) to targets (n, 3) by weighted least squares."""
    shares = weights / weights.sum()
    here, there = shares @ points[:, :2], shares @ targets[:, :2]
    spread = ((points[:, :2] - here) * shares[:, None]).T @ (targets[:, :2] - there)
    angle = np.arctan2(spread[0, 1] - spread[1, 0], spread[0, 0] + spread[1, 1])
    return np.array([*(there - rotation(angle) @ here), angle])


def covariances(rng: np.random.Generator, count: int) -> FloatArray:
    """Return covariances (count, 3, 3) of any shape [m^2]."""
    roots = 0.1 * rng.standard_normal((count, 3, 3))
    return roots @ roots.transpose(0, 2, 1) + 1e-4 * np.eye(3)


def test_the_kernel_agrees_with_matrices() -> None:
    """For deformed maps with lost and renumbered landmarks, the deformed share is that of plain numpy."""
    shares = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        means = rng.uniform(-9.0, 9.0, (60, 3)) * [1.0, 1.0, 0.1]
        old = LandmarkMap(means, covariances(rng, 60), np.eye(60, 5), None, rng.permutation(60))
        bent = transform_points(rng.uniform(-3.0, 3.0, 3), means) + rng.normal(0.0, 0.2, (60, 3))
        bent[: 5 * seed, :2] += rng.uniform(0.5, 1.5, 2)
        kept = rng.permutation(60)[:40]
        joint = LandmarkMap(bent[kept], covariances(rng, 40), np.eye(40, 5), None, old.ids[kept])
        for options in (AlignmentOptions(), AlignmentOptions(position_gate=3.0), AlignmentOptions(min_inliers=41)):
            shares.append(plain_share(old, joint, options))
            assert deformed_fraction(old, joint, options) == shares[-1]
    assert len(set(shares)) > 8
