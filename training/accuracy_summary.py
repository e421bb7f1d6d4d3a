"""Trials of many seeds in one line each: means and medians with bootstrap intervals, and the goals they are held to."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from slam_backend.errors import FloatArray

CONFIDENCE = 0.95
RESAMPLES = 5000
CONDITION = ("preset", "association", "robots", "length")
GROUP = (*CONDITION, "method", "particles")
FIGURES = (
    "pose_rms_m", "pose_aligned_rms_m", "heading_rms_deg", "map_rmse_m", "map_aligned_rmse_m", "map_recall",
    "map_precision", "confirmed_recall", "confirmed_precision", "nees_median", "nees_mean", "anees", "ess_share",
    "nis", "wrong_match_share", "held_back_share", "step_ms", "rejuvenation_ms",
    "refused_share",
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Goal:
    """One figure that must stay below a limit.

    Attributes:
        name: What is asked.
        condition: Fields of the trials it is about.
        figure: Which of their figures.
        statistic: Over the seeds.
        limit: It may at most be this.
        over: Fields of other trials, of the same seeds, whose statistic divides this one; None: it stands alone.
    """

    name: str
    condition: Mapping[str, Any]
    figure: str
    statistic: Callable[[FloatArray], Any]
    limit: float
    over: Mapping[str, Any] | None = None


def _at(preset: str, association: str, method: str = "fastslam2") -> dict[str, Any]:
    """Return the fields of single-robot trials of 100 m, filters with 100 particles."""
    return {
        "preset": preset, "association": association, "robots": 1, "length": 100.0, "method": method,
        "particles": 100 if method.startswith("fastslam") else 0,
    }  # fmt: skip


REJUVENATED = _at("good", "known", "fastslam2+rejuvenation")


GOALS = (
    Goal(name="good stereo, known: pose, mean [m]", condition=_at("good", "known"), figure="pose_rms_m",
         statistic=np.mean, limit=0.09),
    Goal(name="good stereo, known: map, mean [m]", condition=_at("good", "known"), figure="map_rmse_m",
         statistic=np.mean, limit=0.11),
    Goal(name="good stereo, known: map, half of that, a goal beyond [m]", condition=_at("good", "known"),
         figure="map_rmse_m", statistic=np.mean, limit=0.055),
    Goal(name="coarse stereo, known: pose, mean [m]", condition=_at("coarse", "known"), figure="pose_rms_m",
         statistic=np.mean, limit=0.14),
    *(
        Goal(name=f"{preset} stereo, known: {name} over fastslam1's", condition=_at(preset, "known"), figure=figure,
             statistic=np.mean, limit=0.75, over=_at(preset, "known", "fastslam1"))
        for preset in ("good", "coarse") for name, figure in (("pose", "pose_rms_m"), ("map", "map_rmse_m"))
    ),
    Goal(name="good stereo, unknown: pose, median [m]", condition=_at("good", "unknown"), figure="pose_rms_m",
         statistic=np.median, limit=0.15),
    Goal(name="good stereo, unknown: pose, worst seed [m]", condition=_at("good", "unknown"), figure="pose_rms_m",
         statistic=np.max, limit=1.0),
    Goal(name="good stereo, known, rejuvenated: map over batch ML's", condition=REJUVENATED, figure="map_rmse_m",
         statistic=np.mean, limit=1.3, over=_at("good", "known", "batch_ml")),
    Goal(name="good stereo, known, rejuvenated: pose over the ideal online estimate's", condition=REJUVENATED,
         figure="pose_rms_m", statistic=np.mean, limit=1.5, over=_at("good", "known", "ideal_online")),
    Goal(name="good stereo, known, rejuvenated: NEES, median", condition=REJUVENATED, figure="nees_median",
         statistic=np.median, limit=4.0),
    Goal(name="good stereo: pose, unknown over known, a goal beyond", condition=_at("good", "unknown"),
         figure="pose_rms_m", statistic=np.mean, limit=1.0, over=_at("good", "known")),
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
    groups: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in GROUP), []).append(row)
    lines = []
    for key, members in groups.items():
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
        found[f"{name}_low"], found[f"{name}_high"] = interval((values,), statistic)
    return found


def interval(samples: Sequence[FloatArray], statistic: Callable[..., Any]) -> tuple[float | None, float | None]:
    """Return the 95 % percentile bootstrap interval of a statistic of samples (n,) of the same seeds, drawn together.

    One seed tells nothing of the others: (None, None).
    """
    if len(samples[0]) < 2:
        return None, None
    result = stats.bootstrap(
        samples, statistic, n_resamples=RESAMPLES, confidence_level=CONFIDENCE, method="percentile",
        paired=len(samples) > 1, vectorized=True, random_state=np.random.default_rng(0),
    )  # fmt: skip
    low, high = result.confidence_interval
    return float(low), float(high)


def check_goals(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Hold the trials to the goals that they are about.

    Returns:
        Per goal with all its trials: `goal`, `limit`, `reached`, `low` and `high` of its interval, `seeds`, `met`.
    """
    found = []
    for goal in GOALS:
        own = _of_seeds(rows, goal.condition, goal.figure)
        seeds = sorted(own)
        if goal.over is not None:
            other = _of_seeds(rows, goal.over, goal.figure)
            seeds = sorted(own.keys() & other.keys())
        if not seeds:
            continue
        samples = [np.array([own[seed] for seed in seeds])]
        statistic = goal.statistic
        if goal.over is not None:
            samples.append(np.array([other[seed] for seed in seeds]))
            statistic = _ratio_of(goal.statistic)
        reached = float(statistic(*samples))
        low, high = (None, None) if goal.statistic is np.max else interval(samples, statistic)
        found.append(
            {"goal": goal.name, "limit": goal.limit, "reached": reached, "low": low, "high": high, "seeds": len(seeds),
             "met": reached <= goal.limit}
        )  # fmt: skip
    return found


def _ratio_of(statistic: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function that divides the statistic of one sample by that of another."""

    def ratio(a: FloatArray, b: FloatArray, axis: int = -1) -> Any:
        return statistic(a, axis=axis) / statistic(b, axis=axis)

    return ratio


def _of_seeds(rows: Sequence[Mapping[str, Any]], condition: Mapping[str, Any], figure: str) -> dict[int, float]:
    """Return a figure by seed of the trials with these fields."""
    return {
        row["seed"]: float(row[figure])
        for row in rows
        if all(row[name] == value for name, value in condition.items()) and row[figure] is not None
    }
