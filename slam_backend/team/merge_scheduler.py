"""Which pair of groups tries to align its maps, and when: alignment is dear, and the same evidence fails twice."""

import copy
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from slam_backend.core.read_only import as_constant, with_constants
from slam_backend.core.validation import MOST, FloatArray, argument_error, check_int, known_names
from slam_backend.geometry import wrap_angle
from slam_backend.maps.alignment import (
    DISTINCT_ROTATION,
    DISTINCT_TRANSLATION,
    Alignment,
    AlignmentOptions,
    candidate_matches,
)
from slam_backend.maps.correspondences import too_many
from slam_backend.maps.landmark_map import LandmarkMap

PairKey = tuple[tuple[int, ...], tuple[int, ...]]  # two groups, as tuples of robots
MIN_LOG_GROWTH = 0.125  # of all that was read has to be new before logs are smoothed once more for the same pair
MIN_IMPROVEMENT = 0.7  # waiting has helped where no more of a doubt is left


@known_names
@dataclass(frozen=True, slots=True, kw_only=True)
class AttemptOptions:
    """When groups try to align their maps.

    Attributes:
        every: At most one pair tries in so many steps.
        new_candidates: A refused pair tries again only when so many of its candidate matches are new, or the last
            attempt is more than `longest_wait` steps ago: by then the same landmarks are known better. If its maps did
            align, and were refused only when they were straight, it needs no new ones.
        longest_wait: After each refusal a pair waits twice as long as before, at most so many steps; or longer, after
            one for which logs were smoothed (`MergeScheduler.record`).
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


@dataclass(slots=True)
class AttemptRecord:
    """What one pair of groups has tried."""

    wait: int
    last_step: int = 0
    next_step: int = 0
    tried: set[tuple[int, int]] = field(default_factory=set)  # candidate matches of the last attempt, by landmark ids


@dataclass(frozen=True, slots=True, eq=False)
class PendingAttempt:
    """An attempt whose maps fit as the filters bent them, and which goes on when these have straightened them.

    Attributes:
        pair: That tries.
        numbers: Of both joint filters' maps: with others it does not go on.
        alignment: How the maps fit.
        since: Step in which it began.
        ready: Whether both maps are straight; it goes on one step later.
    """

    pair: PairKey
    numbers: tuple[int, int]
    alignment: Alignment
    since: int
    ready: bool = False


class MergeScheduler:
    """The memory of past attempts.

    Args:
        options: The rhythm.
        alignment: What makes a candidate match, and how many an alignment needs.

    Attributes:
        straightening: The attempt that goes on; None: none does.
    """

    def __init__(self, options: AttemptOptions, alignment: AlignmentOptions) -> None:
        self._options = options
        self._alignment = alignment
        self._records: dict[PairKey, AttemptRecord] = {}
        self._proposed: dict[PairKey, set[tuple[int, int]]] = {}
        self._bars: list[tuple[PairKey, int]] = []
        self._uncertainties: dict[tuple[int, int], float] = {}  # robot of either side -> the least that there has been
        self._trials: dict[tuple[int, int], FloatArray] = {}  # robots whose starts are the frames -> the last motion
        self.straightening: PendingAttempt | None = None

    def is_due(self, step: int) -> bool:
        """Tell whether a pair may try at this step, or an attempt goes on."""
        options = self._options
        return self.straightening is not None or (options.enabled and step % options.every == options.every - 1)

    def may_try(self, pair: PairKey, step: int) -> bool:
        """Tell whether the pair's wait is over, and nothing bars it."""
        if any(step < until and _touches(pair, barred) for barred, until in self._bars):
            return False
        return pair not in self._records or step >= self._records[pair].next_step

    def choose(self, maps: Mapping[PairKey, tuple[LandmarkMap, LandmarkMap]], step: int) -> PairKey | None:
        """Return the pair with the most new candidate matches, if it has enough for an attempt; the first of equals."""
        best: PairKey | None = None
        most = 0
        self._proposed = {}
        for pair, (map_a, map_b) in maps.items():
            if not len(map_a) or not len(map_b):
                continue  # before its first landmark a map does not know how long descriptors are
            if too_many(map_a, map_b, self._alignment):
                continue
            rows = candidate_matches(map_a, map_b, self._alignment)
            if len(rows) < self._alignment.min_inliers:
                continue
            found = set(zip(map_a.ids[rows[:, 0]].tolist(), map_b.ids[rows[:, 1]].tolist(), strict=True))
            record = self._records.get(pair)
            stale = record is None or step - record.last_step > self._options.longest_wait
            new = len(found if record is None or stale else found - record.tried)
            if new >= self._options.new_candidates and new > most:
                best, most = pair, new
                self._proposed = {pair: found}
        return best

    def should_defer(self, pair: PairKey, doubt: float, most: float = math.inf) -> bool:
        """Tell whether a pair whose maps align had better try again later, and remember its doubt.

        It had at first, as long as the doubt falls by a good part from one attempt to the next, and while the doubt is
        beyond what can be taken at all. Where it does not fall, the ways of the robots to what they have in common are
        as uncertain as they will be for long, and the particles of the merge know it.

        Args:
            pair: That tries; what either group's robots went through before they were in it counts.
            doubt: How uncertain the motion between its maps is, 1 = just sure enough [-].
            most: Doubt beyond which no pair merges, whether waiting helps or not [-].
        """
        robots = [(a, b) for a in pair[0] for b in pair[1]]
        before = min(self._uncertainties.get(key, math.inf) for key in robots)
        self._uncertainties |= {key: min(doubt, self._uncertainties.get(key, math.inf)) for key in robots}
        return doubt > 1.0 and (doubt > most or doubt < MIN_IMPROVEMENT * before)

    def change(self, pair: PairKey, motion: FloatArray) -> float:
        """Return by how much the last trial of two groups was another motion, and remember this one.

        Args:
            pair: That tries.
            motion: (3,) [m, m, rad] between the frames of the two groups, as their joint filter has it on trial.

        Returns:
            The shift over 0.25 m or the turn over 2.5 degrees, whichever is more; infinite if there was no trial of
            these frames.
        """
        frames = pair[0][0], pair[1][0]
        before = self._trials.get(frames)
        self._trials[frames] = as_constant(motion)
        if before is None:
            return math.inf
        x, y, turn = (motion - before).tolist()
        return max(
            math.hypot(x, y) / (0.5 * DISTINCT_TRANSLATION), abs(float(wrap_angle(turn))) / (0.5 * DISTINCT_ROTATION)
        )

    def record(self, pair: PairKey, step: int, success: bool, straightened: bool = False) -> None:
        """Remember an attempt of the pair that `choose` returned: its evidence, and how long it now waits.

        Args:
            pair: Which tried.
            step: When.
            success: Whether it merges.
            straightened: Whether its logs were smoothed, because its candidates did fit: they need no new ones then to
                try again. But smoothing may cost in proportion to all that was read, so that a refused pair waits until
                an eighth of that is new: however long it goes on, it costs a multiple of it.
        """
        if success:
            gone = set(pair[0]) | set(pair[1])
            self._records = {key: value for key, value in self._records.items() if not gone & set(key[0] + key[1])}
            return
        record = self._records.setdefault(pair, AttemptRecord(self._options.every))
        record.tried = set() if straightened else self._proposed.get(pair, set())
        record.last_step = step
        record.next_step = step + max(record.wait, math.ceil(MIN_LOG_GROWTH * step) if straightened else 0)
        record.wait = min(2 * record.wait, self._options.longest_wait)

    def block(self, pair: PairKey, until: int) -> None:
        """Keep a pair, and every pair of groups that robots of either side belong to, from trying before this step."""
        self._bars = [*(bar for bar in self._bars if bar[0] != pair), (pair, until)]

    def get_state(self) -> dict[str, Any]:
        """Return the options and a copy of the memory; arrays are read-only."""
        memory: dict[str, Any] = {"records": copy.deepcopy(self._records), "bars": tuple(self._bars)}
        memory |= {"uncertainties": dict(self._uncertainties), "trials": dict(self._trials)}
        fixed = {"options": self._options, "alignment": self._alignment, "straightening": self.straightening}
        return fixed | memory

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Take over options and a memory that `get_state` returned."""
        self._options, self._alignment = state["options"], state["alignment"]
        self.straightening = state["straightening"]
        self._records = copy.deepcopy(state["records"])
        self._bars = list(state["bars"])
        self._uncertainties, self._trials = dict(state["uncertainties"]), dict(with_constants(state["trials"]))


def _touches(pair: PairKey, barred: PairKey) -> bool:
    """Tell whether one group of a pair has robots of the one barred side, and the other of the other."""
    one, other = set(pair[0]), set(pair[1])
    return any(one & set(a) and other & set(b) for a, b in (barred, barred[::-1]))
