"""Large floors: wings with two rows of rooms along a corridor each, joined by crossing corridors."""

from itertools import pairwise

from vslam_env.world.generators._blueprint import Blueprint, Room

WING = 10.0  # [m] typical depth: a row of rooms, a corridor and another row
BLOCK = 25.0  # [m] typical length between crossing corridors
ROOM = 5.0  # [m] typical width of a room
CORRIDOR = (2.1, 2.5)  # [m]
BACK_DOOR = 0.5  # share of the blocks with a door to the wing behind
WIDE_ENOUGH = 2.2  # [m] of a wall for a door

Span = tuple[float, float]


def add_wings(plan: Blueprint, area: Room, entrances: int = 0) -> None:
    """Add a furnished floor of wings along x, with outer walls.

    Args:
        plan: Plan to extend.
        area: Rectangle of the floor, at least about 20 x 14 m.
        entrances: Number of doors to the outside, at ends of corridors.
    """
    rng = plan.rng
    width, depth = area.size
    wings = list(pairwise(plan.split(area.y0, area.y1, max(2, round(depth / WING)))))
    across = float(rng.uniform(*CORRIDOR))  # width of the crossing corridors
    starts = plan.split(area.x0, area.x1 + across, max(2, round(width / BLOCK)))
    blocks = [(a, b - across) for a, b in pairwise(starts)]
    corridors: list[Span] = []
    for low, high in wings:
        middle, half = 0.5 * (low + high) + rng.uniform(-0.4, 0.4), 0.5 * rng.uniform(*CORRIDOR)
        corridors.append((middle - half, middle + half))
    crossings = [(a[1], b[0]) for a, b in pairwise(blocks)]
    _add_shell(plan, area, corridors, crossings, entrances)
    rooms: list[Room] = []
    for block in blocks:
        behind: list[Room] = []
        for wing, corridor in zip(wings, corridors, strict=True):
            below = _row(plan, block, (wing[0], corridor[0]), corridor[0])
            above = _row(plan, block, (corridor[1], wing[1]), corridor[1])
            if behind:
                plan.wall(block[0], wing[0], block[1], wing[0], _back_doors(plan, behind, below))
            rooms += below + above
            behind = above
        edges = [area.y0, *(y for corridor in corridors for y in corridor), area.y1]
        for x, outer in zip(block, (area.x0, area.x1), strict=True):
            if x != outer:
                for low, high in zip(edges[0::2], edges[1::2], strict=True):
                    plan.wall(x, low, x, high)
        for corridor in corridors:
            plan.pilasters(*block, *corridor)
    for crossing in crossings:
        for low, high in zip(edges[0::2], edges[1::2], strict=True):
            plan.pilasters(low, high, *crossing, upright=True)
    for room in rooms:
        plan.furnish(room)


def _row(plan: Blueprint, block: Span, depth: Span, corridor_wall: float) -> list[Room]:
    """Add a row of rooms, each with a door to the corridor."""
    ends = plan.split(*block, max(1, round((block[1] - block[0]) / ROOM)))
    spans = tuple(pairwise(ends))
    plan.wall(block[0], corridor_wall, block[1], corridor_wall, spans)
    for x in ends[1:-1]:
        plan.wall(x, depth[0], x, depth[1])
    return [Room(a, depth[0], b, depth[1]) for a, b in spans]


def _back_doors(plan: Blueprint, behind: list[Room], rooms: list[Room]) -> tuple[Span, ...]:
    """Draw the span of a door between rooms that share a wall along x, or none."""
    shared = [(max(a.x0, b.x0), min(a.x1, b.x1)) for a in behind for b in rooms]
    wide = [span for span in shared if span[1] - span[0] > WIDE_ENOUGH]
    if not wide or plan.rng.random() > BACK_DOOR:
        return ()
    return (wide[int(plan.rng.integers(len(wide)))],)


def _add_shell(plan: Blueprint, area: Room, corridors: list[Span], crossings: list[Span], entrances: int) -> None:
    """Add the outer walls, with doors at drawn ends of corridors."""
    ends = [(side, span) for side in ("west", "east") for span in corridors]
    ends += [(side, span) for side in ("south", "north") for span in crossings]
    chosen = [ends[i] for i in plan.rng.permutation(len(ends))[:entrances]]
    doors = {side: tuple(span for at, span in chosen if at == side) for side in ("west", "east", "south", "north")}
    plan.wall(area.x0, area.y0, area.x1, area.y0, doors["south"])
    plan.wall(area.x1, area.y0, area.x1, area.y1, doors["east"])
    plan.wall(area.x0, area.y1, area.x1, area.y1, doors["north"])
    plan.wall(area.x0, area.y0, area.x0, area.y1, doors["west"])
