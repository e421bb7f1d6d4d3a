"""The picture of the stereo eye's quality: guards against outliers, and descriptors from other angles and distances."""

from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from training.bench.stereo.tables import NAMES
from training.experiments.plotting import save_png

COLOURS = {"usurf": "#0072B2", "sift": "#D55E00", "orb": "#009E73"}


def draw_stereo(file: Path, result: dict[str, Any]) -> None:
    """Draw outliers after each guard, and recall by angle and by distance, into a PNG file."""
    figure = Figure(figsize=(13.0, 4.2), layout="constrained")
    guards, angles, ratios = figure.subplots(1, 3)
    for row in result["quality"]:
        names = [entry["name"] for entry in row["guards"]]
        shares = [100.0 * entry["outliers"] for entry in row["guards"]]
        name = row["descriptor"]
        guards.plot(range(len(names)), shares, marker="o", color=COLOURS[name], label=NAMES[name])
    guards.set_xticks(range(len(names)), names, rotation=25)
    guards.set_ylabel("matches off by more than 1 px [%]")
    guards.set_title("Guards, one after the other")
    for axes, key, label in (
        (angles, "angles", "viewing angle [degrees]"),
        (ratios, "ratios", "distance, times 2.5 m"),
    ):
        for row in result["retrieval"]:
            if row["style"] != "distinct":
                continue
            name = NAMES[row["descriptor"]] + (f", window {row['window']:g} m" if row["window"] else "")
            numbers = [float(value) for value in row[key]]
            style = {"color": COLOURS[row["descriptor"]], "ls": "--" if row["window"] else "-", "marker": "o"}
            axes.plot(numbers, [cell["recall"] for cell in row[key].values()], label=name, **style)
        axes.set_ylim(0.0, 1.02)
        axes.set_xlabel(label)
        axes.set_ylabel("nearest descriptor is the right landmark")
    angles.set_title("Found again from another angle")
    ratios.set_title("Found again from another distance")
    for axes in (guards, angles, ratios):
        axes.grid(alpha=0.2)
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(fontsize=8, frameon=False)
    save_png(figure, file, 120)
