"""Plots as small PNG files, and common plot elements."""

from collections.abc import Callable
from functools import wraps
from io import BytesIO
from pathlib import Path
from typing import Any, ParamSpec

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from PIL import Image

from slam_backend.core.files import write_file
from slam_backend.core.validation import FloatArray, is_argument_error
from training.experiments.output.console import print_warning

P = ParamSpec("P")

CHI_SQUARE_95 = 5.991  # two degrees of freedom
MOST_LETTERS = 200  # of an error's text
COLOURS = 256  # enough for lines, points and text edges; reduces files to a quarter


def picture(draw: Callable[P, None]) -> Callable[P, None]:
    """Let a function draw a picture with settings of its own; a decorator.

    The user's settings of matplotlib have no effect on it, and a picture that cannot be drawn costs one line on stderr.
    A file that cannot be written is an error.
    """

    @wraps(draw)
    def drawn(*values: P.args, **named: P.kwargs) -> None:
        try:
            with mpl.rc_context():
                mpl.rcdefaults()
                draw(*values, **named)
        except Exception as error:
            if is_argument_error(error):
                raise
            file = next(value for value in (*values, *named.values()) if isinstance(value, Path))
            what = " ".join(f"{type(error).__name__}: {error}".split())
            print_warning(f"{file.name} is not drawn: {what[:MOST_LETTERS]}")

    return drawn


def save_png(figure: Figure, file: Path, dpi: int) -> None:
    """Write a figure with an adaptive colour palette.

    Raises:
        ValueError: If the file cannot be written; the message names `out`.
    """
    whole = BytesIO()
    figure.savefig(whole, format="png", dpi=dpi)
    picture = Image.open(whole).convert("RGB")
    packed = BytesIO()
    picture.quantize(COLOURS, dither=Image.Dither.NONE).save(packed, format="PNG", optimize=True)
    write_file(file, packed.getvalue(), "out")


def rgb(colour: tuple[int, int, int]) -> tuple[float, float, float]:
    """Return an RGB colour of bytes as floats for matplotlib."""
    r, g, b = colour
    return r / 255.0, g / 255.0, b / 255.0


def ellipse_95(mean: FloatArray, covariance: FloatArray, **style: Any) -> Ellipse:
    """Return the 95 % ellipse of a planar Gaussian with mean (2 or 3,) and covariance (2, 2) [m^2]."""
    values, vectors = np.linalg.eigh(covariance)
    width, height = 2.0 * np.sqrt(CHI_SQUARE_95 * np.maximum(values, 0.0))
    angle = float(np.rad2deg(np.arctan2(vectors[1, 0], vectors[0, 0])))
    return Ellipse((float(mean[0]), float(mean[1])), float(width), float(height), angle=angle, **style)


def add_legend(figure: Figure, axes: Axes, **style: Any) -> None:
    """Add a legend for the content of some axes above a figure, in as few rows as fit into its width."""
    handles, labels = axes.get_legend_handles_labels()
    for columns in range(len(labels), 0, -1):
        legend = figure.legend(handles, labels, loc="outside upper center", ncols=columns, frameon=False, **style)
        if columns == 1 or legend.get_window_extent().width <= figure.bbox.width:
            return
        legend.remove()
