"""Checks of the paper's claims on Fig. 6, by 95 % intervals paired over seeds."""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy import stats

from slam_backend.core.validation import FloatArray
from training.experiments.statistics import CONFIDENCE
from training.experiments.study import Claim, Estimate, Row
from training.paper.fig6.trials import BOUND

LEAST = 1e-12  # [m, ms]; lower limit, because the logarithm of 0 is undefined

Rows = Sequence[Row]

ENOUGH = 100  # smallest number of particles for the paper's claims about robots
PAPER = {"regime": "paper", "proposal": "fastslam1"}
# Stronger than the paper's claim: the error of three robots relative to a single robot's, at M = 100.
LARGEST_SHARE, AT = 0.85, 100
# The paper has no rejuvenation. With good stereo its map error should be near that of batch maximum likelihood, which
# uses true associations and the whole run, and three robots that share the measurements should gain nearly as much: the
# ratio of their errors to a single robot's is at most this multiple of the same ratio for batch maximum likelihood.
REJUVENATED, NEAR_BOUND, NEAR_ITS_GAIN = "fastslam2+rejuvenation", 1.3, 1.15


def paired_ratio(above: Mapping[int, float], below: Mapping[int, float]) -> Estimate:
    """Return the geometric mean over seeds of `above / below`, with its 95 % interval by Student's t on the logarithms.

    It is None without common seeds; a single one has no interval.

    >>> paired_ratio({0: 2.0, 1: 8.0, 2: 5.0}, {0: 1.0, 1: 2.0}).value
    2.82842712474619
    """
    seeds = sorted(above.keys() & below.keys())
    if not seeds:
        return Estimate(None)
    logs: FloatArray = np.log([max(above[s], LEAST) for s in seeds]) - np.log([max(below[s], LEAST) for s in seeds])
    centre = float(logs.mean())
    if len(seeds) == 1:
        return Estimate(float(np.exp(centre)))
    half = float(stats.t.ppf(0.5 * (1.0 + CONFIDENCE), len(seeds) - 1) * logs.std(ddof=1) / np.sqrt(len(seeds)))
    return Estimate(*(float(np.exp(centre + side * half)) for side in (0.0, -1.0, 1.0)))


def by_seed(rows: Rows, name: str = "map_rmse_m", **point: object) -> dict[int, float]:
    """Return a metric of the rows with the given fields, by seed, without unknown values."""
    chosen = (row for row in rows if all(row[field] == value for field, value in point.items()))
    return {row["seed"]: float(row[name]) for row in chosen if row.get(name) is not None}


def over_robots(name: str, rows: Rows) -> Estimate:
    """Return the ratio of a metric of the rows of one filter: largest over smallest number of robots."""
    robots = [row["robots"] for row in rows]
    if min(robots) == max(robots):
        return Estimate(None)
    return paired_ratio(*(by_seed(rows, name, robots=k) for k in (max(robots), min(robots))))


def flat_within(particles: int) -> float:
    """Return the factor within which the step time counts as independent of K: 2, or 1.5 for M >= 1000.

    The same factors apply to the dependence on the number of landmarks. Without division of the measurements, three
    robots would take three times as long as one.
    """
    return 1.5 if particles >= 1000 else 2.0


def claim(
    text: str, ratio: Estimate, above: float | None = None, below: float | None = None, at_most: float | None = None
) -> Claim:
    """Return a claim about a ratio; an inconclusive one does not hold.

    Args:
        above, below: Limits of its interval; None: no such limit.
        at_most: Maximum of the ratio itself; None: no such limit.
    """
    limits = {"above": above, "below": below, "at most": at_most}
    holds = (
        ratio.low is not None and ratio.high is not None
        and (above is None or ratio.low > above)
        and (below is None or ratio.high < below)
        and (at_most is None or ratio.value <= at_most)
    )  # fmt: skip
    words = ", ".join(f"{name} {limit:g}" for name, limit in limits.items() if limit is not None)
    return Claim(text, ratio, words, holds)


def check_claims(rows: Rows) -> list[Claim]:
    """Check the paper's claims on the rows of all trials, as far as there are any."""
    own = [row for row in rows if all(row[name] == value for name, value in PAPER.items())]
    errors = [row for row in own if row.get("map_rmse_m") is not None]
    numbers = sorted({row["particles"] for row in errors})
    robots = sorted({row["robots"] for row in errors})
    claims = []
    for k in robots if len(numbers) > 1 else ():
        few, many = numbers[0], numbers[-1]
        found = paired_ratio(*(by_seed(errors, robots=k, particles=m) for m in (many, few)))
        claims.append(claim(f"map error, K={k}: M={many} below M={few}", found, below=1.0))
    if len(robots) > 1:
        one, most = robots[0], robots[-1]
        for m in (m for m in numbers if m >= ENOUGH):
            found = paired_ratio(*(by_seed(errors, robots=k, particles=m) for k in (most, one)))
            limit = LARGEST_SHARE if m == AT else None
            claims.append(claim(f"map error, M={m}: K={most} below K={one}", found, below=1.0, at_most=limit))
    return claims + _rejuvenation_claims(rows) + _time_claims(own)


def _rejuvenation_claims(rows: Rows) -> list[Claim]:
    """Return the claims about rejuvenated filters: against other filters, against the bound, and over robots."""
    good = [row for row in rows if row["regime"] == "good"]
    robots = sorted({row["robots"] for row in good if row["proposal"] == REJUVENATED and row["particles"] == AT})
    own, plain, bound = (
        {k: by_seed(good, robots=k, proposal=name, particles=m) for k in robots}
        for name, m in ((REJUVENATED, AT), ("fastslam2", AT), (BOUND, 0))
    )
    at, claims = f"good stereo, M={AT}", []
    for k in robots:
        claims.append(claim(f"{at}, K={k}: rejuvenated below fastslam2", paired_ratio(own[k], plain[k]), below=1.0))
    for k in robots:
        name = f"{at}, K={k}: rejuvenated near batch ML"
        claims.append(claim(name, paired_ratio(own[k], bound[k]), at_most=NEAR_BOUND))
    if len(robots) > 1:
        one, most = robots[0], robots[-1]
        name = f"{at}, rejuvenated: K={most} below K={one}"
        claims.append(claim(name, paired_ratio(own[most], own[one]), below=1.0))
        found = paired_ratio(_product(own[most], bound[one]), _product(own[one], bound[most]))
        name = f"{at}, rejuvenated: K={most} over K={one}, over that of batch ML"
        claims.append(claim(name, found, below=NEAR_BOUND, at_most=NEAR_ITS_GAIN))
    return claims


def _product(a: Mapping[int, float], b: Mapping[int, float]) -> dict[int, float]:
    """Return the products of two values with a common seed."""
    return {seed: a[seed] * b[seed] for seed in a.keys() & b.keys()}


def _time_claims(rows: Rows) -> list[Claim]:
    """Return the claims about the step time."""
    timed = [row for row in rows if row.get("median_ms") is not None]
    robots = sorted({row["robots"] for row in timed})
    claims = []
    for m in sorted({row["particles"] for row in timed if row["particles"] >= ENOUGH}) if len(robots) > 1 else ():
        own, factor = [row for row in timed if row["particles"] == m], flat_within(m)
        name = f"time, M={m}: K={robots[-1]} over K={robots[0]}"
        claims.append(claim(name, over_robots("median_ms", own), above=1.0 / factor, below=factor))
    return claims
