"""Scheduler of merge attempts: alignment is expensive, and a retry on the same evidence fails again."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import MOST, argument_error, check_int, known_names
from slam_backend.maps.alignment import AlignmentOptions
from slam_backend.maps.correspondences import candidates, too_many
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.state import (
    MAX_LANDMARKS,
    Dict,
    Each,
    Float,
    Int,
    Options,
    Record,
    Row,
    State,
)

PairKey = tuple[tuple[int, ...], tuple[int, ...]]  # two groups, as tuples of robots
LANDMARK, ROBOT = Int(0, MAX_LANDMARKS), Int(high="K")
ROBOTS = Each(ROBOT)
PAIR = Row(ROBOTS, ROBOTS)
MIN_LOG_GROWTH = 0.125  # least share of new entries in the logs before they are smoothed again for the same pair
MIN_IMPROVEMENT = 0.7  # waiting helps if the uncertainty falls below this share of its last value


@short_repr
@known_names
@dataclass(frozen=True, slots=True, kw_only=True)
class AttemptOptions:
    """Schedule of alignment attempts.

    Attributes:
        every: Steps between attempts; one pair tries at a time.
        new_candidates: Least number of new candidate matches for another attempt of a refused pair, unless the last one
            is more than `longest_wait` steps ago: by then the same landmarks are known better. A pair whose maps
            aligned, but not after smoothing, needs no new ones.
        longest_wait: Longest wait after a refusal [steps]. It is `every` or, after smoothing of the logs, until an
            eighth of them is new.
        enabled: Whether any pair tries at all.
    """

    every: int = 25
    new_candidates: int = 3
    longest_wait: int = 200
    enabled: bool = True

    def __post_init__(self) -> None:
        for name in ("every", "new_candidates", "longest_wait"):
            check_int(f"attempts.{name}", getattr(self, name), 1, "Give a number of at least 1.", MOST)
        if not isinstance(self.enabled, bool):
            raise argument_error("attempts.enabled", "True or False", self.enabled, "Give a bool.")


@dataclass(frozen=True, slots=True)
class AttemptRecord:
    """Past attempts of one pair of groups.

    Attributes:
        last_step: Step of the last attempt.
        next_step: Step from which the pair may try again.
        tried: Candidate matches of the last attempt, by landmark ids.
    """

    STATE = State(last_step=Int(), next_step=Int(), tried=Each(Row(LANDMARK, LANDMARK), kind=frozenset))
    last_step: int
    next_step: int
    tried: frozenset[tuple[int, int]]


class MergeScheduler:
    """Scheduler of attempts, with a memory of past ones.

    Args:
        options: Options of the schedule.
        alignment: Options of alignments, with the gate of candidate matches and the least number of inliers.
    """

    STATE = State(
        options=Options(AttemptOptions), alignment=Options(AlignmentOptions),
        records=Dict(PAIR, Record(AttemptRecord)), blocks=Each(Row(PAIR, Int()), kind=list),
        uncertainties=Dict(Row(ROBOT, ROBOT), Float(0.0, math.inf)),
    )  # fmt: skip

    def __init__(self, options: AttemptOptions, alignment: AlignmentOptions) -> None:
        self._options = options
        self.alignment = alignment
        self._records: dict[PairKey, AttemptRecord] = {}
        self._proposed: dict[PairKey, set[tuple[int, int]]] = {}
        self._blocks: list[tuple[PairKey, int]] = []  # blocked pairs, and the step when the block ends
        self._uncertainties: dict[tuple[int, int], float] = {}  # least uncertainty by robots of both sides

    def is_due(self, step: int) -> bool:
        """Return whether a pair may try at this step."""
        options = self._options
        return options.enabled and step % options.every == options.every - 1

    def may_try(self, pair: PairKey, step: int) -> bool:
        """Return whether the pair's wait is over, and no block applies."""
        if any(step < until and _touches(pair, blocked) for blocked, until in self._blocks):
            return False
        return pair not in self._records or step >= self._records[pair].next_step

    def choose(self, maps: Mapping[PairKey, tuple[LandmarkMap, LandmarkMap]], step: int) -> PairKey | None:
        """Return the pair with the most new candidate matches, if it has enough for an attempt; the first of equals."""
        best: PairKey | None = None
        most = 0
        self._proposed = {}
        for pair, (map_a, map_b) in maps.items():
            if not len(map_a) or not len(map_b):
                continue  # an empty map has no descriptor length yet
            if too_many(map_a, map_b, self.alignment):
                continue
            rows = candidates(map_a, map_b, self.alignment)[0]
            if len(rows) < self.alignment.min_inliers:
                continue
            matches = set(zip(map_a.ids[rows[:, 0]].tolist(), map_b.ids[rows[:, 1]].tolist(), strict=True))
            record = self._records.get(pair)
            stale = record is None or step - record.last_step > self._options.longest_wait
            new = len(matches if record is None or stale else matches - record.tried)
            if new >= self._options.new_candidates and new > most:
                best, most = pair, new
                self._proposed = {pair: matches}
        return best

    def should_defer(self, pair: PairKey, uncertainty: float) -> bool:
        """Return whether a pair whose maps align should try again later, and record its uncertainty.

        It should while the uncertainty falls substantially from one attempt to the next. If it does not fall, the paths
        between the starts and the common landmarks will stay as uncertain for long: only the joint map can make them
        known, and the particles of the merge represent the uncertainty.

        Args:
            pair: Groups of the attempt; earlier uncertainties count for any of their robots.
            uncertainty: Relative uncertainty of the motion between the maps; up to 1 there is no need to wait [-].
        """
        robots = [(a, b) for a in pair[0] for b in pair[1]]
        before = min(self._uncertainties.get(key, math.inf) for key in robots)
        self._uncertainties |= {key: min(uncertainty, self._uncertainties.get(key, math.inf)) for key in robots}
        return 1.0 < uncertainty < MIN_IMPROVEMENT * before

    def record(self, pair: PairKey, step: int, success: bool, smoothed: bool = False) -> None:
        """Record an attempt of the pair that `choose` returned: its candidate matches, and its next wait.

        Args:
            pair: Groups of the attempt.
            step: Step of the attempt.
            success: Whether the groups merge.
            smoothed: Whether the logs were smoothed for the attempt, as the candidates fitted; the next attempt then
                needs no new ones, but waits until an eighth of the logs is new.
        """
        if success:
            gone = set(pair[0]) | set(pair[1])
            self._records = {key: value for key, value in self._records.items() if not gone & set(key[0] + key[1])}
            return
        options = self._options
        tried = frozenset() if smoothed else frozenset(self._proposed.get(pair, ()))
        growth = min(math.ceil(MIN_LOG_GROWTH * step), options.longest_wait) if smoothed else 0
        self._records[pair] = AttemptRecord(step, step + max(options.every, growth), tried)

    def block(self, pair: PairKey, until: int) -> None:
        """Block all pairs of groups with a robot of each side of a pair before a step."""
        self._blocks = [*(block for block in self._blocks if block[0] != pair), (pair, until)]


def _touches(pair: PairKey, blocked: PairKey) -> bool:
    """Return whether a pair has robots of both sides of a blocked pair, one side in each group."""
    one, other = set(pair[0]), set(pair[1])
    return any(one & set(a) and other & set(b) for a, b in (blocked, blocked[::-1]))
