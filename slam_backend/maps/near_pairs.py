"""Pairs of landmarks with similar descriptors in two growing maps, of which only the new ones are compared."""

from typing import NamedTuple

import numpy as np

from slam_backend.core.validation import BoolArray, Float32Array, FloatArray, IntArray
from slam_backend.maps._kernels import descriptor_matching
from slam_backend.maps.alignment_types import AlignmentOptions

MOST_PER_LANDMARK = 50  # near pairs of a landmark in the mean; with more, as without appearance, none are kept


class Appearance(NamedTuple):
    """Landmarks of a map: ids (n,) int64, ascending, and descriptors (n, d) float32 [-]."""

    ids: IntArray
    descriptors: Float32Array


class NearPairs(NamedTuple):
    """All pairs of landmarks of two maps whose descriptors are within a distance.

    Attributes:
        a, b: Landmarks of the two maps.
        rows: (k, 2) int64 rows (in a, in b) of the pairs, by rising row in a, then in b.
        squares: (k,) float32 [-]. Squared distances of their descriptors.
        limit: Largest squared distance [-].
    """

    a: Appearance
    b: Appearance
    rows: IntArray
    squares: Float32Array
    limit: float


def near_pairs(
    a: Appearance, b: Appearance, options: AlignmentOptions, known: NearPairs | None = None
) -> NearPairs | None:
    """Return the pairs that can matter to candidates of an alignment.

    Args:
        a, b: Landmarks of the two maps.
        options: Gate and ratio of descriptors.
        known: Earlier result, of which the pairs of landmarks with the same ids and descriptors are taken over.

    Returns:
        The pairs; None if there are too many, or without appearance.
    """
    if not options.appearance or a.descriptors.shape[1] != b.descriptors.shape[1]:
        return None
    limit = 1.001 * (options.descriptor_gate / min(options.descriptor_ratio, 1.0)) ** 2  # rivals in the ratio test
    if known is not None and (known.limit != limit or _widths(known.a, known.b) != _widths(a, b)):
        known = None  # other options, or a map that was empty: its descriptors had no width
    is_new_a, is_new_b = np.ones(len(a.ids), np.bool_), np.ones(len(b.ids), np.bool_)
    parts: list[tuple[IntArray, Float32Array]] = []
    if known is not None:
        now_a, now_b = _rows_now(known.a, a), _rows_now(known.b, b)
        rows = np.column_stack([now_a[known.rows[:, 0]], now_b[known.rows[:, 1]]])
        held = (rows >= 0).all(axis=1)
        parts.append((rows[held], known.squares[held]))
        is_new_a[now_a[now_a >= 0]] = is_new_b[now_b[now_b >= 0]] = False
    most = MOST_PER_LANDMARK * (len(a.ids) + len(b.ids))
    for rows_a, rows_b in (
        (np.flatnonzero(is_new_a), np.arange(len(b.ids))), (np.flatnonzero(~is_new_a), np.flatnonzero(is_new_b)),
    ):  # fmt: skip
        if not len(rows_a) or not len(rows_b):
            continue
        columns = np.ascontiguousarray(b.descriptors[rows_b].T)
        found, squares = descriptor_matching.near(a.descriptors[rows_a], columns, limit, most)
        if len(found) > most:
            return None
        parts.append((np.column_stack([rows_a[found[:, 0]], rows_b[found[:, 1]]]), squares))
    rows = np.concatenate([part[0] for part in parts]) if parts else np.empty((0, 2), np.int64)
    squares = np.concatenate([part[1] for part in parts]) if parts else np.empty(0, np.float32)
    order = np.lexsort((rows[:, 1], rows[:, 0]))
    return NearPairs(a, b, rows[order], squares[order], limit)


def _widths(a: Appearance, b: Appearance) -> tuple[int, int]:
    return a.descriptors.shape[1], b.descriptors.shape[1]


def _rows_now(before: Appearance, now: Appearance) -> IntArray:
    """Return the rows (n,) that landmarks have now; -1 for those that are gone or look different."""
    if now.ids is before.ids and now.descriptors is before.descriptors:
        return np.arange(len(now.ids))
    at = np.minimum(np.searchsorted(now.ids, before.ids), max(len(now.ids) - 1, 0))
    if not len(now.ids):
        return np.full(len(before.ids), -1)
    same = (now.ids[at] == before.ids) & (now.descriptors[at] == before.descriptors).all(axis=1)
    return np.where(same, at, -1)


def mutual_pairs(near: NearPairs, options: AlignmentOptions) -> IntArray:
    """Return what `correspondences.mutual_nearest` returns for the two maps."""
    inside = near.squares <= np.float32(options.descriptor_gate * options.descriptor_gate)
    rows, squares = near.rows[inside], near.squares[inside]
    nearest = [_first_nearest(rows[:, side], squares) for side in (0, 1)]
    return rows[nearest[0] & nearest[1]]


def _first_nearest(owners: IntArray, squares: Float32Array) -> BoolArray:
    """Return the mask of pairs that are the first nearest one of their owner."""
    order = np.lexsort((np.arange(len(owners)), squares, owners))
    mask = np.zeros(len(owners), np.bool_)
    mask[order[np.unique(owners[order], return_index=True)[1]]] = True
    return mask


def similar_pairs(near: NearPairs, options: AlignmentOptions) -> IntArray:
    """Return what `correspondences.similar_pairs` returns for the two maps, within the gate of the options."""
    rows = near.rows[near.squares.astype(np.float64) <= options.descriptor_gate * options.descriptor_gate]
    few = [np.bincount(rows[:, side])[rows[:, side]] <= options.max_similar for side in (0, 1)]
    return rows[few[0] & few[1]]


def passes_ratio_test(
    near: NearPairs, matches: IntArray, side: int, positions: FloatArray, options: AlignmentOptions
) -> BoolArray:
    """Return what `correspondences.passes_ratio_test` returns for matches (k, 2), one-to-one.

    Args:
        near: Near pairs of the two maps.
        matches: (k, 2) int64 rows (in a, in b).
        side: Map in which rivals are sought, 0: a, 1: b.
        positions: (n, 3) float64 [m]. All positions in that map.
        options: Ratio, and distance within which landmarks do not compete.
    """
    own, partners = matches[:, 1 - side], matches[:, side]
    there, here = (near.a, near.b) if side == 0 else (near.b, near.a)
    off = here.descriptors[own] - there.descriptors[partners]
    distances = np.add.accumulate(off * off, axis=1)[:, -1]
    limits = (distances.astype(np.float64) / (options.descriptor_ratio * options.descriptor_ratio)).astype(np.float32)
    number = np.full(len(here.ids), -1)
    number[own] = np.arange(len(own))
    match, rivals, squares = number[near.rows[:, 1 - side]], near.rows[:, side], near.squares
    match, rivals, squares = match[match >= 0], rivals[match >= 0], squares[match >= 0]
    apart = ((positions[rivals] - positions[partners[match]]) ** 2).sum(axis=1)
    rival = (squares <= limits[match]) & (apart > options.same_place * options.same_place)
    passed = np.ones(len(matches), np.bool_)
    passed[match[rival]] = False
    return passed
