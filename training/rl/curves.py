"""Training curves: plots, and the means of the first and last tenth."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from slam_backend.core.validation import FloatArray
from training.experiments.output.plotting import picture, save_png

Row = Mapping[str, float]

PANELS = (
    ("return", "return of an episode"), ("map_error", "map error at its end [m]"), ("map_recall", "recall at its end"),
    ("merges", "merges"),
)  # fmt: skip
EPOCH_PANELS = (
    ("loss", "cross entropy, training worlds"), ("cross_entropy", "cross entropy, validation worlds"),
    ("agreement", "agreement with the teacher"), ("return", "return of the driver"),
)  # fmt: skip
COLOUR = "#0072B2"


def first_and_last_tenth(rows: Sequence[Row]) -> dict[str, dict[str, Any]]:
    """Return the means over the first and over the last tenth of the rollouts, at least one rollout each."""
    tenth = max(1, len(rows) // 10)
    return {"first": _mean(rows[:tenth]), "last": _mean(rows[-tenth:])}


def _mean(rows: Sequence[Row]) -> dict[str, Any]:
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}


@picture
def draw_learning(file: Path, rows: Sequence[Mapping[str, float]]) -> None:
    """Plot each metric by rollout, with its running mean over a tenth of the rollouts, into a PNG file."""
    steps = np.array([row["steps"] for row in rows])
    with mpl.rc_context({"font.size": 9}):
        figure = Figure(figsize=(10.0, 5.6), layout="constrained")
        for axes, (name, label) in zip(figure.subplots(2, 2, sharex=True).flat, PANELS, strict=True):
            values = np.array([row[name] for row in rows])
            axes.plot(steps, values, ".", color=COLOUR, alpha=0.35, markersize=4, label="each rollout")
            axes.plot(steps, running_mean(values, max(1, len(rows) // 10)), color=COLOUR, label="running mean")
            axes.set_ylabel(label)
            axes.set_xlim(left=0.0)
            axes.grid(alpha=0.3)
            if axes.get_subplotspec().is_last_row():
                axes.set_xlabel("decisions of all robots")
        figure.axes[0].legend(loc="lower right")
        save_png(figure, file, 120)


@picture
def draw_imitation(file: Path, rows: Sequence[Mapping[str, float]]) -> None:
    """Plot each metric of an imitation by epoch, with a line where a round begins, into a PNG file."""
    epochs = np.arange(1, len(rows) + 1)
    begins = [n for n in range(1, len(rows)) if rows[n]["round"] != rows[n - 1]["round"]]
    with mpl.rc_context({"font.size": 9}):
        figure = Figure(figsize=(10.0, 5.6), layout="constrained")
        for axes, (name, label) in zip(figure.subplots(2, 2, sharex=True).flat, EPOCH_PANELS, strict=True):
            axes.plot(epochs, [row[name] for row in rows], ".-", color=COLOUR)
            for begin in begins:
                axes.axvline(begin + 0.5, color="0.6", linewidth=0.8)
            axes.set_ylabel(label)
            axes.grid(alpha=0.3)
            if axes.get_subplotspec().is_last_row():
                axes.set_xlabel("epochs of all rounds")
        save_png(figure, file, 120)


def running_mean(values: FloatArray, window: int) -> FloatArray:
    """Return the mean of the last `window` values (n,) at each index; the first means are over fewer values.

    >>> running_mean(np.array([1.0, 3.0, 5.0]), 2)
    array([1., 2., 4.])
    """
    sums = np.concatenate([[0.0], np.cumsum(values)])
    ends = np.arange(1, len(values) + 1)
    begins = np.maximum(0, ends - window)
    means: FloatArray = (sums[ends] - sums[begins]) / (ends - begins)
    return means
