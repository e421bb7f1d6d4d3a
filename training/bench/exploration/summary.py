"""Trials of `vslam bench exploration` summed up: means, paired differences, curves."""

from collections.abc import Mapping, Sequence
from typing import Any

from training.bench.exploration.bench import NO_ORACLE
from training.bench.exploration.trials import CURVES, TEAM
from training.experiments.statistics import ahead_by, grouped, mean_of

Rows = Sequence[Mapping[str, Any]]
PLACE = ("world", "robots", "oracle")
CONDITION = (*PLACE, "policy")
FIGURES = (
    "coverage", "mean_coverage", "below_90_s", "reached_90", *TEAM, "pose_error", "way_m", "right_merges",
    "false_merges", "undone_merges", "first_merge_s", "last_merge_s", "one_group", "attempts", "collisions",
    "invalid_actions", "decision_ms",
)  # fmt: skip
# What policies are compared by, and whether more of it is better.
COMPARED = {
    "mean_coverage": True, "below_90_s": False, "map_error": False, "map_rmse_m": False, "pose_error": False,
}  # fmt: skip


def summarise(rows: Rows) -> list[dict[str, Any]]:
    """Return a line for each of `CONDITION`, in the order in which they first come: its seeds and means.

    Of each figure the mean over the seeds that have it, and with `_low` and `_high` its 95 % bootstrap interval. Where
    90 % of the floor are not always reached, the mean of `below_90_s` is a restricted one: of the time spent below.
    """
    lines = []
    for key, own in grouped(rows, CONDITION).items():
        line: dict[str, Any] = dict(zip(CONDITION, key, strict=True)) | {"seeds": len(own)}
        for figure in FIGURES:
            line |= mean_of(figure, [row[figure] for row in own])
        lines.append(line)
    return lines


def compare_policies(rows: Rows) -> list[dict[str, Any]]:
    """Return how each policy differs from the first, in each place and by each figure, on common seeds.

    Fields: those of `PLACE`, `policy`, `than`, `figure`, `seeds`, `more` with `more_low` and `more_high` (95 %,
    bootstrap over the seeds), `better`: the share of seeds in which the policy is the better one.
    """
    found = []
    for key, own in grouped(rows, PLACE).items():
        by_policy = grouped(own, ("policy",))
        (first,), *others = by_policy
        for (policy,) in others:
            told = dict(zip(PLACE, key, strict=True)) | {"policy": policy, "than": first}
            found += _differences(told, by_policy[policy,], by_policy[first,])
    return found


def compare_oracles(rows: Rows) -> list[dict[str, Any]]:
    """Return how each policy with an oracle differs from itself without, in the same form; `than` is `"none"`."""
    found = []
    for (world, robots, policy), own in grouped(rows, ("world", "robots", "policy")).items():
        by_oracle = grouped(own, ("oracle",))
        for (oracle,) in by_oracle:
            if oracle != NO_ORACLE and (NO_ORACLE,) in by_oracle:
                told = {"world": world, "robots": robots, "oracle": oracle, "policy": policy, "than": NO_ORACLE}
                found += _differences(told, by_oracle[oracle,], by_oracle[NO_ORACLE,])
    return found


def curves(rows: Rows) -> list[dict[str, Any]]:
    """Return a row for each of `CONDITION` and time: means of `CURVES` over seeds, with intervals.

    Policies that decide at other times may have other times.
    """
    found = []
    for key, own in grouped(rows, CONDITION).items():
        for point, when in enumerate(own[0]["curves"]["time_s"]):
            line: dict[str, Any] = dict(zip(CONDITION, key, strict=True)) | {"time_s": when}
            for name in CURVES:
                line |= mean_of(name, [row["curves"][name][point] for row in own])
            found.append(line)
    return found


def _differences(told: Mapping[str, Any], own: Rows, other: Rows) -> list[dict[str, Any]]:
    """Return a line for each of `COMPARED` that both have on common seeds."""
    found = []
    for figure, more_is_better in COMPARED.items():
        more = ahead_by(_by_seed(own, figure), _by_seed(other, figure))
        if len(more):
            better = float(((more > 0.0) if more_is_better else (more < 0.0)).mean())
            line = dict(told) | {"figure": figure, "seeds": len(more)} | mean_of("more", more) | {"better": better}
            found.append(line)
    return found


def _by_seed(rows: Rows, figure: str) -> dict[int, float]:
    """Return a figure by seed, of the trials that have it."""
    return {row["seed"]: row[figure] for row in rows if row[figure] is not None}
