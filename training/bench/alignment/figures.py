"""The figure of `vslam bench alignment`: success, errors over the bound and time against the share of wrong matches."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from training.experiments.plotting import save_png

# Told apart by colour-blind eyes too.
COLOURS = {
    "ransac": "#0072B2", "clique": "#009E73", "gnc": "#CC79A7", "impicp": "#E69F00", "icp": "#D55E00", "svd": "#7f7f7f",
}  # fmt: skip
MARKERS = {"ransac": "o", "clique": "s", "gnc": "^", "impicp": "D", "icp": "v", "svd": "x"}
PANELS = (
    ("right", "share right [%]"), ("translation", "translation error / bound"), ("rotation", "rotation error / bound"),
    ("median_ms", "computing time, median [ms]"),
)  # fmt: skip


def draw_alignment(file: Path, lines: Sequence[Mapping[str, Any]]) -> None:
    """Draw a row of panels for each share of common landmarks into a PNG file.

    Args:
        file: Where to write.
        lines: Of `summarise`; those of the grid count.
    """
    grid = [line for line in lines if line["kind"] == "grid" and line["overlap"] is not None]
    overlaps = [o for o in dict.fromkeys(line["overlap"] for line in grid) if o < 1.0]
    if not overlaps:
        return
    with mpl.rc_context({"font.size": 9, "axes.titlesize": 9}):
        figure = Figure(figsize=(12.0, 2.7 * len(overlaps) + 0.4), layout="constrained")
        axes = figure.subplots(len(overlaps), len(PANELS), squeeze=False, sharex=True)
        for row, overlap in zip(axes, overlaps, strict=True):
            for panel, (key, label) in zip(row, PANELS, strict=True):
                _draw_panel(panel, [line for line in grid if line["overlap"] == overlap], key)
                panel.set_ylabel(label)
            row[0].set_title(f"{200 * overlap:.0f} of 200 landmarks in common", loc="left")
        for panel in axes[-1]:
            panel.set_xlabel("wrong look-alikes [%]")
        handles, labels = axes[0][0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False)
        save_png(figure, file, 110)


def _draw_panel(ax: Axes, lines: Sequence[Mapping[str, Any]], key: str) -> None:
    """Draw one figure of all methods against the share of outliers; where a method never succeeds, nothing."""
    for method in dict.fromkeys(line["method"] for line in lines):
        own = [line for line in lines if line["method"] == method and line[key] is not None]
        factor = 100.0 if key == "right" else 1.0
        ax.plot(
            [100.0 * line["outliers"] for line in own], [factor * line[key] for line in own], marker=MARKERS[method],
            ms=5, mfc="none", lw=1.2, color=COLOURS[method], label=method,
        )  # fmt: skip
    if key == "right":
        ax.set_ylim(-5.0, 105.0)
    elif key == "median_ms":
        ax.set_yscale("log")
        ax.axhline(5.0, color="0.5", lw=0.8, ls=":")
        ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        ax.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        ax.yaxis.set_minor_formatter(NullFormatter())
    else:
        ax.axhline(1.1, color="0.5", lw=0.8, ls=":")
        ax.set_ylim(0.8, 1.3)
    ax.set_xlim(-5.0, 95.0)
    ax.grid(alpha=0.2, which="both")
