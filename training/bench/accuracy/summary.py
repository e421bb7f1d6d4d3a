"""Trials of many seeds in one line each: means and medians with bootstrap intervals."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from slam_backend.core.validation import FloatArray
from training.experiments.statistics import grouped, interval

CONDITION = ("preset", "association", "robots", "length")
GROUP = (*CONDITION, "method", "particles")
FIGURES = (
    "pose_rms_m", "pose_aligned_rms_m", "heading_rms_deg", "map_rmse_m", "map_aligned_rmse_m", "map_recall",
    "map_precision", "confirmed_recall", "confirmed_precision", "nees_median", "nees_mean", "anees", "ess_share",
    "nis", "wrong_match_share", "held_back_share", "step_ms", "rejuvenation_ms",
    "refused_share",
)  # fmt: skip


def summarise(rows: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return one line per condition, method and M, in the order in which they first come.

    Args:
        rows: As `play` returns them; None and NaN stand for what is not known.

    Returns:
        The fields of `GROUP`, `seeds`, and for each of `FIGURES` a table with `mean`, `median` and their intervals
        `mean_low`, `mean_high`, `median_low`, `median_high` (95 %, percentile bootstrap over seeds; None for a single
        seed) and `worst`; or None where no seed has the figure.
    """
    lines = []
    for key, members in grouped(rows, GROUP).items():
        line: dict[str, Any] = dict(zip(GROUP, key, strict=True)) | {"seeds": len(members)}
        for figure in FIGURES:
            values = np.array([np.nan if row[figure] is None else row[figure] for row in members], dtype=np.float64)
            line[figure] = describe(values[np.isfinite(values)])
        lines.append(line)
    return lines


def describe(values: FloatArray) -> dict[str, float | None] | None:
    """Return mean, median, their bootstrap intervals and the largest of values (n,); None if there are none.

    >>> describe(np.array([2.0]))["mean_low"] is None
    True
    """
    if not len(values):
        return None
    found: dict[str, float | None] = {"worst": float(values.max())}
    for name, statistic in (("mean", np.mean), ("median", np.median)):
        found[name] = float(statistic(values))
        found[f"{name}_low"], found[f"{name}_high"] = interval(values, statistic)
    return found
