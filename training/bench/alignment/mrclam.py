"""Pairwise alignment of real maps: robots of an MR.CLAM log map alone; barcodes are known, then unknown."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from slam_backend.maps.alignment import DISTINCT_ROTATION, DISTINCT_TRANSLATION, AlignmentOptions, align_maps
from training.bench.config import MrclamPairsConfig
from training.experiments.statistics import grouped
from training.experiments.tables import number
from training.replay.config import MrclamConfig
from training.replay.core import Replay, replay_log
from training.replay.log import Log
from training.replay.metrics import motion_error
from training.replay.readers import read_mrclam

HEADINGS = (
    "after [s]", "barcodes", "method", "pairs", "aligned", "false", "median [m]", "worst [m]", "median [°]",
    "worst [°]",
)  # fmt: skip
METHODS = ("ransac",)
ENOUGH_SHARED = 5  # shared landmarks from which maps should be alignable by barcodes
# Maps are deformed by tenths of a metre, early ones more.
OPTIONS = AlignmentOptions(position_floor=0.3, min_inliers=ENOUGH_SHARED, max_sigma_heading=0.05)
BARCODES: dict[str, AlignmentOptions] = {"given": OPTIONS, "hidden": replace(OPTIONS, appearance=False)}


def align_log(config: MrclamPairsConfig, on_part: Callable[[float], None] = lambda share: None) -> list[dict[str, Any]]:
    """Let each robot map alone for each duration, and align all pairs of maps.

    Returns:
        Rows of `align_pairs` with `duration_s` (None: the whole log).
    """
    rows = []
    for place, duration in enumerate(config.durations):
        limit = duration or None
        log = read_mrclam(config.path, duration=limit, alone=True)
        alone = MrclamConfig(path=config.path, duration=limit, alone=True, particles=config.particles, seed=config.seed)
        done = place / len(config.durations)

        def on_step(share: float, report: Any, done: float = done) -> None:
            on_part(done + share / len(config.durations))

        result = replay_log(log, alone, on_step)
        rows += [{"duration_s": limit} | row for row in align_pairs(result, log)]
    return rows


def align_pairs(result: Replay, log: Log) -> list[dict[str, Any]]:
    """Align the maps of all pairs of robots, with known and unknown barcodes, by all methods.

    Returns:
        Rows of `robots` (numbers of the log), `shared` landmarks, `barcodes`, `method`, `accepted`, `reason`,
        `inliers`; `error_m` at b's landmarks and `error_deg`, relative to the transform between the fits of both maps
        to the true landmarks, None if refused.
    """
    numbers = [robot.number for robot in log.robots]
    rows = []
    for a, b in combinations(range(len(numbers)), 2):
        maps, claims = (result.maps[a], result.maps[b]), (result.claims[a], result.claims[b])
        shared = len(np.intersect1d(*claims))
        for barcodes, options in BARCODES.items():
            for method in METHODS:
                alignment = align_maps(*maps, method, np.random.default_rng(0), options)
                error = motion_error(alignment.transform, maps, claims, log.landmarks) if alignment.success else None
                rows.append(
                    {
                        "robots": [numbers[a], numbers[b]], "shared": shared, "barcodes": barcodes, "method": method,
                        "accepted": alignment.success, "reason": alignment.reason, "inliers": len(alignment.inliers),
                        "error_m": error[0] if error else None,
                        "error_deg": float(np.rad2deg(error[1])) if error else None,
                    }
                )  # fmt: skip
    return rows


def summarise(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return one line per duration, barcodes and method.

    Returns:
        Lines of `duration_s`, `barcodes`, `method`, `pairs` with enough shared landmarks, `accepted` of these, `false`
        (error above 0.5 m or 5 degrees), `median_m`, `worst_m`, `median_deg`, `worst_deg` of the accepted ones.
    """
    lines = []
    for (duration, barcodes, method), group in grouped(rows, ("duration_s", "barcodes", "method")).items():
        apart = np.array([[row["error_m"], row["error_deg"]] for row in group if row["error_m"] is not None])
        line: dict[str, Any] = {
            "duration_s": duration, "barcodes": barcodes, "method": method,
            "pairs": sum(row["shared"] >= ENOUGH_SHARED for row in group),
            "accepted": sum(row["accepted"] for row in group), "false": 0,
        } | dict.fromkeys(("median_m", "worst_m", "median_deg", "worst_deg"))  # fmt: skip
        if len(apart):
            line["false"] = int(
                ((apart[:, 0] > DISTINCT_TRANSLATION) | (apart[:, 1] > np.rad2deg(DISTINCT_ROTATION))).sum()
            )
            for column, unit in enumerate(("m", "deg")):
                line[f"median_{unit}"] = float(np.median(apart[:, column]))
                line[f"worst_{unit}"] = float(apart[:, column].max())
        lines.append(line)
    return lines


def cells(line: Mapping[str, Any]) -> list[str]:
    """Return one row of the table as text."""
    after = "all" if line["duration_s"] is None else f"{line['duration_s']:g}"
    counts = [str(line[name]) for name in ("pairs", "accepted", "false")]
    errors = [number(line[name]) for name in ("median_m", "worst_m", "median_deg", "worst_deg")]
    return [after, line["barcodes"], line["method"], *counts, *errors]
