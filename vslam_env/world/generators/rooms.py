"""Procedural grids of rooms of one size, with doors between neighbours, from a flat to the largest world."""

from itertools import pairwise, product
from typing import Any

import numpy as np

from slam_backend.core.validation import argument_error, check_float
from vslam_env.world.generators._blueprint import JAMB, Blueprint, Room
from vslam_env.world.spec import LARGEST_EXTENT, World

LEAST_ROOM, LARGEST_ROOM = 2.5, 30.0  # [m]
DOORS = 0.6  # share of the walls between neighbours with a door, besides those that connect all rooms


def rooms(rng: np.random.Generator, extent: float = 60.0, room: float = 10.0) -> World:
    """Build a square grid of furnished rooms.

    Args:
        rng: Source of the layout.
        extent: Side of the square [m], up to 200.
        room: Least side of a room [m], 2.5 to 30; enlarged so that whole rooms fill the square.

    Returns:
        Closed world without landmarks, in which all rooms are connected, most of them by several ways.

    Raises:
        ValueError: If a size is out of range.
    """
    room = check_float("room", room, "Give the side of a room in metres.", at_least=LEAST_ROOM, at_most=LARGEST_ROOM)
    extent = check_float("extent", extent, "Give metres.", above=0.0, at_most=LARGEST_EXTENT)
    if extent < 2.0 * room:
        raise argument_error("extent", f"at least {2.0 * room:g} m for rooms of {room:g} m", extent, "Fit two rooms.")
    plan, count = Blueprint(rng), int(extent / room + 1e-9)
    side = extent / count
    edges = np.linspace(0.0, extent, count + 1).tolist()
    plan.shell(0.0, 0.0, extent, extent)
    beside, above = _doors(count, rng)
    span = min(2.0, 0.5 * (side - 2.0 * JAMB) - 0.05)  # doors lie near the middles of walls, clear of crossings
    for i, at in enumerate(edges[1:-1], start=1):
        for j in range(count):
            low, high = edges[j], edges[j + 1]
            middle = 0.5 * (low + high)
            door = ((middle - span - JAMB, middle + span + JAMB),)
            plan.wall(at, low, at, high, door if beside[i - 1, j] else ())
            plan.wall(low, at, high, at, door if above[j, i - 1] else ())
    if side >= 4.0:
        for (x0, x1), (y0, y1) in product(pairwise(edges), repeat=2):
            plan.furnish(Room(x0, y0, x1, y1))
    return World("rooms", plan.finished())


def _doors(count: int, rng: np.random.Generator) -> tuple[Any, Any]:
    """Return which rooms (i, j) have doors to (i + 1, j) and (i, j + 1): (n - 1, n) bool and (n, n - 1) bool.

    A random spanning tree connects all rooms; other doors are drawn.
    """
    pairs = [((i, j), (i + 1, j)) for i in range(count - 1) for j in range(count)]
    pairs += [((i, j), (i, j + 1)) for i in range(count) for j in range(count - 1)]
    part = {(i, j): (i, j) for i in range(count) for j in range(count)}

    def root(room: tuple[int, int]) -> tuple[int, int]:
        while part[room] != room:
            part[room] = part[part[room]]
            room = part[room]
        return room

    beside, above = rng.random((count - 1, count)) < DOORS, rng.random((count, count - 1)) < DOORS
    for index in rng.permutation(len(pairs)).tolist():
        here, there = pairs[index]
        first, second = root(here), root(there)
        if first != second:
            part[first] = second
            (beside if there[0] > here[0] else above)[here] = True
    return beside, above
