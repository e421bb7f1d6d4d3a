"""Groups of rows, 95 % bootstrap intervals, and paired differences."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy import stats

from slam_backend.core.validation import FloatArray

CONFIDENCE = 0.95
RESAMPLES = 5000


def grouped(rows: Iterable[Mapping[str, Any]], names: Sequence[str]) -> dict[tuple[Any, ...], list[Mapping[str, Any]]]:
    """Return rows grouped by the values of some fields, in the order of first occurrence."""
    groups: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in names), []).append(row)
    return groups


def interval(values: FloatArray, statistic: Callable[..., Any]) -> tuple[float | None, float | None]:
    """Return the 95 % percentile bootstrap interval of a statistic of values (n,).

    A single seed has no interval: (None, None).
    """
    if len(values) < 2:
        return None, None
    result = stats.bootstrap(
        (values,), statistic, n_resamples=RESAMPLES, confidence_level=CONFIDENCE, method="percentile",
        vectorized=True, random_state=np.random.default_rng(0),
    )  # fmt: skip
    low, high = result.confidence_interval
    return float(low), float(high)


def differences(
    rows: Sequence[Mapping[str, Any]], names: Sequence[str], by: Sequence[str], field: str, base: Any = None
) -> list[Mapping[str, Any]]:
    """Return the differences of some metrics to the rows with one value of a field, as rows.

    Args:
        rows: Rows, one for each seed and combination of the fields `by`.
        names: Metrics; a difference is None if one of its values is.
        base: Value of the field in the other row, which agrees in the seed and the other fields; None: the first value.

    >>> rows = [{"policy": policy, "seed": 1, "m": m} for policy, m in (("a", 0.25), ("b", 1.0))]
    >>> differences(rows, ["m"], ["policy"], "policy")
    [{'policy': 'b', 'seed': 1, 'm': 0.75}]
    """
    first = rows[0][field] if base is None and rows else base
    found: list[Mapping[str, Any]] = []
    for group in grouped(rows, [*(name for name in by if name != field), "seed"]).values():
        for other in (row for row in group if row[field] == first):
            for row in (row for row in group if row is not other):
                pairs = {name: (row[name], other[name]) for name in names}
                found.append({**row} | {n: None if None in pair else pair[0] - pair[1] for n, pair in pairs.items()})
    return found
