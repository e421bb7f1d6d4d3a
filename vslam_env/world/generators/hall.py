"""Procedural halls: one large room with pillars that occlude parts of it."""

import numpy as np

from slam_backend.core.validation import FloatArray
from vslam_env.world.spec import World

PILLARS = (8, 14)  # least and greatest number
SIDE = (0.5, 0.9)  # [m] least and greatest side of a pillar
PASSAGE = 1.4  # [m] least gap between pillars, and between pillars and walls


def hall(rng: np.random.Generator) -> World:
    """Build a hall of about 20 x 15 m with 8 to 14 square pillars at random angles.

    Args:
        rng: Source of the layout.

    Returns:
        Closed world with 36 to 60 walls, without landmarks.
    """
    width, height = rng.uniform(18.0, 22.0), rng.uniform(13.0, 16.0)
    corners = np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]])
    outlines = [corners]
    pillars = np.empty((0, 3))  # middle and half diagonal of each
    wanted = int(rng.integers(PILLARS[0], PILLARS[1] + 1))
    for _ in range(60 * wanted):
        half = rng.uniform(*SIDE) * np.sqrt(0.5)
        margin = half + PASSAGE
        middle = rng.uniform((margin, margin), (width - margin, height - margin))
        gaps = np.hypot(*(pillars[:, :2] - middle).T) - pillars[:, 2] - half
        if (gaps < PASSAGE).any():
            continue
        pillars = np.vstack([pillars, [*middle, half]])
        angle = rng.uniform(0.0, 0.5 * np.pi) + 0.5 * np.pi * np.arange(4)
        outlines.append(middle + half * np.column_stack([np.cos(angle), np.sin(angle)]))
        if len(pillars) == wanted:
            break
    return World("hall", np.vstack([_closed(outline) for outline in outlines]))


def _closed(corners: FloatArray) -> FloatArray:
    """Return the walls (n, 4) of a closed outline (n, 2)."""
    return np.hstack([corners, np.roll(corners, -1, axis=0)])
