"""Colours (RGB), distinguishable with colour vision deficiency."""

from collections.abc import Hashable, Sequence

import numpy as np

Colour = tuple[int, int, int]

PAPER: Colour = (250, 249, 246)
STRIP: Colour = (240, 239, 235)
RULE: Colour = (216, 214, 208)
INK: Colour = (52, 54, 60)
FAINT_INK: Colour = (122, 124, 130)
WALL: Colour = (190, 192, 198)
TRUE_LANDMARK: Colour = (84, 86, 92)
FLASH: Colour = (240, 196, 25)

# Palette of Okabe and Ito, with brown instead of yellow, which is too light on this background.
ROBOTS: tuple[Colour, ...] = (
    (0, 114, 178),
    (213, 94, 0),
    (0, 158, 115),
    (204, 121, 167),
    (230, 159, 0),
    (86, 180, 233),
    (122, 84, 48),
    (70, 70, 76),
)


def robot_colour(index: int) -> Colour:
    """Return the colour (RGB) of the robot with an index >= 0; colours repeat after eight."""
    return ROBOTS[index % len(ROBOTS)]


def shared_by(groups: Sequence[Hashable]) -> tuple[int, ...]:
    """Return, for each robot, the first robot of its group, which has the group's colour: a shared map is drawn once.

    Args:
        groups: Label of each robot's group.

    >>> shared_by([5, 1, 5])
    (0, 1, 0)
    """
    return tuple(groups.index(group) for group in groups)


def mix(colour: Colour, other: Colour, share: float) -> Colour:
    """Return the mixture of `colour` and a `share` in [0, 1] of `other`; with the background it looks translucent.

    >>> mix((0, 100, 200), (100, 100, 100), 0.5)
    (50, 100, 150)
    """
    r, g, b = np.rint((1.0 - share) * np.array(colour) + share * np.array(other)).astype(int).tolist()
    return (r, g, b)
