from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from slam_backend.frontend import usurf_descriptors

REFERENCE = ("sk_brick", "sk_camera", "sk_coffee", "syn_blocks", "syn_posters")


def _plain(image: np.ndarray, point: tuple[float, float], s: float) -> np.ndarray:
    """Return the descriptor of one point straight from the definition: each box is summed pixel by pixel."""

    def covered(begin: float, end: float, size: int) -> np.ndarray:
        """Return how much of an interval lies on each pixel; what lies beyond the border counts for the outermost."""
        first, last = int(np.floor(begin)) - 1, int(np.ceil(end)) + 2
        share = np.zeros(size)
        for pixel in range(first, last):
            length = max(0.0, min(end, pixel + 0.5) - max(begin, pixel - 0.5))
            share[min(max(pixel, 0), size - 1)] += length
        return share

    def box(x1: float, y1: float, x2: float, y2: float) -> float:
        return float(covered(y1, y2, image.shape[0]) @ image @ covered(x1, x2, image.shape[1]))

    cells = np.zeros((4, 4, 4))
    for j in range(20):
        for i in range(20):
            x, y = point[0] + (i - 9.5) * s, point[1] + (j - 9.5) * s
            weight = np.exp(-0.5 * ((i - 9.5) ** 2 + (j - 9.5) ** 2) / 3.3**2)
            dx = weight * (box(x, y - s, x + s, y + s) - box(x - s, y - s, x, y + s))
            dy = weight * (box(x - s, y, x + s, y + s) - box(x - s, y - s, x + s, y))
            cells[j // 5, i // 5] += [dx, dy, abs(dx), abs(dy)]
    return cells.ravel() / np.linalg.norm(cells)


def test_the_compiled_form_agrees_with_the_definition() -> None:
    """The compiled descriptors are those of box sums taken pixel by pixel, inside the image and beyond its border."""
    rng = np.random.default_rng(1)
    image = rng.integers(0, 256, (40, 55), dtype=np.uint8)
    points = np.array([[27.3, 19.8], [3.1, 5.5], [54.0, 39.0], [-2.0, 20.0]])
    scales = np.array([0.8, 1.7, 2.3, 1.2])
    expected = [_plain(image.astype(float), (x, y), s) for (x, y), s in zip(points, scales, strict=True)]
    found = usurf_descriptors(image, points, scales)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, expected, atol=2e-6)


def test_it_agrees_with_the_reference_descriptors(data_dir: Path) -> None:
    """Conformance: on real and synthetic images the median cosine is at least .9995, the 5th percentile .995."""
    folder, cosines = data_dir / "usurf_reference", []
    for name in REFERENCE:
        reference = np.load(folder / f"{name}.npz")
        image = cv2.imread(str(folder / "images" / f"{name}.png"), cv2.IMREAD_GRAYSCALE)
        keep = reference["inside"].astype(bool) & ~reference["degenerate"].astype(bool)
        points = np.column_stack([reference["x_eff"], reference["y_eff"]])[keep]
        found = usurf_descriptors(image, points, reference["window"][keep] / 21.0)
        cosines.append(np.sum(found * reference["desc"][keep], axis=1))
    together = np.concatenate(cosines)
    assert len(together) > 2900
    assert np.median(together) >= 0.9995
    assert np.percentile(together, 5) >= 0.995


def test_brightness_and_contrast_change_nothing() -> None:
    """A descriptor depends neither on an offset nor on a factor of the grey levels."""
    image = np.random.default_rng(2).integers(0, 100, (60, 60), dtype=np.uint8)
    points = np.array([[30.2, 28.9]])
    brighter = (2 * image + 40).astype(np.uint8)
    one, other = (usurf_descriptors(pixels, points, 2.0) for pixels in (image, brighter))
    np.testing.assert_allclose(other, one, atol=1e-5)


def test_an_image_and_its_transpose_have_swapped_parts() -> None:
    """Transposing image and point swaps cell rows with columns and dx with dy: neither is mistaken for the other."""
    image = np.random.default_rng(3).integers(0, 256, (50, 70), dtype=np.uint8)
    one = usurf_descriptors(image, [[30.5, 20.0]], 1.5).reshape(4, 4, 4)
    other = usurf_descriptors(image.T.copy(), [[20.0, 30.5]], 1.5).reshape(4, 4, 4)
    np.testing.assert_allclose(other, one.transpose(1, 0, 2)[:, :, [1, 0, 3, 2]], atol=1e-5)
    assert np.abs(other - one).max() > 0.05


def test_a_step_has_the_sign_of_the_definition() -> None:
    """Brighter to the right is a positive dx, brighter below a positive dy."""
    step = np.zeros((60, 60), dtype=np.uint8)
    step[:, 30:] = 200
    sums = usurf_descriptors(step, [[29.5, 29.5]], 2.0).reshape(16, 4).sum(axis=0)
    assert sums[0] == pytest.approx(sums[2])
    assert sums[0] > 1.0
    assert abs(sums[1]) < 1e-6
    sums = usurf_descriptors(step.T.copy(), [[29.5, 29.5]], 2.0).reshape(16, 4).sum(axis=0)
    assert sums[1] == pytest.approx(sums[3])


def test_what_has_no_contrast_has_the_zero_vector() -> None:
    """Empty and saturated patches are described by zeros, not by noise of the arithmetic."""
    for level in (0, 117, 255):
        image = np.full((64, 64), level, dtype=np.uint8)
        assert not usurf_descriptors(image, [[31.7, 20.2], [-5.0, 63.0]], 2.3).any()
    assert usurf_descriptors(image, np.empty((0, 2)), 2.3).shape == (0, 64)


@pytest.mark.parametrize(
    ("image", "points", "scales", "message"),
    [
        (np.zeros((30, 30, 3), np.uint8), [[9, 9]], 2.0, "image: expected a grey image .* got a colour image"),
        (np.zeros((30, 30)), [[9, 9]], 2.0, "image: expected an image of dtype uint8, got an array of dtype float64"),
        (np.zeros((30, 5), np.uint8), [[9, 9]], 2.0, r"image: expected at least 16 rows .* got shape \(30, 5\)"),
        (np.zeros(30, np.uint8), [[9, 9]], 2.0, r"image: expected a grey image \(H, W\), got shape \(30,\)"),
        (np.zeros((30, 30), np.uint8), [9, 9], 2.0, r"points_xy: expected an array of shape \(n, 2\)"),
        (np.zeros((30, 30), np.uint8), [[9, np.nan]], 2.0, "points_xy: expected finite numbers"),
        (np.zeros((30, 30), np.uint8), [[9, 9]], 0.0, "scales: expected numbers > 0, got 0.0"),
        (np.zeros((30, 30), np.uint8), [[9, 9]], [1.0, 2.0], r"scales: expected an array of shape \(1,\)"),
    ],
)
def test_bad_input_is_named(image: Any, points: Any, scales: Any, message: str) -> None:
    """Colour, float and tiny images, ill-shaped points and impossible scales are refused by name."""
    with pytest.raises(ValueError, match=message):
        usurf_descriptors(image, points, scales)
