"""Procedural offices: rooms with doors along corridors that run in a ring or along a spine."""

from itertools import pairwise

import numpy as np

from vslam_env.world.generators._blueprint import Blueprint, Room
from vslam_env.world.spec import World

ENOUGH_WALLS = 58  # rooms that come up later stay empty


def office(rng: np.random.Generator) -> World:
    """Build a furnished office floor of about 20 x 14 m with 7 to 10 rooms.

    Args:
        rng: Source of the layout.

    Returns:
        A closed world without landmarks, about 45 to 65 walls. A robot of radius 0.2 m can reach every room, and there
        is always a way round: the ring of corridors, or neighbouring rooms with a door between them.
    """
    plan = Blueprint(rng)
    rooms = _ring(plan) if rng.random() < 0.6 else _spine(plan)
    for index in rng.permutation(len(rooms)):
        if len(plan.segments) < ENOUGH_WALLS:
            plan.furnish(rooms[index])
    return World("office", plan.finished())


def _ring(plan: Blueprint) -> list[Room]:
    """Draw two rows of rooms with a ring of corridors between them, around a core of rooms."""
    rng = plan.rng
    width, height, corridor = rng.uniform(19.5, 21.0), rng.uniform(14.0, 15.0), rng.uniform(1.7, 1.95)
    bottom, top = rng.uniform(3.4, 3.9), height - rng.uniform(3.4, 3.9)
    _shell(plan, width, height)
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
    """Draw two rows of rooms along one corridor; neighbours of a row have doors between them."""
    rng = plan.rng
    width, height, corridor = rng.uniform(19.0, 21.0), rng.uniform(13.0, 14.5), rng.uniform(1.8, 2.2)
    low = 0.5 * (height - corridor) + rng.uniform(-0.6, 0.6)
    _shell(plan, width, height)
    rooms = []
    for y0, y1, corridor_wall, parts in (
        (0.0, low, low, 4),
        (low + corridor, height, low + corridor, int(rng.integers(3, 6))),
    ):
        ends = plan.split(0.0, width, parts)
        rooms += _row(plan, ends, y0, y1, corridor_wall, door_between=int(rng.integers(1, len(ends) - 1)))
    plan.pilasters(0.0, width, low, low + corridor)
    return rooms


def _shell(plan: Blueprint, width: float, height: float) -> None:
    """Draw the four outer walls."""
    plan.wall(0.0, 0.0, width, 0.0)
    plan.wall(width, 0.0, width, height)
    plan.wall(0.0, height, width, height)
    plan.wall(0.0, 0.0, 0.0, height)


def _row(
    plan: Blueprint, ends: list[float], y0: float, y1: float, corridor_wall: float, door_between: int | None = None
) -> list[Room]:
    """Draw a row of rooms between y0 and y1 that open to a corridor.

    Args:
        plan: To draw into.
        ends: Where rooms end along x, in order.
        y0: Lower wall of the row [m].
        y1: Upper wall [m].
        corridor_wall: y of the one with the doors [m].
        door_between: The wall ends[i] that has a door, too.
    """
    spans = tuple(pairwise(ends))
    plan.wall(ends[0], corridor_wall, ends[-1], corridor_wall, spans)
    for i, x in enumerate(ends[1:-1], start=1):
        plan.wall(x, y0, x, y1, ((y0, y1),) if i == door_between else ())
    return [Room(a, y0, b, y1) for a, b in spans]
