"""Attempt of two groups to align their maps: choice of the pair, smoothing of both maps, and a second alignment.

Filters whose smoother works in slices smooth over several steps, one slice in each, as for a rejuvenation that is due.
The attempt continues when both have finished and are in contact; of large maps ten steps later at the earliest, so that
its work does not all fall into one decision of a robot, and their merge is prepared (`merge_preparation`). Other
filters smooth their whole logs in one step.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from slam_backend.core.validation import IntArray
from slam_backend.fastslam.particle_maps import present_slots
from slam_backend.fastslam.reports import MergeEvent
from slam_backend.maps.alignment import Alignment, AlignmentOptions, align_candidates
from slam_backend.maps.correspondences import has_enough_candidates
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.maps.near_pairs import Appearance
from slam_backend.smoother.options import extra_keys
from slam_backend.team.group_merging import MergePlan, smoothed_graphs, smoothed_maps, transform_uncertainty
from slam_backend.team.groups import Group
from slam_backend.team.merge_preparation import MergePreparation
from slam_backend.team.merge_scheduler import MergeScheduler, PairKey, PendingAttempt
from slam_backend.team.options import MergeOptions
from slam_backend.team.shared_records import SharedRecords

LEAST_KEPT = 0.8  # least share of the inliers before smoothing that must remain after it
MOST_STEPS = 40  # longest wait of an attempt for smoothed maps and contact; then it takes the maps as they are
LEAST_STEPS = 10  # shortest wait of a costly one, so that its work does not all fall into one decision of a robot

Pair = tuple[Group, Group]
Maps = tuple[LandmarkMap, LandmarkMap]


class AttemptResult(NamedTuple):
    """Outcome of a step for the attempts of a team.

    Attributes:
        event: The attempt that ends in this step, or None.
        plan: Plan of the merge, if it succeeded.
        preparation: Preparation of a merge of large maps that goes on in the next step, or None.
    """

    event: MergeEvent | None = None
    plan: MergePlan | None = None
    preparation: MergePreparation | None = None


def run_attempt(
    groups: Sequence[Group], networks: IntArray, step: int, schedule: MergeScheduler, alignment: AlignmentOptions,
    merging: MergeOptions, records: SharedRecords, rng: np.random.Generator,
    preparation: MergePreparation | None = None,
) -> AttemptResult:  # fmt: skip
    """Start an attempt of the most promising pair of groups, or continue a pending one, or the preparation of a merge.

    Args:
        groups: Groups of the team, by their robots. The filters of the pair may be smoothed.
        networks: (K,) robots with the same number are in contact.
        step: Step of the team.
        schedule: Scheduler; it keeps a pending attempt.
        alignment: Options of alignments.
        merging: Options of merges.
        records: Records of the team, which count the traffic.
        rng: Generator for the search and for the draws of the merge that follows.
        preparation: Preparation that goes on since the last step, or None; its attributes change.
    """
    if preparation is not None:
        return _prepare(preparation, groups, networks, step, schedule, alignment, merging, records, rng)
    pending = schedule.pending_attempt
    if pending is None:
        return _start(groups, networks, step, schedule, alignment, merging, records, rng)
    pair = next((pair for pair in _pairs(groups) if _is_same(pending, pair)), None)
    late = step - pending.since >= MOST_STEPS
    if pair is None or (late and not _are_connected(pair, networks)):
        schedule.pending_attempt = None
        return AttemptResult()
    soon = step - pending.since < LEAST_STEPS and _is_costly(pair)
    if not pending.ready or soon or not _are_connected(pair, networks):
        ready = pending.ready or late or not any(group.trunk.filter.rejuvenation_requested for group in pair)
        schedule.pending_attempt = replace(
            pending, ready=ready
        )  # continued in the next step to limit the work per step
        return AttemptResult()
    schedule.pending_attempt = None
    maps = _mixtures(pair)
    outcome = _realign(pair, pending.alignment, maps, schedule, alignment, records, rng)
    return _finish(MergePlan(pair, maps, outcome), step, pending.alignment, schedule, alignment, merging, rng)


def _prepare(
    preparation: MergePreparation, groups: Sequence[Group], networks: IntArray, step: int, schedule: MergeScheduler,
    alignment: AlignmentOptions, merging: MergeOptions, records: SharedRecords, rng: np.random.Generator,
) -> AttemptResult:  # fmt: skip
    """Continue the preparation of a merge; it ends, too, if a group has changed or is out of contact for long."""
    pair = next((pair for pair in _pairs(groups) if _is_same(preparation, pair)), None)
    if pair is None:
        preparation.give_up()
        return AttemptResult()
    if not preparation.advance(pair, _are_connected(pair, networks), merging, alignment, records, rng):
        return AttemptResult(preparation=preparation)
    uncertainty = merging.min_sigmas * preparation.uncertainty
    if math.isnan(uncertainty):
        return AttemptResult()  # given up
    plan = None if preparation.joint is None else preparation.plan(pair)
    found = preparation.alignment if plan is None else plan.alignment
    found = _refused_if_uncertain(found, pair, uncertainty, 0.0, schedule, merging)
    return _end(pair, found, plan, step, preparation.unsmoothed, uncertainty, schedule)


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
    if not unsmoothed.success or not merging.smooth_first:
        return _finish(plan, step, None, schedule, options, merging, rng)
    if _smooth_in_slices(pair):
        for group in pair:
            group.trunk.filter.request_rejuvenation()
        schedule.pending_attempt = PendingAttempt(chosen, _numbers(pair), unsmoothed, step)
        return AttemptResult()
    before = [group.trunk.filter.get_state() for group in pair]
    smoothed = smoothed_maps(*pair)
    if smoothed is None:
        return _finish(plan, step, None, schedule, options, merging, rng)
    outcome = _realign(pair, unsmoothed, smoothed, schedule, options, records, rng, before)
    return _finish(MergePlan(pair, smoothed, outcome), step, unsmoothed, schedule, options, merging, rng)


def _appearance(group: Group) -> Appearance:
    """Return the landmarks of a group's `map`."""
    state = group.trunk.filter.state
    slots = present_slots(state.maps, state.best, 1)
    return Appearance(state.maps.ids[slots], state.maps.descriptors[slots])


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
    records: SharedRecords, rng: np.random.Generator, before: Sequence[Mapping[str, Any]] = (),
) -> Alignment:  # fmt: skip
    """Align smoothed maps, which must keep most inliers of the unsmoothed ones.

    Otherwise filters that were smoothed for the attempt are restored to their states `before` it.
    """
    alignment = _align(pair, maps, schedule, options, rng)
    records.exchange.record_smoothed(*representatives(pair), *maps)
    fewer = alignment.success and len(alignment.inliers) < LEAST_KEPT * len(unsmoothed.inliers)
    if fewer or alignment.reason == "too few inliers":
        alignment = Alignment.refused("too few inliers", alignment.ratio)
        for group, state in zip(pair, before, strict=bool(before)):  # the smoother has failed
            group.trunk.filter.restore_checked(state)
    return alignment


def _finish(
    plan: MergePlan, step: int, unsmoothed: Alignment | None, schedule: MergeScheduler, alignment: AlignmentOptions,
    merging: MergeOptions, rng: np.random.Generator,
) -> AttemptResult:  # fmt: skip
    """Check the uncertainty of the merge, and record the outcome of the attempt.

    Where the joint graph of large maps tells, most attempts end there, and the merges of others are prepared.
    """
    pair, found, uncertainty = plan.groups, plan.alignment, float("nan")
    if found.success and merging.min_sigmas:
        may_try, before = merging.min_sigmas_on_trial > 0.0 and merging.smooth_first, rng.bit_generator.state
        claimed = plan.by_graphs() if may_try else None
        if claimed is None:
            plan, uncertainty, change = _on_trial(plan, may_try, schedule, alignment, merging, rng)
        else:
            plan, uncertainty = claimed[0], merging.min_sigmas * claimed[1]
            change = schedule.change(_key(pair), plan.alignment.transform)
            if uncertainty <= merging.prepared_uncertainty and change <= 1.0:
                return AttemptResult(preparation=MergePreparation.of(plan, unsmoothed))
        found = _refused_if_uncertain(plan.alignment, pair, uncertainty, change, schedule, merging)
        if not found.success:  # the draws for the merge are dropped
            rng.bit_generator.state = before
    return _end(pair, found, plan, step, unsmoothed, uncertainty, schedule)


def _on_trial(
    plan: MergePlan, may_try: bool, schedule: MergeScheduler, alignment: AlignmentOptions, merging: MergeOptions,
    rng: np.random.Generator,
) -> tuple[MergePlan, float, float]:  # fmt: skip
    """Merge on trial, if allowed and if the two maps alone leave the motion too uncertain.

    Returns:
        The plan with the last estimate of the motion; its relative uncertainty, at most 1 for a merge; and its change
        since the last trial of this pair, at most 1 for a merge, 0 without a trial.
    """
    plan = plan.with_pairing(merging, rng)
    uncertainty = merging.min_sigmas * transform_uncertainty(plan)
    trial = plan.on_trial(merging, alignment, rng) if may_try and uncertainty > 1.0 else None
    if trial is None:
        return plan, uncertainty, 0.0
    change = schedule.change(_key(plan.groups), trial[0].alignment.transform)
    return trial[0], merging.min_sigmas * trial[1], change


def _refused_if_uncertain(
    found: Alignment, pair: Pair, uncertainty: float, change: float, schedule: MergeScheduler, merging: MergeOptions
) -> Alignment:
    """Return an alignment, or its refusal if its uncertainty, or its change since the last one, exceeds the limits."""
    if schedule.should_defer(_key(pair), uncertainty, merging.max_uncertainty):
        return Alignment.refused("too uncertain", found.ratio, "paths", uncertainty)
    if change > 1.0:
        return Alignment.refused("too uncertain", found.ratio, "repeat", change)
    return found


def _end(
    pair: Pair, found: Alignment, plan: MergePlan | None, step: int, unsmoothed: Alignment | None, uncertainty: float,
    schedule: MergeScheduler,
) -> AttemptResult:  # fmt: skip
    """Record the outcome of an attempt."""
    schedule.record(_key(pair), step, found.success, unsmoothed is not None, _smooth_in_slices(pair))
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


def _smooth_in_slices(pair: Pair) -> bool:
    """Return whether the smoothers of both joint filters work in slices."""
    return all(group.trunk.filter.smooths_incrementally for group in pair)


def _is_costly(pair: Pair) -> bool:
    """Return whether the run of two groups is so long, or one of their maps so large, that an attempt is costly."""
    graphs = smoothed_graphs(*(group.trunk.filter for group in pair))
    if graphs is None:
        return False
    latest = np.concatenate([graph.latest for graph in graphs])
    return extra_keys(max(len(graph.landmark_ids) for graph in graphs), latest) > 0


def _unique(pairs: Mapping[PairKey, Pair]) -> list[Group]:
    """Return the distinct groups of some pairs."""
    return list({group.robots: group for pair in pairs.values() for group in pair}.values())


def _key(pair: Pair) -> PairKey:
    return pair[0].robots, pair[1].robots


def _numbers(pair: Pair) -> tuple[int, int]:
    return pair[0].trunk.number, pair[1].trunk.number


def _is_same(begun: PendingAttempt | MergePreparation, pair: Pair) -> bool:
    """Return whether a pair is that of an attempt, with the same filters."""
    return (begun.pair, begun.numbers) == (_key(pair), _numbers(pair))


def _mixtures(pair: Pair) -> Maps:
    return pair[0].trunk.filter.map("mixture"), pair[1].trunk.filter.map("mixture")
