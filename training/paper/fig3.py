"""Figs. 3 and 4 of the paper: matches and transform of two maps; covariance ellipses before and after fusion."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from slam_backend.core.validation import FloatArray, IntArray, argument_error
from slam_backend.geometry import transform_points, wrap_angle
from slam_backend.maps.alignment import Alignment, align_maps, candidate_matches
from slam_backend.maps.alignment_types import AlignmentOptions
from slam_backend.maps.fusion import fuse_maps, move_covariances
from slam_backend.maps.landmark_map import LandmarkMap
from training.experiments.output.plotting import CHI_SQUARE_95, ellipse_95, picture, save_png
from training.experiments.study import Column, ResultTable
from training.paper.config import PairConfig
from training.paper.map_pairs import Stage, map_alone, simulate_pair, true_motion

SHOWN = 3  # number of landmarks in Fig. 4

COLOURS = {"map 1": "#0072B2", "map 2": "#D55E00", "fused": "#009E73"}
APART = 3.0  # gap between the two maps in the left panel [m]


@dataclass(frozen=True, slots=True, eq=False)
class AlignedPair:
    """Maps of two robots and the estimated transform between them."""

    stage: Stage  # Both maps
    candidates: IntArray  # (k, 2) rows (a, b) of landmarks with similar descriptors
    alignment: Alignment  # Successful alignment
    truth: FloatArray  # (3,) True transform between the start frames [m, m, rad]

    @property
    def maps(self) -> tuple[LandmarkMap, LandmarkMap]:
        """Both maps, in their start frames."""
        return self.stage.maps

    def errors(self) -> tuple[float, float]:
        """Return the errors of the transform [m, degrees]."""
        error = self.alignment.transform - self.truth
        return float(np.hypot(error[0], error[1])), abs(float(np.rad2deg(wrap_angle(error[2]))))


def align_pair(config: PairConfig) -> AlignedPair:
    """Let two robots map separately, and align their maps.

    Raises:
        ValueError: If the maps cannot be aligned.
    """
    run = simulate_pair(config.seed, config.length, config.landmarks)
    *_, stage = map_alone(run, config.particles, config.seed, config.length)
    alignment = align_maps(*stage.maps, rng=np.random.default_rng(config.seed))
    if not alignment.success:
        hint = "Let the robots drive farther, or take another seed."
        raise argument_error("length", "maps that can be aligned", f"a refusal: {alignment.reason}", hint)
    return AlignedPair(stage, candidate_matches(*stage.maps, AlignmentOptions()), alignment, true_motion(run))


@dataclass(frozen=True, slots=True, eq=False)
class FusedLandmarks:
    """Several landmarks before and after fusion, frame of the first map."""

    true_ids: IntArray  # (n,) Numbers of the true landmarks
    means: FloatArray  # (3, n, 3) float64 [m]. Means in the first map, the second map after alignment, the fused map.
    covariances: FloatArray  # (3, n, 3, 3) float64 [m^2]. Covariances; aligned ones include the transform's.


def fuse_pair(pair: AlignedPair, shown: int = SHOWN) -> FusedLandmarks:
    """Fuse both maps, and return the shared landmarks with the largest fused uncertainty in the plane."""
    (map_a, map_b), alignment = pair.maps, pair.alignment
    rows_a, rows_b = alignment.inliers.T
    fused = fuse_maps(map_a, map_b, alignment)
    one, two = map_a.covariances[rows_a, :2, :2], map_b.covariances[rows_b, :2, :2]
    chosen = np.argsort(-np.linalg.det(one) * np.linalg.det(two), kind="stable")[:shown]
    a, b = rows_a[chosen], rows_b[chosen]
    return FusedLandmarks(
        true_ids=pair.stage.true_ids[0][a],
        means=np.array([map_a.means[a], transform_points(alignment.transform, map_b.means[b]), fused.means[a]]),
        covariances=np.array([
            map_a.covariances[a], move_covariances(alignment, map_b.means[b], map_b.covariances[b]),
            fused.covariances[a],
        ]),
    )  # fmt: skip


def matches(pair: AlignedPair) -> list[dict[str, Any]]:
    """Return a row for each match: true landmarks, positions in both maps, the aligned second one, and `is_true`."""
    map_a, map_b = pair.maps
    rows = []
    for a, b in pair.alignment.inliers.tolist():
        true_a, true_b = int(pair.stage.true_ids[0][a]), int(pair.stage.true_ids[1][b])
        moved = transform_points(pair.alignment.transform, map_b.means[b])
        names = ("ax", "ay", "az", "bx", "by", "bz", "moved_x", "moved_y")
        points = map(float, (*map_a.means[a], *map_b.means[b], *moved[:2]))
        rows.append(
            {"true_a": true_a, "true_b": true_b, **dict(zip(names, points, strict=True))}
            | {"is_true": true_a == true_b and true_a >= 0}
        )
    return rows


def ellipses(fused: FusedLandmarks) -> list[dict[str, Any]]:
    """Return a row for each landmark and map: mean, covariance, and root of the determinant in the plane [cm^2]."""
    names = ("x", "y", "z", "xx", "xy", "xz", "yy", "yz", "zz")
    rows = []
    for i, true_id in enumerate(fused.true_ids.tolist()):
        for kind, means, covariances in zip(COLOURS, fused.means, fused.covariances, strict=True):
            values = map(float, (*means[i], *covariances[i][np.triu_indices(3)]))
            area = float(1e4 * np.sqrt(np.linalg.det(covariances[i][:2, :2])))
            rows.append({"landmark": true_id, "map": kind, **dict(zip(names, values, strict=True)), "area_cm2": area})
    return rows


MATCHES = ResultTable(
    name="matches", title="Matches", by=("seed",),
    columns=(
        Column("matches", statistic=len, digits=0), Column("is_true", "true", "sum", digits=0),
        Column("translation_m", "error [m]"), Column("rotation_deg", "error [deg]", digits=2),
    ),
)  # fmt: skip
ELLIPSES = ResultTable(
    name="ellipses",
    title="Ellipses before and after fusion",
    by=("landmark", "map"),
    columns=(Column("area_cm2", "area / pi [cm^2]", digits=2),),
)


@picture
def draw_fig3(file: Path, pair: AlignedPair) -> None:
    """Draw both maps in their own frames with lines between matches, and the aligned maps, into a PNG file."""
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
        left.set_title(f"(a) own frames; {len(rows_a)} matches\nof {len(pair.candidates)} candidates", loc="left")
        moved = transform_points(pair.alignment.transform, map_b.means)
        right.scatter(
            *map_a.means[rows_a, :2].T, s=60, marker="o", facecolor="none", edgecolor="0.6", lw=0.7, label="matched"
        )
        _dots(right, map_a.means[:, :2], "map 1")
        _dots(right, moved[:, :2], "map 2")
        metres, degrees = pair.errors()
        title = f"(b) map 2 moved into the frame of map 1,\nerror {100 * metres:.0f} cm and {degrees:.1f}°"
        right.set_title(title, loc="left")
        for axes in (left, right):
            axes.set_aspect("equal")
            axes.set_xlabel("x [m]")
            axes.set_ylabel("y [m]")
            axes.grid(alpha=0.2)
        right.legend(loc="best", fontsize=8)
        save_png(figure, file, 120)


@picture
def draw_fig4(file: Path, fused: FusedLandmarks) -> None:
    """Draw the 95 % ellipses of several landmarks before and after fusion, one per column, into a PNG file."""
    count = len(fused.true_ids)
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
                    alpha = 0.35 if faint else 1.0
                    style = {"facecolor": "none", "edgecolor": COLOURS[name], "lw": 1.4, "alpha": alpha}
                    axes.add_patch(ellipse_95(mean, covariance, **style))
                    axes.plot(*mean, ls="", marker="+", ms=7, color=COLOURS[name], alpha=alpha, label=name)
                axes.set_xlim(middle[0] - reach, middle[0] + reach)
                axes.set_ylim(middle[1] - reach, middle[1] + reach)
                axes.set_aspect("equal")
                axes.set_title(f"{title}: landmark {fused.true_ids[column]}", loc="left")
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
