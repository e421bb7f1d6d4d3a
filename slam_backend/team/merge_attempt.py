"""An attempt of two groups to align their maps: the pair is chosen, both maps are straightened, and align once more.

Filters that keep a smoother which works in slices straighten theirs over some steps, a slice in each, as they would for
a rejuvenation that is due; the attempt goes on when both have, and hear each other. Others smooth all they have read
in one step.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from slam_backend.core.validation import IntArray
from slam_backend.fastslam.reports import MergeEvent
from slam_backend.maps.alignment import Alignment, AlignmentOptions, align_maps
from slam_backend.maps.correspondences import has_enough_candidates
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.team.group_merging import MergePlan, smoothed_maps, transform_uncertainty
from slam_backend.team.groups import Group
from slam_backend.team.merge_scheduler import MergeScheduler, PairKey, PendingAttempt
from slam_backend.team.options import MergeOptions
from slam_backend.team.shared_records import SharedRecords

LEAST_KEPT = 0.8  # of the landmarks on which two bent maps agree, the straight ones have to agree on so many
MOST_STEPS = 40  # for which an attempt waits for straight maps and for contact; then it takes maps as they are

Pair = tuple[Group, Group]
Maps = tuple[LandmarkMap, LandmarkMap]


class AttemptResult(NamedTuple):
    """An attempt that has come to its end, and the merge to be made if it is a success."""

    event: MergeEvent
    plan: MergePlan | None


def run_attempt(
    groups: Sequence[Group], networks: IntArray, step: int, schedule: MergeScheduler, alignment: AlignmentOptions,
    merging: MergeOptions, records: SharedRecords, rng: np.random.Generator,
) -> AttemptResult | None:  # fmt: skip
    """Let the most promising pair of groups try, or go on with an attempt whose maps are straightened; when it is due.

    Args:
        groups: Of the team, by their robots. Filters of a pair that tries are straightened.
        networks: (K,) robots with the same number are in contact.
        step: Of the team.
        schedule: Who tries when; it remembers an attempt that goes on.
        alignment: When two maps are believed to fit together.
        merging: Whether maps are straightened, and how sure a merge has to be.
        records: In which what is sent is written down.
        rng: For the search, and the draws of the merge that follows.

    Returns:
        The attempt that came to its end in this step; its two groups are to be merged if its alignment is a success.
    """
    pending = schedule.straightening
    if pending is None:
        return _start(groups, networks, step, schedule, alignment, merging, records, rng)
    pair = next((pair for pair in _pairs(groups) if _is_meant(pending, pair)), None)
    late = step - pending.since >= MOST_STEPS
    if pair is None or (late and not _are_connected(pair, networks)):
        schedule.straightening = None
        return None
    if not pending.ready or not _are_connected(pair, networks):
        ready = pending.ready or late or not any(group.trunk.filter.rejuvenation_requested for group in pair)
        schedule.straightening = replace(pending, ready=ready)  # to go on would be too much for one step
        return None
    schedule.straightening = None
    maps = _mixtures(pair)
    outcome = _realign(pair, pending.alignment, maps, alignment, records, rng)
    return _finish(MergePlan(pair, maps, outcome), step, pending.alignment, schedule, alignment, merging, rng)


def _start(
    groups: Sequence[Group], networks: IntArray, step: int, schedule: MergeScheduler, options: AlignmentOptions,
    merging: MergeOptions, records: SharedRecords, rng: np.random.Generator,
) -> AttemptResult | None:  # fmt: skip
    """Choose a pair and align its maps as the filters have bent them."""
    if len(groups) < 2:
        return None
    able = (pair for pair in _pairs(groups) if _are_connected(pair, networks))
    pairs = {_key(pair): pair for pair in able if schedule.may_try(_key(pair), step)}
    looks = {group.robots: group.trunk.filter.descriptors() for group in _unique(pairs)}
    pairs = {key: pair for key, pair in pairs.items() if has_enough_candidates(looks[key[0]], looks[key[1]], options)}
    maps = {group.robots: group.trunk.filter.map("mixture") for group in _unique(pairs)}
    chosen = schedule.choose({key: (maps[key[0]], maps[key[1]]) for key in pairs}, step)
    if chosen is None:
        return None
    pair, (map_a, map_b) = pairs[chosen], (maps[chosen[0]], maps[chosen[1]])
    bent = align_maps(map_a, map_b, rng=rng, options=options)
    records.exchange.record_maps(*representatives(pair), map_a, map_b)
    plan = MergePlan(pair, (map_a, map_b), bent)
    if not bent.success or not merging.smooth_first:
        return _finish(plan, step, None, schedule, options, merging, rng)
    if all(group.trunk.filter.smooths_incrementally for group in pair):
        for group in pair:
            group.trunk.filter.request_rejuvenation()
        schedule.straightening = PendingAttempt(chosen, _numbers(pair), bent, step)
        return None
    before = [group.trunk.filter.get_state() for group in pair]
    straight = smoothed_maps(*pair)
    if straight is None:
        return _finish(plan, step, None, schedule, options, merging, rng)
    outcome = _realign(pair, bent, straight, options, records, rng, before)
    return _finish(MergePlan(pair, straight, outcome), step, bent, schedule, options, merging, rng)


def _realign(
    pair: Pair, bent: Alignment, maps: Maps, options: AlignmentOptions, records: SharedRecords,
    rng: np.random.Generator,
    before: Sequence[Mapping[str, Any]] = (),
) -> Alignment:  # fmt: skip
    """Align straight maps, which must agree on most of what the bent ones did.

    Where they do not, filters that were straightened on purpose go on from their states `before` that.
    """
    alignment = align_maps(*maps, rng=rng, options=options)
    records.exchange.record_smoothed(*representatives(pair), *maps)
    fewer = alignment.success and len(alignment.inliers) < LEAST_KEPT * len(bent.inliers)
    if fewer or alignment.reason == "too few inliers":
        alignment = Alignment.refused("too few inliers", alignment.ratio)
        for group, state in zip(pair, before, strict=bool(before)):  # the smoother has lost its way
            group.trunk.filter.restore_checked(state)
    return alignment


def _finish(
    plan: MergePlan, step: int, bent: Alignment | None, schedule: MergeScheduler, alignment: AlignmentOptions,
    merging: MergeOptions, rng: np.random.Generator,
) -> AttemptResult:  # fmt: skip
    """Ask whether a merge would be sure enough, and remember what came of the attempt."""
    pair, found, doubt = plan.groups, plan.alignment, float("nan")
    if found.success and merging.min_sigmas:
        before = rng.bit_generator.state
        plan, doubt, change = _on_trial(plan.with_pairing(merging, rng), schedule, alignment, merging, rng)
        found = plan.alignment
        if schedule.should_defer(_key(pair), doubt, merging.max_uncertainty):
            found = Alignment.refused("too uncertain", found.ratio, "paths", doubt)
        elif change > 1.0:
            found = Alignment.refused("too uncertain", found.ratio, "repeat", change)
        if not found.success:  # nothing was drawn for a merge
            rng.bit_generator.state = before
            plan = plan._replace(pairing=None, joint=None)
    schedule.record(_key(pair), step, found.success, straightened=bent is not None)
    event = MergeEvent(step, "attempt", pair[0].robots, pair[1].robots, found, bent, doubt)
    return AttemptResult(event, plan if found.success else None)


def _on_trial(
    plan: MergePlan, schedule: MergeScheduler, alignment: AlignmentOptions, merging: MergeOptions,
    rng: np.random.Generator,
) -> tuple[MergePlan, float, float]:  # fmt: skip
    """Merge on trial where two maps alone are not sure enough.

    Returns:
        The plan, by the motion that was found last; the doubt about it, 1 = just sure enough; and by how much the last
        trial of this pair found another one, 1 = just too much, 0 without a trial.
    """
    doubt = merging.min_sigmas * transform_uncertainty(plan)
    if doubt <= 1.0 or not (merging.min_sigmas_on_trial and merging.smooth_first):
        return plan, doubt, 0.0
    trial = plan.on_trial(merging, alignment, rng)
    if trial is None:
        return plan, doubt, 0.0
    return trial[0], merging.min_sigmas * trial[1], schedule.change(_key(plan.groups), trial[0].alignment.transform)


def representatives(pair: Pair) -> tuple[int, int]:
    """Return the robots by whom two groups exchange their maps."""
    return pair[0].trunk.active_robots[0], pair[1].trunk.active_robots[0]


def _pairs(groups: Sequence[Group]) -> list[Pair]:
    """Return the pairs of groups none of which takes back a merge."""
    able = [group for group in groups if group.undoing is None]
    return [(a, b) for i, a in enumerate(able) for b in able[i + 1 :]]


def _are_connected(pair: Pair, networks: IntArray) -> bool:
    """Tell whether two groups hear each other."""
    one, other = representatives(pair)
    return bool(networks[one] == networks[other])


def _unique(pairs: Mapping[PairKey, Pair]) -> list[Group]:
    """Return the groups of some pairs, each once."""
    return list({group.robots: group for pair in pairs.values() for group in pair}.values())


def _key(pair: Pair) -> PairKey:
    return pair[0].robots, pair[1].robots


def _numbers(pair: Pair) -> tuple[int, int]:
    return pair[0].trunk.number, pair[1].trunk.number


def _is_meant(pending: PendingAttempt, pair: Pair) -> bool:
    """Tell whether a pair is the one whose maps are straightened, with the filters that it had."""
    return (pending.pair, pending.numbers) == (_key(pair), _numbers(pair))


def _mixtures(pair: Pair) -> Maps:
    return pair[0].trunk.filter.map("mixture"), pair[1].trunk.filter.map("mixture")
