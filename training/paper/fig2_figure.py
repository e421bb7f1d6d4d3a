"""The picture of `vslam paper fig2`: translation and rotation error against the size of the maps."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from training.experiments.plotting import save_png
from training.paper.fig2 import LABELS, METHODS, OURS

COLOURS = {"svd": "#7f7f7f", "icp": "#D55E00", "impicp": "#E69F00", "ransac": "#0072B2", OURS: "#009E73"}
MARKERS = {"svd": "x", "icp": "v", "impicp": "D", "ransac": "o", OURS: "s"}
NAMES = {"svd": "SVD", "icp": "ICP", "impicp": "ImpICP", "ransac": "RANSAC", OURS: "ours, refined, where accepted"}


def draw_fig2(file: Path, lines: Sequence[Mapping[str, Any]]) -> None:
    """Draw medians as lines and the middle 10 to 90 % up to its upper end as bars, on a log scale, into a PNG file.

    Args:
        file: Where to write.
        lines: Of `summarise`.
    """
    with mpl.rc_context({"font.size": 9}):
        figure = Figure(figsize=(10.0, 4.0), layout="constrained")
        panels = figure.subplots(1, 2)
        for letter, axes, (name, label) in zip("ab", panels, LABELS.items(), strict=True):
            for place, method in enumerate(METHODS):
                own = [line for line in lines if line["method"] == method and line[f"{name}_median"] is not None]
                if not own:
                    continue
                middle = [line[f"{name}_median"] for line in own]
                above = [max(line[f"{name}_p90"] - line[f"{name}_median"], 0.0) for line in own]
                axes.errorbar(
                    [line["size"] + 3.0 * (place - 2) for line in own], middle, yerr=[[0.0] * len(own), above],
                    marker=MARKERS[method], ms=4.5, mfc="none", lw=1.2, elinewidth=0.7, capsize=2,
                    color=COLOURS[method], label=NAMES[method],
                )  # fmt: skip
            axes.set_yscale("log")
            axes.set_xlabel("landmarks in a map")
            axes.set_ylabel(f"error in {label}")
            axes.set_title(f"({letter})", loc="left")
            axes.grid(alpha=0.2, which="both")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False)
        save_png(figure, file, 120)
