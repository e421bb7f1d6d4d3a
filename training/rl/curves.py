"""The rows of a training as CSV, and their first and last tenth."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from training.experiments.tables import csv_text

Row = Mapping[str, float]


def to_csv(rows: Sequence[Row]) -> str:
    """Return one line per rollout under a heading; numbers have six digits."""
    names = list(rows[0]) if rows else []
    return csv_text(names, ([row[name] for name in names] for row in rows))


def ends_of(rows: Sequence[Row]) -> dict[str, dict[str, Any]]:
    """Return the means over the first and over the last tenth of the rollouts, at least one each."""
    tenth = max(1, len(rows) // 10)
    return {"first": _mean(rows[:tenth]), "last": _mean(rows[-tenth:])}


def _mean(rows: Sequence[Row]) -> dict[str, Any]:
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
