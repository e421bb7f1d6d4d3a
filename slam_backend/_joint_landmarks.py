"""Landmarks of all particles of two filters: taken out, moved by each particle's own motion, fused."""

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from slam_backend._packed import UNPACK, UPPER
from slam_backend.errors import FloatArray, IntArray
from slam_backend.existence import ExistenceModel
from slam_backend.filter import FastSlam
from slam_backend.fusion import fuse_landmarks


class Landmarks(NamedTuple):
    """A filter's landmarks, by ascending id if all: values (n, 9, M), counts (n, M), and one row each of the others.

    The log-odds of existence are (n, M), None where the filter does not keep them.
    """

    ids: IntArray
    values: FloatArray
    counts: IntArray
    odds: FloatArray | None
    descriptors: NDArray[np.float32]
    identities: IntArray

    @classmethod
    def of(cls, slam: FastSlam, ids: IntArray | None = None) -> Self:
        """Return all of a filter, or those of these ids (n,) in their order."""
        maps = slam._maps
        slots = maps.used_slots()
        if ids is not None:
            slots = slots[np.searchsorted(maps.ids[slots], ids)]
        values, counts = maps.dense(slots)
        return cls(
            maps.ids[slots], values, counts.astype(np.int64), maps.dense_odds(slots), maps.descriptors[slots],
            maps.identities[slots],
        )  # fmt: skip

    def chosen(self, rows: IntArray) -> Self:
        """Return those of these rows, in their order."""
        odds = None if self.odds is None else self.odds[rows]
        return type(self)(
            self.ids[rows], self.values[rows], self.counts[rows], odds, self.descriptors[rows], self.identities[rows]
        )


def odds_of(dense: Landmarks, chosen: IntArray, model: ExistenceModel | None) -> FloatArray:
    """Return the log-odds of existence (n, M) that the chosen particles (M,) have: the prior, where they have none."""
    if dense.odds is not None:
        return np.take(dense.odds, chosen, axis=1)
    return np.full((len(dense.ids), len(chosen)), 0.0 if model is None else model.log_odds_prior)


def move_landmarks(landmarks: FloatArray, motion: FloatArray) -> None:
    """Move landmarks (n, 9, M) in place, each particle by its own motion (M, 3); covariances by Eq. 16 corrected."""
    c, s = np.cos(motion[:, 2]), np.sin(motion[:, 2])
    x, y = landmarks[:, 0].copy(), landmarks[:, 1].copy()
    landmarks[:, 0] = c * x - s * y + motion[:, 0]
    landmarks[:, 1] = s * x + c * y + motion[:, 1]
    xx, xy, xz, yy, yz = (landmarks[:, i].copy() for i in range(3, 8))
    landmarks[:, 3] = c * c * xx - 2.0 * c * s * xy + s * s * yy  # Eq. 16 *: R Sigma R^T
    landmarks[:, 4] = c * s * (xx - yy) + (c * c - s * s) * xy
    landmarks[:, 5] = c * xz - s * yz
    landmarks[:, 6] = s * s * xx + 2.0 * c * s * xy + c * c * yy
    landmarks[:, 7] = s * xz + c * yz


def fuse_rows(
    a: tuple[FloatArray, IntArray], rows_a: IntArray, b: tuple[FloatArray, IntArray], rows_b: IntArray
) -> None:
    """Fuse b's rows into a's, in place, where a particle holds both; where it holds b's alone, take that.

    Each side is (landmarks (n, 9, M), counts (n, M), 0 = not held).
    """
    landmarks_a, landmarks_b = (side[0][rows].transpose(0, 2, 1) for side, rows in ((a, rows_a), (b, rows_b)))
    in_a, in_b = a[1][rows_a] > 0, b[1][rows_b] > 0
    row, particle = np.nonzero(in_a & in_b)
    one, two = landmarks_a[row, particle], landmarks_b[row, particle]
    means, covariances = fuse_landmarks(one[:, :3], one[:, 3:][:, UNPACK], two[:, :3], two[:, 3:][:, UNPACK])
    fused = np.where((in_b & ~in_a)[..., None], landmarks_b, landmarks_a)
    fused[row, particle] = np.concatenate([means, covariances[:, *UPPER]], axis=1)
    a[0][rows_a] = fused.transpose(0, 2, 1)
    a[1][rows_a] += b[1][rows_b]


def fuse_odds(
    model: ExistenceModel, odds_a: FloatArray, counts_a: IntArray, rows_a: IntArray,
    odds_b: FloatArray, counts_b: IntArray, rows_b: IntArray,
) -> None:  # fmt: skip
    """Fuse the log-odds of existence (n, M) of b's rows into a's, in place, like `fuse_rows`, and before it.

    What either filter saw is independent given whether the landmark exists: log-odds add up, and the prior that both
    hold counts once. What then lies below the floor is given one more chance: it stays there until the next miss.
    """
    in_a, in_b = counts_a[rows_a] > 0, counts_b[rows_b] > 0
    one, two = odds_a[rows_a], odds_b[rows_b]
    both = np.clip(one + two - model.log_odds_prior, model.log_odds_floor, model.log_odds_cap)
    odds_a[rows_a] = np.where(in_a & in_b, both, np.where(in_b, two, one))


def stack_descriptors(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float32]:
    """Stack the descriptors of two maps, one of which may still be empty and of unknown width."""
    if not len(a) or not len(b):
        return np.array(a if len(a) else b)
    return np.concatenate([a, b])
