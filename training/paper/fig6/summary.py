"""The trials of Fig. 6 summed up: one line per point of the figure, and ratios paired over seeds."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy import stats

from slam_backend.core.validation import FloatArray
from training.experiments.statistics import CONFIDENCE, grouped, mean_of
from training.experiments.tables import csv_text
from training.paper.fig6.trials import FIGURES

POINT = ("regime", "proposal", "robots", "particles")
TIMES = ("median_ms", "all_median_ms", "all_mean_ms", "measured")
LEAST = 1e-12  # [m, ms]; the logarithm of 0 is none

Rows = Iterable[Mapping[str, Any]]


def summarise(errors: Rows, times: Rows) -> list[dict[str, Any]]:
    """Return one line per regime, proposal, K and M, in the order in which they first come.

    Args:
        errors: As `play_error` returns them.
        times: As `play_time` returns them; they belong to the paper's regime.

    Returns:
        The fields of `POINT`, `seeds`, `timed_seeds`, and for each of `FIGURES` and `TIMES` its mean over the seeds,
        with `_low` and `_high` appended the ends of its 95 % bootstrap interval; None where it is not known.
    """
    groups = grouped(errors, POINT)
    clocked: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for row in times:
        for i, robots in enumerate(row["robots"]):
            point = ("paper", "fastslam1", robots, row["particles"])
            clocked.setdefault(point, []).append({name: row[name][i] for name in TIMES})
    lines = []
    for point in dict.fromkeys([*groups, *clocked]):
        own, timed = groups.get(point, []), clocked.get(point, [])
        line = dict(zip(POINT, point, strict=True)) | {"seeds": len(own), "timed_seeds": len(timed)}
        for names, rows in ((FIGURES, own), (TIMES, timed)):
            for name in names:
                line |= mean_of(name, [row[name] for row in rows])
        lines.append(line)
    return lines


def to_csv(lines: Sequence[Mapping[str, Any]]) -> str:
    """Return the lines of `summarise` as CSV with a heading; what is not known is empty, numbers have six digits."""
    figures = (f"{name}{end}" for name in (*FIGURES, *TIMES) for end in ("", "_low", "_high"))
    names = [*POINT, "seeds", "timed_seeds", *figures]
    return csv_text(names, ([line[name] for name in names] for line in lines))


def paired_ratio(above: Mapping[int, float], below: Mapping[int, float]) -> dict[str, Any]:
    """Return the geometric mean over seeds of `above / below`, with its 95 % interval by Student's t on the logarithms.

    Args:
        above: By seed a positive value.
        below: Likewise; only seeds that both have count.

    Returns:
        `ratio`, `low`, `high` and `seeds`; None for what so few seeds do not tell.

    >>> paired_ratio({0: 2.0, 1: 8.0, 2: 5.0}, {0: 1.0, 1: 2.0})["ratio"]
    2.82842712474619
    """
    seeds = sorted(above.keys() & below.keys())
    if not seeds:
        return {"ratio": None, "low": None, "high": None, "seeds": 0}
    logs: FloatArray = np.log([max(above[s], LEAST) for s in seeds]) - np.log([max(below[s], LEAST) for s in seeds])
    centre, low, high = float(logs.mean()), None, None
    if len(seeds) > 1:
        half = float(stats.t.ppf(0.5 * (1.0 + CONFIDENCE), len(seeds) - 1) * logs.std(ddof=1) / np.sqrt(len(seeds)))
        low, high = float(np.exp(centre - half)), float(np.exp(centre + half))
    return {"ratio": float(np.exp(centre)), "low": low, "high": high, "seeds": len(seeds)}


def error_by_seed(errors: Rows, figure: str = "map_rmse_m", **point: Any) -> dict[int, float]:
    """Return a figure by seed of the error trials with these fields."""
    return _by_seed(errors, point, lambda row: row[figure])


def time_by_seed(times: Rows, robots: int, particles: int) -> dict[int, float]:
    """Return by seed the median time [ms] of the steps with all measurements, for K robots and M particles."""
    return _by_seed(
        (row for row in times if robots in row["robots"]), {"particles": particles},
        lambda row: row["median_ms"][row["robots"].index(robots)],
    )  # fmt: skip


def _by_seed(rows: Rows, point: Mapping[str, Any], read: Callable[[Mapping[str, Any]], Any]) -> dict[int, float]:
    """Return what is read from the rows with these fields, by seed; what is not known is left out."""
    chosen = (row for row in rows if all(row[name] == value for name, value in point.items()))
    return {row["seed"]: float(value) for row in chosen if (value := read(row)) is not None}
