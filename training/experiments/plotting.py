"""Figures as small PNG files."""

from io import BytesIO
from pathlib import Path

from matplotlib.figure import Figure
from PIL import Image

from slam_backend.core.files import write_file

COLOURS = 256  # lines, points and edges of letters need no more; a file is then a quarter as large


def save_png(figure: Figure, file: Path, dpi: int) -> None:
    """Write a figure with a palette of its own.

    Args:
        figure: Its size in inches is its own.
        file: Where to write.
        dpi: Pixels of an inch.

    Raises:
        ValueError: If the file cannot be written; the message names `out`.
    """
    whole = BytesIO()
    figure.savefig(whole, format="png", dpi=dpi)
    picture = Image.open(whole).convert("RGB")
    packed = BytesIO()
    picture.quantize(COLOURS, dither=Image.Dither.NONE).save(packed, format="PNG", optimize=True)
    write_file(file, packed.getvalue(), "out")
