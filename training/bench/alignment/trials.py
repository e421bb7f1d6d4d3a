"""Trials of `vslam bench alignment`: alignment error of one method on one pair of maps."""

import time
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np

from slam_backend.geometry import wrap_angle
from slam_backend.maps.alignment import DISTINCT_ROTATION, DISTINCT_TRANSLATION, align_maps
from training.bench.alignment.map_pairs import (
    IDENTIFIABLE,
    UNALIGNABLE,
    MapPair,
    draw_identifiable,
    draw_pair,
    draw_unalignable,
)

TRIALS_FILE = "trials.jsonl"
Kind = Literal["grid", "U", "I"]
KINDS: tuple[Kind, ...] = ("grid", "U", "I")


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


def cases(kind: Kind) -> tuple[str, ...]:
    """Return the cases of a hard kind."""
    return {"U": UNALIGNABLE, "I": IDENTIFIABLE, "grid": ("",)}[kind]


@lru_cache(maxsize=1)
def maps_of(kind: Kind, case: str, overlap: float, outliers: float, seed: int) -> MapPair:
    """Return the maps of a trial, which are the same for all methods."""
    cell = KINDS.index(kind), cases(kind).index(case), round(1000 * overlap), round(1000 * outliers)
    rng = np.random.default_rng([seed, *cell])  # cells share no random draws, so that their errors are independent
    if kind == "grid":
        return draw_pair(overlap, outliers, rng)
    return draw_unalignable(case, rng) if kind == "U" else draw_identifiable(case, rng)


def play(trial: Trial) -> dict[str, Any]:
    """Align the maps of a trial.

    Returns:
        Fields of the trial; `success`, `reason`, `ratio`, `inliers`; wall-clock time `seconds`, processor time
        `cpu_seconds`. If there is a true transform and an estimate: `error_m` and `error_rad`, `false` if above
        0.5 m or 5 degrees, `nees`, and the Cramer-Rao variances `bound_m2` and `bound_rad2`. Without a true transform
        any estimate is false.
    """
    pair = maps_of(trial.kind, trial.case, trial.overlap, trial.outliers, trial.seed)
    rng = np.random.default_rng(trial.seed)
    begun, begun_cpu = time.perf_counter(), time.thread_time()
    alignment = align_maps(pair.a, pair.b, trial.method, rng)
    seconds, cpu_seconds = time.perf_counter() - begun, time.thread_time() - begun_cpu
    row: dict[str, Any] = {name: getattr(trial, name) for name in Trial.__dataclass_fields__} | {
        "success": alignment.success, "reason": alignment.reason, "ratio": alignment.ratio,
        "inliers": len(alignment.inliers), "seconds": seconds, "cpu_seconds": cpu_seconds, "false": alignment.success,
    }  # fmt: skip
    if alignment.success and len(pair.pairs):
        error = alignment.transform - pair.pose
        error[2] = wrap_angle(error[2])
        bound = pair.bound()
        row |= {
            "error_m": float(np.hypot(error[0], error[1])), "error_rad": abs(float(error[2])),
            "false": bool(np.hypot(error[0], error[1]) > DISTINCT_TRANSLATION or abs(error[2]) > DISTINCT_ROTATION),
            "nees": float(error @ np.linalg.solve(alignment.covariance, error)),
            "bound_m2": float(bound[0, 0] + bound[1, 1]), "bound_rad2": float(bound[2, 2]),
        }  # fmt: skip
    return row
