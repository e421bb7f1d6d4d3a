"""Fig. 2 of the paper: errors of alignment methods over the size of the two maps."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from slam_backend.core.validation import FloatArray
from slam_backend.geometry import wrap_angle
from slam_backend.maps.alignment import DISTINCT_ROTATION, DISTINCT_TRANSLATION, align_maps, propose_motion
from training.experiments.plotting import add_legend, picture, save_png
from training.experiments.tables import csv_text
from training.paper.map_pairs import map_alone, simulate_pair, true_motion

TRIALS_FILE = "runs.jsonl"
PAPER_METHODS = ("svd", "icp", "impicp", "ransac")
OURS = "ours"  # ransac with refinement and refusals
METHODS = (*PAPER_METHODS, OURS)
ENOUGH_SHARED = 12  # shared landmarks below which maps need not be alignable
BIN = 50  # width of a bin [landmarks]
# Thresholds of "practically zero", for medians over the runs in each bin.
PRACTICALLY_ZERO = {"translation_m": 0.2, "rotation_deg": 1.0}
LABELS = {"translation_m": "translation [m]", "rotation_deg": "rotation [°]"}

COLOURS = {"svd": "#7f7f7f", "icp": "#D55E00", "impicp": "#E69F00", "ransac": "#0072B2", OURS: "#009E73"}
MARKERS = {"svd": "x", "icp": "v", "impicp": "D", "ransac": "o", OURS: "s"}
NAMES = {"svd": "SVD", "icp": "ICP", "impicp": "ImpICP", "ransac": "RANSAC", OURS: "ours, refined, where accepted"}


@dataclass(frozen=True, slots=True)
class Fig2Trial:
    """One run of two robots; fields as in `Fig2Config`."""

    length: float
    every: float
    landmarks: int
    particles: int
    seed: int


def play(trial: Fig2Trial) -> dict[str, Any]:
    """Let two robots map, and align their maps at each stage of the path.

    Returns:
        Fields of the trial and `stages`: rows of `length`, `size` (mean number of landmarks of the two maps), `shared`
        true landmarks, and `translation_m` and `rotation_deg` of each method, None where it gives no alignment.
    """
    run = simulate_pair(trial.seed, trial.length, trial.landmarks)
    truth = true_motion(run)
    stages = []
    for stage in map_alone(run, trial.particles, trial.seed, trial.every):
        row: dict[str, Any] = {
            "length": stage.length, "size": 0.5 * (len(stage.maps[0]) + len(stage.maps[1])), "shared": stage.shared,
        }  # fmt: skip
        for method in PAPER_METHODS:
            row[method] = _error(propose_motion(*stage.maps, method, np.random.default_rng(trial.seed)), truth)
        found = align_maps(*stage.maps, rng=np.random.default_rng(trial.seed))
        row[OURS] = _error(found.transform, truth) if found.success else None
        stages.append(row)
    return asdict(trial) | {"stages": stages}


def _error(motion: FloatArray | None, truth: FloatArray) -> dict[str, float] | None:
    """Return the errors of a transform."""
    if motion is None:
        return None
    turned = abs(float(np.rad2deg(wrap_angle(motion[2] - truth[2]))))
    return {"translation_m": float(np.hypot(*(motion - truth)[:2])), "rotation_deg": turned}


def summarise(rows: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return one line for each bin of map sizes and each method, over the stages with enough shared landmarks.

    Returns:
        Lines of `size` (middle of the bin), `method`, `stages`, `found` (share of stages with a result), and `_median`,
        `_mean` and `_p90` of `translation_m` and `rotation_deg` over these; None without a result.
    """
    bins: dict[int, list[Mapping[str, Any]]] = {}
    for row in rows:
        for stage in row["stages"]:
            if stage["shared"] >= ENOUGH_SHARED:
                bins.setdefault(int(stage["size"] // BIN), []).append(stage)
    lines = []
    for place, stages in sorted(bins.items()):
        for method in METHODS:
            found = [stage[method] for stage in stages if stage[method] is not None]
            line: dict[str, Any] = {
                "size": (place + 0.5) * BIN, "method": method, "stages": len(stages), "found": len(found) / len(stages),
            }  # fmt: skip
            for name in PRACTICALLY_ZERO:
                values = np.array([error[name] for error in found])
                figures = (np.median(values), values.mean(), np.quantile(values, 0.9)) if found else (None,) * 3
                line |= dict(zip((f"{name}_{kind}" for kind in ("median", "mean", "p90")), figures, strict=True))
            lines.append(line)
    return lines


def refusals(rows: Iterable[Mapping[str, Any]]) -> dict[str, int]:
    """Return the number of stages with too few shared landmarks, and of false alignments of ours among them."""
    poor = [stage for row in rows for stage in row["stages"] if stage["shared"] < ENOUGH_SHARED]
    false = [
        stage for row in rows for stage in row["stages"]
        if stage[OURS] is not None
        and (
            stage[OURS]["translation_m"] > DISTINCT_TRANSLATION
            or stage[OURS]["rotation_deg"] > np.rad2deg(DISTINCT_ROTATION)
        )
    ]  # fmt: skip
    return {"share_too_little": len(poor), "false": len(false)}


def check_claims(lines: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Check the paper's claim: RANSAC is best, with practically zero error for any size of the maps.

    Returns:
        Rows of `claim`, `measured`, `at_most` and `holds`; means weigh all sizes equally.
    """
    claims: list[dict[str, Any]] = []
    sizes = sorted({line["size"] for line in lines})
    at = {(line["size"], line["method"]): line for line in lines}

    def figure(size: float, method: str, name: str) -> float:
        value = at[size, method][name]
        return float("inf") if value is None else float(value)

    for name, limit in PRACTICALLY_ZERO.items():
        worst = max((figure(size, "ransac", f"{name}_median") for size in sizes), default=float("inf"))
        claims.append({"claim": f"RANSAC, median {LABELS[name]}, worst size", "measured": worst, "at_most": limit})
        for other in ("svd", "icp", "impicp"):
            ours, theirs = (sum(figure(size, m, f"{name}_mean") for size in sizes) for m in ("ransac", other))
            ratio = ours / theirs if sizes else float("inf")
            claims.append({"claim": f"RANSAC over {other}, mean {LABELS[name]}", "measured": ratio, "at_most": 1.0})
    return [claim | {"holds": bool(claim["measured"] <= claim["at_most"])} for claim in claims]


def to_csv(rows: Iterable[Mapping[str, Any]]) -> str:
    """Return every stage and method as CSV."""
    headings = ["seed", "length_m", "size", "shared", "method", *PRACTICALLY_ZERO]
    lines = []
    for row in rows:
        for stage in row["stages"]:
            for method in METHODS:
                error = stage[method] or dict.fromkeys(PRACTICALLY_ZERO)
                lines.append([row["seed"], stage["length"], stage["size"], stage["shared"], method, *error.values()])
    return csv_text(headings, lines)


@picture
def draw_fig2(file: Path, lines: Sequence[Mapping[str, Any]]) -> None:
    """Draw medians as lines and 90 % quantiles as error bars, on a log scale, into a PNG file."""
    with mpl.rc_context({"font.size": 9}):
        figure = Figure(figsize=(10.0, 4.0), layout="constrained")
        panels = figure.subplots(1, 2)
        for letter, axes, (name, label) in zip("ab", panels, LABELS.items(), strict=True):
            for place, method in enumerate(METHODS):
                chosen = [line for line in lines if line["method"] == method and line[f"{name}_median"] is not None]
                if not chosen:
                    continue
                middle = [line[f"{name}_median"] for line in chosen]
                above = [max(line[f"{name}_p90"] - line[f"{name}_median"], 0.0) for line in chosen]
                axes.errorbar(
                    [line["size"] + 3.0 * (place - 2) for line in chosen], middle, yerr=[[0.0] * len(chosen), above],
                    marker=MARKERS[method], ms=4.5, mfc="none", lw=1.2, elinewidth=0.7, capsize=2,
                    color=COLOURS[method], label=NAMES[method],
                )  # fmt: skip
            axes.set_yscale("log")
            axes.set_xlabel("landmarks in a map")
            axes.set_ylabel(f"error in {label}")
            axes.set_title(f"({letter})", loc="left")
            axes.grid(alpha=0.2, which="both")
        add_legend(figure, panels[0])
        save_png(figure, file, 120)
