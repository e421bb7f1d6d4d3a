"""Choice of two groups whose maps may be aligned, their alignment, and the bounds of its uncertainty."""

from collections.abc import Mapping, Sequence

import numpy as np

from slam_backend.core.validation import IntArray
from slam_backend.maps.alignment import Alignment, AlignmentOptions, align_maps
from slam_backend.maps.correspondences import has_enough_candidates
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.team.groups import Group
from slam_backend.team.merge_scheduler import MergeScheduler, PairKey

MIN_REMAINING_INLIERS = 0.8  # least share of the inliers before smoothing that must remain after it

GroupPair = tuple[Group, Group]
MapPair = tuple[LandmarkMap, LandmarkMap]


def choose_pair(
    groups: Sequence[Group], networks: IntArray, step: int, schedule: MergeScheduler
) -> tuple[GroupPair, MapPair] | None:
    """Return the pair of groups in contact with the most new candidate matches, and their maps; None if none may try.

    Args:
        groups: Groups that may merge, by their robots.
        networks: (K,) robots with the same number are in contact.
        step: Step of the team.
        schedule: Scheduler of attempts.
    """
    connected = (pair for pair in pairs_of(groups) if are_connected(pair, networks))
    pairs = {key_of(pair): pair for pair in connected if schedule.may_try(key_of(pair), step)}
    looks = {group.robots: group.trunk.filter.descriptors() for group in _distinct(pairs)}
    pairs = {
        (a, b): pair for (a, b), pair in pairs.items() if has_enough_candidates(looks[a], looks[b], schedule.alignment)
    }  # with too few no maps need to be built
    maps = {group.robots: group.trunk.filter.map("mixture") for group in _distinct(pairs)}
    chosen = schedule.choose({key: (maps[key[0]], maps[key[1]]) for key in pairs}, step)
    return None if chosen is None else (pairs[chosen], (maps[chosen[0]], maps[chosen[1]]))


def align_smoothed(
    maps: MapPair, unsmoothed: Alignment, options: AlignmentOptions, rng: np.random.Generator
) -> Alignment:
    """Align smoothed maps, which must keep most inliers of the unsmoothed ones."""
    alignment = align_maps(*maps, rng=rng, options=options)
    fewer = alignment.success and len(alignment.inliers) < MIN_REMAINING_INLIERS * len(unsmoothed.inliers)
    if fewer or alignment.reason == "too few inliers":
        return Alignment.refused("too few inliers", alignment.ratio)
    return alignment


def pairs_of(groups: Sequence[Group]) -> list[GroupPair]:
    """Return all pairs of some groups."""
    return [(a, b) for i, a in enumerate(groups) for b in groups[i + 1 :]]


def key_of(pair: GroupPair) -> PairKey:
    """Return the robots of two groups."""
    return pair[0].robots, pair[1].robots


def map_numbers(pair: GroupPair) -> tuple[int, int]:
    """Return the numbers of the maps of two groups' joint filters."""
    return pair[0].trunk.number, pair[1].trunk.number


def mixture_maps(pair: GroupPair) -> MapPair:
    """Return the maps of two groups' joint filters, with mixture covariances."""
    return pair[0].trunk.filter.map("mixture"), pair[1].trunk.filter.map("mixture")


def representatives(pair: GroupPair) -> tuple[int, int]:
    """Return the robots through which two groups exchange their maps."""
    return pair[0].trunk.active_robots[0], pair[1].trunk.active_robots[0]


def are_connected(pair: GroupPair, networks: IntArray) -> bool:
    """Return whether two groups are in contact."""
    robot_a, robot_b = representatives(pair)
    return bool(networks[robot_a] == networks[robot_b])


def _distinct(pairs: Mapping[PairKey, GroupPair]) -> list[Group]:
    """Return the distinct groups of some pairs."""
    return list({group.robots: group for pair in pairs.values() for group in pair}.values())
