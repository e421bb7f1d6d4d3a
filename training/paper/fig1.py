"""Fig. 1 of the paper: particles along the paths of several robots, with odometry only and with measurements."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

from slam_backend.core.validation import FloatArray, IntArray
from training.experiments.output.plotting import picture, rgb, save_png
from training.experiments.study import Column, ResultTable
from training.paper.config import Fig1Config
from training.paper.fig6.trials import FILTER_OPTIONS, REGIMES
from training.stereo_runs.batch_problem import BatchProblem
from training.stereo_runs.office import Office
from training.stereo_runs.runs import STEP, StereoRun, simulate_run
from vslam_env.rendering.palette import FAINT_INK, TRUE_LANDMARK, WALL, robot_colour

WIDTH = 3.5  # width of a text column [in]
SMALL = 0.1  # [m]; clouds with a smaller RMS spread are also shown enlarged
ENLARGED = 6.0
INK = "0.25"


@dataclass(frozen=True, slots=True, eq=False)
class Clouds:
    """Sets of particles along the paths of K robots."""

    steps: IntArray  # (n,) int64. Steps of the sets, starting with the start.
    poses: FloatArray  # (n, K, M, 3) float64 [m, m, rad], world frame. All particles, after resampling.
    # (K, T, 3) float64 [m, m, rad], world frame. Without measurements: the measured odometry; with measurements: the
    # filter's pose estimates at their own steps.
    paths: FloatArray
    landmarks: FloatArray  # (N, 3) float64 [m], world frame. Final map, empty without measurements.

    def spreads(self) -> FloatArray:
        """Return the RMS distance (n, K) [m] of the particles of each set from their mean."""
        apart = self.poses[..., :2] - self.poses[..., :2].mean(axis=2, keepdims=True)
        return np.asarray(np.sqrt((apart**2).sum(axis=3).mean(axis=2)))


def simulate_fig1(config: Fig1Config) -> StereoRun:
    """Return the run of the figure, with the robots of Fig. 6 in the paper's regime."""
    return simulate_run(REGIMES["paper"].spec(config.robots, config.length), config.seed)


def draw_clouds(run: StereoRun, config: Fig1Config, measured: bool) -> Clouds:
    """Run `fastslam1` for the robots, and return its particles.

    Args:
        measured: Whether the filter uses measurements; otherwise only the motion model moves the particles
            (Eq. 4).
    """
    slam = run.build_filter(config.particles, "fastslam1", seed=config.seed, **FILTER_OPTIONS["fastslam1"])
    robots = range(config.robots)
    stride = max(round(config.every / STEP), 1)
    steps, poses, paths = [], [], []
    for step, reading in enumerate(run.readings()):
        slam.step(**(reading if measured else reading | {"measurements": [None] * config.robots, "identities": None}))
        if step % stride == 0:
            steps.append(step)
            poses.append([slam.particles(robot)[0] for robot in robots])
        paths.append([slam.pose(robot).mean for robot in robots])
    reckoned = BatchProblem.of_run(run).dead_reckoning().paths
    return Clouds(
        steps=np.array(steps), poses=np.array(poses),
        paths=np.array(paths).transpose(1, 0, 2) if measured else reckoned,
        landmarks=slam.map().means if measured else np.zeros((0, 3)),
    )  # fmt: skip


def path_errors(run: StereoRun, clouds: Clouds, name: str) -> list[dict[str, Any]]:
    """Return the errors of path and last particles for each robot.

    Args:
        name: Name of the dashed path.

    Returns:
        Rows of `path`, the name; `robot`; `path_rms_m` of the dashed path, `end_error_m` at the last set of particles,
        and `end_spread_m` of that set.
    """
    errors = np.linalg.norm((clouds.paths - run.true_paths)[..., :2], axis=2)
    spreads = clouds.spreads()[-1]
    return [
        {
            "path": name, "robot": robot, "path_rms_m": float(np.sqrt((own**2).mean())),
            "end_error_m": float(own[clouds.steps[-1]]), "end_spread_m": float(spread),
        }
        for robot, (own, spread) in enumerate(zip(errors, spreads, strict=True), 1)
    ]  # fmt: skip


TABLE = ResultTable(
    name="paths", title="Errors of paths and of the last particles", by=("path", "robot"),
    columns=(
        Column("path_rms_m", "path RMS [m]", digits=2), Column("end_error_m", "final error [m]", digits=2),
        Column("end_spread_m", "final spread [m]", digits=2),
    ),
)  # fmt: skip


@picture
def draw_fig1(file: Path, run: StereoRun, panels: Sequence[tuple[str, str, Clouds]]) -> None:
    """Draw the panels one below the other, for the width of a text column, into a PNG file.

    Args:
        panels: Title, name of the dashed line, and particles of each panel.
    """
    ratio = run.office.size[1] / run.office.size[0]
    with mpl.rc_context({"font.size": 7, "axes.titlesize": 7.5, "axes.linewidth": 0.6}):
        layout = ConstrainedLayoutEngine(h_pad=0.02, hspace=0.0)
        figure = Figure(figsize=(WIDTH, len(panels) * (0.95 * WIDTH * ratio + 0.17) + 0.65), layout=layout)
        axes = figure.subplots(len(panels), 1, squeeze=False, sharex=True).ravel()
        for letter, ax, (title, dashed, clouds) in zip("abcd", axes, panels, strict=False):
            _draw_office(ax, run.office)
            _draw_clouds(ax, run, clouds)
            if clouds.spreads()[-1].max() < SMALL:
                _enlarge_ends(ax, run, clouds)
            ax.set_title(f"({letter}) {title}; dashed: {dashed}", loc="left", pad=3)
            ax.set_ylabel("y [m]", labelpad=1)
        axes[-1].set_xlabel("x [m]", labelpad=1)
        figure.legend(
            handles=_legend(len(run.true_paths)), loc="outside lower center", ncols=3, frameon=False, columnspacing=1.2,
            handlelength=1.6, borderpad=0.0,
        )  # fmt: skip
        save_png(figure, file, 270)


def _draw_office(ax: Axes, office: Office) -> None:
    """Draw the blocks of rooms, the outer walls and the true landmarks, with equal axes."""
    for x1, y1, x2, y2 in office.blocks:
        ax.add_patch(Rectangle((x1, y1), x2 - x1, y2 - y1, fc="0.96", ec=rgb(WALL), lw=0.8))
    ax.add_patch(Rectangle((0.0, 0.0), *office.size, fc="none", ec=rgb(WALL), lw=0.8))
    ax.scatter(office.landmarks[:, 0], office.landmarks[:, 1], s=2.5, color=rgb(TRUE_LANDMARK), lw=0)
    margin = 0.4
    ax.set(
        aspect="equal", xlim=(-margin, office.size[0] + margin), ylim=(-margin, office.size[1] + margin),
        xticks=np.arange(0.0, office.size[0] + 0.1, 3.0), yticks=np.arange(0.0, office.size[1] + 0.1, 3.0),
    )  # fmt: skip
    ax.tick_params(length=2, pad=1.5, width=0.6)


def _draw_clouds(ax: Axes, run: StereoRun, clouds: Clouds) -> None:
    """Draw the map, and each robot's true path, dashed path and particles as dashes along their headings."""
    ax.plot(*clouds.landmarks[:, :2].T, ls="", marker="+", ms=2.2, mew=0.45, color=INK, zorder=2)
    for robot, true in enumerate(run.true_paths):
        colour = rgb(robot_colour(robot))
        ax.plot(*true[:, :2].T, color=colour, lw=0.9, alpha=0.55, zorder=3)
        ax.plot(*clouds.paths[robot, :, :2].T, color=colour, lw=0.8, ls=(0, (3.0, 1.6)), zorder=4)
        _draw_particles(ax, clouds.poses[:, robot].reshape(-1, 3), 0.12, colour)
        taken = true[clouds.steps]
        ax.plot(*taken[1:, :2].T, ls="", marker="o", ms=1.8, mfc="white", mec=INK, mew=0.45, zorder=6)
        ax.plot(*true[0, :2], marker="o", ms=6.5, mfc="white", mec=colour, mew=0.9, zorder=7)
        ax.text(
            true[0, 0], true[0, 1], str(robot + 1), ha="center", va="center_baseline", fontsize=5.5, color=colour,
            weight="bold", zorder=8,
        )  # fmt: skip


def _draw_particles(ax: Axes, poses: FloatArray, length: float, colour: tuple[float, float, float]) -> None:
    """Draw poses (n, 3) as dashes of the given length [m] along their headings."""
    half = 0.5 * length * np.column_stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])])
    dashes = np.stack([poses[:, :2] - half, poses[:, :2] + half], axis=1)
    ax.add_collection(LineCollection(list(dashes), colors=[colour], linewidths=0.35, alpha=0.4, zorder=5))


def _enlarge_ends(ax: Axes, run: StereoRun, clouds: Clouds) -> None:
    """Draw the last sets of particles enlarged inside the blocks of rooms, as far as there are blocks."""
    for robot, (x1, y1, x2, y2) in zip(range(len(run.true_paths)), run.office.blocks, strict=False):
        colour, width, height = rgb(robot_colour(robot)), 0.9 * (x2 - x1), 0.9 * (y2 - y1)
        box = (x1 + 0.05 * (x2 - x1), y1 + 0.05 * (y2 - y1), width, height)
        inset = ax.inset_axes(box, transform=ax.transData)
        true, poses = run.true_paths[robot, clouds.steps[-1]], clouds.poses[-1, robot]
        centre = 0.5 * (true[:2] + poses[:, :2].mean(axis=0))
        reach = 0.5 * np.array([width, height]) / ENLARGED
        inset.set(xlim=centre[0] + reach[0] * np.array([-1, 1]), ylim=centre[1] + reach[1] * np.array([-1, 1]))
        inset.set(xticks=[], yticks=[])
        inset.spines[:].set(color=colour, linewidth=0.6)
        _draw_particles(inset, poses, 0.05, colour)
        inset.plot(*true[:2], marker="o", ms=2.6, mfc="white", mec=INK, mew=0.5, zorder=6)
        text = f"{robot + 1} at the end, {ENLARGED:g} : 1"
        inset.text(0.03, 0.95, text, transform=inset.transAxes, fontsize=5, va="top", color=colour)


def _legend(robots: int) -> list[Line2D]:
    """Return the entries of the legend."""
    colours = [Line2D([], [], color=rgb(robot_colour(k)), lw=1.6, label=f"robot {k + 1}") for k in range(robots)]
    return [
        *colours, Line2D([], [], color=rgb(FAINT_INK), lw=0.9, label="true path"),
        Line2D([], [], ls="", marker="o", ms=2.5, mfc="white", mec=INK, mew=0.5, label="true pose at a cloud"),
        Line2D([], [], ls="", marker="$\\cdots$", ms=6, color=rgb(FAINT_INK), mew=0.2, label="particles"),
        Line2D([], [], ls="", marker="o", ms=2, color=rgb(TRUE_LANDMARK), mew=0, label="true landmark"),
        Line2D([], [], ls="", marker="+", ms=3.5, color=INK, mew=0.6, label="landmark of the map"),
    ]  # fmt: skip
