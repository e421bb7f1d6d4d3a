"""The picture of one filter's replay: path, dead reckoning, the truth and the landmarks, in metres of equal length."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.geometry import transform_points
from training.experiments.plotting import save_png
from training.replay.figures import COLOURS, TRUTH
from training.replay.single_robot import OneReplay, PositionScore

MARGIN = 0.06  # of the larger extent, around what the picture must show
STRAY = 0.001  # share of the known positions at each edge that it need not show: a fix may jump by 100 m
WIDTH = 8.0  # [in]
OFTEN = 10  # measurements that make a landmark a sure one


def draw_one(
    file: Path,
    title: str,
    result: OneReplay,
    paths: tuple[FloatArray, FloatArray],
    scores: tuple[PositionScore, PositionScore] | None = None,
    truth: FloatArray | None = None,
    truth_label: str = "true path",
) -> None:
    """Draw a replay into a PNG file, all fitted to the truth, each path by its own SE(2) alignment.

    Dead reckoning may leave the picture, which shows estimate and truth, stray known positions apart; the legend says
    how many of these lie outside.

    Args:
        file: Where to write.
        title: Above the picture.
        result: With the landmarks.
        paths: Positions (T, 2) [m], start frame, of the estimate and of dead reckoning.
        scores: Of both; None without truth: all is then drawn in the start frame.
        truth: (n, 2) [m]. Known positions.
        truth_label: What they are.
    """
    origin = np.zeros(3)
    fits = (origin, origin) if scores is None else (scores[0].world_from_path, scores[1].world_from_path)
    estimate, reckoned = (transform_points(fit, path) for fit, path in zip(fits, paths, strict=True))
    landmarks = transform_points(fits[0], result.landmarks.means[:, :2])
    tails = ("", "") if scores is None else tuple(f", {score.aligned:.2f} m RMS" for score in scores)
    low, high = _window(estimate, truth)
    with mpl.rc_context({"font.size": 9, "axes.titlesize": 10}):
        ratio = float(np.clip((high - low)[1] / (high - low)[0], 0.4, 1.6))
        figure = Figure(figsize=(WIDTH, 0.93 * WIDTH * ratio + 0.6), layout="constrained")
        ax = figure.subplots()
        if truth is not None:
            outside = np.count_nonzero(((truth < low) | (truth > high)).any(axis=1))
            label = f"{truth_label} ({outside} of {len(truth)} outside)" if outside else truth_label
            ax.plot(*truth.T, ls="", marker=".", ms=5.0, mew=0.0, color=TRUTH, label=label)
        _draw_landmarks(ax, landmarks, result.landmarks.counts)
        ax.plot(*reckoned.T, color=COLOURS[1], lw=0.8, ls=":", label=f"odometry{tails[1]}")
        ax.plot(*estimate.T, color=COLOURS[0], lw=0.9, label=f"estimate{tails[0]}")
        ax.set_aspect("equal", adjustable="box")
        ax.set_xlim(low[0], high[0])
        ax.set_ylim(low[1], high[1])
        ax.set_title(title)
        ax.set_xlabel("x [m]")
        ax.set_ylabel("y [m]")
        ax.grid(alpha=0.15)
        ax.legend(fontsize=8, loc="best", framealpha=0.85)
        save_png(figure, file, 100)


def _window(estimate: FloatArray, truth: FloatArray | None) -> tuple[FloatArray, FloatArray]:
    """Return the lower and upper corner (2,) [m] of what the picture shows."""
    low, high = estimate.min(axis=0), estimate.max(axis=0)
    if truth is not None:
        few, most = np.quantile(truth, [STRAY, 1.0 - STRAY], axis=0)
        low, high = np.minimum(low, few), np.maximum(high, most)
    room = MARGIN * float((high - low).max()) + 1e-3
    return low - room, high + room


def _draw_landmarks(ax: Axes, landmarks: FloatArray, counts: IntArray) -> None:
    """Draw landmarks (N, 2): those measured often full, the others pale."""
    often = counts >= OFTEN
    for chosen, alpha, label in ((~often, 0.35, f"seen less than {OFTEN} times"), (often, 1.0, "landmarks")):
        if chosen.any():
            label = f"{np.count_nonzero(chosen)} {label}"
            ax.plot(*landmarks[chosen].T, ls="", marker="o", ms=2.2, color=COLOURS[2], alpha=alpha, label=label)
