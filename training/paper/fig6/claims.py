"""Summary of Fig. 6, and checks of the paper's claims by 95 % intervals paired over seeds."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy import stats

from slam_backend.core.validation import FloatArray
from training.experiments.statistics import CONFIDENCE, grouped, mean_ci
from training.experiments.tables import csv_text
from training.paper.fig6.trials import BOUND, FIGURES

POINT = ("regime", "proposal", "robots", "particles")
TIMES = ("median_ms", "all_median_ms", "all_mean_ms", "measured")
LEAST = 1e-12  # [m, ms]; lower limit, because the logarithm of 0 is undefined

Rows = Iterable[Mapping[str, Any]]

ENOUGH = 100  # smallest number of particles for the paper's claims about robots
PAPER = {"regime": "paper", "proposal": "fastslam1"}
# Stronger than the paper's claim: the error of three robots relative to a single robot's, at M = 100.
LARGEST_SHARE, AT = 0.85, 100
# The paper has no rejuvenation. With good stereo its map error should be near that of batch maximum likelihood, which
# uses true associations and the whole run, and three robots that share the measurements should gain nearly as much: the
# ratio of their errors to a single robot's is at most this multiple of the same ratio for batch maximum likelihood.
REJUVENATED, NEAR_BOUND, NEAR_ITS_GAIN = "fastslam2+rejuvenation", 1.3, 1.15


def summarise(errors: Rows, times: Rows) -> list[dict[str, Any]]:
    """Return one line per regime, proposal, K and M, in the order of first occurrence.

    Args:
        times: Results of `play_time`, which belong to the paper's regime.

    Returns:
        The fields of `POINT`, `seeds`, `timed_seeds`, and the mean of each of `FIGURES` and `TIMES` over the seeds,
        with the ends of its 95 % bootstrap interval as `_low` and `_high`; None if unknown.
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
                line |= mean_ci(name, [row[name] for row in rows])
        lines.append(line)
    return lines


def to_csv(lines: Sequence[Mapping[str, Any]]) -> str:
    """Return the lines of `summarise` as CSV with a header; unknown values are empty, numbers have six digits."""
    figures = (f"{name}{end}" for name in (*FIGURES, *TIMES) for end in ("", "_low", "_high"))
    names = [*POINT, "seeds", "timed_seeds", *figures]
    return csv_text(names, ([line[name] for name in names] for line in lines))


def paired_ratio(above: Mapping[int, float], below: Mapping[int, float]) -> dict[str, Any]:
    """Return the geometric mean over seeds of `above / below`, with its 95 % interval by Student's t on the logarithms.

    Returns:
        `ratio`, `low`, `high` and `seeds`; None for values that need more seeds.

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
    """Return a metric of the error trials with the given fields, by seed."""
    return _by_seed(errors, point, lambda row: row[figure])


def time_by_seed(times: Rows, robots: int, particles: int) -> dict[int, float]:
    """Return the median time [ms] of the steps with all measurements for K robots and M particles, by seed."""
    return _by_seed(
        (row for row in times if robots in row["robots"]), {"particles": particles},
        lambda row: row["median_ms"][row["robots"].index(robots)],
    )  # fmt: skip


def _by_seed(rows: Rows, point: Mapping[str, Any], read: Callable[[Mapping[str, Any]], Any]) -> dict[int, float]:
    """Return values of the rows with the given fields, by seed, without unknown ones."""
    chosen = (row for row in rows if all(row[name] == value for name, value in point.items()))
    return {row["seed"]: float(value) for row in chosen if (value := read(row)) is not None}


def flat_within(particles: int) -> float:
    """Return the factor within which the step time counts as independent of K: 2, or 1.5 for M >= 1000.

    The same factors apply to the dependence on the number of landmarks. Without division of the measurements, three
    robots would take three times as long as one.
    """
    return 1.5 if particles >= 1000 else 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Claim:
    """Statement about a ratio."""

    claim: str  # Text of the claim
    ratio: float | None  # Geometric mean over seeds; None without data
    low: float | None  # Lower end of its 95 % interval, paired over seeds; None for a single seed
    high: float | None  # Upper end of the interval
    seeds: int  # Number of seeds
    above: float | None = None  # Limit below the interval; None: no such limit
    below: float | None = None  # Limit above the interval; None: no such limit
    ratio_at_most: float | None = None  # Maximum of the ratio itself; None: no such limit

    @property
    def holds(self) -> bool:
        """Whether the data show the claim; an inconclusive claim does not hold."""
        if self.ratio is None or self.low is None or self.high is None:
            return False
        return (
            (self.above is None or self.low > self.above)
            and (self.below is None or self.high < self.below)
            and (self.ratio_at_most is None or self.ratio <= self.ratio_at_most)
        )

    def to_mapping(self) -> dict[str, Any]:
        """Return the claim as plain values."""
        return asdict(self) | {"holds": self.holds}


def check_claims(errors: Sequence[Mapping[str, Any]], times: Sequence[Mapping[str, Any]]) -> list[Claim]:
    """Check the paper's claims on the trials of its regime, as far as there are any."""
    rows = [row for row in errors if all(row[name] == value for name, value in PAPER.items())]
    numbers = sorted({row["particles"] for row in rows})
    robots = sorted({row["robots"] for row in rows})
    claims = []
    for k in robots if len(numbers) > 1 else ():
        few, many = numbers[0], numbers[-1]
        found = paired_ratio(*(error_by_seed(rows, robots=k, particles=m) for m in (many, few)))
        claims.append(Claim(claim=f"map error, K={k}: M={many} below M={few}", below=1.0, **found))
    if len(robots) > 1:
        one, most = robots[0], robots[-1]
        for m in (m for m in numbers if m >= ENOUGH):
            found = paired_ratio(*(error_by_seed(rows, robots=k, particles=m) for k in (most, one)))
            limit = LARGEST_SHARE if m == AT else None
            name = f"map error, M={m}: K={most} below K={one}" + (f", at most {limit} of it" if limit else "")
            claims.append(Claim(claim=name, below=1.0, ratio_at_most=limit, **found))
    return claims + _rejuvenation_claims(errors) + _time_claims(times)


def _rejuvenation_claims(errors: Iterable[Mapping[str, Any]]) -> list[Claim]:
    """Return the claims about rejuvenated filters: against other filters, against the bound, and over robots."""
    good = [row for row in errors if row["regime"] == "good"]
    robots = sorted({row["robots"] for row in good if row["proposal"] == REJUVENATED and row["particles"] == AT})
    own, plain, bound = (
        {k: error_by_seed(good, robots=k, proposal=name, particles=m) for k in robots}
        for name, m in ((REJUVENATED, AT), ("fastslam2", AT), (BOUND, 0))
    )
    at, claims = f"good stereo, M={AT}", []
    for k in robots:
        found = paired_ratio(own[k], plain[k])
        claims.append(Claim(claim=f"{at}, K={k}: rejuvenated below fastslam2", below=1.0, **found))
    for k in robots:
        name = f"{at}, K={k}: rejuvenated at most {NEAR_BOUND} times batch ML"
        claims.append(Claim(claim=name, ratio_at_most=NEAR_BOUND, **paired_ratio(own[k], bound[k])))
    if len(robots) > 1:
        one, most = robots[0], robots[-1]
        name = f"{at}, rejuvenated: K={most} below K={one}"
        claims.append(Claim(claim=name, below=1.0, **paired_ratio(own[most], own[one])))
        found = paired_ratio(_product(own[most], bound[one]), _product(own[one], bound[most]))
        name = f"{at}, rejuvenated: K={most} over K={one} at most {NEAR_ITS_GAIN} times that of batch ML"
        claims.append(Claim(claim=name, below=NEAR_BOUND, ratio_at_most=NEAR_ITS_GAIN, **found))
    return claims


def _product(a: Mapping[int, float], b: Mapping[int, float]) -> dict[int, float]:
    """Return the products of two values with a common seed."""
    return {seed: a[seed] * b[seed] for seed in a.keys() & b.keys()}


def _time_claims(times: Sequence[Mapping[str, Any]]) -> list[Claim]:
    """Return the claims about the step time."""
    robots = sorted({k for row in times for k in row["robots"]})
    if len(robots) < 2:
        return []
    one, most = robots[0], robots[-1]
    claims = []
    for m in sorted({row["particles"] for row in times if row["particles"] >= ENOUGH}):
        found, factor = paired_ratio(*(time_by_seed(times, k, m) for k in (most, one))), flat_within(m)
        name = f"time, M={m}: K={most} and K={one} equal within a factor of {factor:g}"
        claims.append(Claim(claim=name, above=1.0 / factor, below=factor, **found))
    return claims


def robots_ratios(errors: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the ratio of map errors, largest over smallest number of robots, for each regime, proposal and M.

    Returns:
        Rows of `regime`, `proposal`, `particles`, `robots` (the two numbers, smallest first), `raw` and `aligned`, the
        last two as results of `paired_ratio`.
    """
    rows = list(errors)
    robots = sorted({row["robots"] for row in rows})
    if len(robots) < 2:
        return []
    lines = []
    for regime, proposal, m in dict.fromkeys((row["regime"], row["proposal"], row["particles"]) for row in rows):
        line: dict[str, Any] = {"regime": regime, "proposal": proposal, "particles": m}
        line["robots"] = [robots[0], robots[-1]]
        for name, figure in (("raw", "map_rmse_m"), ("aligned", "map_aligned_rmse_m")):
            line[name] = paired_ratio(*(
                error_by_seed(rows, figure, regime=regime, proposal=proposal, robots=k, particles=m)
                for k in (robots[-1], robots[0])
            ))  # fmt: skip
        lines.append(line)
    return lines
