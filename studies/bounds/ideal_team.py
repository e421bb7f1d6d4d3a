"""The ideal team: all readings at once, true identities and noise, and merges as soon as maps share enough landmarks.

It is played on the readings of an episode, so that it says what filters could know, not what other driving would tell.
"""

from collections import Counter
from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.geometry import inverse, transform_points
from slam_backend.metrics import map_error
from slam_backend.team.communication import contact_components
from slam_backend.team.reports import MergeEvent
from studies.bounds.episodes import RecordedEpisode, components
from studies.bounds.ladder import Associations, build_problem, true_covariances, true_start
from studies.bounds.online import ideal_online
from training.stereo_runs.batch_ml import most_likely

SHARED = 8  # true landmarks that both maps hold when the ideal team merges them
NOT_TRIED, NO_CONTACT = "not tried", "no contact"

Merge = tuple[int, tuple[int, ...], tuple[int, ...]]  # tick, groups


class IdealTeam(NamedTuple):
    """What an ideal team knows at the end of an episode.

    Attributes:
        merges: Merges in order.
        paths: (K, T, 3) float64 [m, m, rad], own start frames. Each pose from the readings up to its own tick.
        map_errors: (K,) float64 [m]. Map error E of each robot at the end.
    """

    merges: Sequence[Merge]
    paths: FloatArray
    map_errors: FloatArray


def ideal_team(episode: RecordedEpisode) -> IdealTeam:
    """Return what the ideal team knows."""
    config, count = episode.config, len(episode.true_paths)
    merges, noise = ideal_merges(episode), config.odometry
    problem, fusions = build_problem(
        episode, Associations(episode.true_ids, merges), config.landmark_sensor.camera,
        true_covariances(episode.odometry, noise), (noise.bias_distance, noise.bias_heading_per_metre, 0.0),
    )  # fmt: skip
    batch = most_likely(problem, true_start(episode, problem))
    assert batch.bases is not None
    first = components(count, merges)
    group = np.zeros(len(problem.names), np.int64)
    group[problem.landmarks] = first[problem.robots]
    seen = np.bincount(problem.landmarks, minlength=len(problem.names))
    scored = np.full(len(episode.landmarks), -2)  # row of each true landmark among those that count
    scored[episode.observable] = np.arange(len(episode.observable))
    errors = []
    for robot, start in enumerate(episode.true_paths[:, 0]):
        held = (group == first[robot]) & (seen >= config.belief.confirm_after)
        places = transform_points(start, transform_points(inverse(batch.bases[robot]), batch.landmarks[held]))
        claims, truths = scored[problem.names[held]], episode.landmarks[episode.observable]
        errors.append(map_error(places, claims, truths, config.map_error_cutoff))
    return IdealTeam(merges, ideal_online(problem, batch, fusions=fusions).paths, np.array(errors))


def ideal_merges(episode: RecordedEpisode) -> list[Merge]:
    """Return the merges of groups in contact that have measured `SHARED` common landmarks, as soon as they have."""
    count = len(episode.true_paths)
    held: dict[tuple[int, ...], set[int]] = {(robot,): set() for robot in range(count)}
    merges: list[Merge] = []
    for tick, named in enumerate(episode.true_ids):
        for robots, landmarks in held.items():
            for robot in robots:
                landmarks.update(named[robot][named[robot] >= 0].tolist())
        networks = contacts_at(episode, tick)
        while (pair := _next_pair(held, networks)) is not None:
            a, b = pair
            merges.append((tick, a, b))
            held[tuple(sorted(a + b))] = held.pop(a) | held.pop(b)
    return merges


def contacts_at(episode: RecordedEpisode, tick: int) -> IntArray:
    """Return the network (K,) of each robot in a tick; robots in one network are in contact."""
    readings = episode.readings[tick]
    rows = [own.contacts for own in readings if own.contacts is not None]
    return contact_components(np.stack(rows) if rows else None, len(readings))


def _next_pair(
    held: dict[tuple[int, ...], set[int]], networks: IntArray
) -> tuple[tuple[int, ...], tuple[int, ...]] | None:
    """Return two groups that can merge; None if none can."""
    for a, b in combinations(sorted(held), 2):
        if networks[a[0]] == networks[b[0]] and len(held[a] & held[b]) >= SHARED:
            return a, b
    return None


def waits_by_reason(episode: RecordedEpisode, ideal: Sequence[Merge], events: Sequence[MergeEvent]) -> Counter[str]:
    """Return the ticks from each ideal merge to that of the filters, or the end, by what kept them apart.

    That is the reason of the last refusal of both sides; before any attempt `NO_CONTACT`, or `NOT_TRIED`.
    """
    waits: Counter[str] = Counter()
    for tick, a, b in ideal:
        reason = NOT_TRIED
        for now in range(len(episode.true_ids)):
            for event in events:
                refused = event.kind == "attempt" and not event.alignment.success
                if event.step == now and refused and _is_between(event, a, b):
                    reason = ": ".join(filter(None, (event.alignment.reason, event.alignment.missed)))
            if now < tick:
                continue
            if _share_a_map(events, now, a, b):
                break
            networks = contacts_at(episode, now)
            apart = not (set(networks[list(a)]) & set(networks[list(b)]))
            waits[NO_CONTACT if reason == NOT_TRIED and apart else reason] += 1
    return waits


def _is_between(event: MergeEvent, a: Sequence[int], b: Sequence[int]) -> bool:
    """Return whether an event is of two groups with robots of both sides."""
    one, other = set(event.robots_a), set(event.robots_b)
    return any(one & set(x) and other & set(y) for x, y in ((a, b), (b, a)))


def _share_a_map(events: Sequence[MergeEvent], now: int, a: Sequence[int], b: Sequence[int]) -> bool:
    """Return whether robots of both sides share a map after a step."""
    undone = {id(event.alignment) for event in events if event.kind == "undo" and event.step <= now}
    merges = [
        (event.step, event.robots_a, event.robots_b)
        for event in events
        if event.kind == "merge" and event.step <= now and id(event.alignment) not in undone
    ]
    first = components(1 + max(*a, *b, *(robot for _, x, y in merges for robot in x + y)), merges)
    return bool(set(first[list(a)].tolist()) & set(first[list(b)].tolist()))
