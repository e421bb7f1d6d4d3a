"""Alignment methods on simulated maps: success, error over the Cramer-Rao bound, and time.

python -m studies.merging.alignment --quick
"""

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import Any, Literal

import numpy as np
from scipy.stats import chi2

from slam_backend.geometry import wrap_angle
from slam_backend.maps.alignment import align_maps
from slam_backend.maps.alignment_types import is_distinct
from studies.merging.map_pairs import IDENTIFIABLE, UNALIGNABLE, MapPair, draw_identifiable, draw_pair, draw_unalignable
from training.commands.study import run_program
from training.experiments.config import ExperimentConfig, first_seed, option
from training.experiments.statistics import CONFIDENCE
from training.experiments.study import Chart, Column, Estimate, Panel, ResultTable, Row, Study

# ---------------------------------------------------------------------- trials

Method = Literal["ransac", "svd", "icp", "impicp"]
Kind = Literal["grid", "U", "I"]
CASES: dict[Kind, tuple[str, ...]] = {"grid": ("",), "U": UNALIGNABLE, "I": IDENTIFIABLE}
# (overlap, outliers): of 200 landmarks in each map, 20 true pairs allow up to 180 wrong ones, 200 allow none.
GRID = (
    (1.0, 0.0), (0.5, 0.0), (0.5, 0.5), (0.25, 0.0), (0.25, 0.5), (0.25, 0.75), (0.1, 0.0), (0.1, 0.5), (0.1, 0.8),
    (0.1, 0.9),
)  # fmt: skip


class Config(ExperimentConfig):
    """A grid of cells, and the hard sets U and I, whose trials are divided among their cases."""

    methods: tuple[Method, ...] = option(
        ("ransac", "svd", "icp", "impicp"), "Methods: ransac, svd, icp, impicp.", shown="all"
    )
    seeds: int = option(500, "Number of trials of each grid cell and method.", ge=1, hint="Use at least one trial.")
    hard: int = option(1000, "Number of trials of each hard set and method.", ge=0, hint="Use 0 to omit the hard sets.")
    seed: int = first_seed()


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One alignment."""

    # "grid": 200 landmarks each, with a given share of common landmarks and of wrong similar pairs. "U": maps that must
    # not be aligned. "I": maps that can barely be aligned.
    kind: Kind
    case: str  # Entry of `UNALIGNABLE` or `IDENTIFIABLE`; empty for the grid
    overlap: float  # Share of common landmarks in the grid; 0 for the hard kinds
    outliers: float  # Share of wrong pairs among the similar ones in the grid; 0 for the hard kinds
    method: str  # Method of `align_maps`
    seed: int  # Seed of maps and search


def trials(config: Config) -> list[Trial]:
    """Return all trials, with trials on the same maps in succession."""
    grid = [
        Trial(kind="grid", case="", overlap=overlap, outliers=outliers, method=method, seed=config.seed + i)
        for (overlap, outliers), i, method in product(GRID, range(config.seeds), config.methods)
    ]
    hard: tuple[Kind, ...] = ("U", "I")
    return grid + [
        Trial(
            kind=kind, case=CASES[kind][i % len(CASES[kind])], overlap=0.0, outliers=0.0, method=method,
            seed=config.seed + i,
        )
        for kind, i, method in product(hard, range(config.hard), config.methods)
    ]  # fmt: skip


@lru_cache(maxsize=1)
def maps_of(kind: Kind, case: str, overlap: float, outliers: float, seed: int) -> MapPair:
    """Return the maps of a trial, which are the same for all methods."""
    cell = list(CASES).index(kind), CASES[kind].index(case), round(1000 * overlap), round(1000 * outliers)
    rng = np.random.default_rng([seed, *cell])  # cells share no random draws, so that their errors are independent
    if kind == "grid":
        return draw_pair(overlap, outliers, rng)
    return draw_unalignable(case, rng) if kind == "U" else draw_identifiable(case, rng)


def play(config: Config, trial: Trial) -> dict[str, Any]:
    """Align the maps of a trial.

    Returns:
        `success`, `reason`, `ratio`, `inliers`; wall-clock time `seconds`, processor time `cpu_seconds`. If there is a
        true transform and an estimate: `error_m` and `error_rad`, `false` if above 0.5 m or 5 degrees, `nees`, and the
        Cramer-Rao variances `bound_m2` and `bound_rad2`. Without a true transform any estimate is false.
    """
    pair = maps_of(trial.kind, trial.case, trial.overlap, trial.outliers, trial.seed)
    rng = np.random.default_rng(trial.seed)
    begun, begun_cpu = time.perf_counter(), time.thread_time()
    alignment = align_maps(pair.a, pair.b, trial.method, rng)
    row: dict[str, Any] = {
        "success": alignment.success, "reason": alignment.reason, "ratio": alignment.ratio,
        "inliers": len(alignment.inliers), "seconds": time.perf_counter() - begun,
        "cpu_seconds": time.thread_time() - begun_cpu, "false": alignment.success,
    }  # fmt: skip
    if alignment.success and len(pair.pairs):
        error = alignment.transform - pair.pose
        error[2] = wrap_angle(error[2])
        bound = pair.bound()
        row |= {
            "error_m": float(np.hypot(error[0], error[1])), "error_rad": abs(float(error[2])),
            "false": is_distinct(error),
            "nees": float(error @ np.linalg.solve(alignment.covariance, error)),
            "bound_m2": float(bound[0, 0] + bound[1, 1]), "bound_rad2": float(bound[2, 2]),
        }  # fmt: skip
    return row


# ---------------------------------------------------------------------- results


def _share_right(rows: Sequence[Row]) -> float:
    """Return the share of alignments that were accepted and are not false."""
    return sum(row["success"] and not row["false"] for row in rows) / len(rows)


def _over_bound(error: str, bound: str, rows: Sequence[Row]) -> float | None:
    """Return the RMS error of accepted alignments over the root of the mean Cramer-Rao bound."""
    found = [row for row in rows if error in row]
    if not found:
        return None
    return float(np.sqrt(np.mean([row[error] ** 2 for row in found]) / np.mean([row[bound] for row in found])))


def _translation(rows: Sequence[Row]) -> float | None:
    return _over_bound("error_m", "bound_m2", rows)


def _rotation(rows: Sequence[Row]) -> float | None:
    return _over_bound("error_rad", "bound_rad2", rows)


def _anees(rows: Sequence[Row]) -> Estimate:
    """Return the mean NEES over its dimension; the ends are those of 95 % of consistent covariances."""
    values = [row["nees"] for row in rows if "nees" in row]
    if not values:
        return Estimate(None)
    dof = 3 * len(values)
    low, high = (float(chi2.ppf(0.5 + 0.5 * side * CONFIDENCE, dof)) / dof for side in (-1.0, 1.0))
    return Estimate(float(np.mean(values)) / 3.0, low, high)


def _refusals(rows: Sequence[Row]) -> str:
    """Return the reasons of refusals with their numbers."""
    counts = Counter(row["reason"] for row in rows if row["reason"]).most_common()
    return ", ".join(f"{reason} {count}" for reason, count in counts)


def _accepted(rows: Sequence[Row]) -> str:
    return f"{sum(row['success'] for row in rows)} of {len(rows)}"


RIGHT = Column("right", "right [%]", _share_right, digits=1, factor=100.0)
TRANSLATION = Column("translation", "translation/bound", _translation, digits=2)
ROTATION = Column("rotation", "rotation/bound", _rotation, digits=2)
ANEES = Column("anees", "ANEES (consistent)", _anees, digits=2)
TIME = Column("cpu_seconds", "median [ms]", "median", digits=1, factor=1e3)
TIMES = TIME, Column("cpu_seconds", "95 % [ms]", "p95", digits=1, factor=1e3)
REFUSALS = Column("reasons", "refused for", _refusals)
SHARES = {
    name: (heading, lambda value: f"{100.0 * value:.0f} %")
    for name, heading in (("overlap", "common"), ("outliers", "wrong"))
}

STUDY = Study(
    name="alignment",
    about="""Compare alignment methods on simulated maps: success rate, error over the Cramer-Rao bound, and time.

    The grid varies the share of common landmarks and of wrong similar pairs; U: maps that must not be aligned; I: maps
    that can barely be aligned. One process with one thread, for comparable times. Ctrl-C finishes the current trial
    and summarises the finished ones; the same command with --out FOLDER resumes the run.
    """,
    config=Config,
    trial=Trial,
    trials=trials,
    play=play,
    timed=True,
    quick={"seeds": 10, "hard": 45},
    tables=(
        ResultTable(
            name="grid", by=("overlap", "outliers", "method"), words=SHARES, pooled=("overlap", "outliers"),
            title="200 landmarks in each map, 5 cm noise, by share of common landmarks and of wrong similar pairs",
            columns=(RIGHT, TRANSLATION, ROTATION, ANEES, *TIMES), where=lambda row: row["kind"] == "grid",
        ),
        ResultTable(
            name="unalignable", by=("case", "method"), pooled=("case",), title="Maps that must not be aligned",
            columns=(Column("accepted", "", _accepted), REFUSALS, *TIMES), where=lambda row: row["kind"] == "U",
        ),
        ResultTable(
            name="identifiable", by=("case", "method"), pooled=("case",),
            title="Maps that can barely be aligned: 12 to 40 true pairs, spread over 2 m to 15 m",
            columns=(
                Column("success", "accepted [%]", digits=1, factor=100.0), Column("false", "", "sum", digits=0),
                Column("error_m", "worst [m]", "worst", digits=2),
                Column("error_rad", "worst [°]", "worst", digits=2, factor=180.0 / np.pi), ANEES, REFUSALS, TIME,
            ),
            where=lambda row: row["kind"] == "I",
        ),
    ),
    chart=Chart(
        x="outliers", label="wrong similar pairs [%]", factor=100.0, by="method", rows="overlap",
        title=lambda overlap: f"{200 * overlap:.0f} of 200 landmarks in common",
        where=lambda row: row["kind"] == "grid" and row["overlap"] < 1.0,
        panels=(
            Panel(column=RIGHT, limits=(-5.0, 105.0)), Panel(column=TRANSLATION, limits=(0.8, 1.3), guide=1.1),
            Panel(column=ROTATION, limits=(0.8, 1.3), guide=1.1), Panel(column=TIME, log=True, guide=5.0),
        ),
    ),
)  # fmt: skip

if __name__ == "__main__":
    run_program(STUDY)
