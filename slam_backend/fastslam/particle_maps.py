"""Landmarks of all particles: storage, lazy resampling, and the map of the best particle.

A *slot* is one landmark of the joint map; its values lie in a *row* of `values` and `counts`, one entry per particle.
Resampling moves no row. Instead each slot refers to an *ancestor map* for reading its row: the values of particle m are
at `maps[map_of[slot], m]`; map 0 is the identity. Slots that were last refreshed at the same time share a map.
Resampling composes the maps in use with its ancestors: O(maps M) small integers in place of O(N M) landmarks. A frame
touches only its candidates: their rows are copied, through their maps, to free rows, after which the values of each
particle are at its own place. Thus no two particles share values that one of them writes.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.jit import LINE
from slam_backend.core.packed_symmetric import UNPACK_INDEX
from slam_backend.core.read_only import as_read_only
from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.fastslam import _kernels
from slam_backend.fastslam._kernels import LANES
from slam_backend.fastslam._kernels.records import SLOT
from slam_backend.maps.landmark_map import MapSummaryRows
from slam_backend.state import (
    FLOAT32,
    FLOAT64,
    INT32,
    INT64,
    LARGEST,
    MAX_DESCRIPTOR,
    MAX_DISTANCE,
    MAX_LANDMARKS,
    Array,
    Int,
    Maybe,
    Sizes,
    State,
)


def empty_aligned(shape: tuple[int, ...], dtype: Any) -> Any:
    """Return an uninitialised array that starts at a cache line: vectors that straddle two lines are slow."""
    kind = np.dtype(dtype)
    size = math.prod(shape) * kind.itemsize
    raw = np.empty(size + LINE, dtype=np.uint8)
    start = -raw.ctypes.data % LINE
    return raw[start : start + size].view(kind).reshape(shape)


def zeros_aligned(shape: tuple[int, ...], dtype: Any) -> Any:
    """Return zeros of a shape and a numpy type, aligned to a cache line."""
    array = empty_aligned(shape, dtype)
    array.fill(0)
    return array


def _num_heads(descriptor_size: int) -> int:
    """Return how many components of a descriptor are compared first: half of a long descriptor.

    Descriptors of one building have much in common: with a quarter of 64 components three landmarks in four would still
    be candidates, with half of them one in thirty.
    """
    return descriptor_size // 2 if descriptor_size >= 32 and descriptor_size % 2 == 0 else descriptor_size


def padded_lanes(num_particles: int) -> int:
    """Return P, M rounded up to whole blocks of lanes."""
    return -(-num_particles // LANES) * LANES


class MapStore:
    """Storage of the landmark Gaussians, counts, descriptors and names of all particles; see the module.

    Args:
        num_particles: M.
        log_odds_prior: Log-odds of the existence of a new landmark; None: existence is not estimated.

    Attributes:
        padded: P, M rounded up to whole blocks of lanes.
        values: (rows * 9 * P,) float64 [m, m^2], map frame, each row
            [block][x, y, z, Sxx, Sxy, Sxz, Syy, Syz, Szz][lane].
        counts: (rows, P) int32. Matches of the landmark in the particle, its creation included; 0: not present.
        table: (6, slots) int64, see `SlotRows`.
        maps: (maps, P) int32. users: (maps,) int64, how many slots read by each.
        odds: (slots, P) float64. Log-odds that the landmark exists, read through its map as a row is; (0, P) without.
        descriptors: (slots, d) float32. heads: (h, slots) every (d / h)-th component of them, `FAR` where free.
        free_rows: A stack; `tops` = (its height, that of the free slots, the name of the next landmark).
    """

    def __init__(self, num_particles: int, log_odds_prior: float | None = None) -> None:
        self.log_odds_prior = log_odds_prior
        self._clear(num_particles)

    def _clear(self, num_particles: int) -> None:
        """Allocate empty arrays for M particles."""
        self.num_particles = num_particles
        self.padded = padded_lanes(num_particles)
        self.values: FloatArray = empty_aligned((0,), np.float64)
        self.counts: NDArray[np.int32] = empty_aligned((0, self.padded), np.int32)
        self.odds: FloatArray = empty_aligned((0, self.padded), np.float64)
        self.maps: NDArray[np.int32] = np.zeros((1, self.padded), dtype=np.int32)
        self.users: IntArray = np.zeros(1, dtype=np.int64)
        self.table: IntArray = np.zeros((6, 0), dtype=np.int64)
        self.descriptors: NDArray[np.float32] = np.zeros((0, 0), dtype=np.float32)
        self.heads: NDArray[np.float32] = np.zeros((0, 0), dtype=np.float32)
        self._free_maps = 0
        self.free_rows: IntArray = np.zeros(0, dtype=np.int64)
        self.tops: IntArray = np.zeros(3, dtype=np.int64)

    @property
    def row_of(self) -> IntArray:
        """(slots,) row of each slot. A view, as the others."""
        return np.asarray(self.table[SLOT.row_of])

    @property
    def map_of(self) -> IntArray:
        """(slots,) the ancestor map by which each is to be read."""
        return np.asarray(self.table[SLOT.map_of])

    @property
    def ids(self) -> IntArray:
        """(slots,) stable names of the landmarks, -1 = free slot."""
        return np.asarray(self.table[SLOT.ids])

    @property
    def identities(self) -> IntArray:
        """(slots,) the caller's own names, -1 = none."""
        return np.asarray(self.table[SLOT.identities])

    @property
    def last_seen(self) -> IntArray:
        """(slots,) steps of the smoother in which the most probable particle matched landmarks last, 0 = never."""
        return np.asarray(self.table[SLOT.last_seen])

    @property
    def free_slots(self) -> IntArray:
        """(slots,) a stack of free slots."""
        return np.asarray(self.table[SLOT.free_slots])

    @property
    def next_id(self) -> int:
        """Name of the next landmark."""
        return int(self.tops[2])

    @property
    def nbytes(self) -> int:
        """Memory in use [bytes]."""
        arrays = (
            self.values, self.counts, self.maps, self.users, self.table, self.descriptors, self.heads,
            self.free_rows, self.odds,
        )  # fmt: skip
        return sum(array.nbytes for array in arrays)

    @property
    def arrays(self) -> _kernels.MapArrays:
        """The arrays as kernels take them."""
        return _kernels.MapArrays(
            self.values, self.counts, self.odds, self.table, self.maps, self.users, self.free_rows, self.tops,
            self.descriptors, self.heads,
        )  # fmt: skip

    @property
    def blocks(self) -> FloatArray:
        """`values` as (rows, blocks, 9, lanes). A view."""
        return self.values.reshape(-1, self.padded // LANES, 9, LANES)

    def used_slots(self) -> IntArray:
        """Return the slots of landmarks that at least one particle holds, by ascending id."""
        used = np.flatnonzero(self.ids >= 0)
        return used[np.argsort(self.ids[used])]

    # ------------------------------------------------------------------ capacity

    def reserve(self, new: int, descriptor_size: int) -> None:
        """Provide slots and rows for `new` landmarks, and one row for refreshing landmarks.

        Args:
            new: Largest number of new landmarks.
            descriptor_size: Length d of their descriptors, equal to that in the map unless that is empty.
        """
        rows, slots, _ = self.tops.tolist()
        if slots < new:
            self._grow_slots(max(64, len(self.ids), new - slots), descriptor_size)
        if rows < new + 1:
            self._grow_rows(max(64, len(self.counts), new + 1))

    def _begin(self, new: int, descriptor_size: int) -> None:
        """Assign the lowest slots and rows to `new` landmarks, yet to be written; large enough arrays are reused.

        New arrays have space for half as many landmarks more, so that the next landmark does not move all.

        Args:
            new: Number of landmarks.
            descriptor_size: Length d of the descriptors.
        """
        if min(len(self.ids), len(self.counts)) < new or self.descriptors.shape[1] != descriptor_size:
            self._clear(self.num_particles)
            if new or descriptor_size:
                self._grow_slots(max(64, new), descriptor_size)
                self._grow_rows(max(64, new + new // 2 + 1))
        slots, rows = len(self.ids), len(self.counts)
        self.row_of[:new], self.map_of[:new] = np.arange(new), 0
        self.ids[new:] = self.identities[new:] = -1
        self.users[:], self._free_maps = 0, len(self.users) - 1
        self.free_rows[: rows - new] = np.arange(rows - 1, new - 1, -1)  # the lowest is taken first
        self.free_slots[: slots - new] = np.arange(slots - 1, new - 1, -1)
        self.tops[:2] = rows - new, slots - new

    def _grow_slots(self, extra: int, descriptor_size: int) -> None:
        """Add `extra` slots for descriptors of the given length."""
        old = len(self.ids)
        table = np.zeros((len(self.table), old + extra), dtype=np.int64)
        table[:, :old] = self.table
        table[SLOT.ids, old:] = table[SLOT.identities, old:] = -1
        descriptors = zeros_aligned((old + extra, descriptor_size), np.float32)
        if old and self.descriptors.shape[1]:
            descriptors[:old] = self.descriptors
        self.descriptors = descriptors
        heads = empty_aligned((_num_heads(descriptor_size), old + extra), np.float32)
        heads[:] = _kernels.FAR
        if old and len(self.heads):
            heads[:, :old] = self.heads
        self.heads = heads
        if self.log_odds_prior is not None:
            odds = zeros_aligned((old + extra, self.padded), np.float64)
            odds[:old] = self.odds
            self.odds = odds
        top = int(self.tops[1])
        # The lowest is taken first once the old ones are gone.
        table[SLOT.free_slots, :extra] = np.arange(old + extra - 1, old - 1, -1)
        table[SLOT.free_slots, extra : extra + top] = self.free_slots[:top]
        self.table = table
        self.tops[1] = extra + top

    def _grow_rows(self, extra: int) -> None:
        """Add `extra` rows, uninitialised."""
        old, padded = len(self.counts), self.padded
        values = empty_aligned(((old + extra) * 9 * padded,), np.float64)
        values[: len(self.values)] = self.values
        self.values = values
        counts = empty_aligned((old + extra, padded), np.int32)
        counts[:old] = self.counts
        self.counts = counts
        top = int(self.tops[0])
        free = np.empty(old + extra, dtype=np.int64)
        free[:extra] = np.arange(old + extra - 1, old - 1, -1)
        free[extra : extra + top] = self.free_rows[:top]
        self.free_rows = free
        self.tops[0] = extra + top

    def _prepare_search(self, n: int) -> None:
        """Write the heads of the first n slots, and mark the others free."""
        if len(self.heads):
            self.heads[:, :n] = self.descriptors[:n, :: self.descriptors.shape[1] // len(self.heads)].T
            self.heads[:, n:] = _kernels.FAR


MAX_MAPS = 512  # limit of ancestor maps; beyond it the slots of the least used maps are refreshed
LONGEST_DESCRIPTOR = 1 << 16


class ParticleMaps(MapStore):
    """Landmarks of all particles, with separate values for each particle.

    Args:
        num_particles: M.
        log_odds_prior: Log-odds of the existence of a new landmark; None: existence is not estimated.
    """

    # ------------------------------------------------------------------ resampling

    def resample(self, ancestors: IntArray, of_robots: FloatArray, of_particles: FloatArray) -> int:
        """Replace each particle by its ancestor, with equal weights; return the most probable one.

        Args:
            ancestors: (M,) ascending.
            of_robots, of_particles: Pose and weight arrays of the filter, see `FastSlam`.
        """
        if not self._free_maps:
            self._make_maps()
        room = np.empty((3, len(ancestors)), np.uint32)
        self._free_maps, best = _kernels.resample(ancestors, of_robots, of_particles, self.arrays, room)
        return best

    def _make_maps(self) -> None:
        """Provide a free ancestor map, by allocation or by refreshing slots."""
        if len(self.users) > MAX_MAPS:
            self._refresh_oldest()
        else:
            extra = max(16, len(self.users))
            self.maps = np.concatenate([self.maps, np.zeros((extra, self.padded), dtype=np.int32)])
            self.users = np.concatenate([self.users, np.zeros(extra, dtype=np.int64)])

    def _refresh_oldest(self) -> None:
        """Refresh the slots of the quarter of the maps with the fewest users."""
        order = np.argsort(np.where(self.users[1:] > 0, self.users[1:], np.iinfo(np.int64).max))
        chosen = order[: MAX_MAPS // 4] + 1
        self.refresh(np.flatnonzero(np.isin(self.map_of, chosen) & (self.ids >= 0)))

    def refresh(self, slots: IntArray) -> None:
        """Copy slots through their ancestor maps, so that each particle's values are at its own place."""
        if not self.tops[0]:
            self._grow_rows(64)
        _kernels.apply_resampling(slots, self.arrays)

    # ------------------------------------------------------------------ existence

    def add_odds(self, new_slots: IntArray) -> None:
        """Set the log-odds of new landmarks to the prior; -1 among `new_slots` = none."""
        self.odds[new_slots[new_slots >= 0]] = self.log_odds_prior

    def odds_of_particle(self, m: int, slots: IntArray) -> FloatArray:
        """Return the log-odds (n,) of the slots (n,) of particle m. A copy."""
        return np.asarray(self.odds[slots, self.columns_of(m, slots)])

    def odds_and_counts(self, slots: IntArray) -> tuple[FloatArray, NDArray[np.int32]]:
        """Return log-odds of existence, if it is estimated, and counts, (n, M) each, of slots (n,). Copies."""
        of, own = self.map_of[slots, None], np.arange(self.num_particles)
        places = np.where(of > 0, self.maps[of, own], own)
        return self.odds[slots[:, None], places], self.counts[self.row_of[slots, None], places]

    def release(self, slots: IntArray) -> None:
        """Forget the landmarks of slots (n,), up to date, that no particle holds."""
        _kernels.release(slots, self.arrays)

    # ------------------------------------------------------------------ reading and writing whole maps

    def columns_of(self, m: int, slots: IntArray) -> IntArray:
        """Return the places (n,) in their rows where the values of the slots (n,) of particle m stand."""
        of = self.map_of[slots]
        return np.where(of > 0, self.maps[of, m], m)

    def of_particle(self, m: int, slots: IntArray) -> tuple[FloatArray, NDArray[np.int32]]:
        """Return values (n, 9) and counts (n,) of the slots (n,) of particle m. Copies."""
        places, rows = self.columns_of(m, slots), self.row_of[slots]
        return self.blocks[rows, places // LANES, :, places % LANES], self.counts[rows, places]

    def dense(self, slots: IntArray) -> tuple[FloatArray, NDArray[np.int32]]:
        """Return values (n, 9, M) and counts (n, M) of slots (n,) in all particles. Copies."""
        self.refresh(slots)
        rows, m = self.row_of[slots], self.num_particles
        blocks = self.blocks[rows]
        values = blocks.transpose(0, 2, 1, 3).reshape(len(rows), 9, self.padded)[:, :, :m]
        return np.ascontiguousarray(values), self.counts[rows, :m]

    def load_metadata(
        self, counts: NDArray[np.integer[Any]], descriptors: NDArray[np.float32], ids: IntArray, identities: IntArray,
        next_id: int, odds: FloatArray | None = None, last_seen: IntArray | None = None,
    ) -> None:  # fmt: skip
        """Replace all landmarks, except for the values: the caller then writes the first n of `blocks`.

        Args:
            counts: (n, M), or (n, 1) if all particles have the same. Measurement counts, 0 where a particle lacks the
                landmark; at least one particle holds each landmark.
            descriptors: (n, d) float32.
            ids, identities: (n,) int64. Stable names, and the caller's own, -1 = none.
            next_id: Name of the next landmark.
            odds: (n, M) float64, log-odds of existence; None: the prior, if existence is estimated.
            last_seen: (n,) int64, see `MapStore`; None: never.
        """
        n, m = len(ids), self.num_particles
        self._begin(n, descriptors.shape[1] if n else self.descriptors.shape[1])
        self.tops[2] = next_id
        self.counts[:n, :m], self.counts[:n, m:] = counts, 0
        self.ids[:n], self.identities[:n], self.last_seen[:n] = ids, identities, 0 if last_seen is None else last_seen
        self.descriptors[:n] = descriptors
        if self.log_odds_prior is not None:
            self.odds[:n, :m] = self.log_odds_prior if odds is None else odds
        self._prepare_search(n)

    # ------------------------------------------------------------------ snapshots

    def compact(self) -> "CompactMaps":
        """Return the content; equal maps give equal contents. Nothing is shared."""
        used = self.used_slots()
        of, rows = self.map_of[used], self.row_of[used]
        live, first = np.unique(of[of > 0], return_index=True)
        live = live[np.argsort(first)]  # ordered by their first users
        number = np.zeros(len(self.users), dtype=np.int64)
        number[live] = np.arange(1, len(live) + 1)
        odds = None if self.log_odds_prior is None else as_read_only(np.take(self.odds, used, axis=0))
        return CompactMaps(
            values=as_read_only(np.take(self.values.reshape(-1, 9 * self.padded), rows, axis=0)),
            counts=as_read_only(np.take(self.counts, rows, axis=0)),
            odds=odds,
            maps=as_read_only(np.take(self.maps, live, axis=0)),
            map_of=as_read_only(number[of]),
            ids=as_read_only(self.ids[used]),
            identities=as_read_only(self.identities[used]),
            last_seen=as_read_only(self.last_seen[used]),
            descriptors=as_read_only(self.descriptors[used]),
            next_id=self.next_id,
        )

    def load(self, content: "CompactMaps") -> None:
        """Replace the content by that of maps with as many particles; allocated rows are reused."""
        n = len(content.ids)
        self._begin(n, content.descriptors.shape[1])
        self.values.reshape(-1, 9 * self.padded)[:n], self.counts[:n] = content.values, content.counts
        if content.odds is not None:
            self.odds[:n] = content.odds
        for name in ("map_of", "ids", "identities", "last_seen", "descriptors"):
            getattr(self, name)[:n] = getattr(content, name)
        self._prepare_search(n)
        self.maps = np.concatenate([np.zeros((1, self.padded), dtype=np.int32), content.maps])
        self.users = np.bincount(content.map_of, minlength=len(self.maps)).astype(np.int64)
        self.users[0], self._free_maps = 0, 0
        self.tops[2] = content.next_id


@dataclass(frozen=True, slots=True, eq=False)
class CompactMaps:
    """Content of the maps of M particles: n landmarks by ascending id, and the a ancestor maps that they use.

    Attributes:
        values, counts, odds: (n, 9 P) float64, (n, P) int32, (n, P) float64 or None; see `MapStore`.
        maps: (a, P) int32. The ancestor maps but the identity.
        map_of: (n,) int64. The ancestor map of each landmark, from 1; 0 is the identity.
        ids, identities, last_seen: (n,) int64, see `MapStore`.
        descriptors: (n, d) float32.
        next_id: Name of the next landmark.
    """

    STATE = State(
        values=Array(FLOAT64, "n *", -math.inf, math.inf, nan=True),
        counts=Array(INT32, "n P", 0, MAX_LANDMARKS, used="M"),
        odds=Maybe(Array(FLOAT64, "n P", used="M")),
        maps=Array(INT32, "a P", 0, "P"),
        map_of=Array(INT64, "n", 0, "a+1"),
        ids=Array(INT64, "n", 0, MAX_LANDMARKS, ascending=True),
        identities=Array(INT64, "n", -1),
        last_seen=Array(INT64, "n"),
        descriptors=Array(FLOAT32, "n d", -MAX_DESCRIPTOR, MAX_DESCRIPTOR),
        next_id=Int(0, MAX_LANDMARKS),
    )
    values: FloatArray
    counts: NDArray[np.int32]
    odds: FloatArray | None
    maps: NDArray[np.int32]
    map_of: IntArray
    ids: IntArray
    identities: IntArray
    last_seen: IntArray
    descriptors: NDArray[np.float32]
    next_id: int

    @staticmethod
    def check_state(parts: Mapping[str, Any], sizes: Sizes) -> None:
        """Refuse maps with a landmark of a particle that has no valid Gaussian, or with indices of no particle."""
        m, padded, n = sizes["M"], sizes["P"], len(parts["ids"])
        if parts["values"].shape[1] != 9 * padded:
            raise ValueError(f"values of {parts['values'].shape[1]} columns for {padded} lanes")
        blocks = parts["values"].reshape(n, padded // LANES, 9, LANES)
        valid = (np.abs(blocks[:, :, :3]) <= MAX_DISTANCE).all(axis=2) & (blocks[:, :, [3, 6, 8]] > 0.0).all(axis=2)
        valid &= (np.abs(blocks[:, :, 3:]) <= LARGEST).all(axis=2)
        if (~valid.reshape(n, padded) & (parts["counts"] > 0))[:, :m].any():
            raise ValueError("a Gaussian out of range")
        if n and parts["ids"][-1] >= parts["next_id"]:
            raise ValueError("an id from next_id on")
        if (parts["maps"][:, :m] >= m).any():
            raise ValueError("an ancestor beyond the particles")
        if sizes["d"] > LONGEST_DESCRIPTOR:
            raise ValueError("descriptors that are too long")


def write_summary(maps: ParticleMaps, m: int, min_count: int, rows: MapSummaryRows, first: int) -> int:
    """Write the summary of `best_map`, with the same arguments: the same landmarks in the same order.

    Args:
        maps: Maps of all particles.
        m: Index of the particle.
        min_count: Least number of measurements of a landmark in the summary.
        rows: Arrays to write, as far as they reach.
        first: First row to write.

    Returns:
        The row after the last, which may lie beyond the arrays.
    """
    last, ascending = _kernels.map_summary(maps.table, maps.maps, maps.values, maps.counts, m, min_count, *rows, first)
    if not ascending:
        order = first + np.argsort(rows.counts_and_ids[first:last, 1])
        for column in rows:
            column[first:last] = column[order]
    return last


def present_slots(maps: ParticleMaps, m: int, min_count: int) -> IntArray:
    """Return the slots (n,) of `best_map`, which takes the same, by ascending id."""
    slots = maps.used_slots()
    return slots[maps.counts[maps.row_of[slots], maps.columns_of(m, slots)] >= max(min_count, 1)]


def best_map(maps: ParticleMaps, m: int, min_count: int) -> tuple[FloatArray, FloatArray, Any, IntArray, IntArray]:
    """Return the map of one particle, by ascending id.

    Args:
        maps: Maps of all particles.
        m: Index of the particle.
        min_count: Least number of measurements of a landmark in the result.

    Returns:
        Means (n, 3) [m], covariances (n, 3, 3) [m^2], map frame, descriptors (n, d) float32, counts (n,) and ids (n,):
        all fresh.
    """
    slots = present_slots(maps, m, min_count)
    values, counts = maps.of_particle(m, slots)
    covariances = np.take(values, 3 + UNPACK_INDEX, axis=1)
    return values[:, :3].copy(), covariances, maps.descriptors[slots], counts.astype(np.int64), maps.ids[slots]
