"""Rewards as named, weighted terms of what a step changed.

Discount by at least 0.999 per tick of 0.1 s, which is 0.99 per second: `gamma ** decision_ticks` for a step. With less,
what comes after the first seconds barely counts, and looking around once pays nearly as much as exploring.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import repeat
from operator import add, mul, sub
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from slam_backend.core.validation import argument_error, check_array, check_float
from vslam_env.evaluation.team_metrics import RobotMetrics, TeamMetrics

__all__ = [
    "COSTS", "POTENTIALS", "RUNNING_COST", "TERMS", "RewardSpec", "RewardTerm", "TeamMetrics", "evaluate",
    "make_terms", "totals",
]  # fmt: skip


@runtime_checkable
class RewardTerm(Protocol):
    """One part of the reward. A term of your own is any object with these three."""

    @property
    def name(self) -> str:
        """Shown in infos as `reward/<name>`."""

    @property
    def weight(self) -> float:
        """What the term is multiplied with."""

    def __call__(self, before: TeamMetrics, after: TeamMetrics) -> ArrayLike:
        """Return what each robot gains (K,) by a step, unweighted. Neither standing may be written to."""


RewardFunction = Callable[[TeamMetrics, TeamMetrics], list[float]]


@dataclass(frozen=True, slots=True)
class _NamedTerm:
    name: str
    weight: float

    def __call__(self, before: TeamMetrics, after: TeamMetrics) -> list[float]:
        return TERMS[self.name](before, after)


def _rise_of(name: str) -> RewardFunction:
    """Return the gain that pays how much one of the figures has risen."""
    row = RobotMetrics._fields.index(name)
    return lambda before, after: list(map(sub, after.per_robot[row], before.per_robot[row]))


def _fall_of(name: str) -> RewardFunction:
    """Return the gain that pays how much one of the figures has fallen."""
    row = RobotMetrics._fields.index(name)
    return lambda before, after: list(map(sub, before.per_robot[row], after.per_robot[row]))


def _map_error_squared(before: TeamMetrics, after: TeamMetrics) -> list[float]:
    errors = zip(before.per_robot.map_errors, after.per_robot.map_errors, strict=True)
    return [then * then - now * now for then, now in errors]


def _team_map_error(before: TeamMetrics, after: TeamMetrics) -> list[float]:
    return _shared_by_all(float(before.map_errors.mean() - after.map_errors.mean()), after)


def _coverage(before: TeamMetrics, after: TeamMetrics) -> list[float]:
    return _shared_by_all(after.coverage - before.coverage, after)


def _collisions(before: TeamMetrics, after: TeamMetrics) -> list[float]:
    return list(map(float, map(sub, before.counts.collisions, after.counts.collisions)))


def _time(before: TeamMetrics, after: TeamMetrics) -> list[float]:
    return _shared_by_all(before.time - after.time, after)


def _shared_by_all(gain: float, after: TeamMetrics) -> list[float]:
    """Return what all robots gain alike, robot by robot."""
    return [gain] * len(after.per_robot.map_errors)


# Potentials telescope: what an episode pays in all is where it ends minus where it began, so that nothing is gained by
# going to and fro. Costs only ever fall.
POTENTIALS: dict[str, RewardFunction] = {
    "map_error": _fall_of("map_errors"),
    "map_error_squared": _map_error_squared,
    "team_map_error": _team_map_error,
    "recall": _rise_of("accurate_recalls"),
    "pose_uncertainty": _fall_of("pose_sigmas"),
    "coverage": _coverage,
    "own_coverage": _rise_of("found"),
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
    """Turn names with weights, or ready-made terms, into terms.

    Raises:
        ValueError: If there is no term, a name is unknown, repeats or is no text, or an object is no term.
    """
    if isinstance(reward, (Mapping, list, tuple)) and not reward:
        raise argument_error("reward", "at least one term", reward, "E.g. {'map_error': 1.0}.")
    if isinstance(reward, Mapping):
        for name in reward:
            if name not in TERMS:
                names = "one of " + ", ".join(repr(known) for known in TERMS)
                raise argument_error("reward", names, name, "Choose one of these names, or pass a term of your own.")
        cure = "Give the weight of the term."
        return tuple(_NamedTerm(n, check_float(f"reward[{n!r}]", weight, cure)) for n, weight in reward.items())
    if not isinstance(reward, (list, tuple)):
        raise argument_error("reward", "weights by name, or a list of terms", reward, "E.g. {'map_error': 1.0}.")
    for term in reward:
        if isinstance(term, type):
            raise argument_error("reward", "terms, not their classes", term, f"Make one: {term.__name__}(...).")
        if not isinstance(term, RewardTerm):
            raise argument_error(
                "reward", "terms with name, weight and a call", term, "See vslam_env.reward.RewardTerm."
            )
        if not isinstance(term.name, str) or not term.name:
            raise argument_error("reward", "terms whose name is a text", term.name, "Infos show it as reward/<name>.")
    names_used = [term.name for term in reward]
    if len(set(names_used)) < len(names_used):
        raise argument_error("reward", "terms with different names", names_used, "Rename one of them.")
    return tuple(reward)


def is_named(term: RewardTerm) -> bool:
    """Tell whether a term is one of the package's, which its name and weight describe."""
    return isinstance(term, _NamedTerm)


def evaluate(
    terms: Sequence[RewardTerm], before: TeamMetrics, after: TeamMetrics, shared: bool = False
) -> dict[str, list[float]]:
    """Return the weighted reward of each term for a step, by name, one for each of the K robots.

    Args:
        terms: What is paid for.
        before: The step.
        after: The step.
        shared: Each robot gets the mean over all robots, term by term.

    Raises:
        ValueError: If a term of one's own returns anything but one finite number for each robot.
    """
    rewards = {}
    for term in terms:
        paid = term(before, after) if isinstance(term, _NamedTerm) else _own(term, before, after)
        if shared:
            paid = _shared_by_all(float(np.mean(paid)), after)
        rewards[term.name] = list(map(mul, repeat(float(term.weight)), paid))
    return rewards


def _own(term: RewardTerm, before: TeamMetrics, after: TeamMetrics) -> list[float]:
    """Return what a term of one's own pays for a step, or raise unless that is a finite number for each robot."""
    given = term(before, after)
    paid, robots = _floats(given), len(after.per_robot.map_errors)
    if len(paid) != robots or not all(map(math.isfinite, paid)):
        cure = "Return one number for each robot."
        raise argument_error(f"reward term {term.name!r}", f"{robots} finite numbers", given, cure)
    return paid


def _floats(given: Any) -> list[float]:
    """Return what a term of one's own gave as a list; an empty one if it is no row of finite numbers."""
    try:
        row: list[float] = check_array("reward", given, (None,), "Return one number for each robot.").tolist()
    except ValueError:
        return []
    return row


def totals(rewards: Mapping[str, Sequence[float]]) -> list[float]:
    """Return the sum of all terms of `evaluate`, one at least, for each robot."""
    total, *others = rewards.values()
    for paid in others:
        total = list(map(add, total, paid))
    return list(total)
