"""Floor plan under construction: rooms, walls with doors, and furniture."""

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from slam_backend.core.validation import FloatArray

DOOR = (1.1, 1.4)  # [m] least and greatest width
JAMB = 0.35  # [m] wall left between a door and the end of its wall
DOOR_CLEARANCE = 1.1  # [m] least distance of furniture from the middle of a door
PASSAGE = 0.75  # [m] free width around furniture
FURNISHED = 0.8  # share of rooms, or halves of large ones, with furniture
PILASTER = (0.25, 0.35)  # [m] least and greatest depth

Segment = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class Room:
    """Rectangular room from (x0, y0) to (x1, y1) [m]."""

    x0: float
    y0: float
    x1: float
    y1: float

    @property
    def size(self) -> tuple[float, float]:
        """Width and height [m]."""
        return self.x1 - self.x0, self.y1 - self.y0

    def halves(self) -> tuple["Room", "Room"]:
        """Return the two halves along the longer side, with a passage between them."""
        width, height = self.size
        if width >= height:
            x = 0.5 * (self.x0 + self.x1)
            gap = 0.5 * PASSAGE
            return Room(self.x0, self.y0, x - gap, self.y1), Room(x + gap, self.y0, self.x1, self.y1)
        y = 0.5 * (self.y0 + self.y1)
        gap = 0.5 * PASSAGE
        return Room(self.x0, self.y0, self.x1, y - gap), Room(self.x0, y + gap, self.x1, self.y1)


@dataclass(slots=True)
class Blueprint:
    """Floor plan under construction.

    Attributes:
        rng: Source of all draws.
        segments: Walls [m].
        doors: Middles (x, y) of the doors [m].
    """

    rng: np.random.Generator
    segments: list[Segment] = field(default_factory=list)
    doors: list[tuple[float, float]] = field(default_factory=list)

    def wall(self, x0: float, y0: float, x1: float, y1: float, spans: tuple[tuple[float, float], ...] = ()) -> None:
        """Add an axis-parallel wall with doors.

        Args:
            x0, y0: Start of the wall [m], world frame.
            x1, y1: End of the wall [m], x1 = x0 or y1 = y0.
            spans: Intervals (from, to) along the wall [m], each with one door at a random position.
        """
        upright = x0 == x1
        begin, end = (y0, y1) if upright else (x0, x1)
        cuts = [begin]
        for low, high in sorted(spans):
            width = self.rng.uniform(*DOOR)
            middle = self.rng.uniform(low + JAMB + 0.5 * width, high - JAMB - 0.5 * width)
            cuts += [middle - 0.5 * width, middle + 0.5 * width]
            self.doors.append((x0, middle) if upright else (middle, y0))
        cuts.append(end)
        for a, b in zip(cuts[0::2], cuts[1::2], strict=True):
            self.segments.append((x0, a, x0, b) if upright else (a, y0, b, y0))

    def shell(self, x0: float, y0: float, x1: float, y1: float) -> None:
        """Add the four outer walls of a rectangle [m]."""
        self.wall(x0, y0, x1, y0)
        self.wall(x1, y0, x1, y1)
        self.wall(x0, y1, x1, y1)
        self.wall(x0, y0, x0, y1)

    def block(self, x0: float, y0: float, x1: float, y1: float) -> None:
        """Add the outline of a solid box [m]."""
        self.segments += _chain([(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)])

    def split(self, begin: float, end: float, parts: int) -> list[float]:
        """Divide [begin, end] [m] at random into parts of similar length; return all boundaries [m]."""
        shares = self.rng.uniform(0.75, 1.25, parts)
        return [begin, *(begin + (end - begin) * np.cumsum(shares)[:-1] / shares.sum()).tolist(), end]

    def pilasters(self, begin: float, end: float, low: float, high: float, upright: bool = False) -> None:
        """Add pilasters alternately to both walls of a corridor along x, away from doors.

        Landmarks on corridor walls are invisible at oblique angles; pilasters face along the corridor.

        Args:
            begin, end: Range of the corridor along x [m], world frame.
            low, high: Positions y of its walls [m].
            upright: Whether the corridor runs along y, with x and y exchanged.
        """
        x = begin + self.rng.uniform(1.0, 3.0)
        upper = self.rng.random() < 0.5
        while x < end - 0.5:
            y, inward = (high, -1.0) if upper else (low, 1.0)
            if self._clear_of_doors(*((y, x, y, x) if upright else (x, y, x, y))):
                tip = y + inward * self.rng.uniform(*PILASTER)
                self.segments.append((y, x, tip, x) if upright else (x, y, x, tip))
                upper = not upper
                x += self.rng.uniform(2.5, 4.0)
            x += 0.4

    def furnish(self, room: Room) -> None:
        """Furnish a room, or both halves of a large one; some stay empty."""
        parts = room.halves() if max(room.size) > 5.0 else (room,)
        for part in parts:
            if self.rng.random() > FURNISHED:
                continue
            draw = (self._screen, self._cabinet, self._table)[self.rng.choice(3, p=(0.45, 0.25, 0.3))]
            for _ in range(8):
                segments = draw(room, part)
                if segments and self._clear(segments):
                    self.segments += segments
                    break

    def _screen(self, room: Room, part: Room) -> list[Segment]:
        """Return a screen that projects from a wall far enough to occlude part of the room."""
        upright = room.size[0] >= room.size[1]
        depth = room.size[1] if upright else room.size[0]
        length = min(self.rng.uniform(0.3, 0.55) * depth, depth - 1.4)
        from_far = self.rng.random() < 0.5
        if upright:
            x = self.rng.uniform(part.x0 + PASSAGE, max(part.x0 + PASSAGE, part.x1 - PASSAGE))
            return [(x, room.y1, x, room.y1 - length) if from_far else (x, room.y0, x, room.y0 + length)]
        y = self.rng.uniform(part.y0 + PASSAGE, max(part.y0 + PASSAGE, part.y1 - PASSAGE))
        return [(room.x1, y, room.x1 - length, y) if from_far else (room.x0, y, room.x0 + length, y)]

    def _cabinet(self, room: Room, part: Room) -> list[Segment]:
        """Return a cabinet against the upper or lower wall of the room: three sides of a box."""
        width, depth = self.rng.uniform(1.0, 1.6), self.rng.uniform(0.4, 0.6)
        if part.x1 - part.x0 < width + 2.0 * PASSAGE or room.size[1] < depth + 1.4:
            return []
        x = self.rng.uniform(part.x0 + PASSAGE, part.x1 - PASSAGE - width)
        at_top = part.y1 == room.y1 and (part.y0 != room.y0 or self.rng.random() < 0.5)
        y, inward = (room.y1, -depth) if at_top else (room.y0, depth)
        return _chain([(x, y), (x, y + inward), (x + width, y + inward), (x + width, y)])

    def _table(self, room: Room, part: Room) -> list[Segment]:
        """Return a free-standing table or column."""
        if self.rng.random() < 0.3:
            width = height = self.rng.uniform(0.35, 0.5)
        else:
            width, height = self.rng.uniform(1.2, 1.8), self.rng.uniform(0.7, 0.9)
        if part.size[1] > part.size[0]:
            width, height = height, width
        free_x, free_y = part.size[0] - width - 2.0 * PASSAGE, part.size[1] - height - 2.0 * PASSAGE
        if min(free_x, free_y) < 0.0:
            return []
        x, y = part.x0 + PASSAGE + self.rng.uniform(0.0, free_x), part.y0 + PASSAGE + self.rng.uniform(0.0, free_y)
        return _chain([(x, y), (x + width, y), (x + width, y + height), (x, y + height), (x, y)])

    def _clear(self, segments: list[Segment]) -> bool:
        """Return whether furniture leaves all doors free."""
        box = np.array(segments).reshape(-1, 2)
        return self._clear_of_doors(*box.min(axis=0).tolist(), *box.max(axis=0).tolist())

    def _clear_of_doors(self, x0: float, y0: float, x1: float, y1: float) -> bool:
        """Return whether no door is close to a box."""
        gap = DOOR_CLEARANCE
        near = ((x, y) for x, y in self.doors if x0 - gap < x < x1 + gap and y0 - gap < y < y1 + gap)
        return all(np.hypot(max(x0 - x, 0.0, x - x1), max(y0 - y, 0.0, y - y1)) > gap for x, y in near)

    def finished(self) -> FloatArray:
        """Return the walls (S, 4) [m], randomly mirrored."""
        walls = np.array(self.segments)
        for axes in ([0, 2], [1, 3]):
            if self.rng.random() < 0.5:
                walls[:, axes] = walls[:, axes].max() - walls[:, axes]
        return walls


def _chain(corners: list[tuple[float, float]]) -> list[Segment]:
    """Return the segments of a polyline."""
    return [(*a, *b) for a, b in pairwise(corners)]
