"""Procedural campuses: buildings with wings, and paths with hedges, benches and trees between them."""

from itertools import pairwise

import numpy as np

from slam_backend.core.validation import check_float
from vslam_env.world.generators._blueprint import Blueprint, Room
from vslam_env.world.generators._wings import add_wings
from vslam_env.world.spec import LARGEST_EXTENT, World

LEAST_EXTENT = 70.0  # [m]
DEPTH = 0.8  # depth of the campus over its width
LOT = 38.0  # [m] typical side of a building and the paths around it
PATH = (2.5, 3.5)  # [m] from a building to the edge of its lot
GREEN = 0.2  # share of the lots, at most, that are greens with trees and benches
ENTRANCES = (2, 5)  # least number of doors of a building to the outside, and one more than the greatest
SPACING = (3.0, 4.5)  # [m] between hedges along a path
SHRUB = 4.5  # [m] side of the squares of a green, some with a tree or a bench


def campus(rng: np.random.Generator, extent: float = 120.0) -> World:
    """Build a fenced campus of several buildings with outdoor paths.

    Args:
        rng: Source of the layout.
        extent: Width of the campus, 0.8 times as deep [m], 70 to 200.

    Returns:
        Closed world without landmarks. Every building has two to four doors to the outside.

    Raises:
        ValueError: If the extent is out of range.
    """
    extent = check_float("extent", extent, "Give metres.", at_least=LEAST_EXTENT, at_most=LARGEST_EXTENT)
    plan, depth = Blueprint(rng), DEPTH * extent
    columns, rows = (max(1, round(side / LOT)) for side in (extent, depth))
    plan.shell(0.0, 0.0, extent, depth)
    lots = [
        Room(x0, y0, x1, y1)
        for x0, x1 in pairwise(np.linspace(0.0, extent, columns + 1).tolist())
        for y0, y1 in pairwise(np.linspace(0.0, depth, rows + 1).tolist())
    ]
    greens = set(rng.permutation(len(lots))[: int(rng.integers(int(GREEN * len(lots)) + 1))].tolist())
    for index, lot in enumerate(lots):
        west, south, east, north = rng.uniform(*PATH, 4)
        area = Room(lot.x0 + west, lot.y0 + south, lot.x1 - east, lot.y1 - north)
        if index in greens:
            _green(plan, area)
        else:
            add_wings(plan, area, int(rng.integers(*ENTRANCES)))
        if lot.y1 < depth:
            _hedges(plan, lot.x0, lot.x1, lot.y1)
        if lot.x1 < extent:
            _hedges(plan, lot.y0, lot.y1, lot.x1, upright=True)
    for _ in range(2):
        plan.pilasters(0.0, extent, 0.0, depth)
        plan.pilasters(0.0, depth, 0.0, extent, upright=True)
    return World("campus", plan.finished())


def _hedges(plan: Blueprint, begin: float, end: float, at: float, upright: bool = False) -> None:
    """Add hedges along the middle of a path along x, at y = `at` [m]; `upright`: along y, at x = `at`."""
    rng = plan.rng
    place = begin + rng.uniform(*SPACING)
    while place < end - 2.5:
        long, across = rng.uniform(0.4, 1.2), rng.uniform(0.3, 0.5)
        low, high = at - 0.5 * across, at + 0.5 * across
        plan.block(*((low, place, high, place + long) if upright else (place, low, place + long, high)))
        place += long + rng.uniform(*SPACING)


def _green(plan: Blueprint, area: Room) -> None:
    """Add trees and benches to a green."""
    rng = plan.rng
    for x in np.arange(area.x0, area.x1 - SHRUB, SHRUB).tolist():
        for y in np.arange(area.y0, area.y1 - SHRUB, SHRUB).tolist():
            width, height = (rng.uniform(0.35, 0.5), rng.uniform(0.35, 0.5)) if rng.random() < 0.6 else (1.6, 0.5)
            left, low = x + rng.uniform(0.8, SHRUB - width - 0.8), y + rng.uniform(0.8, SHRUB - height - 0.8)
            plan.block(left, low, left + width, low + height)
