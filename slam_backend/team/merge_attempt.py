"""Attempt of two groups to align their maps: choice of the pair, smoothing of both maps, and a second alignment.

Before the second alignment both filters smooth, as for a rejuvenation that is due, and the attempt continues when both
have finished and are in contact.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from slam_backend.core.validation import IntArray
from slam_backend.fastslam.particle_maps import present_slots
from slam_backend.maps.alignment import Alignment, AlignmentOptions, align_candidates
from slam_backend.maps.correspondences import has_enough_candidates
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.maps.near_pairs import Appearance
from slam_backend.team.group_merging import MergePlan
from slam_backend.team.groups import Group
from slam_backend.team.merge_scheduler import MergeScheduler, PairKey, PendingAttempt
from slam_backend.team.options import MergeOptions
from slam_backend.team.reports import MergeEvent
from slam_backend.team.shared_records import SharedRecords

LEAST_KEPT = 0.8  # least share of the inliers before smoothing that must remain after it
MOST_STEPS = 40  # longest wait of an attempt for smoothed maps and contact; then it takes the maps as they are

Pair = tuple[Group, Group]
Maps = tuple[LandmarkMap, LandmarkMap]


class AttemptResult(NamedTuple):
    """Outcome of a step for the attempts of a team.

    Attributes:
        event: The attempt that ends in this step, or None.
        plan: Plan of the merge, if it succeeded.
    """

    event: MergeEvent | None = None
    plan: MergePlan | None = None


def run_attempt(
    groups: Sequence[Group], networks: IntArray, step: int, schedule: MergeScheduler, alignment: AlignmentOptions,
    merging: MergeOptions, records: SharedRecords, rng: np.random.Generator,
) -> AttemptResult:  # fmt: skip
    """Start an attempt of the most promising pair of groups, or continue a pending one.

    Args:
        groups: Groups of the team, by their robots. The filters of the pair may be smoothed.
        networks: (K,) robots with the same number are in contact.
        step: Step of the team.
        schedule: Scheduler; it keeps a pending attempt.
        alignment: Options of alignments.
        merging: Options of merges.
        records: Records of the team, which count the traffic.
        rng: Generator for the search and for the draws of the merge that follows.
    """
    pending = schedule.pending_attempt
    if pending is None:
        return _start(groups, networks, step, schedule, alignment, merging, records, rng)
    pair = next((pair for pair in _pairs(groups) if _is_same(pending, pair)), None)
    late = step - pending.since >= MOST_STEPS
    if pair is None or (late and not _are_connected(pair, networks)):
        schedule.pending_attempt = None
        return AttemptResult()
    if not pending.ready or not _are_connected(pair, networks):
        ready = pending.ready or late or not any(group.trunk.filter.rejuvenation_requested for group in pair)
        schedule.pending_attempt = replace(
            pending, ready=ready
        )  # continued in the next step to limit the work per step
        return AttemptResult()
    schedule.pending_attempt = None
    maps = _mixtures(pair)
    outcome = _realign(pair, pending.alignment, maps, schedule, alignment, records, rng)
    return _finish(MergePlan(pair, maps, outcome), step, pending.alignment, schedule, merging, rng)


def _start(
    groups: Sequence[Group], networks: IntArray, step: int, schedule: MergeScheduler, options: AlignmentOptions,
    merging: MergeOptions, records: SharedRecords, rng: np.random.Generator,
) -> AttemptResult:  # fmt: skip
    """Choose a pair and align its maps before smoothing."""
    if len(groups) < 2:
        return AttemptResult()
    connected = (pair for pair in _pairs(groups) if _are_connected(pair, networks))
    pairs = {_key(pair): pair for pair in connected if schedule.may_try(_key(pair), step)}
    found = {group.robots: _appearance(group) for group in _unique(pairs)}
    pairs = {key: pair for key, pair in pairs.items() if _may_align(key, found, schedule, options)}
    maps = {group.robots: group.trunk.filter.map("mixture") for group in _unique(pairs)}
    chosen = schedule.choose({key: (maps[key[0]], maps[key[1]]) for key in pairs}, step)
    if chosen is None:
        return AttemptResult()
    pair, (map_a, map_b) = pairs[chosen], (maps[chosen[0]], maps[chosen[1]])
    unsmoothed = _align(pair, (map_a, map_b), schedule, options, rng)
    records.exchange.record_maps(*representatives(pair), map_a, map_b)
    plan = MergePlan(pair, (map_a, map_b), unsmoothed)
    if not unsmoothed.success or not merging.smooth_first or not _can_smooth(pair):
        return _finish(plan, step, None, schedule, merging, rng)
    for group in pair:
        group.trunk.filter.request_rejuvenation()
    schedule.pending_attempt = PendingAttempt(chosen, _numbers(pair), unsmoothed, step)
    return AttemptResult()


def _appearance(group: Group) -> Appearance:
    """Return the landmarks of a group's `map`."""
    slam = group.trunk.filter
    slots = present_slots(slam.maps, slam.best_particle, 1)
    return Appearance(slam.maps.ids[slots], slam.maps.descriptors[slots])


def _may_align(
    key: PairKey, found: Mapping[tuple[int, ...], Appearance], schedule: MergeScheduler, options: AlignmentOptions
) -> bool:
    """Return whether the maps of two groups may have enough candidates; with too few no maps need to be built."""
    a, b = (found[robots] for robots in key)
    return has_enough_candidates(a.descriptors, b.descriptors, options, schedule.near_pairs(key, a, b))


def _align(
    pair: Pair, maps: Maps, schedule: MergeScheduler, options: AlignmentOptions, rng: np.random.Generator
) -> Alignment:
    """Return the result of `align_maps`; descriptors compared in earlier attempts are not compared again."""
    return align_candidates(*maps, schedule.candidates(_key(pair), *maps), "ransac", rng, options)


def _realign(
    pair: Pair, unsmoothed: Alignment, maps: Maps, schedule: MergeScheduler, options: AlignmentOptions,
    records: SharedRecords, rng: np.random.Generator,
) -> Alignment:  # fmt: skip
    """Align smoothed maps, which must keep most inliers of the unsmoothed ones."""
    alignment = _align(pair, maps, schedule, options, rng)
    records.exchange.record_smoothed(*representatives(pair), *maps)
    fewer = alignment.success and len(alignment.inliers) < LEAST_KEPT * len(unsmoothed.inliers)
    if fewer or alignment.reason == "too few inliers":
        return Alignment.refused("too few inliers", alignment.ratio)
    return alignment


def _finish(
    plan: MergePlan, step: int, unsmoothed: Alignment | None, schedule: MergeScheduler, merging: MergeOptions,
    rng: np.random.Generator,
) -> AttemptResult:  # fmt: skip
    """Check the uncertainty of the motion, and record the outcome of the attempt."""
    pair, found, uncertainty = plan.groups, plan.alignment, float("nan")
    if found.success and merging.min_sigmas:
        before = rng.bit_generator.state
        known, relative = plan.with_motion(merging, rng)
        uncertainty = merging.min_sigmas * relative
        if known.pairing is not None or uncertainty <= merging.trusted_uncertainty:
            plan = known
        change = schedule.change(_key(pair), known.alignment.transform)
        found = _refused_if_uncertain(plan.alignment, pair, uncertainty, change, schedule, merging)
        if not found.success:  # the draws for the merge are dropped
            rng.bit_generator.state = before
    return _end(pair, found, plan, step, unsmoothed, uncertainty, schedule)


def _refused_if_uncertain(
    found: Alignment, pair: Pair, uncertainty: float, change: float, schedule: MergeScheduler, merging: MergeOptions
) -> Alignment:
    """Return an alignment, or its refusal if its uncertainty, or its change since the last one, exceeds the limits."""
    if schedule.should_defer(_key(pair), uncertainty, merging.max_uncertainty):
        return Alignment.refused("too uncertain", found.ratio, "paths", uncertainty)
    if uncertainty > 1.0 and merging.least_sigmas and change > 1.0:
        return Alignment.refused("too uncertain", found.ratio, "repeat", change)
    return found


def _end(
    pair: Pair, found: Alignment, plan: MergePlan, step: int, unsmoothed: Alignment | None, uncertainty: float,
    schedule: MergeScheduler,
) -> AttemptResult:  # fmt: skip
    """Record the outcome of an attempt."""
    schedule.record(_key(pair), step, found.success, unsmoothed is not None)
    event = MergeEvent(step, "attempt", pair[0].robots, pair[1].robots, found, unsmoothed, uncertainty)
    return AttemptResult(event, plan if found.success else None)


def representatives(pair: Pair) -> tuple[int, int]:
    """Return the robots through which two groups exchange their maps."""
    return pair[0].trunk.active_robots[0], pair[1].trunk.active_robots[0]


def _pairs(groups: Sequence[Group]) -> list[Pair]:
    """Return the pairs of groups without a rollback in progress."""
    available = [group for group in groups if group.undoing is None]
    return [(a, b) for i, a in enumerate(available) for b in available[i + 1 :]]


def _are_connected(pair: Pair, networks: IntArray) -> bool:
    """Return whether two groups are in contact."""
    one, other = representatives(pair)
    return bool(networks[one] == networks[other])


def _can_smooth(pair: Pair) -> bool:
    """Return whether both joint filters have a smoother that can still work."""
    return all(group.trunk.filter.can_rejuvenate for group in pair)


def _unique(pairs: Mapping[PairKey, Pair]) -> list[Group]:
    """Return the distinct groups of some pairs."""
    return list({group.robots: group for pair in pairs.values() for group in pair}.values())


def _key(pair: Pair) -> PairKey:
    return pair[0].robots, pair[1].robots


def _numbers(pair: Pair) -> tuple[int, int]:
    return pair[0].trunk.number, pair[1].trunk.number


def _is_same(begun: PendingAttempt, pair: Pair) -> bool:
    """Return whether a pair is that of an attempt, with the same filters."""
    return (begun.pair, begun.numbers) == (_key(pair), _numbers(pair))


def _mixtures(pair: Pair) -> Maps:
    return pair[0].trunk.filter.map("mixture"), pair[1].trunk.filter.map("mixture")
