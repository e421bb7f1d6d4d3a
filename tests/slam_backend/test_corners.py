from typing import Any

import numpy as np
import pytest
from box_pairs import paint

from slam_backend.frontend import CornerOptions, harris_corners, spread_order


def test_corners_follow_motions_by_fractions_of_a_pixel() -> None:
    """Corners of boxes are found to a tenth of a pixel, but for an offset that all have and that lies inside."""
    rng = np.random.default_rng(1)
    grid = np.stack(np.meshgrid(np.arange(30.0, 270.0, 50.0), np.arange(30.0, 200.0, 50.0)), axis=-1).reshape(-1, 2)
    true = grid + rng.uniform(-0.5, 0.5, grid.shape)
    image = paint(320, 240, np.column_stack([true, true + 25.3]), np.full(len(true), 220.0))
    found = harris_corners(image, CornerOptions(most=400)).points
    apart = np.hypot(*(found[:, None] - true[None]).transpose(2, 0, 1))
    errors = found[apart.argmin(axis=0)] - true
    assert errors.std(axis=0).max() < 0.1
    assert (np.abs(errors.mean(axis=0) - 0.85) < 0.1).all()


def test_noise_and_flat_images_have_no_corners() -> None:
    """Camera noise of two grey levels is no corner, nor is an empty, grey or saturated image."""
    noise = np.random.default_rng(2).normal(128.0, 2.0, (120, 160))
    for image in (np.rint(noise).astype(np.uint8), *(np.full((120, 160), level, np.uint8) for level in (0, 90, 255))):
        assert len(harris_corners(image).points) == 0


def test_corners_keep_their_distances() -> None:
    """No two corners lie within the spacing of each other, none within the border, and responses are positive."""
    image = np.random.default_rng(3).integers(0, 256, (97, 131), dtype=np.uint8)
    options = CornerOptions(most=1000, spacing=5, border=9)
    points, responses = harris_corners(image, options)
    apart = np.abs(points[:, None] - points[None]).max(axis=2) + 100.0 * np.eye(len(points))
    assert len(points) > 50
    assert apart.min() > 4.0  # pixels are more than 5 apart, peaks within them less than 1 off each
    assert points.min() >= 8.0
    assert points[:, 0].max() < 131 - 8
    assert points[:, 1].max() < 97 - 8
    assert responses.min() > 0.0


def test_equal_neighbours_give_one_corner() -> None:
    """Of peaks that are exactly alike and within the spacing, the first one counts."""
    image = np.zeros((60, 60), dtype=np.uint8)
    image[28:32, 20:24] = image[28:32, 24:28] = 200  # mirrored halves of one bar
    points = harris_corners(image, CornerOptions(spacing=8)).points
    assert len(points) == 1


def test_the_order_is_that_of_ranks_within_cells() -> None:
    """`spread_order` sorts by rank within the own cell, then by quality; here checked the long way."""
    rng = np.random.default_rng(4)
    points, quality = rng.uniform(-50.0, 200.0, (70, 2)), rng.permutation(70).astype(float)
    order = spread_order(points, quality, 40.0)
    cells = [tuple(cell) for cell in np.floor(points / 40.0).astype(int)]
    ranks = [sum(cells[j] == cells[i] and quality[j] > quality[i] for j in range(70)) for i in range(70)]
    assert order.tolist() == sorted(range(70), key=lambda i: (ranks[i], -quality[i]))
    assert spread_order(np.empty((0, 2)), np.empty(0), 40.0).tolist() == []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"most": 0}, "corners.most: expected an int >= 1, got 0"),
        ({"border": 2}, "corners.border: expected an int >= 4, got 2"),
        ({"relative": 0.0}, "corners.relative: expected a finite number .*, got 0.0"),
    ],
)
def test_impossible_options_are_refused(change: dict[str, Any], message: str) -> None:
    """The error names the option."""
    with pytest.raises(ValueError, match=message):
        CornerOptions(**change)
