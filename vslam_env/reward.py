"""Rewards as named, weighted terms computed from the team metrics before and after a step.

Learners should discount by at least 0.999 per tick of 0.1 s (0.99 per second): `gamma ** decision_ticks` per step. A
lower discount ignores all but the first seconds, so that turning once on the spot pays nearly as much as exploring.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import repeat
from operator import add, attrgetter, mul, sub
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from slam_backend.core.validation import argument_error, check_array, check_float, choice_error
from vslam_env.evaluation.information import information
from vslam_env.evaluation.team_metrics import TeamMetrics

__all__ = [
    "COSTS", "POTENTIALS", "RUNNING_COST", "TERMS", "RewardSpec", "RewardTerm", "TeamMetrics", "evaluate",
    "make_terms", "totals",
]  # fmt: skip


@runtime_checkable
class RewardTerm(Protocol):
    """One part of the reward; a custom term is any object with these three members.

    With an attribute `reads_beliefs = True` its metrics contain the beliefs of the robots, `TeamMetrics.beliefs`.
    """

    @property
    def name(self) -> str:
        """Name of the term, shown in infos as `reward/<name>`."""

    @property
    def weight(self) -> float:
        """Factor of the term."""

    def __call__(self, before: TeamMetrics, after: TeamMetrics) -> ArrayLike:
        """Return the unweighted reward (K,) of a step for each robot; the metrics are read-only."""


RewardFunction = Callable[[TeamMetrics, TeamMetrics], list[float]]


@dataclass(frozen=True, slots=True)
class _NamedTerm:
    name: str
    weight: float

    @property
    def reads_beliefs(self) -> bool:
        return self.name in READS_BELIEFS

    def __call__(self, before: TeamMetrics, after: TeamMetrics) -> list[float]:
        return TERMS[self.name](before, after)


def _rise_of(name: str) -> RewardFunction:
    """Return a reward function: the increase of a metric."""
    row = attrgetter(name)
    return lambda before, after: list(map(sub, row(after.per_robot), row(before.per_robot)))


def _fall_of(name: str) -> RewardFunction:
    """Return a reward function: the decrease of a metric."""
    row = attrgetter(name)
    return lambda before, after: list(map(sub, row(before.per_robot), row(after.per_robot)))


def _map_error_squared(before: TeamMetrics, after: TeamMetrics) -> list[float]:
    errors = zip(before.per_robot.map_errors, after.per_robot.map_errors, strict=True)
    return [old * old - new * new for old, new in errors]


def _team_map_error(before: TeamMetrics, after: TeamMetrics) -> list[float]:
    return _shared_by_all(float(before.map_errors.mean() - after.map_errors.mean()), after)


def _coverage(before: TeamMetrics, after: TeamMetrics) -> list[float]:
    return _shared_by_all(after.coverage - before.coverage, after)


def _information(before: TeamMetrics, after: TeamMetrics) -> list[float]:
    return list(map(sub, map(information, after.beliefs), map(information, before.beliefs)))


def _collisions(before: TeamMetrics, after: TeamMetrics) -> list[float]:
    return list(map(float, map(sub, before.counts.collisions, after.counts.collisions)))


def _time(before: TeamMetrics, after: TeamMetrics) -> list[float]:
    return _shared_by_all(before.time - after.time, after)


def _shared_by_all(reward: float, after: TeamMetrics) -> list[float]:
    """Return the same reward for each robot."""
    return [reward] * len(after.per_robot.map_errors)


# Potentials telescope: their sum over an episode is what the value has improved between its first and last step, so
# that oscillation gains nothing. Costs are never positive.
COVERAGE, OWN_COVERAGE, OWN_RECALL, INFORMATION = "coverage", "own_coverage", "own_recall", "information"
READS_BELIEFS = frozenset({INFORMATION})  # built-in terms whose metrics contain beliefs, which takes time
READS_COVERAGE = frozenset({COVERAGE, OWN_COVERAGE})  # built-in terms whose metrics have the coverage of every step
POTENTIALS: dict[str, RewardFunction] = {
    "map_error": _fall_of("map_errors"),
    "map_error_squared": _map_error_squared,
    "team_map_error": _team_map_error,
    "recall": _rise_of("accurate_recalls"),
    "pose_uncertainty": _fall_of("pose_sigmas"),
    COVERAGE: _coverage,
    OWN_COVERAGE: _rise_of("discovered"),
    OWN_RECALL: _rise_of("own_recalls"),
    INFORMATION: _information,
}
RUNNING_COST = "running_cost"
COSTS: dict[str, RewardFunction] = {
    "collisions": _collisions,
    "distance": _fall_of("distances"),
    "time": _time,
    RUNNING_COST: _fall_of("error_integrals"),
}
TERMS = POTENTIALS | COSTS

RewardSpec = Mapping[str, float] | list[RewardTerm] | tuple[RewardTerm, ...]


def make_terms(reward: RewardSpec) -> tuple[RewardTerm, ...]:
    """Return the terms for weights by name, or validate a list of terms.

    Raises:
        ValueError: If there is no term, a name is unknown, repeated or not a string, or an object is not a term.
    """
    if isinstance(reward, (Mapping, list, tuple)) and not reward:
        raise argument_error("reward", "at least one term", reward, "For example {'map_error': 1.0}.")
    if isinstance(reward, Mapping):
        for name in reward:
            if name not in TERMS:
                raise choice_error("reward", name, TERMS, "Choose one of these names, or pass a custom term.")
        hint = "Give the weight of the term."
        return tuple(_NamedTerm(n, check_float(f"reward[{n!r}]", weight, hint)) for n, weight in reward.items())
    if not isinstance(reward, (list, tuple)):
        raise argument_error("reward", "weights by name, or a list of terms", reward, "For example {'map_error': 1.0}.")
    for term in reward:
        if isinstance(term, type):
            raise argument_error("reward", "terms, not classes", term, f"Pass an instance: {term.__name__}(...).")
        if not isinstance(term, RewardTerm):
            raise argument_error(
                "reward", "terms with name, weight and __call__", term, "See vslam_env.reward.RewardTerm."
            )
        if not isinstance(term.name, str) or not term.name:
            raise argument_error("reward", "terms whose name is a string", term.name, "Infos show it as reward/<name>.")
    names_used = [term.name for term in reward]
    if len(set(names_used)) < len(names_used):
        raise argument_error("reward", "terms with different names", names_used, "Rename one of them.")
    return tuple(reward)


def is_named(term: RewardTerm) -> bool:
    """Return whether a term is a built-in one, defined by its name and weight."""
    return isinstance(term, _NamedTerm)


def reads_beliefs(term: RewardTerm) -> bool:
    """Return whether a term reads `TeamMetrics.beliefs`."""
    return bool(getattr(term, "reads_beliefs", False))


def reads_coverage(term: RewardTerm) -> bool:
    """Return whether a term may read the coverage of every step; all custom terms may."""
    return not is_named(term) or term.name in READS_COVERAGE


def evaluate(
    terms: Sequence[RewardTerm], before: TeamMetrics, after: TeamMetrics, shared: bool = False
) -> dict[str, list[float]]:
    """Return the weighted rewards of a step by name of the term, each with one value per robot.

    Args:
        terms: Terms of the reward.
        before: Metrics before the step.
        after: Metrics after the step.
        shared: Whether each robot gets the mean over all robots, term by term.

    Raises:
        ValueError: If a custom term returns anything but one finite number for each robot.
    """
    rewards = {}
    for term in terms:
        values = term(before, after) if isinstance(term, _NamedTerm) else _own(term, before, after)
        if shared:
            values = _shared_by_all(float(np.mean(values)), after)
        rewards[term.name] = list(map(mul, repeat(float(term.weight)), values))
    return rewards


def _own(term: RewardTerm, before: TeamMetrics, after: TeamMetrics) -> list[float]:
    """Return the rewards of a custom term, or raise unless they are one finite number for each robot."""
    result = term(before, after)
    values, robots = _floats(result), len(after.per_robot.map_errors)
    if len(values) != robots or not all(map(math.isfinite, values)):
        hint = "Return one number for each robot."
        raise argument_error(f"reward term {term.name!r}", f"{robots} finite numbers", result, hint)
    return values


def _floats(values: Any) -> list[float]:
    """Return the result of a custom term as a list; empty if it is not a row of finite numbers."""
    try:
        row: list[float] = check_array("reward", values, (None,), "Return one number for each robot.").tolist()
    except ValueError:
        return []
    return row


def totals(rewards: Mapping[str, Sequence[float]]) -> list[float]:
    """Return the sum of the rewards of `evaluate`, at least one term, for each robot."""
    total, *others = rewards.values()
    for values in others:
        total = list(map(add, total, values))
    return list(total)
