"""Why maps were not merged: the attempts of each pair of groups, counted by what came of them."""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from slam_backend.alignment_types import REASONS
from slam_backend.reports import MergeEvent


@dataclass(frozen=True, slots=True, kw_only=True)
class PairAttempts:
    """The attempts of one pair of groups to align their maps.

    Attributes:
        robots_a: The one group, as it was then.
        robots_b: The other group.
        attempts: How many there were.
        refusals: Refused attempts by reason, one of `REASONS` each, in that order.
        last_reason: Reason of the last refusal; empty if there was none.
        last_step: Step of the last refusal; None if there was none.
        missed: Bound that the last refusal missed, see `Alignment.missed`.
        excess: Figure of that bound over the bound, see `Alignment.excess`.
    """

    robots_a: tuple[int, ...]
    robots_b: tuple[int, ...]
    attempts: int
    refusals: Mapping[str, int]
    last_reason: str
    last_step: int | None
    missed: str
    excess: float


def count_attempts(events: Iterable[MergeEvent]) -> tuple[PairAttempts, ...]:
    """Return what came of the attempts of each pair of groups, in order of their first attempts.

    Args:
        events: All events of a team, in order; merges and undos do not count.
    """
    tried: dict[tuple[tuple[int, ...], tuple[int, ...]], list[MergeEvent]] = {}
    for event in events:
        if event.kind == "attempt":
            tried.setdefault((event.robots_a, event.robots_b), []).append(event)
    return tuple(_of_pair(own) for own in tried.values())


def refusals_of(events: Iterable[MergeEvent], robot: int) -> dict[str, float]:
    """Return how many attempts a robot's groups made, and how many were refused for each reason.

    Args:
        events: All events of a team.
        robot: Index of the robot.

    Returns:
        `attempts`, and for each of `REASONS` a key such as `refused_too_uncertain`.
    """
    own = [event for event in events if event.kind == "attempt" and robot in event.robots_a + event.robots_b]
    counts = Counter(event.alignment.reason for event in own)
    named = {f"refused_{reason.replace(' ', '_')}": float(counts[reason]) for reason in REASONS}
    return {"attempts": float(len(own))} | named


def _of_pair(events: list[MergeEvent]) -> PairAttempts:
    """Return the attempts of one pair, at least one."""
    refused = [event for event in events if not event.alignment.success]
    counts = Counter(event.alignment.reason for event in refused)
    last = refused[-1] if refused else None
    return PairAttempts(
        robots_a=events[0].robots_a,
        robots_b=events[0].robots_b,
        attempts=len(events),
        refusals={reason: counts[reason] for reason in REASONS if counts[reason]},
        last_reason=last.alignment.reason if last else "",
        last_step=last.step if last else None,
        missed=last.alignment.missed if last else "",
        excess=last.alignment.excess if last else float("nan"),
    )
