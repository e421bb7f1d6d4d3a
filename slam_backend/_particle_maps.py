"""The landmarks of all particles, resampled lazily: ancestor indices are composed, and values move when they are used.

A *slot* is one landmark of the joint map; its values lie in a *row* of `values` and `counts`, one entry per particle. A
resampling moves no row. Instead each slot says by which *ancestor map* its row is to be read: particle m's values are
those at `maps[map_of[slot], m]`; map 0 stands for the identity. Slots last brought up to date at the same time share a
map, and a resampling composes the maps in use with its own ancestors: O(maps M) small integers in place of O(N M)
landmarks. A frame touches only its candidates: their rows are copied, through their maps, to free ones, and from then
on every particle's values are at its own place. So no two particles ever share what one of them writes.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam_backend import _existence_kernels, _kernels
from slam_backend._kernels import LANES
from slam_backend._map_store import MapStore
from slam_backend.errors import FloatArray, IntArray

MAX_MAPS = 512  # slots whose map is the oldest are brought up to date rather than keep more maps than this
MAPS_KEPT = (  # in a state
    "num_particles", "values", "counts", "odds", "maps", "map_of", "ids", "identities", "last_seen", "descriptors",
    "next_id",
)  # fmt: skip


class ParticleMaps(MapStore):
    """The landmarks of all particles, each of which has its own values of them.

    Args:
        num_particles: M.
        log_odds_prior: Of the existence of a new landmark; None: existence is not kept.
    """

    # ------------------------------------------------------------------ resampling

    def resample(self, ancestors: IntArray, of_robots: FloatArray, of_particles: FloatArray) -> int:
        """Let each particle become a copy of its ancestor, weighed alike; return the most probable one.

        Args:
            ancestors: (M,) ascending.
            of_robots, of_particles: What else particles hold, see `FilterArrays`.
        """
        if not self._free_maps:
            self._make_maps()
        self._free_maps, best = _kernels.resample(
            ancestors, of_robots, of_particles, self.counts, self.table, self.maps, self.users, self.free_rows,
            self.tops, self.heads, np.empty((3, len(ancestors)), np.uint32),
        )  # fmt: skip
        return best

    def _make_maps(self) -> None:
        """Provide a free map, by one more or by bringing slots up to date."""
        if len(self.users) > MAX_MAPS:
            self._refresh_oldest()
        else:
            extra = max(16, len(self.users))
            self.maps = np.concatenate([self.maps, np.zeros((extra, self.padded), dtype=np.int32)])
            self.users = np.concatenate([self.users, np.zeros(extra, dtype=np.int64)])

    def _refresh_oldest(self) -> None:
        """Bring up to date the slots of the maps with the fewest users, a quarter of them."""
        order = np.argsort(np.where(self.users[1:] > 0, self.users[1:], np.iinfo(np.int64).max))
        chosen = order[: MAX_MAPS // 4] + 1
        self.refresh(np.flatnonzero(np.isin(self.map_of, chosen) & (self.ids >= 0)))

    def refresh(self, slots: IntArray) -> None:
        """Bring slots up to date: afterwards they are read in place."""
        if not self.tops[0]:
            self._grow_rows(64)
        self.carry_odds(slots)
        _kernels.refresh(
            slots, self.values, self.counts, self.row_of, self.map_of, self.maps, self.users, self.free_rows, self.tops
        )

    # ------------------------------------------------------------------ existence

    def carry_odds(self, slots: IntArray) -> None:
        """Bring the log-odds of slots up to date, just before a kernel does so with all else that they hold."""
        if self.log_odds_prior is not None:
            _kernels.carry_odds(slots, self.odds, self.map_of, self.maps)

    def start_odds(self, new_slots: IntArray) -> None:
        """Give landmarks that were just started their prior; -1 among `new_slots` stands for none."""
        self.odds[new_slots[new_slots >= 0]] = self.log_odds_prior

    def odds_of_particle(self, m: int, slots: IntArray) -> FloatArray:
        """Return the log-odds (n,) of the slots (n,) of particle m. A copy."""
        return np.asarray(self.odds[slots, np.where(self.map_of[slots] > 0, self.maps[self.map_of[slots], m], m)])

    def dense_odds(self, slots: IntArray) -> FloatArray | None:
        """Return the log-odds (n, M) of slots (n,) in all particles, None where existence is not kept. A copy."""
        if self.log_odds_prior is None:
            return None
        self.refresh(slots)
        return self.odds[slots][:, : self.num_particles]

    def release(self, slots: IntArray) -> None:
        """Forget the landmarks of slots (n,), up to date, that no particle holds."""
        _existence_kernels.release(
            slots, self.ids, self.row_of, self.heads, self.free_rows, self.free_slots, self.tops, _kernels.FAR
        )

    # ------------------------------------------------------------------ reading and writing whole maps

    def of_particle(self, m: int, slots: IntArray) -> tuple[FloatArray, NDArray[np.int32]]:
        """Return values (n, 9) and counts (n,) of the slots (n,) of particle m. Copies."""
        places = np.where(self.map_of[slots] > 0, self.maps[self.map_of[slots], m], m)
        rows = self.row_of[slots]
        blocks = self.blocks
        return blocks[rows, places // LANES, :, places % LANES], self.counts[rows, places]

    def dense(self, slots: IntArray) -> tuple[FloatArray, NDArray[np.int32]]:
        """Return values (n, 9, M) and counts (n, M) of slots (n,) in all particles. Copies."""
        self.refresh(slots)
        rows, m = self.row_of[slots], self.num_particles
        blocks = self.blocks[rows]
        values = blocks.transpose(0, 2, 1, 3).reshape(len(rows), 9, self.padded)[:, :, :m]
        return np.ascontiguousarray(values), self.counts[rows, :m]

    def load_names(
        self, counts: NDArray[np.integer[Any]], descriptors: NDArray[np.float32], ids: IntArray, identities: IntArray,
        next_id: int, odds: FloatArray | None = None, last_seen: IntArray | None = None,
    ) -> None:  # fmt: skip
        """Replace all landmarks by these but for the values: the first n of `blocks` are then to be written.

        Args:
            counts: (n, M), or (n, 1) where all particles have the same; 0 where a particle lacks the landmark. Each
                landmark is held by a particle.
            descriptors: (n, d) float32.
            ids, identities: (n,) int64. Stable names, and the caller's own, -1 = none.
            next_id: The name that the next landmark will get.
            odds: (n, M) float64, log-odds of existence; None: where existence is kept, landmarks get the prior.
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
        self._set_heads(n)

    # ------------------------------------------------------------------ snapshots

    def get_state(self) -> dict[str, Any]:
        """Return all that decides how the maps go on, compact and shared with nothing."""
        used = self.used_slots()
        of, rows = self.map_of[used], self.row_of[used]
        live, first = np.unique(of[of > 0], return_index=True)
        live = live[np.argsort(first)]  # by their first users: equal maps give equal states
        number = np.zeros(len(self.users), dtype=np.int64)
        number[live] = np.arange(1, len(live) + 1)
        return {
            "num_particles": self.num_particles,
            "values": np.take(self.values.reshape(-1, 9 * self.padded), rows, axis=0),
            "counts": np.take(self.counts, rows, axis=0),
            "odds": None if self.log_odds_prior is None else np.take(self.odds, used, axis=0),
            "maps": np.take(self.maps, live, axis=0),
            "map_of": number[of],
            "ids": self.ids[used],
            "identities": self.identities[used],
            "last_seen": self.last_seen[used],
            "descriptors": self.descriptors[used],
            "next_id": self.next_id,
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on as the maps that gave `state`; rows already allocated are used again."""
        n, m, maps = len(state["ids"]), int(state["num_particles"]), state["maps"]
        if m != self.num_particles:
            self._clear(m)
        self._begin(n, state["descriptors"].shape[1])
        self.values.reshape(-1, 9 * self.padded)[:n] = state["values"]
        self.counts[:n] = state["counts"]
        if self.log_odds_prior is not None:
            self.odds[:n] = state["odds"]
        for name in ("map_of", "ids", "identities", "last_seen", "descriptors"):
            getattr(self, name)[:n] = state[name]
        self._set_heads(n)
        self.maps = np.concatenate([np.zeros((1, self.padded), dtype=np.int32), maps])
        self.users = np.bincount(state["map_of"], minlength=len(maps) + 1).astype(np.int64)
        self.users[0], self._free_maps = 0, 0
        self.tops[2] = state["next_id"]
