"""Procedural loops of corridors around similar solid blocks."""

from itertools import product

import numpy as np

from vslam_env.world.generators._blueprint import PILASTER, Blueprint
from vslam_env.world.spec import World

CORRIDOR = (1.8, 2.2)  # [m]
JOINED = 0.25  # share of neighbouring blocks joined, without a corridor between them
WITH_NICHE = 0.5  # share of blocks with a niche
NICHE = (0.8, 1.2)  # [m] least and greatest width
NICHE_DEPTH = (0.4, 0.7)  # [m]


def loops(rng: np.random.Generator) -> World:
    """Build a grid of corridors of about 22 x 15 m around solid blocks with pilasters, some with a niche.

    Landmarks on corridor walls are invisible at oblique angles; pilasters face along the corridor.

    Args:
        rng: Source of the layout.

    Returns:
        Closed world with about 40 to 90 walls, without landmarks. Every place lies on a loop.
    """
    plan = Blueprint(rng)
    columns, rows = 3, int(rng.integers(2, 4))
    corridor = rng.uniform(*CORRIDOR)
    width, height = rng.uniform(21.0, 23.0), rng.uniform(14.0, 16.0)
    across = plan.split(corridor, width, columns)  # a corridor separates a block from the next
    up = plan.split(corridor, height, rows)
    _shell(plan, width, height)
    for row in range(rows):
        column = 0
        while column < columns:
            last = column + (column + 1 < columns and rng.random() < JOINED)
            _block(plan, across[column], up[row], across[last + 1] - corridor, up[row + 1] - corridor)
            column = last + 1
    return World("loops", plan.finished())


def _shell(plan: Blueprint, width: float, height: float) -> None:
    """Add the outer walls, with a pilaster on each half of the longer and on each shorter wall."""
    corners = [(0.0, 0.0), (width, 0.0), (width, height), (0.0, height)]
    for begin, end in zip(corners, corners[1:] + corners[:1], strict=True):
        plan.segments.append((*begin, *end))
    for half, (y, inward) in product((0.0, 0.5), ((0.0, 1.0), (height, -1.0))):
        x = width * (half + plan.rng.uniform(0.15, 0.35))
        plan.segments.append((x, y, x, y + inward * plan.rng.uniform(*PILASTER)))
    for x, inward in ((0.0, 1.0), (width, -1.0)):
        y = height * plan.rng.uniform(0.3, 0.7)
        plan.segments.append((x, y, x + inward * plan.rng.uniform(*PILASTER), y))


def _block(plan: Blueprint, x0: float, y0: float, x1: float, y1: float) -> None:
    """Add a block with two pilasters and, with some probability, a niche in its lower or upper side."""
    rng = plan.rng
    sides = ((y0, 1.0), (y1, -1.0))
    with_niche = int(rng.integers(2)) if rng.random() < WITH_NICHE else None
    with_column = int(rng.integers(2)) if with_niche is None else 1 - with_niche
    plan.segments += [(x0, y0, x0, y1), (x1, y0, x1, y1)]
    for side, (y, inward) in enumerate(sides):
        if side != with_niche:
            plan.segments.append((x0, y, x1, y))
        else:
            wide, back = rng.uniform(*NICHE), y + inward * rng.uniform(*NICHE_DEPTH)
            a = rng.uniform(x0 + 0.3, x1 - wide - 0.3)
            b = a + wide
            plan.segments += [(x0, y, a, y), (a, y, a, back), (a, back, b, back), (b, back, b, y), (b, y, x1, y)]
        if side == with_column:
            x = rng.uniform(x0 + 0.3, x1 - 0.3)
            plan.segments.append((x, y, x, y - inward * rng.uniform(*PILASTER)))
    x, outward = (x0, -1.0) if rng.random() < 0.5 else (x1, 1.0)
    y = rng.uniform(y0 + 0.3, y1 - 0.3)
    plan.segments.append((x, y, x + outward * rng.uniform(*PILASTER), y))
