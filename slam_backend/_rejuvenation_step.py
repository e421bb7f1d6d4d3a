"""What a filter does to be rejuvenated: when it is due, what the smoother is told, what is kept until the next time."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from slam_backend._particle_maps import ParticleMaps
from slam_backend.errors import FloatArray, IntArray
from slam_backend.filter_options import FilterOptions
from slam_backend.reports import PoseEstimate
from slam_backend.run_log import RobotLog
from slam_backend.smoothing.graph import PathGraph
from slam_backend.smoothing.rejuvenation import Looks, Particles, Rejuvenation, rejuvenate

CLOSURE = 3  # landmarks not seen for long that are matched in one step: a loop is closed
SOONEST = 5  # after a fifth of the usual time at the earliest


class RejuvenationStep:
    """The smoother of one filter, its schedule, and where the robots were thought to be since it last ran.

    Args:
        options: Of the filter, with `rejuvenate_every` set.
        num_robots: K.
    """

    def __init__(self, options: FilterOptions, num_robots: int) -> None:
        assert options.rejuvenate_every is not None
        self._options = options
        self._every = options.rejuvenate_every
        self._graph: PathGraph | None = None
        self._waited = 0  # steps since the last time
        self._read = 0  # measurements since then
        self._closed = False
        self._last_closing = 0  # step in which landmarks not seen for long were matched
        self._last_seen: dict[int, int] = {}  # landmark -> step of the filter's own count
        self._count = 0
        self._guesses: list[dict[int, FloatArray]] = [{} for _ in range(num_robots)]

    # ------------------------------------------------------------------ in each step

    def note(self, robot: int, step: int, estimate: PoseEstimate) -> None:
        """Remember where a robot that read something was thought to be."""
        self._guesses[robot][step] = estimate.mean

    def hasten(self) -> None:
        """Be due at the next step, as after a merge."""
        self._waited = self._every  # without a graph yet, any reading is enough

    def due(self, associations: Sequence[IntArray]) -> bool:
        """Count a step, in which each robot saw these landmarks (n_i,), and tell whether it is time."""
        self._count += 1
        self._waited += 1
        smoothing = self._options.smoothing
        after, long_ago = smoothing.closure_after, 0
        for ids in associations:
            for name in ids.tolist():
                if name >= 0:
                    self._read += 1
                    long_ago += self._count - self._last_seen.get(name, self._count) > after
                    self._last_seen[name] = self._count
        if after > 0 and long_ago >= CLOSURE:
            self._closed |= 2 * (self._count - self._last_closing) > after  # else it is the same one that goes on
            self._last_closing = self._count
        haste = SOONEST if self._closed else 1
        sightings = 0 if self._graph is None else self._graph.num_sightings - smoothing.free_sightings
        return haste * self._waited >= self._every and haste * smoothing.effort * self._read >= sightings

    # ------------------------------------------------------------------ when it is due

    def run(
        self, logs: Sequence[RobotLog], starts: FloatArray, maps: ParticleMaps, camera: FloatArray,
        rng: np.random.Generator,
    ) -> Rejuvenation:  # fmt: skip
        """Smooth, and draw new particles.

        Args:
            logs: Per robot.
            starts: (K, 3, M) where the robots started, map frame.
            maps: Of the present particles; only looked at.
            camera: (7,) as kernels take it.
            rng: Source of the draws.
        """
        graph = PathGraph.at_uncertain_starts(starts) if self._graph is None else self._graph
        new = [log.arrays(int(latest) + 1) for log, latest in zip(logs, graph.latest, strict=True)]
        options = self._options
        slots = maps.used_slots()
        slots = slots[maps.identities[slots] < 0]
        result = rejuvenate(
            graph, new, options.motion, camera, maps.num_particles, rng, options.smoothing, self._guesses,
            Looks(maps.ids[slots], maps.descriptors[slots], options.descriptor_gate),
        )  # fmt: skip
        self._graph = result.graph
        for guesses, latest in zip(self._guesses, result.graph.latest, strict=True):
            for step in [step for step in guesses if step <= latest]:
                del guesses[step]
        self._waited, self._read, self._closed = 0, 0, False
        return result

    def reorder(self, order: IntArray) -> None:
        """Renumber the robots: robot i becomes the one that was `order[i]`."""
        self._graph = None if self._graph is None else self._graph.reordered(order)
        self._guesses = [self._guesses[robot] for robot in order]

    # ------------------------------------------------------------------ snapshots

    def get_state(self) -> dict[str, Any]:
        """Return all that decides how it goes on; the graph's arrays, which cannot be written, are shared."""
        graph = self._graph
        return {
            "graph": None if graph is None else {name: getattr(graph, name) for name in graph.__dataclass_fields__},
            "schedule": (self._waited, self._read, self._closed, self._last_closing, self._count),
            "last_seen": dict(self._last_seen),
            "guesses": tuple(dict(guesses) for guesses in self._guesses),
        }

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Go on exactly as the one that gave `state`."""
        self._graph = None if state["graph"] is None else PathGraph(**state["graph"])
        self._waited, self._read, self._closed, self._last_closing, self._count = state["schedule"]
        self._last_seen = dict(state["last_seen"])
        self._guesses = [dict(guesses) for guesses in state["guesses"]]


def write_maps(maps: ParticleMaps, best: int, particles: Particles) -> None:
    """Give all particles the landmarks of their paths: those that the most probable one held and a sighting supports.

    What only others held was a mistake, as far as is known: the log's association is that of the most probable. Names,
    descriptors and odds stay; where a landmark's odds differ between particles, all get the mean of those that held it.
    """
    slots = maps.used_slots()
    slots = slots[(maps.of_particle(best, slots)[1] > 0) & np.isin(maps.ids[slots], particles.ids)]
    rows = np.searchsorted(particles.ids[order := np.argsort(particles.ids)], maps.ids[slots])
    rows = order[rows]
    m = maps.num_particles
    odds = maps.dense_odds(slots)
    if odds is not None:
        held = maps.dense(slots)[1] > 0
        mean = (odds * held).sum(axis=1) / np.maximum(held.sum(axis=1), 1)
        odds = np.repeat(mean[:, None], m, axis=1)
    counts = np.repeat(particles.counts[rows][:, None], m, axis=1)
    maps.load_tiles(
        particles.tiles[rows], counts, maps.descriptors[slots], maps.ids[slots], maps.identities[slots],
        maps.next_id, odds,
    )  # fmt: skip
