"""The reader of users' images: limits, depths, transparency and damage."""

import struct
import zlib
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from slam_backend.core.image_files import blend_over_white, read_grey_image, read_image


def levels() -> Any:
    """Grey levels (7, 11) that differ everywhere."""
    return np.arange(77, dtype=np.uint8).reshape(7, 11) * 3


@pytest.mark.parametrize("suffix", [".png", ".pgm", ".bmp", ".webp"])
def test_grey_levels_are_kept(tmp_path: Path, suffix: str) -> None:
    """Lossless formats give back each level, also from a path that is not ASCII."""
    path = tmp_path / f"Größe 図{suffix}"
    Image.fromarray(levels()).save(path, lossless=True)
    np.testing.assert_array_equal(read_grey_image(path), levels())


@pytest.mark.parametrize("most", [1, 100, 254, 255, 1000, 65535])
def test_pgm_of_any_largest_value_is_scaled(tmp_path: Path, most: int) -> None:
    """The largest value of a PGM file is white, whatever it is, in plain and in binary files."""
    values = np.array([[0, most // 2, most]], dtype=">u2" if most > 255 else np.uint8)
    plain, binary = tmp_path / "plain.pgm", tmp_path / "binary.pgm"
    plain.write_text(f"P2\n# a map\n3 1\n{most}\n" + " ".join(map(str, values[0])))
    binary.write_bytes(f"P5\n3 1\n{most}\n".encode() + values.tobytes())
    for path in (plain, binary):
        np.testing.assert_allclose(read_grey_image(path), 255.0 * values.astype(float) / most, atol=1.0)


@pytest.mark.parametrize(("factor", "found"), [(1, levels()), (257, levels())])
def test_16_bits(tmp_path: Path, factor: int, found: Any) -> None:
    """Of 16 bits the upper 8 count, or the lower 8 where no value uses more."""
    cv2.imwrite(str(tmp_path / "deep.png"), levels().astype(np.uint16) * factor)
    np.testing.assert_array_equal(read_grey_image(tmp_path / "deep.png"), found)


@pytest.mark.parametrize("mode", ["RGBA", "LA", "P"])
def test_transparent_pixels_are_white(tmp_path: Path, mode: str) -> None:
    """Transparency is blended over white in all modes that have it."""
    grey = np.zeros((4, 6), dtype=np.uint8)
    opacity = np.where(np.arange(6) < 3, 255, 0).astype(np.uint8)[None].repeat(4, axis=0)
    if mode == "P":
        image = Image.fromarray(np.where(opacity > 0, 1, 0).astype(np.uint8), "P")
        image.putpalette([0, 0, 0, 0, 0, 0])
        image.save(tmp_path / "clear.png", transparency=0)
    else:
        image = Image.merge("LA", (Image.fromarray(grey), Image.fromarray(opacity)))
        image.convert(mode).save(tmp_path / "clear.png")
    np.testing.assert_array_equal(read_image(tmp_path / "clear.png")[1], opacity)
    np.testing.assert_array_equal(read_grey_image(tmp_path / "clear.png"), 255 - opacity)


def test_half_transparent_pixels_are_blended() -> None:
    """Opacity is the share of the colour, the rest is white; opaque pixels stay as they are."""
    colours = np.full((1, 3, 3), 100, dtype=np.uint8)
    opacity = np.array([[0, 51, 255]], dtype=np.uint8)
    np.testing.assert_array_equal(blend_over_white(colours, opacity)[0, :, 0], [255, 224, 100])
    assert blend_over_white(colours, np.full((1, 3), 255, np.uint8)) is colours


def test_colours_are_in_the_order_of_opencv(tmp_path: Path) -> None:
    """Blue comes first."""
    cv2.imwrite(str(tmp_path / "blue.png"), np.full((2, 3, 3), (200, 100, 50), dtype=np.uint8))
    assert read_image(tmp_path / "blue.png")[0][0, 0].tolist() == [200, 100, 50]


def bomb(width: int, height: int) -> bytes:
    """Return a small PNG file that says it has many pixels."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    head = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(b"\0" * 999)) + chunk(b"IEND", b"")
    )


@pytest.mark.parametrize("size", [(7100, 7100), (60_000, 60_000), (2**31 - 1, 2**31 - 1)])
def test_pixels_are_limited_before_memory_is_taken(tmp_path: Path, size: tuple[int, int]) -> None:
    """An image with too many pixels is refused by its header, in one line with the limit."""
    (tmp_path / "bomb.png").write_bytes(bomb(*size))
    with pytest.raises(ValueError, match=r"world: expected an image of at most 50 million pixels, got a") as caught:
        read_image(tmp_path / "bomb.png", "world")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".pgm", ".bmp", ".webp"])
def test_broken_images_give_one_line(tmp_path: Path, suffix: str, capfd: pytest.CaptureFixture[str]) -> None:
    """A truncated file, one with damaged bytes and one of another kind raise one line, and no library prints."""
    rng = np.random.default_rng(0)
    cv2.imwrite(str(tmp_path / f"whole{suffix}"), rng.integers(0, 255, (40, 50), dtype=np.uint8))
    whole = (tmp_path / f"whole{suffix}").read_bytes()
    broken = tmp_path / f"broken{suffix}"
    for length in (0, 1, 20, len(whole) // 2):
        broken.write_bytes(whole[:length])
        with pytest.raises(ValueError, match=r"^world: expected an (intact )?image file, got '.*broken") as caught:
            read_image(broken, "world")
        assert "\n" not in str(caught.value)
    for _ in range(50):
        damaged = bytearray(whole)
        for at in rng.integers(0, len(whole), 5):
            damaged[at] = rng.integers(256)
        broken.write_bytes(damaged)
        with suppress(ValueError):
            read_image(broken, "world")
    assert capfd.readouterr() == ("", "")
