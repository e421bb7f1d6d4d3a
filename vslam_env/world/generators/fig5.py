"""Room of the paper's Fig. 5: a rectangle with a few inner walls that restrict the view."""

import numpy as np

from vslam_env.world.spec import World

# Middle (x, y), direction and length of each inner wall, as shares of the room's width, height, a half turn and width.
_INNER = (
    (0.20, 0.30, 0.00, 0.20),
    (0.28, 0.72, 0.50, 0.20),
    (0.45, 0.55, 0.25, 0.16),
    (0.52, 0.20, 0.50, 0.15),
    (0.62, 0.80, 0.00, 0.22),
    (0.76, 0.45, 0.50, 0.24),
    (0.88, 0.72, 0.75, 0.12),
)


def fig5(rng: np.random.Generator) -> World:
    """Build the room, about 16 x 12 m, with small random changes of the inner walls.

    Args:
        rng: Source of the variation.

    Returns:
        World with 11 walls, without landmarks.
    """
    width, height = rng.uniform(15.5, 16.5), rng.uniform(11.5, 12.5)
    corners = np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]])
    outer = np.hstack([corners, np.roll(corners, -1, axis=0)])
    inner = np.array(_INNER)
    middle = inner[:, :2] * (width, height) + rng.uniform(-0.3, 0.3, (len(inner), 2))
    angle = np.pi * inner[:, 2] + rng.uniform(-0.15, 0.15, len(inner))
    half = 0.5 * width * inner[:, 3] * rng.uniform(0.9, 1.1, len(inner))
    reach = half[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return World("fig5", np.vstack([outer, np.hstack([middle - reach, middle + reach])]))
