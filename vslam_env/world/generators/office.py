"""Procedural offices: rooms with doors along a ring of corridors or a single corridor."""

from itertools import pairwise

import numpy as np

from slam_backend.core.validation import check_float
from vslam_env.world.generators._blueprint import Blueprint, Room
from vslam_env.world.generators._wings import add_wings
from vslam_env.world.spec import LARGEST_EXTENT, World

LEAST_EXTENT = 30.0  # [m] of a floor with wings
DEPTH = 0.7  # depth of such a floor over its width
ENOUGH_WALLS = 58  # number of walls above which no more rooms are furnished


def office(rng: np.random.Generator, extent: float | None = None) -> World:
    """Build a furnished office floor.

    Args:
        rng: Source of the layout.
        extent: Width of a floor of wings along crossing corridors, 0.7 times as deep [m], 30 to 200; None: a floor of
            about 20 x 14 m with 7 to 10 rooms and 45 to 65 walls.

    Returns:
        Closed world without landmarks. A robot of radius 0.2 m can reach every room. There is always a loop: the ring
        of corridors, crossing corridors, or neighbouring rooms with a door between them.

    Raises:
        ValueError: If the extent is out of range.
    """
    if extent is not None:
        hint = "Give metres, or leave it out for a floor of 20 x 14 m."
        extent = check_float("extent", extent, hint, at_least=LEAST_EXTENT, at_most=LARGEST_EXTENT)
        wings = Blueprint(rng)
        add_wings(wings, Room(0.0, 0.0, extent, DEPTH * extent))
        return World("office", wings.finished())
    plan = Blueprint(rng)
    rooms = _ring(plan) if rng.random() < 0.6 else _spine(plan)
    for index in rng.permutation(len(rooms)):
        if len(plan.segments) < ENOUGH_WALLS:
            plan.furnish(rooms[index])
    return World("office", plan.finished())


def _ring(plan: Blueprint) -> list[Room]:
    """Add two rows of rooms and a ring of corridors around a core of rooms."""
    rng = plan.rng
    width, height, corridor = rng.uniform(19.5, 21.0), rng.uniform(14.0, 15.0), rng.uniform(1.7, 1.95)
    bottom, top = rng.uniform(3.4, 3.9), height - rng.uniform(3.4, 3.9)
    plan.shell(0.0, 0.0, width, height)
    west = rng.uniform(3.0, 3.8) if rng.random() < 0.6 else 0.0
    east = width - (rng.uniform(3.0, 3.8) if rng.random() < 0.4 else 0.0)
    rooms = _row(plan, plan.split(0.0, width, 3), 0.0, bottom, bottom)
    rooms += _row(plan, plan.split(0.0, width, 3), top, height, top)
    for x, outer in ((west, 0.0), (east, width)):
        if x != outer:
            plan.wall(x, bottom, x, top, ((bottom, top),))
            rooms.append(Room(min(x, outer), bottom, max(x, outer), top))
    x0, x1, y0, y1 = west + corridor, east - corridor, bottom + corridor, top - corridor
    ends = plan.split(x0, x1, 2 if x1 - x0 > 9.0 else 1)
    doors_below = rng.random(len(ends) - 1) < 0.5
    spans = list(pairwise(ends))
    plan.wall(x0, y0, x1, y0, tuple(s for s, below in zip(spans, doors_below, strict=True) if below))
    plan.wall(x0, y1, x1, y1, tuple(s for s, below in zip(spans, doors_below, strict=True) if not below))
    plan.wall(x0, y0, x0, y1)
    plan.wall(x1, y0, x1, y1)
    for x in ends[1:-1]:
        plan.wall(x, y0, x, y1)
    plan.pilasters(x0, x1, bottom, y0)
    plan.pilasters(x0, x1, y1, top)
    return rooms + [Room(a, y0, b, y1) for a, b in spans]


def _spine(plan: Blueprint) -> list[Room]:
    """Add two rows of rooms along one corridor, each row with one door between neighbours."""
    rng = plan.rng
    width, height, corridor = rng.uniform(19.0, 21.0), rng.uniform(13.0, 14.5), rng.uniform(1.8, 2.2)
    low = 0.5 * (height - corridor) + rng.uniform(-0.6, 0.6)
    plan.shell(0.0, 0.0, width, height)
    rooms = []
    for y0, y1, corridor_wall, parts in (
        (0.0, low, low, 4),
        (low + corridor, height, low + corridor, int(rng.integers(3, 6))),
    ):
        ends = plan.split(0.0, width, parts)
        rooms += _row(plan, ends, y0, y1, corridor_wall, door_between=int(rng.integers(1, len(ends) - 1)))
    plan.pilasters(0.0, width, low, low + corridor)
    return rooms


def _row(
    plan: Blueprint, ends: list[float], y0: float, y1: float, corridor_wall: float, door_between: int | None = None
) -> list[Room]:
    """Add a row of rooms with doors to a corridor.

    Args:
        plan: Plan to extend.
        ends: Positions x of the walls between rooms, ascending [m].
        y0: Position y of the lower wall [m].
        y1: Position y of the upper wall [m].
        corridor_wall: Position y of the wall with the doors [m].
        door_between: Index in `ends` of a wall between rooms with a door; None: none.
    """
    spans = tuple(pairwise(ends))
    plan.wall(ends[0], corridor_wall, ends[-1], corridor_wall, spans)
    for i, x in enumerate(ends[1:-1], start=1):
        plan.wall(x, y0, x, y1, ((y0, y1),) if i == door_between else ())
    return [Room(a, y0, b, y1) for a, b in spans]
