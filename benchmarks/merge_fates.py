"""What became of the merges of a run: how far off they were made and left, what they joined, whether they were undone.

Two things can be wrong with a merge. It may join landmarks that are not the same. And the motion between the groups'
start frames may be off, though all pairs are right, where a robot's own way from its start to what is joined is: that
was so before the merge, and is seen by it.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from slam_backend.core.validation import FloatArray
from slam_backend.fastslam.reports import MergeEvent
from slam_backend.geometry import between
from slam_backend.team.merge_monitor import deformed_fraction
from slam_backend.team.team import TeamSlam
from training.episodes.runner import is_false_merge
from vslam_env.evaluation.map_scores import FALSE, GroundTruthAssociation

WINDOW = 200  # [steps] after which a false merge counts


@dataclass(slots=True)
class MergeFate:
    """What became of a merge.

    Attributes:
        seed: Of its run.
        world: Family of worlds.
        alike: How much landmarks look alike.
        step: When it was made.
        robots_a, robots_b: Which groups.
        error_m, error_deg: Of its motion.
        bent_m, bent_deg: Of the motion by which the maps would have merged had they not been straightened; NaN if none.
        wrong_pairs: Share of the pairs it joined that are truly two landmarks; NaN if it was forced without pairs.
        undone_after: Steps until it was undone; None: it was not.
        ended_after: Steps until the run ended.
        later_m, later_deg: Of one group's frame in the other's as the team has it `WINDOW` steps later, or at the end
            of the run if that is earlier; NaN if undone by then.
        end_m, end_deg: The same at the end; NaN if undone.
        moved: Largest share of a side's landmarks that was seen out of place while the merge was watched; beyond
            `MergeOptions.max_deformed` it is undone. NaN if it was not watched.
        doubt: Doubt of the attempt that led to it, see `MergeEvent`; NaN if it was forced.
        undone_m, undone_deg: How far off the merge was, as the team had it, just before it was undone; NaN if it was
            not.
    """

    seed: int
    world: str
    alike: str
    step: int
    robots_a: tuple[int, ...]
    robots_b: tuple[int, ...]
    error_m: float
    error_deg: float
    bent_m: float
    bent_deg: float
    wrong_pairs: float
    undone_after: int | None
    ended_after: int
    later_m: float
    later_deg: float
    end_m: float
    end_deg: float
    moved: float = float("nan")
    doubt: float = float("nan")
    undone_m: float = float("nan")
    undone_deg: float = float("nan")

    @property
    def is_false(self) -> bool:
        """Whether its motion was plainly wrong."""
        return is_false_merge(self.error_m, self.error_deg)

    @property
    def is_rightly_undone(self) -> bool | None:
        """Whether it was off, when made or when undone, by what counts as false; None if it was not undone."""
        if self.undone_after is None:
            return None
        return self.is_false or is_false_merge(self.undone_m, self.undone_deg)

    @property
    def counts(self) -> bool:
        """Whether it was in force after the window, or at the end."""
        return self.undone_after is None or self.undone_after > WINDOW


@dataclass(slots=True)
class Delay:
    """An attempt whose maps aligned as they were, but not once they were straight, or not surely enough then.

    Attributes:
        seed: Of its run.
        step: When it was made.
        reason: Why it was refused.
        merged_after: Steps until the two groups' first robots shared a map; None: they never did.
    """

    seed: int
    step: int
    reason: str
    merged_after: int | None


@dataclass(slots=True)
class RunEnd:
    """How a run ended.

    Attributes:
        seed: Its seed.
        world: Family of worlds, or floor plan.
        groups: The robots that share a map at the end.
        last_merge: The step of the last merge that is in force; None without one.
        ate_m: RMS error of each robot's path after the best SE(2) fit, mean over the robots; NaN where not asked.
    """

    seed: int
    world: str
    groups: tuple[tuple[int, ...], ...]
    last_merge: int | None
    ate_m: float = float("nan")


Fates = tuple[list[MergeFate], list[Delay], RunEnd]


class Follower:
    """Follows the merges of a run, step by step.

    Args:
        team: That merges.
        ledger: Which true landmark each landmark of its maps is.
        starts: (K, 3) true start poses, world frame.

    Attributes:
        wrong_pairs: By number of the event the share of the pairs joined that are truly two landmarks.
        later: How far off each merge is [m, degrees], as the team has it at most `WINDOW` steps later.
        last: How far off each merge is [m, degrees], as the team had it last.
        moved: Largest share of a side's landmarks that was seen out of place while the merge was watched.
    """

    def __init__(self, team: TeamSlam, ledger: GroundTruthAssociation, starts: FloatArray) -> None:
        self._team, self._ledger, self._starts = team, ledger, starts
        self.wrong_pairs: dict[int, float] = {}
        self.later: dict[int, tuple[float, float]] = {}
        self.last: dict[int, tuple[float, float]] = {}
        self.moved: dict[int, float] = {}

    @property
    def groups(self) -> tuple[tuple[int, ...], ...]:
        """Of the team, as it is now."""
        return self._team.groups

    def note(self, step: int) -> None:
        """Look at the merges there are after a step."""
        if step % self._team._merging.watch_every == 0:
            self._weigh()
        for i, event in enumerate(self._team.events):
            if event.kind == "merge" and step - event.step <= WINDOW:
                if i not in self.wrong_pairs:
                    self.wrong_pairs[i] = self._share_of_wrong_pairs(event)
                if undone_in(self._team.events, event) is None:
                    self.later[i] = self.off_now(event)
            if event.kind == "merge" and undone_in(self._team.events, event) is None:
                self.last[i] = self.off_now(event)

    def _weigh(self) -> None:
        """Note which shares of the maps of watched merges are out of place."""
        numbers = {id(event.alignment): i for i, event in enumerate(self._team.events) if event.kind == "merge"}
        for group in self._team._groups:
            if not group.trunk.monitors:
                continue
            joint = group.trunk.filter.map("mixture")
            for watch in group.trunk.monitors:
                i = numbers[id(watch.alignment)]
                share = max(deformed_fraction(old, joint, self._team._alignment) for old in watch.pre_merge_maps)
                self.moved[i] = max(share, self.moved.get(i, 0.0))

    def off_now(self, merge: MergeEvent) -> tuple[float, float]:
        """Return by how much [m, degrees] one group's frame is off in the other's as their joint filter has it now."""
        trunk = self._team._group_of(merge.robots_a[0]).trunk
        robots = (group[0] for group in (merge.robots_a, merge.robots_b))
        starts = [trunk.filter.start_pose(trunk.robots.index(robot)) for robot in robots]
        return off_by(self._starts, merge, between(*starts))

    def _share_of_wrong_pairs(self, merge: MergeEvent) -> float:
        """Return it for a merge just made; false points are no landmarks, and a pair with one is wrong."""
        watches = (watch for group in self._team._groups for watch in group.trunk.monitors)
        sides = next(watch.sides for watch in watches if watch.alignment is merge.alignment)
        claims = []
        for side, joined, rows in zip(sides, self._team.merged_maps(merge), merge.alignment.inliers.T, strict=True):
            book = self._ledger._books[self._ledger._row_of[side.trunk["number"]]]
            claims.append(book[joined.ids[rows]])
        return float(np.mean((claims[0] != claims[1]) | (claims[0] == FALSE))) if len(claims[0]) else float("nan")


def off_by(starts: FloatArray, event: MergeEvent, motion: FloatArray) -> tuple[float, float]:
    """Return by how much [m, degrees] a motion between two groups' frames is wrong."""
    error = between(between(starts[event.robots_a[0]], starts[event.robots_b[0]]), motion)
    return float(np.hypot(*error[:2])), float(abs(np.degrees(error[2])))


def fates(
    events: Sequence[MergeEvent], starts: FloatArray, seed: int, world: str, alike: str, steps: int, follower: Follower
) -> Fates:
    """Return what became of the merges of a run that has ended after so many steps, and which came later.

    Args:
        events: Of the run.
        starts: (K, 3) true start poses, world frame.
        seed, world, alike: Of the run.
        steps: Of the run.
        follower: That was there in all of them.
    """
    found, nothing = [], (float("nan"), float("nan"))
    for i, event in enumerate(events):
        if event.kind == "merge":
            undone = undone_in(events, event)
            soon = undone is not None and undone - event.step <= WINDOW
            found.append(
                MergeFate(
                    seed, world, alike, event.step, event.robots_a, event.robots_b,
                    *off_by(starts, event, event.alignment.transform), *off_if_bent(starts, events[:i], event),
                    follower.wrong_pairs[i], None if undone is None else undone - event.step, steps - event.step,
                    *(nothing if soon else follower.later[i]),
                    *(nothing if undone is not None else follower.off_now(event)),
                    follower.moved.get(i, float("nan")), doubt_of(events[:i], event),
                    *(nothing if undone is None else follower.last[i]),
                )
            )  # fmt: skip
    kept = [e.step for e in events if e.kind == "merge" and undone_in(events, e) is None]
    return found, delays(events, seed), RunEnd(seed, world, follower.groups, max(kept, default=None))


def undone_in(events: Sequence[MergeEvent], merge: MergeEvent) -> int | None:
    """Return the step in which a merge was undone; None: it was not."""
    return next((e.step for e in events if e.kind == "undo" and e.alignment is merge.alignment), None)


def doubt_of(before: Sequence[MergeEvent], merge: MergeEvent) -> float:
    """Return the doubt of the attempt that led to a merge; NaN if it was forced."""
    return next((event.uncertainty for event in before if event.alignment is merge.alignment), float("nan"))


def off_if_bent(starts: FloatArray, before: Sequence[MergeEvent], merge: MergeEvent) -> tuple[float, float]:
    """Return by how much [m, degrees] the maps of a merge were off before they were straightened; NaN if they were not.

    Args:
        starts: As in `fates`.
        before: The events before the merge, the attempt that led to it among them.
        merge: The merge.
    """
    attempt = next((event for event in before if event.alignment is merge.alignment), None)
    nothing = float("nan"), float("nan")
    return (
        nothing
        if attempt is None or attempt.unsmoothed_alignment is None
        else off_by(starts, attempt, attempt.unsmoothed_alignment.transform)
    )


def delays(events: Sequence[MergeEvent], seed: int) -> list[Delay]:
    """Return the attempts of a run that were refused only because maps were straightened."""
    found = []
    for i, event in enumerate(events):
        if event.unsmoothed_alignment is not None and not event.alignment.success:
            pair = {event.robots_a[0], event.robots_b[0]}
            merged = (e.step for e in events[i:] if e.kind == "merge" and len(pair & {*e.robots_a, *e.robots_b}) == 2)
            later = next(merged, None)
            found.append(Delay(seed, event.step, event.alignment.reason, later and later - event.step))
    return found


def summarise(merges: list[MergeFate], late: list[Delay], ends: list[RunEnd], steps: int) -> dict[str, Any]:
    """Return the figures of all runs together."""
    whole = [end.last_merge for end in ends if len(end.groups) == 1 and end.last_merge is not None]
    false = [merge for merge in merges if merge.is_false]
    right = [merge for merge in merges if not merge.is_false]
    after = [merge.undone_after for merge in false if merge.undone_after is not None]
    return {
        "runs": len(ends),
        "runs_in_one_group": sum(len(end.groups) == 1 for end in ends),
        "last_merge_of_these_median": float(np.median(whole)) if whole else float("nan"),
        "ate_m_mean": mean(end.ate_m for end in ends),
        "steps": steps,
        "merges": len(merges),
        "right_merges": len(right),
        "right_merges_undone": sum(merge.undone_after is not None for merge in right),
        "wrongly_undone": sum(merge.is_rightly_undone is False for merge in merges),
        "false_merges": len(false),
        "false_merges_undone": len(after),
        "false_merges_in_force": sum(merge.counts for merge in false),
        "false_after_the_window": sum(is_false_merge(merge.later_m, merge.later_deg) for merge in merges),
        "false_at_the_end": sum(is_false_merge(merge.end_m, merge.end_deg) for merge in merges),
        "joined_wrong_pairs": sum(merge.wrong_pairs > 0.0 for merge in merges),
        "largest_share_of_wrong_pairs": max((merge.wrong_pairs for merge in merges), default=float("nan")),
        "steps_until_undone_median": float(np.median(after)) if after else float("nan"),
        "rms_error_m": rms(merge.error_m for merge in merges),
        "rms_error_after_the_window_m": rms(merge.later_m for merge in merges),
        "largest_error_m": max((merge.error_m for merge in merges), default=float("nan")),
        "false_had_they_been_bent": sum(is_false_merge(merge.bent_m, merge.bent_deg) for merge in merges),
        "rms_error_had_they_been_bent_m": rms(merge.bent_m for merge in merges),
        "largest_share_moved_in_right_merges": max(
            (m.moved for m in right if np.isfinite(m.moved)), default=float("nan")
        ),
        "refused_once_straight": len(late),
        "never_merged_after_that": sum(delay.merged_after is None for delay in late),
    }


def mean(values: Iterable[float]) -> float:
    """Return the mean of those that are not NaN; NaN if all are."""
    known = [value for value in values if np.isfinite(value)]
    return float(np.mean(known)) if known else float("nan")


def rms(values: Iterable[float]) -> float:
    """Return the root mean square of those that are not NaN; NaN if all are."""
    squares = np.square([value for value in values if np.isfinite(value)])
    return float(np.sqrt(squares.mean())) if len(squares) else float("nan")
