"""Rewards as named, weighted terms of what a step changed."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from slam_backend.errors import FloatArray, bad_argument, check_float
from vslam_env.standing import Standing

__all__ = [
    "COSTS", "POTENTIALS", "TERMS", "RewardSpec", "RewardTerm", "Standing", "evaluate", "make_terms", "totals",
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

    def __call__(self, before: Standing, after: Standing) -> FloatArray:
        """Return what each robot gains (K,) by a step, unweighted. Neither standing may be written to."""


@dataclass(frozen=True, slots=True)
class _NamedTerm:
    name: str
    weight: float

    def __call__(self, before: Standing, after: Standing) -> FloatArray:
        return TERMS[self.name](before, after)


def _map_error(before: Standing, after: Standing) -> FloatArray:
    return before.map_errors - after.map_errors


def _map_error_squared(before: Standing, after: Standing) -> FloatArray:
    return before.map_errors**2 - after.map_errors**2


def _team_map_error(before: Standing, after: Standing) -> FloatArray:
    return np.full(len(after.map_errors), before.map_errors.mean() - after.map_errors.mean())


def _recall(before: Standing, after: Standing) -> FloatArray:
    return after.placed_recalls - before.placed_recalls


def _pose_uncertainty(before: Standing, after: Standing) -> FloatArray:
    return before.pose_sigmas - after.pose_sigmas


def _coverage(before: Standing, after: Standing) -> FloatArray:
    return np.full(len(after.map_errors), after.coverage - before.coverage)


def _own_coverage(before: Standing, after: Standing) -> FloatArray:
    return after.found - before.found


def _collisions(before: Standing, after: Standing) -> FloatArray:
    return (before.collisions - after.collisions).astype(np.float64)


def _distance(before: Standing, after: Standing) -> FloatArray:
    return before.distances - after.distances


def _time(before: Standing, after: Standing) -> FloatArray:
    return np.full(len(after.map_errors), before.time - after.time)


# Potentials telescope: what an episode pays in all is where it ends minus where it began, so that nothing is gained by
# going to and fro. Costs only ever fall.
POTENTIALS: dict[str, Callable[[Standing, Standing], FloatArray]] = {
    "map_error": _map_error,
    "map_error_squared": _map_error_squared,
    "team_map_error": _team_map_error,
    "recall": _recall,
    "pose_uncertainty": _pose_uncertainty,
    "coverage": _coverage,
    "own_coverage": _own_coverage,
}
COSTS: dict[str, Callable[[Standing, Standing], FloatArray]] = {
    "collisions": _collisions,
    "distance": _distance,
    "time": _time,
}
TERMS = POTENTIALS | COSTS

RewardSpec = Mapping[str, float] | list[RewardTerm] | tuple[RewardTerm, ...]


def make_terms(reward: RewardSpec) -> tuple[RewardTerm, ...]:
    """Turn names with weights, or ready-made terms, into terms.

    Raises:
        ValueError: If there is no term, a name is unknown, repeats or is no text, or an object is no term.
    """
    if isinstance(reward, (Mapping, list, tuple)) and not reward:
        raise bad_argument("reward", "at least one term", reward, "E.g. {'map_error': 1.0}.")
    if isinstance(reward, Mapping):
        for name in reward:
            if name not in TERMS:
                names = "one of " + ", ".join(repr(known) for known in TERMS)
                raise bad_argument("reward", names, name, "Choose one of these names, or pass a term of your own.")
        cure = "Give the weight of the term."
        return tuple(_NamedTerm(n, check_float(f"reward[{n!r}]", weight, cure)) for n, weight in reward.items())
    if not isinstance(reward, (list, tuple)):
        raise bad_argument("reward", "weights by name, or a list of terms", reward, "E.g. {'map_error': 1.0}.")
    for term in reward:
        if isinstance(term, type):
            raise bad_argument("reward", "terms, not their classes", term, f"Make one: {term.__name__}(...).")
        if not isinstance(term, RewardTerm):
            raise bad_argument("reward", "terms with name, weight and a call", term, "See vslam_env.reward.RewardTerm.")
        if not isinstance(term.name, str) or not term.name:
            raise bad_argument("reward", "terms whose name is a text", term.name, "Infos show it as reward/<name>.")
    names_used = [term.name for term in reward]
    if len(set(names_used)) < len(names_used):
        raise bad_argument("reward", "terms with different names", names_used, "Rename one of them.")
    return tuple(reward)


def evaluate(
    terms: Sequence[RewardTerm], before: Standing, after: Standing, shared: bool = False
) -> dict[str, list[float]]:
    """Return the weighted reward of each term for a step, by name, one for each of the K robots.

    Args:
        terms: What is paid for.
        before: The step.
        after: The step.
        shared: Each robot gets the mean over all robots, term by term.

    Raises:
        ValueError: If a term returns anything but one finite number for each robot.
    """
    robots = len(after.collisions)
    rewards = {}
    for term in terms:
        given = term(before, after)
        try:
            value = np.asarray(given, dtype=np.float64)
        except (TypeError, ValueError):  # no numbers at all
            value = np.array(np.nan)
        paid = value.tolist()
        if value.shape != (robots,) or not all(map(math.isfinite, paid)):
            raise bad_argument(
                f"reward term {term.name!r}", f"{robots} finite numbers", given, "Return one number for each robot."
            )
        weight = float(term.weight)
        if shared:
            paid = [float(value.mean())] * robots
        rewards[term.name] = [weight * each for each in paid]
    return rewards


def totals(rewards: Mapping[str, Sequence[float]]) -> list[float]:
    """Return the sum of all terms of `evaluate`, one at least, for each robot."""
    total, *others = rewards.values()
    for paid in others:
        total = [so_far + more for so_far, more in zip(total, paid, strict=True)]
    return list(total)
