"""What a smoother is told: what logs hold that is new, where landmarks are thought to be, and how they look."""

from collections.abc import Sequence

import numpy as np

from slam_backend._best_map import write_outline
from slam_backend._particle_maps import ParticleMaps
from slam_backend.landmark_map import OutlineRows
from slam_backend.log_arrays import LogArrays
from slam_backend.run_log import RobotLog
from slam_backend.smoothing.extending import Places, first_rows
from slam_backend.smoothing.graph import PathGraph
from slam_backend.smoothing.reassociation import Known
from slam_backend.smoothing.rejuvenation import Looks


def places_of(maps: ParticleMaps, best: int) -> Places:
    """Return where the most probable particle holds its landmarks to be."""
    rows = OutlineRows.unwritten(len(maps.ids))
    num = write_outline(maps, best, 1, rows, 0)
    return Places(rows.names[:num, 1].copy(), rows.places[:num, :3].copy())


def known_of(maps: ParticleMaps, best: int) -> Known:
    """Return what the most probable particle knows of the landmarks that no caller has named."""
    slots = maps.used_slots()
    slots = slots[maps.identities[slots] < 0]
    values, counts = maps.of_particle(best, slots)
    held = counts > 0
    slots, values = slots[held], values[held]
    return Known(maps.ids[slots], values[:, :3], values[:, 3:], counts[held], maps.descriptors[slots])


def looks_of(maps: ParticleMaps, gate: float) -> Looks:
    """Return the appearance of landmarks that no caller has named; beyond the gate two do not look alike."""
    slots = maps.used_slots()
    slots = slots[maps.identities[slots] < 0]
    return Looks(maps.ids[slots], maps.descriptors[slots], gate)


def since(logs: Sequence[RobotLog], graph: PathGraph, until: PathGraph | None = None) -> list[LogArrays]:
    """Return what the logs hold after a graph's last steps, up to another's."""
    new = [log.arrays(int(latest) + 1) for log, latest in zip(logs, graph.latest, strict=True)]
    if until is None:
        return new
    ends = [np.searchsorted(log.steps, last, side="right") for log, last in zip(new, until.latest, strict=True)]
    return [first_rows(log, int(end)) for log, end in zip(new, ends, strict=True)]


def most_waiting(logs: Sequence[RobotLog], graph: PathGraph) -> int:
    """Return how many steps after the last ones of a graph the log has that holds most of them."""
    return max(log.num_since(step + 1) for log, step in zip(logs, graph.latest.tolist(), strict=True))
