"""Check of true landmarks against maps: a few far from where all others say they are, perhaps with swapped names."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.geometry import transform_points
from slam_backend.metrics import align_se2

LEAST = 6  # landmarks of a map that is checked
MOST_WRONG = 1 / 3  # share of the landmarks that may be wrong
MOST_MISPLACED = 2  # landmarks that may be wrong without being swapped
APART = 4.0  # ratio of the least error of wrong landmarks to the largest of the others
LEAST_ERROR = 0.3  # [m] of wrong landmarks
REFINEMENTS = 10


class WrongLandmarks(NamedTuple):
    """Landmarks whose true positions contradict those of all others.

    Attributes:
        rows: (k,) int64, ascending. Indices of the landmarks.
        errors: (k,) float64 [m]. Distances from their true positions after a fit of the others.
        instead: (k,) int64. Indices of the landmarks at whose true positions they lie, a permutation of `rows`; `rows`
            itself if none explains the errors.
        others: RMS distance of the others [m].
    """

    rows: IntArray
    errors: FloatArray
    instead: IntArray
    others: float


def find_wrong_landmarks(truth: FloatArray, means: FloatArray) -> WrongLandmarks | None:
    """Return the few landmarks that a rigid fit of all others contradicts, or None.

    Args:
        truth: (n, 2) float64 [m], world frame. True positions.
        means: (n, 2) float64 [m], map frame. Estimated positions of the same landmarks.
    """
    if len(truth) < LEAST:
        return None
    fitted = transform_points(_robust_fit(truth, means), means)
    errors = np.hypot(*(fitted - truth).T)
    order = np.argsort(errors)
    first = len(truth) - int(MOST_WRONG * len(truth))  # landmarks before this one in `order` are right
    ratios = errors[order[first:]] / np.maximum(errors[order[first - 1 : -1]], 1e-9)
    if ratios.max() < APART or errors[order[first + int(ratios.argmax())]] < LEAST_ERROR:
        return None
    split = first + int(ratios.argmax())
    rows, right = np.sort(order[split:]), order[:split]
    distances = np.hypot(*(fitted[rows, None] - truth[rows]).transpose(2, 0, 1))
    nearest = distances.argmin(axis=1)
    bound = errors[rows].min() / APART
    is_permuted = len(set(nearest.tolist())) == len(rows) and distances.min(axis=1).max() < bound
    if not is_permuted and len(rows) > MOST_MISPLACED:
        return None  # a bent map, rather
    instead = rows[nearest] if is_permuted else rows
    return WrongLandmarks(rows, errors[rows], instead, float(np.sqrt(np.mean(errors[right] ** 2))))


def _robust_fit(truth: FloatArray, means: FloatArray) -> FloatArray:
    """Return the motion (3,) that fits most landmarks, by least trimmed squares from fits of two."""
    kept = len(truth) - int(MOST_WRONG * len(truth))

    def best(motion: FloatArray) -> tuple[float, IntArray]:
        errors = np.hypot(*(transform_points(motion, means) - truth).T)
        chosen = np.argsort(errors)[:kept]
        return float((errors[chosen] ** 2).sum()), chosen

    motions = [align_se2(truth[[i, j]], means[[i, j]]) for i, j in combinations(range(len(truth)), 2)]
    motion = min(motions, key=lambda motion: best(motion)[0])
    for _ in range(REFINEMENTS):
        _, chosen = best(motion)
        motion = align_se2(truth[chosen], means[chosen])
    return motion


def wrong_landmark_notes(
    truth: FloatArray, maps: Sequence[Mapping[int, FloatArray]], names: Sequence[int]
) -> Iterator[str]:
    """Yield a line for each set of landmarks that most of the maps contradict.

    Args:
        truth: (n, 2) float64 [m], world frame. True positions.
        maps: Estimated positions (2,) or (3,) [m] by index of the landmark, each map in its own frame.
        names: Names of the n landmarks.
    """
    counts: Counter[tuple[tuple[int, ...], tuple[int, ...]]] = Counter()
    findings: dict[tuple[tuple[int, ...], tuple[int, ...]], WrongLandmarks] = {}
    for places in maps:
        rows = np.array(sorted(places), dtype=np.int64)
        means = np.array([places[row][:2] for row in rows.tolist()]).reshape(-1, 2)
        if (found := find_wrong_landmarks(truth[rows], means)) is not None:
            key = tuple(rows[found.rows].tolist()), tuple(rows[found.instead].tolist())
            counts[key] += 1
            findings.setdefault(key, found)
    for (wrong, instead), count in counts.items():
        if 2 * count <= sum(set(wrong) <= places.keys() for places in maps):
            continue
        found = findings[wrong, instead]
        listed = ", ".join(str(names[row]) for row in wrong)
        what = "contradict all others"
        if wrong != instead:
            pairs = ", ".join(f"{names[a]} is mapped at {names[b]}" for a, b in zip(wrong, instead, strict=True))
            what = f"seem to be swapped ({pairs})"
        yield (
            f"The true positions of landmarks {listed} {what}: after a fit of the others, to {found.others:.2f} m RMS, "
            f"they are {found.errors.min():.2f} m off or more. Check Landmark_Groundtruth.dat and Barcodes.dat."
        )
