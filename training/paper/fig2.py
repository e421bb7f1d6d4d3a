"""Fig. 2 of the paper: errors of alignment methods over the size of the two maps."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from slam_backend.core.validation import FloatArray
from slam_backend.geometry import wrap_angle
from slam_backend.maps.alignment import DISTINCT_ROTATION, DISTINCT_TRANSLATION, align_maps, propose_motion
from training.experiments.study import Chart, Claim, Column, Estimate, Panel, ResultTable, Row, Study, Words
from training.paper.config import Fig2Config, Fig2Trial
from training.paper.map_pairs import map_alone, simulate_pair, true_motion

PAPER_METHODS = ("svd", "icp", "impicp", "ransac")
OURS = "ours"  # ransac with refinement and refusals
METHODS = (*PAPER_METHODS, OURS)
NAMES = {"svd": "SVD", "icp": "ICP", "impicp": "ImpICP", "ransac": "RANSAC", OURS: "ours (refined)"}
WORDS: Words = {"method": ("method", NAMES.__getitem__)}
ENOUGH_SHARED = 12  # shared landmarks below which maps need not be alignable
BIN = 50  # width of a bin [landmarks]
# Thresholds of "practically zero", for medians over the runs in each bin.
PRACTICALLY_ZERO = {"translation_m": 0.2, "rotation_deg": 1.0}
FALSE = {"translation_m": DISTINCT_TRANSLATION, "rotation_deg": float(np.rad2deg(DISTINCT_ROTATION))}


def play(config: Fig2Config, trial: Fig2Trial) -> dict[str, Any]:
    """Let two robots map, and align their maps at each stage of the path.

    Returns:
        `stages`: rows of `length`, `size` (mean number of landmarks of the two maps), `shared`
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
    return {"stages": stages}


def _error(motion: FloatArray | None, truth: FloatArray) -> dict[str, float] | None:
    """Return the errors of a transform."""
    if motion is None:
        return None
    turned = abs(float(np.rad2deg(wrap_angle(motion[2] - truth[2]))))
    return {"translation_m": float(np.hypot(*(motion - truth)[:2])), "rotation_deg": turned}


def unfold(rows: Sequence[Row]) -> list[Row]:
    """Return a row for each stage and method: errors, None without an alignment, and `size`, the middle of a bin.

    Smaller maps come first.
    """
    found = [
        {
            "seed": row["seed"], "length_m": stage["length"], "landmarks": stage["size"],
            "size": int((stage["size"] // BIN + 0.5) * BIN), "shared": stage["shared"], "method": method,
            "found": stage[method] is not None, **(stage[method] or dict.fromkeys(PRACTICALLY_ZERO)),
        }
        for row in rows
        for stage in row["stages"]
        for method in METHODS
    ]  # fmt: skip
    return sorted(found, key=lambda row: int(row["size"]))


def _spread(name: str, rows: Sequence[Row]) -> Estimate:
    """Return the median of an error, from which its interval reaches to the 90 % quantile."""
    values = [row[name] for row in rows if row[name] is not None]
    return Estimate(*map(float, np.quantile(values, (0.5, 0.5, 0.9)))) if values else Estimate(None)


def _share_enough(row: Row) -> bool:
    return bool(row["shared"] >= ENOUGH_SHARED)


def _poor(rows: Sequence[Row]) -> int:
    """Return the number of stages with too few shared landmarks."""
    return sum(not _share_enough(row) for row in rows)


def _false(rows: Sequence[Row]) -> int:
    """Return the number of false alignments."""
    return sum(row["found"] and any(row[name] > limit for name, limit in FALSE.items()) for row in rows)


def check_claims(rows: Sequence[Row]) -> list[Claim]:
    """Check the paper's claim: RANSAC is best, with practically zero error for any size of the maps.

    Means weigh all sizes equally; an error is infinite where a method gives no alignment.
    """
    at = {(line["size"], line["method"]): line for line in TABLE.lines(rows)}
    sizes = {size for size, _ in at}

    def errors(method: str, column: Column) -> list[float]:
        found = [at[size, method][column.title].value for size in sizes]
        return [float("inf") if value is None else value for value in found]

    claims = []
    for limit, median, mean in zip(PRACTICALLY_ZERO.values(), MEDIANS, MEANS, strict=True):
        found = {f"RANSAC, median {median.title}, worst size": (max(errors("ransac", median), default=np.inf), limit)}
        for other in ("svd", "icp", "impicp"):
            ratio = sum(errors("ransac", mean)) / sum(errors(other, mean)) if sizes else np.inf
            found[f"RANSAC over {other}, {mean.title}"] = ratio, 1.0
        for text, (value, most) in found.items():
            claims.append(Claim(text, Estimate(value), f"at most {most:g}", bool(value <= most)))
    return claims


MEDIANS = tuple(Column(name, statistic=partial(_spread, name)) for name in PRACTICALLY_ZERO)
MEANS = tuple(Column(name, f"mean {Column(name).title}") for name in PRACTICALLY_ZERO)
TABLE = ResultTable(
    name="fig2",
    title="Errors over the size of the maps: medians (to 90 %)",
    by=("size", "method"),
    where=_share_enough,
    columns=(Column("found", "found [%]", digits=0, factor=100.0), *MEDIANS, *MEANS),
)

STUDY = Study(
    name="fig2",
    config=Fig2Config,
    trial=Fig2Trial,
    trials=Fig2Config.trials,
    play=play,
    unfold=unfold,
    claims=check_claims,
    tables=(
        TABLE,
        ResultTable(
            name="refusals", title="All stages", by=("method",),
            columns=(
                Column("poor", "share too little", _poor, digits=0),
                Column("false", "falsely aligned", _false, digits=0),
            ),
        ),
    ),
    chart=Chart(
        x="size", label="landmarks in a map", by="method", where=_share_enough,
        words=WORDS,
        panels=tuple(
            Panel(column=replace(column, heading=f"error of {column.title}"), log=True) for column in MEDIANS
        ),
    ),
)  # fmt: skip
