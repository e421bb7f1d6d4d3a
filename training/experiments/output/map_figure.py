"""Picture of two landmark maps, aligned or not."""

from pathlib import Path

from matplotlib.figure import Figure

from slam_backend.maps.alignment_types import Alignment
from slam_backend.maps.landmark_map import LandmarkMap
from training.experiments.output.plotting import picture, save_png

FIRST, SECOND = "#0072B2", "#D55E00"


@picture
def draw_maps(file: Path, map_a: LandmarkMap, map_b: LandmarkMap, found: Alignment) -> None:
    """Draw two maps into a PNG file: in the frame of the first if they are aligned, otherwise side by side."""
    figure = Figure(figsize=(8.0, 5.0), layout="constrained")
    axes = figure.subplots(1, 1 if found.success else 2, squeeze=False)[0]
    moved = map_b.moved((found.tx, found.ty, found.theta)) if found.success else map_b
    for panel, landmarks, colour, name in ((axes[0], map_a, FIRST, "first"), (axes[-1], moved, SECOND, "second")):
        panel.plot(*landmarks.means[:, :2].T, ".", color=colour, label=f"{name} map, {len(landmarks)} landmarks")
    if found.success:
        shared = map_a.means[found.inliers[:, 0], :2]
        axes[0].plot(*shared.T, "o", mfc="none", mec="0.3", ms=9, label=f"{len(shared)} common landmarks")
    figure.suptitle("" if found.success else f"Not aligned: {found.reason}")
    for panel in axes:
        panel.set_aspect("equal", adjustable="datalim")
        panel.legend(loc="upper right", fontsize=8)
        panel.set(xlabel="x [m]", ylabel="y [m]")
    save_png(figure, file, 110)
