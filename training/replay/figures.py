"""Plots of replays: paths and maps against the ground truth, a panel for each robot and each joint map."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from slam_backend.core.validation import FloatArray
from slam_backend.geometry import compose, inverse, transform_points
from slam_backend.maps.landmark_map import LandmarkMap
from training.experiments.output.plotting import ellipse_95, picture, save_png
from training.replay.core import Replay
from training.replay.log import Log
from training.replay.metrics import PathScore, align_to_truth, paths_of

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#B8860B")  # safe for colour-blind readers
TRUTH = "#9a9a9a"
COLUMNS, WIDTH, HEIGHT = 3, 4.6, 6.4  # panels of a team in a row, and their size [in]
ALONE = 8.0  # width of the only panel [in]
MARGIN = 0.06  # margin around the content, relative to the larger extent
STRAY = 0.001  # share of outliers ignored at each edge: a GPS fix may jump by 100 m
OFTEN = 10  # measurements from which a landmark is drawn opaque
FEW = 100  # landmarks of a map that is drawn with ellipses

Scores = Sequence[PathScore | None]  # path scores of `score_path` for each robot


@picture
def draw_replay(file: Path, log: Log, result: Replay, scores: Scores, groups: Sequence[tuple[int, ...]] = ()) -> None:
    """Draw the replay into a PNG file.

    Args:
        groups: Groups of robots with a panel each; none: each robot, and each group with a joint map.
    """
    joint = [group for group in result.groups if len(group) > 1]
    panels = groups or [*((robot,) for robot in range(len(log.robots))), *joint]
    columns = min(COLUMNS, len(panels))
    rows = -(-len(panels) // columns)
    with mpl.rc_context({"font.size": 9, "axes.titlesize": 10}):
        figure = Figure(figsize=(WIDTH * columns, HEIGHT * rows), layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False).ravel()
        for group, ax in zip(panels, axes, strict=False):
            _draw_panel(ax, log, result, scores, group)
        for ax in axes[len(panels) :]:
            ax.set_axis_off()
        if log.team is None:
            (left, right), (low, high) = axes[0].get_xlim(), axes[0].get_ylim()
            figure.set_size_inches(ALONE, 0.6 + 0.93 * ALONE * np.clip((high - low) / (right - left), 0.4, 1.6))
        save_png(figure, file, 110)


def starts_in_world(log: Log, result: Replay, scores: Scores, group: tuple[int, ...]) -> list[FloatArray]:
    """Return the start frames (3,) of a group's robots: the first is placed by its map, else its path, else at 0."""
    robot = group[0]
    fitted, score = align_to_truth(result.maps[robot], result.claims[robot], log.landmarks), scores[robot]
    own = np.zeros(3) if score is None else score.scores[0].world_from_path
    world_from_group = compose(own if fitted is None else fitted.world_from_map, result.start_from_group[robot])
    return [compose(world_from_group, inverse(result.start_from_group[each])) for each in group]


def _draw_panel(ax: Axes, log: Log, result: Replay, scores: Scores, group: tuple[int, ...]) -> None:
    """Draw robots with their map; paths of a single one are fitted to the truth each, those of several by the map.

    The panel is limited to estimates and truth, except outliers, and may cut off dead reckoning.
    """
    joint, starts, shown = len(group) > 1, starts_in_world(log, result, scores, group), []
    for robot, start in zip(group, starts, strict=True):
        score, colour = scores[robot], COLOURS[robot % len(COLOURS)]
        frames, labels = [start] * 2, ["estimate", "odometry"]
        if score is not None:
            points = score.truth[:, :2]
            shown.append(np.quantile(points, [STRAY, 1.0 - STRAY], axis=0))
            style = {"lw": 2.2} if score.truth.shape[1] == 3 else {"ls": "", "marker": ".", "ms": 5.0, "mew": 0.0}
            label = ("true path" if score.truth.shape[1] == 3 else "GPS") if robot == group[0] else None
            ax.plot(*points.T, color=TRUTH, alpha=0.35 if joint else 0.8, zorder=1, label=label, **style)
            if not joint:
                frames = [own.world_from_path for own in score.scores]
                labels = [f"{kind} {own.aligned:.2f} m" for kind, own in zip(labels, score.scores, strict=True)]
        paths = [transform_points(*each) for each in zip(frames, paths_of(result, log, robot, 2), strict=True)]
        shown.append(paths[0])
        if not joint:
            ax.plot(*paths[1].T, color=COLOURS[1] if log.team is None else colour, lw=0.8, ls=":", label=labels[1])
        name = f"robot {log.robots[robot].number}"
        ax.plot(*paths[0].T, color=colour, lw=0.9, alpha=0.85, label=name if joint else labels[0])
    _draw_landmarks(ax, result.maps[group[0]].moved(starts[0]), "black" if joint else COLOURS[2])
    if log.landmarks is not None:
        ax.plot(*log.landmarks.T, ls="", marker="+", ms=8, mew=1.1, color="#404040", zorder=3, label="true landmarks")
        shown.append(log.landmarks)
    low, high = (getattr(np.concatenate(shown), end)(axis=0) for end in ("min", "max"))
    room = MARGIN * float((high - low).max()) + 1e-3
    ax.set_xlim(low[0] - room, high[0] + room)
    ax.set_ylim(low[1] - room, high[1] + room)
    ax.set_aspect("equal")
    ax.set_title(_title(log, result, scores, group))
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")
    ax.grid(alpha=0.15)
    ax.legend(fontsize=7, loc="best", framealpha=0.8)


def _title(log: Log, result: Replay, scores: Scores, group: tuple[int, ...]) -> str:
    """Return the title of a panel, with the errors of the map if they are known."""
    names = ", ".join(str(log.robots[robot].number) for robot in group)
    words = log.title if log.team is None else f"joint map of {names}" if len(group) > 1 else f"robot {names}"
    if (fitted := align_to_truth(result.maps[group[0]], result.claims[group[0]], log.landmarks)) is not None:
        return f"{words}: map {fitted.score.rmse:.2f} m, {fitted.score.recall:.0%} of landmarks"
    return words if scores[group[0]] else f"{words}, start frame" + (" of the first" if len(group) > 1 else "")


def _draw_landmarks(ax: Axes, landmarks: LandmarkMap, colour: str) -> None:
    """Draw landmarks: opaque if measured often, and with 95 % ellipses if they are few."""
    if len(landmarks) <= FEW:
        for mean, covariance in zip(landmarks.means, landmarks.covariances, strict=True):
            ax.add_patch(ellipse_95(mean, covariance[:2, :2], fc=colour, ec=colour, alpha=0.3, zorder=4))
    often = landmarks.counts >= OFTEN
    for chosen, alpha, label in ((~often, 0.35, f"seen less than {OFTEN} times"), (often, 1.0, "landmarks")):
        if chosen.any():
            points, label = landmarks.means[chosen, :2], f"{np.count_nonzero(chosen)} {label}"
            ax.plot(*points.T, ls="", marker="o", ms=2.5, color=colour, alpha=alpha, zorder=5, label=label)
