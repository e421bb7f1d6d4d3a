from pathlib import Path

import cv2
import numpy as np

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


def test_descriptors_agree_with_the_reference(data_dir: Path) -> None:
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


def test_patches_without_contrast_have_zero_descriptors() -> None:
    """Empty and saturated patches are described by zeros, not by noise of the arithmetic."""
    for level in (0, 117, 255):
        image = np.full((64, 64), level, dtype=np.uint8)
        assert not usurf_descriptors(image, [[31.7, 20.2], [-5.0, 63.0]], 2.3).any()
    assert usurf_descriptors(image, np.empty((0, 2)), 2.3).shape == (0, 64)
