"""What the trials of `vslam bench alignment` come to."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import chi2

from training.experiments.statistics import CONFIDENCE, grouped

CELL = ("kind", "case", "overlap", "outliers", "method")


def summarise(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return a line for each cell and method, in order of appearance, and for each kind and method as a whole.

    Returns:
        Lines of `CELL` (None where they are pooled), `trials`, `accepted`, `right` (accepted and not false), `false`,
        `reasons` (how often each), `translation` and `rotation` (RMS error over the root of the mean Cramer-Rao bound,
        accepted trials), `anees` with `anees_low` and `anees_high`, between which it lies with 95 % if covariances are
        honest, `worst_m`, `worst_deg`; computing time `median_ms`, `p95_ms`, `max_ms`, and `passed_ms`, the median of
        what passed, which other processes lengthen.
    """
    cells = grouped(rows, CELL)
    for (kind, method), own in grouped(rows, ("kind", "method")).items():
        cells[kind, None, None, None, method] = own
    return [dict(zip(CELL, cell, strict=True)) | _describe(own) for cell, own in cells.items()]


def _describe(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the figures of one line."""
    found = [row for row in rows if "error_m" in row]
    milliseconds = 1e3 * np.array([row["cpu_seconds"] for row in rows])
    line: dict[str, Any] = {
        "trials": len(rows),
        "accepted": sum(row["success"] for row in rows) / len(rows),
        "right": sum(row["success"] and not row["false"] for row in rows) / len(rows),
        "false": sum(row["false"] for row in rows),
        "reasons": dict(Counter(row["reason"] for row in rows if row["reason"]).most_common()),
        "median_ms": float(np.median(milliseconds)),
        "p95_ms": float(np.quantile(milliseconds, 0.95)),
        "max_ms": float(milliseconds.max()),
        "passed_ms": 1e3 * float(np.median([row["seconds"] for row in rows])),
    }
    figures = ("translation", "rotation", "anees", "anees_low", "anees_high", "worst_m", "worst_deg")
    line |= dict.fromkeys(figures)
    if found:
        column = {name: np.array([row[name] for row in found]) for name in ("error_m", "error_rad", "nees")}
        dof = 3 * len(found)
        low, high = (float(chi2.ppf(0.5 + 0.5 * side * CONFIDENCE, dof)) / dof for side in (-1.0, 1.0))
        line |= {
            "translation": _over_bound(column["error_m"], [row["bound_m2"] for row in found]),
            "rotation": _over_bound(column["error_rad"], [row["bound_rad2"] for row in found]),
            "anees": float(column["nees"].mean() / 3.0),
            "anees_low": low,
            "anees_high": high,
            "worst_m": float(column["error_m"].max()),
            "worst_deg": float(np.rad2deg(column["error_rad"].max())),
        }
    return line


def _over_bound(errors: Any, bounds: Sequence[float]) -> float:
    """Return the RMS error over the root of the mean bound."""
    return float(np.sqrt((np.asarray(errors) ** 2).mean() / np.mean(bounds)))
