"""Where the landmarks of all particles lie: rows of values, slots with names and descriptors, and how both grow."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam_backend import _kernels
from slam_backend._jit import LINE
from slam_backend._kernels import LANES
from slam_backend._kernels.layout import FREE_SLOTS, IDENTITIES, IDS, LAST_SEEN, MAP_OF, ROW_OF
from slam_backend.errors import FloatArray, IntArray


def aligned(shape: tuple[int, ...], dtype: Any) -> Any:
    """Return an array, yet to be written, that starts at a cache line: vectors that straddle two are slow."""
    kind = np.dtype(dtype)
    size = math.prod(shape) * kind.itemsize
    raw = np.empty(size + LINE, dtype=np.uint8)
    start = -raw.ctypes.data % LINE
    return raw[start : start + size].view(kind).reshape(shape)


def aligned_zeros(shape: tuple[int, ...], dtype: Any) -> Any:
    """Return zeros of a shape and a numpy type that start at a cache line."""
    array = aligned(shape, dtype)
    array.fill(0)
    return array


def _num_heads(descriptor_size: int) -> int:
    """Return how many components of a descriptor are compared first: half where they are many.

    Descriptors of one building have much in common: by a quarter of 64 three landmarks in four would still be in
    question, by half of them one in thirty.
    """
    return descriptor_size // 2 if descriptor_size >= 32 and descriptor_size % 2 == 0 else descriptor_size


class MapStore:
    """Landmark Gaussians, counts, descriptors and names of all particles; `_particle_maps` says how they are read.

    Args:
        num_particles: M.
        log_odds_prior: Of the existence of a new landmark; None: existence is not kept.

    Attributes:
        padded: P, M rounded up to whole blocks of lanes.
        values: (rows * 9 * P,) float64 [m, m^2], map frame, each row
            [block][x, y, z, Sxx, Sxy, Sxz, Syy, Syz, Szz][lane].
        counts: (rows, P) int32. How often the particle matched the landmark, its start included; 0: it lacks it.
        table: (6, slots) int64. Per slot `row_of`, `map_of`, `ids`, `identities` and `last_seen`; and the stack
            `free_slots`.
        maps: (maps, P) int32. users: (maps,) int64, how many slots read by each.
        odds: (slots, P) float64. Log-odds that the landmark exists, read through its map as a row is; (0, P) without.
        descriptors: (slots, d) float32. heads: (h, slots) every (d / h)-th component of them, `FAR` where free.
        free_rows: A stack; `tops` = (its height, that of the free slots, the name of the next landmark).
    """

    def __init__(self, num_particles: int, log_odds_prior: float | None = None) -> None:
        self.log_odds_prior = log_odds_prior
        self._clear(num_particles)

    def _clear(self, num_particles: int) -> None:
        """Hold nothing, for M particles."""
        self.num_particles = num_particles
        self.padded = -(-num_particles // LANES) * LANES
        self.values: FloatArray = aligned((0,), np.float64)
        self.counts: NDArray[np.int32] = aligned((0, self.padded), np.int32)
        self.odds: FloatArray = aligned((0, self.padded), np.float64)
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
        return np.asarray(self.table[ROW_OF])

    @property
    def map_of(self) -> IntArray:
        """(slots,) the ancestor map by which each is to be read."""
        return np.asarray(self.table[MAP_OF])

    @property
    def ids(self) -> IntArray:
        """(slots,) stable names of the landmarks, -1 = free slot."""
        return np.asarray(self.table[IDS])

    @property
    def identities(self) -> IntArray:
        """(slots,) the caller's own names, -1 = none."""
        return np.asarray(self.table[IDENTITIES])

    @property
    def last_seen(self) -> IntArray:
        """(slots,) steps of the smoother in which the most probable particle matched landmarks last, 0 = never."""
        return np.asarray(self.table[LAST_SEEN])

    @property
    def free_slots(self) -> IntArray:
        """(slots,) a stack of free slots."""
        return np.asarray(self.table[FREE_SLOTS])

    @property
    def next_id(self) -> int:
        """The name that the next landmark will get."""
        return int(self.tops[2])

    @property
    def nbytes(self) -> int:
        """Memory held [bytes]."""
        arrays = (
            self.values, self.counts, self.maps, self.users, self.table, self.descriptors, self.heads, self.free_rows,
            self.odds,
        )  # fmt: skip
        return sum(array.nbytes for array in arrays)

    @property
    def blocks(self) -> FloatArray:
        """`values` as (rows, blocks, 9, lanes). A view."""
        return self.values.reshape(-1, self.padded // LANES, 9, LANES)

    def used_slots(self) -> IntArray:
        """Return the slots that hold a landmark of at least one particle, by ascending id."""
        used = np.flatnonzero(self.ids >= 0)
        return used[np.argsort(self.ids[used])]

    # ------------------------------------------------------------------ room

    def make_room(self, new: int, descriptor_size: int) -> None:
        """See to it that `new` landmarks can start, and a row is left to bring landmarks up to date.

        Args:
            new: How many at most.
            descriptor_size: d of the landmarks; that of the map, if there are any.
        """
        rows, slots, _ = self.tops.tolist()
        if slots < new:
            self._grow_slots(max(64, len(self.ids), new - slots), descriptor_size)
        if rows < new + 1:
            self._grow_rows(max(64, len(self.counts), new + 1))

    def _begin(self, new: int, descriptor_size: int) -> None:
        """Begin with `new` landmarks in the lowest slots and rows, yet to be written; arrays with room are used again.

        New ones have room for half as many landmarks more: the first to come shall not move all.

        Args:
            new: How many.
            descriptor_size: d.
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
        """Provide so many more slots, with room for descriptors of that size."""
        old = len(self.ids)
        table = np.zeros((len(self.table), old + extra), dtype=np.int64)
        table[:, :old], table[IDS, old:], table[IDENTITIES, old:] = self.table, -1, -1
        descriptors = aligned_zeros((old + extra, descriptor_size), np.float32)
        if old and self.descriptors.shape[1]:
            descriptors[:old] = self.descriptors
        self.descriptors = descriptors
        heads = aligned((_num_heads(descriptor_size), old + extra), np.float32)
        heads[:] = _kernels.FAR
        if old and len(self.heads):
            heads[:, :old] = self.heads
        self.heads = heads
        if self.log_odds_prior is not None:
            odds = aligned_zeros((old + extra, self.padded), np.float64)
            odds[:old] = self.odds
            self.odds = odds
        top = int(self.tops[1])
        # The lowest is taken first once the old ones are gone.
        table[FREE_SLOTS, :extra] = np.arange(old + extra - 1, old - 1, -1)
        table[FREE_SLOTS, extra : extra + top] = self.free_slots[:top]
        self.table = table
        self.tops[1] = extra + top

    def _grow_rows(self, extra: int) -> None:
        """Provide so many more rows, written as a whole when they are taken."""
        old, padded = len(self.counts), self.padded
        values = aligned(((old + extra) * 9 * padded,), np.float64)
        values[: len(self.values)] = self.values
        counts = aligned((old + extra, padded), np.int32)
        counts[:old] = self.counts
        self.values, self.counts = values, counts
        top = int(self.tops[0])
        free = np.empty(old + extra, dtype=np.int64)
        free[:extra] = np.arange(old + extra - 1, old - 1, -1)
        free[extra : extra + top] = self.free_rows[:top]
        self.free_rows = free
        self.tops[0] = extra + top

    def _set_heads(self, n: int) -> None:
        """Write the heads of the first n slots; the others are free."""
        if len(self.heads):
            self.heads[:, :n] = self.descriptors[:n, :: self.descriptors.shape[1] // len(self.heads)].T
            self.heads[:, n:] = _kernels.FAR
