"""Trials of Fig. 6 summed up, and what the paper says of it, asked of the data by 95 % intervals paired over seeds."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy import stats

from slam_backend.core.validation import FloatArray
from training.experiments.statistics import CONFIDENCE, grouped, mean_of
from training.experiments.tables import csv_text
from training.paper.fig6.trials import BOUND, FIGURES

POINT = ("regime", "proposal", "robots", "particles")
TIMES = ("median_ms", "all_median_ms", "all_mean_ms", "measured")
LEAST = 1e-12  # [m, ms]; the logarithm of 0 is none

Rows = Iterable[Mapping[str, Any]]

ENOUGH = 100  # particles from which on the paper's claims about robots are asked
PAPER = {"regime": "paper", "proposal": "fastslam1"}
# Beyond what the paper says: with three robots the error is at most this share of a single robot's, at M = 100.
LARGEST_SHARE, AT = 0.85, 100
# Nor does the paper know of rejuvenation. Under good stereo a map is then nearly that of batch maximum likelihood, to
# which names and the whole run are known, and three robots that share the measurements gain nearly what can be had: the
# share of the error that is left is at most so many times the share that is left with batch maximum likelihood.
REJUVENATED, NEAR_BOUND, NEAR_ITS_GAIN = "fastslam2+rejuvenation", 1.3, 1.15


def summarise(errors: Rows, times: Rows) -> list[dict[str, Any]]:
    """Return one line per regime, proposal, K and M, in the order in which they first come.

    Args:
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


def flat_within(particles: int) -> float:
    """Return within what factor the time per step may depend on K and still be called flat: 2, from M = 1000 on 1.5.

    These are the factors within which the time is to be flat in the number of landmarks too. Without the division of
    the measurements, three robots would cost three times as much as one.
    """
    return 1.5 if particles >= 1000 else 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Claim:
    """One statement about a ratio."""

    claim: str  # In words
    ratio: float | None  # Geometric mean over seeds; None without data
    low: float | None  # Lower end of its 95 % interval, paired over seeds; None for a single seed
    high: float | None  # Its upper end
    seeds: int  # How many
    above: float | None = None  # What the interval's lower end must be above; None: no such limit
    below: float | None = None  # What the interval's upper end must be below; None: no such limit
    ratio_at_most: float | None = None  # What the ratio itself may not be above; None: no such limit

    @property
    def holds(self) -> bool:
        """Whether the data show it; what they leave open does not hold."""
        if self.ratio is None or self.low is None or self.high is None:
            return False
        return (
            (self.above is None or self.low > self.above)
            and (self.below is None or self.high < self.below)
            and (self.ratio_at_most is None or self.ratio <= self.ratio_at_most)
        )

    def to_mapping(self) -> dict[str, Any]:
        """Return it as plain values."""
        return asdict(self) | {"holds": self.holds}


def check_claims(errors: Sequence[Mapping[str, Any]], times: Sequence[Mapping[str, Any]]) -> list[Claim]:
    """Ask the paper's claims of the trials in its regime, as far as there are any."""
    own = [row for row in errors if all(row[name] == value for name, value in PAPER.items())]
    numbers = sorted({row["particles"] for row in own})
    robots = sorted({row["robots"] for row in own})
    claims = []
    for k in robots if len(numbers) > 1 else ():
        few, many = numbers[0], numbers[-1]
        found = paired_ratio(*(error_by_seed(own, robots=k, particles=m) for m in (many, few)))
        claims.append(Claim(claim=f"map error, K={k}: M={many} below M={few}", below=1.0, **found))
    if len(robots) > 1:
        one, most = robots[0], robots[-1]
        for m in (m for m in numbers if m >= ENOUGH):
            found = paired_ratio(*(error_by_seed(own, robots=k, particles=m) for k in (most, one)))
            limit = LARGEST_SHARE if m == AT else None
            name = f"map error, M={m}: K={most} below K={one}" + (f", at most {limit} of it" if limit else "")
            claims.append(Claim(claim=name, below=1.0, ratio_at_most=limit, **found))
    return claims + _rejuvenation_claims(errors) + _time_claims(times)


def _rejuvenation_claims(errors: Iterable[Mapping[str, Any]]) -> list[Claim]:
    """Return the claims about the map of rejuvenated filters: over others', over the bound, and over robots."""
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
    """Return the products of what both have for a seed."""
    return {seed: a[seed] * b[seed] for seed in a.keys() & b.keys()}


def _time_claims(times: Sequence[Mapping[str, Any]]) -> list[Claim]:
    """Return the claims about the time per step."""
    robots = sorted({k for row in times for k in row["robots"]})
    if len(robots) < 2:
        return []
    one, most = robots[0], robots[-1]
    claims = []
    for m in sorted({row["particles"] for row in times if row["particles"] >= ENOUGH}):
        found, factor = paired_ratio(*(time_by_seed(times, k, m) for k in (most, one))), flat_within(m)
        name = f"time, M={m}: K={most} and K={one} alike, within a factor of {factor:g}"
        claims.append(Claim(claim=name, above=1.0 / factor, below=factor, **found))
    return claims


def robots_ratios(errors: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return, for each regime, proposal and M, the map error of most robots over that of fewest, as it is and aligned.

    Returns:
        Rows of `regime`, `proposal`, `particles`, `robots` (the two numbers, fewest first), `raw` and `aligned`, the
        last two as `paired_ratio` gives them.
    """
    rows = list(errors)
    robots = sorted({row["robots"] for row in rows})
    if len(robots) < 2:
        return []
    found = []
    for regime, proposal, m in dict.fromkeys((row["regime"], row["proposal"], row["particles"]) for row in rows):
        line: dict[str, Any] = {"regime": regime, "proposal": proposal, "particles": m}
        line["robots"] = [robots[0], robots[-1]]
        for name, figure in (("raw", "map_rmse_m"), ("aligned", "map_aligned_rmse_m")):
            line[name] = paired_ratio(*(
                error_by_seed(rows, figure, regime=regime, proposal=proposal, robots=k, particles=m)
                for k in (robots[-1], robots[0])
            ))  # fmt: skip
        found.append(line)
    return found
