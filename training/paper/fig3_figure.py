"""The pictures of `vslam paper fig3` and `fig4`: matches between two maps, and ellipses before and after fusion."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from slam_backend.core.validation import FloatArray
from slam_backend.geometry import transform_points
from training.experiments.plotting import save_png
from training.paper.fig3 import AlignedPair, FusedLandmarks

CHI_SQUARE_95 = 5.991  # two degrees of freedom
COLOURS = {"map 1": "#0072B2", "map 2": "#D55E00", "fused": "#009E73"}
APART = 3.0  # between the two maps in the left panel [m]


def draw_fig3(file: Path, pair: AlignedPair) -> None:
    """Draw both maps in their own frames with lines between what matches, and one over the other, into a PNG file."""
    map_a, map_b = pair.maps
    offset = np.array([0.0, map_a.means[:, 1].min() - map_b.means[:, 1].max() - APART])
    rows_a, rows_b = pair.alignment.inliers.T
    with mpl.rc_context({"font.size": 9}):
        figure = Figure(figsize=(12.0, 6.0), layout="constrained")
        left, right = figure.subplots(1, 2)
        ends = np.stack([map_a.means[rows_a, :2], map_b.means[rows_b, :2] + offset], axis=1)
        left.add_collection(LineCollection(list(ends), colors="0.65", lw=0.5, zorder=1))
        _dots(left, map_a.means[:, :2], "map 1")
        _dots(left, map_b.means[:, :2] + offset, "map 2")
        left.plot(*np.zeros(2), marker="+", ms=10, color=COLOURS["map 1"])
        left.plot(*offset, marker="+", ms=10, color=COLOURS["map 2"])
        left.set_title(f"(a) own frames; {len(rows_a)} matches\nof {len(pair.candidates)} look-alikes", loc="left")
        moved = transform_points(pair.alignment.transform, map_b.means)
        right.scatter(
            *map_a.means[rows_a, :2].T, s=60, marker="o", facecolor="none", edgecolor="0.6", lw=0.7, label="matched"
        )
        _dots(right, map_a.means[:, :2], "map 1")
        _dots(right, moved[:, :2], "map 2")
        figures = pair.figures()
        right.set_title(
            f"(b) map 2 moved into the frame of map 1,\noff by {100 * figures['translation_error_m']:.0f} cm and "
            f"{figures['rotation_error_deg']:.1f}°",
            loc="left",
        )
        for axes in (left, right):
            axes.set_aspect("equal")
            axes.set_xlabel("x [m]")
            axes.set_ylabel("y [m]")
            axes.grid(alpha=0.2)
        right.legend(loc="best", fontsize=8)
        save_png(figure, file, 120)


def draw_fig4(file: Path, fused: FusedLandmarks) -> None:
    """Draw the 95 % ellipses of a few landmarks before and after fusion, a column for each, into a PNG file."""
    count = len(fused.names)
    with mpl.rc_context({"font.size": 9}):
        figure = Figure(figsize=(3.6 * count, 7.2), layout="constrained")
        panels = figure.subplots(2, count, squeeze=False)
        for row, names, title in zip(
            panels, (("map 1", "map 2"), ("map 1", "map 2", "fused")), ("(a) aligned", "(b) fused"), strict=True
        ):
            for column, axes in enumerate(row):
                spread = np.sqrt(CHI_SQUARE_95 * fused.covariances[:2, column, :2, :2].diagonal(axis1=1, axis2=2))
                means = fused.means[:2, column, :2]
                low, high = (means - spread).min(axis=0), (means + spread).max(axis=0)
                middle, reach = 0.5 * (low + high), 0.55 * float((high - low).max())
                for place, name in enumerate(names):
                    faint = len(names) == 3 and name != "fused"
                    mean, covariance = fused.means[place, column, :2], fused.covariances[place, column, :2, :2]
                    axes.add_patch(_ellipse(mean, covariance, COLOURS[name], faint))
                    alpha = 0.35 if faint else 1.0
                    axes.plot(*mean, ls="", marker="+", ms=7, color=COLOURS[name], alpha=alpha, label=name)
                axes.set_xlim(middle[0] - reach, middle[0] + reach)
                axes.set_ylim(middle[1] - reach, middle[1] + reach)
                axes.set_aspect("equal")
                axes.set_title(f"{title}: landmark {fused.names[column]}", loc="left")
                axes.set_xlabel("x [m]")
                axes.grid(alpha=0.2)
            row[0].set_ylabel("y [m]")
        handles, labels = panels[1][0].get_legend_handles_labels()
        legend = figure.legend(handles, labels, loc="outside upper center", ncols=3, frameon=False)
        for handle in legend.legend_handles:
            if handle is not None:
                handle.set_alpha(1.0)
        save_png(figure, file, 120)


def _dots(axes: Axes, points: FloatArray, name: str) -> None:
    """Draw landmarks as dots."""
    axes.plot(*points.T, ls="", marker="o", ms=2.4, mew=0.0, color=COLOURS[name], label=name)


def _ellipse(mean: FloatArray, covariance: FloatArray, colour: str, faint: bool) -> Ellipse:
    """Return the 95 % ellipse of one landmark in the plane."""
    values, vectors = np.linalg.eigh(covariance)
    width, height = 2.0 * np.sqrt(CHI_SQUARE_95 * np.maximum(values, 0.0))
    angle = float(np.rad2deg(np.arctan2(vectors[1, 0], vectors[0, 0])))
    return Ellipse(
        (float(mean[0]), float(mean[1])), float(width), float(height), angle=angle, facecolor="none", edgecolor=colour,
        lw=1.4, alpha=0.35 if faint else 1.0,
    )  # fmt: skip
