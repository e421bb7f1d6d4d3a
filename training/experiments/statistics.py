"""Means over seeds with 95 % bootstrap intervals, paired differences, and their text format."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy import stats

from slam_backend.core.validation import FloatArray
from training.experiments.tables import number

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


def mean_ci(name: str, values: Sequence[float | None] | FloatArray) -> dict[str, float | None]:
    """Return the mean of a metric over seeds under its name, with the ends of its interval as `_low` and `_high`.

    Args:
        values: Value of each seed, None where a seed has no value. All three results are None without any value; the
            interval is None for a single value.

    >>> mean_ci("path", [3.0, None])
    {'path': 3.0, 'path_low': None, 'path_high': None}
    """
    known = np.array([value for value in values if value is not None], dtype=np.float64)
    if not len(known):
        return dict.fromkeys((name, f"{name}_low", f"{name}_high"))
    low, high = interval(known, np.mean)
    return {name: float(known.mean()), f"{name}_low": low, f"{name}_high": high}


def summarise_means(
    rows: Iterable[Mapping[str, Any]], by: Sequence[str], figures: Sequence[str]
) -> list[dict[str, Any]]:
    """Return one line for each group, in the order of first occurrence: `by`, `seeds`, and metrics by `mean_ci`."""
    lines = []
    for key, group in grouped(rows, by).items():
        line: dict[str, Any] = dict(zip(by, key, strict=True)) | {"seeds": len(group)}
        for figure in figures:
            line |= mean_ci(figure, [row[figure] for row in group])
        lines.append(line)
    return lines


def mean_curves(rows: Iterable[Mapping[str, Any]], by: Sequence[str], names: Sequence[str]) -> list[dict[str, Any]]:
    """Return one line for each group and time of its `curves`: `by`, `time_s`, and curves by `mean_ci`.

    Groups may have other times.
    """
    lines = []
    for key, group in grouped(rows, by).items():
        for point, when in enumerate(group[0]["curves"]["time_s"]):
            line: dict[str, Any] = dict(zip(by, key, strict=True)) | {"time_s": when}
            for name in names:
                line |= mean_ci(name, [row["curves"][name][point] for row in group])
            lines.append(line)
    return lines


def paired_difference(own: Mapping[int, float], other: Mapping[int, float]) -> FloatArray:
    """Return the differences (k,) between two sets of values on their common seeds, in the order of the seeds.

    >>> paired_difference({1: 0.5, 2: 3.0}, {0: 9.0, 1: 0.25}).tolist()
    [0.25]
    """
    return np.array([own[seed] - other[seed] for seed in sorted(own.keys() & other.keys())])


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


def format_ci(line: Mapping[str, Any], name: str, digits: int = 3, factor: float = 1.0, stacked: bool = False) -> str:
    """Format a mean with its interval, if known; unknown values give a dash.

    Args:
        line: Row with the result of `mean_ci`.
        stacked: Whether the interval is on a second line, for narrow columns.

    >>> format_ci({"path": 3.0, "path_low": 2.5, "path_high": 3.25}, "path", 2)
    '3.00 (2.50 .. 3.25)'
    """
    text, *ends = (number(line[f"{name}{end}"], digits, factor) for end in ("", "_low", "_high"))
    if line[f"{name}_low"] is None:
        return text
    return f"{text}\n{'..'.join(ends)}" if stacked else f"{text} ({' .. '.join(ends)})"
