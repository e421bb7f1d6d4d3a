"""Means over seeds with 95 % bootstrap intervals, differences on common seeds, and how they are shown."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy import stats

from slam_backend.core.validation import FloatArray
from training.experiments.tables import number

CONFIDENCE = 0.95
RESAMPLES = 5000


def grouped(rows: Iterable[Mapping[str, Any]], names: Sequence[str]) -> dict[tuple[Any, ...], list[Mapping[str, Any]]]:
    """Return rows by the values of some fields, in the order in which these first come."""
    groups: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in names), []).append(row)
    return groups


def interval(values: FloatArray, statistic: Callable[..., Any]) -> tuple[float | None, float | None]:
    """Return the 95 % percentile bootstrap interval of a statistic of values (n,).

    One seed tells nothing of the others: (None, None).
    """
    if len(values) < 2:
        return None, None
    result = stats.bootstrap(
        (values,), statistic, n_resamples=RESAMPLES, confidence_level=CONFIDENCE, method="percentile",
        vectorized=True, random_state=np.random.default_rng(0),
    )  # fmt: skip
    low, high = result.confidence_interval
    return float(low), float(high)


def mean_of(name: str, values: Sequence[float | None] | FloatArray) -> dict[str, float | None]:
    """Return the mean of a figure over seeds under its name, and with `_low` and `_high` the ends of its interval.

    Args:
        values: One for each seed; None where a seed has none. Without any, all three are None; of a single value the
            interval is not known.

    >>> mean_of("way", [3.0, None])
    {'way': 3.0, 'way_low': None, 'way_high': None}
    """
    known = np.array([value for value in values if value is not None], dtype=np.float64)
    if not len(known):
        return dict.fromkeys((name, f"{name}_low", f"{name}_high"))
    low, high = interval(known, np.mean)
    return {name: float(known.mean()), f"{name}_low": low, f"{name}_high": high}


def summarise_means(
    rows: Iterable[Mapping[str, Any]], by: Sequence[str], figures: Sequence[str]
) -> list[dict[str, Any]]:
    """Return a line for each group in the order in which these first come: `by`, `seeds`, and figures by `mean_of`."""
    lines = []
    for key, own in grouped(rows, by).items():
        line: dict[str, Any] = dict(zip(by, key, strict=True)) | {"seeds": len(own)}
        for figure in figures:
            line |= mean_of(figure, [row[figure] for row in own])
        lines.append(line)
    return lines


def ahead_by(own: Mapping[int, float], other: Mapping[int, float]) -> FloatArray:
    """Return by how much one is above the other (k,) on the seeds that both have, in the order of the seeds.

    >>> ahead_by({1: 0.5, 2: 3.0}, {0: 9.0, 1: 0.25}).tolist()
    [0.25]
    """
    return np.array([own[seed] - other[seed] for seed in sorted(own.keys() & other.keys())])


def shown(line: Mapping[str, Any], name: str, digits: int = 3, factor: float = 1.0, stacked: bool = False) -> str:
    """Show a mean with its interval, where that is known, and what is not known as a dash.

    Args:
        line: With what `mean_of` returned.
        stacked: The interval on a second line, for narrow columns.

    >>> shown({"way": 3.0, "way_low": 2.5, "way_high": 3.25}, "way", 2)
    '3.00 (2.50 .. 3.25)'
    """
    text, *ends = (number(line[f"{name}{end}"], digits, factor) for end in ("", "_low", "_high"))
    if line[f"{name}_low"] is None:
        return text
    return f"{text}\n{'..'.join(ends)}" if stacked else f"{text} ({' .. '.join(ends)})"
