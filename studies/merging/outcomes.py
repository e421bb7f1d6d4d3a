"""Outcomes of the merges of a run: errors at the merge and later, wrong pairs, and undoing.

A merge can be wrong in two ways. Its pairs may not be the same landmarks. And the transform between the groups' start
frames may have an error although all pairs are right, if the path from a start to the shared landmarks has an error:
this error exists before the merge, which reveals it.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from slam_backend.core.validation import FloatArray
from slam_backend.geometry import between
from slam_backend.team.merge_monitor import deformed_fraction
from slam_backend.team.reports import MergeEvent
from slam_backend.team.team import TeamSlam
from training.episodes.runner import is_false_merge
from vslam_env.evaluation.map_scores import FALSE, GroundTruthAssociation

WINDOW = 200  # steps after which a false merge counts


@dataclass(slots=True)
class MergeOutcome:
    """Outcome of a merge.

    Attributes:
        seed: Seed of the run.
        world: World family.
        alike: Description of the similarity of landmarks.
        step: Step of the merge.
        robots_a, robots_b: Robots of the two groups.
        error_m, error_deg: Error of the transform of the merge.
        bent_m, bent_deg: Error of the transform from the unsmoothed maps; NaN if there is none.
        wrong_pairs: Share of the merged pairs that are two landmarks in truth; NaN for a forced merge without pairs.
        undone_after: Steps until the merge was undone; None: it was not.
        ended_after: Steps until the end of the run.
        later_m, later_deg: Error of the transform between the groups' frames, as estimated by the team `WINDOW` steps
            later, or at the end of the run if earlier; NaN if undone by then.
        end_m, end_deg: Error of the same transform at the end; NaN if undone.
        moved: Largest share of a side's landmarks that was out of place while the merge was monitored; above
            `MergeOptions.max_deformed` the merge is undone. NaN if it was not monitored.
        doubt: Uncertainty of the attempt that led to the merge, see `MergeEvent`; NaN for a forced merge.
        undone_m, undone_deg: Error of the merge, as estimated by the team, just before it was undone; NaN if it was
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
        """Whether the error of the transform exceeds the thresholds of a false merge."""
        return is_false_merge(self.error_m, self.error_deg)

    @property
    def is_rightly_undone(self) -> bool | None:
        """Whether the error at the merge or at its undo exceeded the thresholds; None if it was not undone."""
        if self.undone_after is None:
            return None
        return self.is_false or is_false_merge(self.undone_m, self.undone_deg)

    @property
    def counts(self) -> bool:
        """Whether the merge persisted for the window, or until the end."""
        return self.undone_after is None or self.undone_after > WINDOW


@dataclass(slots=True)
class Delay:
    """Attempt with an alignment of the unsmoothed maps, but not of the smoothed ones, or with too large uncertainty.

    Attributes:
        seed: Seed of the run.
        step: Step of the attempt.
        reason: Reason of the refusal.
        merged_after: Steps until the two groups' first robots shared a map; None: never.
    """

    seed: int
    step: int
    reason: str
    merged_after: int | None


@dataclass(slots=True)
class RunEnd:
    """State at the end of a run.

    Attributes:
        seed: Seed of the run.
        world: World family, or floor plan.
        groups: Robots that share a map at the end.
        last_merge: Step of the last merge that was not undone; None without one.
        ate_m: RMS error of each robot's path after the best SE(2) fit, mean over the robots; NaN if not computed.
    """

    seed: int
    world: str
    groups: tuple[tuple[int, ...], ...]
    last_merge: int | None
    ate_m: float = float("nan")


RunOutcomes = tuple[list[MergeOutcome], list[Delay], RunEnd]


class Follower:
    """Observer of the merges of a run, step by step.

    Args:
        team: Team whose merges are observed.
        ground_truth: True landmark of each landmark in the maps.
        starts: (K, 3) true start poses, world frame.

    Attributes:
        wrong_pairs: Share of merged pairs that are two landmarks in truth, by number of the event.
        later: Error of each merge [m, degrees], as estimated by the team at most `WINDOW` steps later.
        last: Latest error of each merge [m, degrees], as estimated by the team.
        moved: Largest share of a side's landmarks that was out of place while the merge was monitored.
    """

    def __init__(self, team: TeamSlam, ground_truth: GroundTruthAssociation, starts: FloatArray) -> None:
        self._team, self._ground_truth, self._starts = team, ground_truth, starts
        self.wrong_pairs: dict[int, float] = {}
        self.later: dict[int, tuple[float, float]] = {}
        self.last: dict[int, tuple[float, float]] = {}
        self.moved: dict[int, float] = {}

    @property
    def groups(self) -> tuple[tuple[int, ...], ...]:
        """Current groups of the team."""
        return self._team.groups

    def note(self, step: int) -> None:
        """Update the records after a step."""
        if step % self._team._merges.merging.watch_every == 0:
            self._weigh()
        for i, event in enumerate(self._team.events):
            if event.kind == "merge" and step - event.step <= WINDOW:
                if i not in self.wrong_pairs:
                    self.wrong_pairs[i] = self._share_of_wrong_pairs(event)
                if undone_in(self._team.events, event) is None:
                    self.later[i] = self.current_error(event)
            if event.kind == "merge" and undone_in(self._team.events, event) is None:
                self.last[i] = self.current_error(event)

    def _weigh(self) -> None:
        """Record the shares of landmarks out of place in the maps of monitored merges."""
        of_event = {id(event.alignment): i for i, event in enumerate(self._team.events) if event.kind == "merge"}
        options = self._team._merges.schedule.alignment
        merges = {joined.number: of_event[id(joined.alignment)] for joined in self._team._merges.watched}
        for group in self._team._groups:
            if not group.trunk.monitors:
                continue
            joint = group.trunk.filter.map("mixture")
            for watch in group.trunk.monitors:
                i = merges[watch.number]
                share = max(deformed_fraction(old, joint, options) for old in watch.pre_merge_maps)
                self.moved[i] = max(share, self.moved.get(i, 0.0))

    def current_error(self, merge: MergeEvent) -> tuple[float, float]:
        """Return the error [m, degrees] of the transform between the groups' frames in their joint filter."""
        trunk = self._team._group_of(merge.robots_a[0]).trunk
        robots = (group[0] for group in (merge.robots_a, merge.robots_b))
        starts = [trunk.filter.start_pose(trunk.robots.index(robot)) for robot in robots]
        return transform_error(self._starts, merge, between(*starts))

    def _share_of_wrong_pairs(self, merge: MergeEvent) -> float:
        """Return the share of wrong pairs of a new merge; pairs with false points are wrong."""
        sides = next(one.sides for one in self._team._merges.watched if one.alignment is merge.alignment)
        claims = []
        for side, joined, rows in zip(sides, self._team.merged_maps(merge), merge.alignment.inliers.T, strict=True):
            claims.append(self._ground_truth.claims_of(side["number"], joined.ids[rows]))
        return float(np.mean((claims[0] != claims[1]) | (claims[0] == FALSE))) if len(claims[0]) else float("nan")


def transform_error(starts: FloatArray, event: MergeEvent, motion: FloatArray) -> tuple[float, float]:
    """Return the error [m, degrees] of a transform between two groups' frames."""
    error = between(between(starts[event.robots_a[0]], starts[event.robots_b[0]]), motion)
    return float(np.hypot(*error[:2])), float(abs(np.degrees(error[2])))


def collect_outcomes(
    events: Sequence[MergeEvent], starts: FloatArray, seed: int, world: str, alike: str, steps: int, follower: Follower
) -> RunOutcomes:
    """Return the outcomes of the merges of a finished run, its late merges and its final state.

    Args:
        events: Events of the run.
        starts: (K, 3) true start poses, world frame.
        seed, world, alike: Description of the run.
        steps: Number of steps of the run.
        follower: Observer of all steps.
    """
    found, nothing = [], (float("nan"), float("nan"))
    for i, event in enumerate(events):
        if event.kind == "merge":
            undone = undone_in(events, event)
            soon = undone is not None and undone - event.step <= WINDOW
            found.append(
                MergeOutcome(
                    seed, world, alike, event.step, event.robots_a, event.robots_b,
                    *transform_error(starts, event, event.alignment.transform),
                    *unsmoothed_error(starts, events[:i], event),
                    follower.wrong_pairs[i], None if undone is None else undone - event.step, steps - event.step,
                    *(nothing if soon else follower.later[i]),
                    *(nothing if undone is not None else follower.current_error(event)),
                    follower.moved.get(i, float("nan")), attempt_uncertainty(events[:i], event),
                    *(nothing if undone is None else follower.last[i]),
                )
            )  # fmt: skip
    kept = [e.step for e in events if e.kind == "merge" and undone_in(events, e) is None]
    return found, collect_delays(events, seed), RunEnd(seed, world, follower.groups, max(kept, default=None))


def undone_in(events: Sequence[MergeEvent], merge: MergeEvent) -> int | None:
    """Return the step in which a merge was undone; None if it was not."""
    return next((e.step for e in events if e.kind == "undo" and e.alignment is merge.alignment), None)


def attempt_uncertainty(before: Sequence[MergeEvent], merge: MergeEvent) -> float:
    """Return the uncertainty of the attempt that led to a merge; NaN if it was forced."""
    return next((event.uncertainty for event in before if event.alignment is merge.alignment), float("nan"))


def unsmoothed_error(starts: FloatArray, before: Sequence[MergeEvent], merge: MergeEvent) -> tuple[float, float]:
    """Return the error [m, degrees] of the transform from the unsmoothed maps of a merge; NaN if there is none.

    Args:
        starts: (K, 3) true start poses, world frame.
        before: Events before the merge, including the attempt that led to it.
        merge: Event of the merge.
    """
    attempt = next((event for event in before if event.alignment is merge.alignment), None)
    nothing = float("nan"), float("nan")
    return (
        nothing
        if attempt is None or attempt.unsmoothed_alignment is None
        else transform_error(starts, attempt, attempt.unsmoothed_alignment.transform)
    )


def collect_delays(events: Sequence[MergeEvent], seed: int) -> list[Delay]:
    """Return the attempts of a run that were refused only because maps were smoothed."""
    found = []
    for i, event in enumerate(events):
        if event.unsmoothed_alignment is not None and not event.alignment.success:
            pair = {event.robots_a[0], event.robots_b[0]}
            merged = (e.step for e in events[i:] if e.kind == "merge" and len(pair & {*e.robots_a, *e.robots_b}) == 2)
            later = next(merged, None)
            found.append(Delay(seed, event.step, event.alignment.reason, later and later - event.step))
    return found


def summarise(merges: list[MergeOutcome], late: list[Delay], ends: list[RunEnd], steps: int) -> dict[str, Any]:
    """Return the summary of all runs."""
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
    """Return the mean of the values that are not NaN; NaN if there are none."""
    known = [value for value in values if np.isfinite(value)]
    return float(np.mean(known)) if known else float("nan")


def rms(values: Iterable[float]) -> float:
    """Return the root mean square of the values that are not NaN; NaN if there are none."""
    squares = np.square([value for value in values if np.isfinite(value)])
    return float(np.sqrt(squares.mean())) if len(squares) else float("nan")
