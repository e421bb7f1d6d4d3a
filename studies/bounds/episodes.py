"""Readings of episodes of the environment with their ground truth, and replays of these by filters."""

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from agents.policy import Policy
from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.fastslam.options import FilterOptions
from slam_backend.fastslam.relative_poses import TeamPoses
from slam_backend.geometry import between
from slam_backend.team.reports import (
    LandmarkIdMap,
    LandmarksCreated,
    MapForked,
    MergeEvent,
    MergeUndone,
    TeamReport,
)
from slam_backend.team.team import TeamSlam
from slam_backend.trajectory import dead_reckoning
from training.episodes.guard import GuardedTeam
from training.episodes.runner import EpisodeRecord, Progress, run_episode
from vslam_env.belief.readings import Readings
from vslam_env.belief.team_belief import merge_options
from vslam_env.config import EnvConfig
from vslam_env.environment import ExplorationEnv

NONE = -1  # label of a measurement without a landmark


@dataclass(frozen=True, slots=True, eq=False)
class RecordedEpisode:
    """Readings of K robots in T ticks, the first at the reset, with the truth."""

    config: EnvConfig  # Configuration of the environment
    belief_seed: np.random.SeedSequence  # Seed of the team's filters
    readings: tuple[tuple[Readings, ...], ...]  # Readings by tick and robot
    true_ids: tuple[tuple[IntArray, ...], ...]  # True landmarks (n,) of the measurements, by tick and robot; -1: none
    true_paths: FloatArray  # (K, T, 3) float64 [m, m, rad], world frame
    landmarks: FloatArray  # (N, 3) float64 [m], world frame. All landmarks of the world.
    observable: IntArray  # (N',) int64. Indices of the landmarks that the record's claims refer to.
    record: EpisodeRecord  # Record of the episode
    actions: tuple[Mapping[str, Any], ...]  # Actions of the robots by step

    @property
    def odometry(self) -> FloatArray:
        """(K, T - 1, 3) float64 [m, m, rad], previous robot frames. Odometry readings."""
        read = [[own.odometry for own in tick] for tick in self.readings[1:]]
        return np.array(read, dtype=np.float64).transpose(1, 0, 2).copy()

    @property
    def own_true_paths(self) -> FloatArray:
        """(K, T, 3) float64 [m, m, rad]. True paths, each in the robot's own start frame."""
        return between(self.true_paths[:, :1], self.true_paths)

    def dead_reckoning(self) -> FloatArray:
        """Return the paths (K, T, 3) [m, m, rad] by odometry alone, each in the robot's own start frame."""
        return np.stack([dead_reckoning(np.zeros(3), own) for own in self.odometry])


@dataclass(frozen=True, slots=True, eq=False)
class FilterTrack:
    """Online estimates and data associations of a team's filters in T ticks."""

    paths: FloatArray  # (K, T, 3) float64 [m, m, rad]. Poses as estimated at each tick, own start frames.
    covariances: FloatArray  # (K, T, 3, 3) float64. Covariances of these poses.
    # Labels (n,) int64 of the landmarks that measurements were associated with, by tick and robot: equal for one
    # landmark, whichever map holds it; `NONE`: rejected
    labels: tuple[tuple[IntArray, ...], ...]
    merges: tuple[tuple[int, tuple[int, ...], tuple[int, ...]], ...]  # Tick and groups of merges that were not undone
    events: tuple[MergeEvent, ...]  # Attempts, merges and undos
    step_ms: float  # Mean processor time of a tick of all filters [ms]


def record_episode(env: ExplorationEnv, policies: Mapping[str, Policy] | GuardedTeam, seed: int) -> RecordedEpisode:
    """Run an episode to its end and record its readings with the true landmarks of all measurements."""
    readings: list[tuple[Readings, ...]] = []
    true_ids: list[tuple[IntArray, ...]] = []
    actions: list[Mapping[str, Any]] = []

    def note(tick: tuple[Readings, ...]) -> None:
        readings.append(tick)
        if len(readings) > 1:  # the frames of the reset are taken before the environment has its episode
            true_ids.append(tuple(frame.true_ids for frame in env.episode.frames))

    def note_step(progress: Progress) -> None:
        if progress.step == 0:
            true_ids.append(tuple(frame.true_ids for frame in env.episode.frames))
        else:
            actions.append(progress.actions)

    env.recorder = note
    record = run_episode(env, policies, seed, note_step)
    env.recorder = None
    episode = env.episode
    landmarks = episode.world.landmarks
    assert landmarks is not None
    return RecordedEpisode(
        config=env.config, belief_seed=episode.belief_seed, readings=tuple(readings), true_ids=tuple(true_ids),
        true_paths=episode.true_path.swapaxes(0, 1).copy(), landmarks=landmarks.positions.copy(),
        observable=np.flatnonzero(episode.scenario.observable_landmarks), record=record,
        actions=tuple(actions),
    )  # fmt: skip


def new_team(episode: RecordedEpisode, options: FilterOptions) -> TeamSlam:
    """Return the team of an episode before its first step, with given options of the filters."""
    belief = episode.config.belief
    seed = np.random.SeedSequence(episode.belief_seed.entropy, spawn_key=episode.belief_seed.spawn_key)
    schedule, merging = merge_options(belief, attempts=True)
    chosen = {field.name: getattr(options, field.name) for field in fields(FilterOptions)}
    return TeamSlam(len(episode.true_paths), belief.alignment, seed, schedule, merging, **chosen)


def replay(episode: RecordedEpisode, options: FilterOptions) -> FilterTrack:
    """Run new filters with given options on the readings of an episode.

    With the options of the episode's own filters they repeat its estimates exactly.
    """
    team, count = new_team(episode, options), len(episode.true_paths)
    points, labels = TeamPoses(count), _Labels(count)
    paths, covariances, seconds = [], [], 0.0
    for tick in episode.readings:
        contacts = None if tick[0].contacts is None else np.stack([own.contacts for own in tick])  # type: ignore[misc]
        begin = time.process_time()
        report = team.step([own.odometry for own in tick], [own.measurements for own in tick], contacts)
        if tick is episode.readings[-1]:
            team.rejuvenate()  # as environments do in the last step
        team.team_poses(points)
        seconds += time.process_time() - begin
        labels.record(report)
        paths.append(points.own.copy())
        covariances.append(points.covariances.copy())
    return FilterTrack(
        np.stack(paths, axis=1), np.stack(covariances, axis=1), labels.resolved(), labels.merges(),
        team.events, 1e3 * seconds / len(paths),
    )  # fmt: skip


class _Labels:
    """Names of landmarks over all maps of a team, joined where maps are merged."""

    def __init__(self, num_robots: int) -> None:
        self._names: list[list[list[tuple[int, int] | None]]] = []  # (map, id) by tick, robot and measurement
        self._held: dict[int, set[int]] = {number: set() for number in range(num_robots)}  # ids of each map
        self._joins: list[tuple[LandmarkIdMap | MapForked, list[tuple[tuple[int, int], tuple[int, int]]]]] = []
        self._merges: list[tuple[int, LandmarkIdMap]] = []

    def record(self, report: TeamReport) -> None:
        """Note the associations and changes of maps in a tick."""
        self._names.append([
            [(number, i) if i >= 0 else None for i in found.tolist()]
            for number, found in zip(maps_before_merges(report), report.associations, strict=True)
        ])  # fmt: skip
        for change in report.map_changes:
            if isinstance(change, LandmarksCreated):
                self._held.setdefault(change.number, set()).update(i for i in change.ids.tolist() if i >= 0)
            elif isinstance(change, LandmarkIdMap):
                a, b, joint = change.maps
                pairs = [((a, i), (joint, i)) for i in self._held[a]]
                pairs += [((b, old), (joint, new)) for old, new in change.ids_b.tolist()]
                self._held[joint] = {new for _, (_, new) in pairs}
                self._joins.append((change, pairs))
                self._merges.append((report.step, change))
            elif isinstance(change, MapForked):
                self._held[change.copy] = set(self._held[change.source])
                self._joins.append((change, [((change.source, i), (change.copy, i)) for i in self._held[change.copy]]))
            elif isinstance(change, MergeUndone):
                self._joins = [join for join in self._joins if getattr(join[0], "maps", None) != change.maps]
                self._merges = [merge for merge in self._merges if merge[1].maps != change.maps]

    def merges(self) -> tuple[tuple[int, tuple[int, ...], tuple[int, ...]], ...]:
        """Return tick and groups of the merges that were not undone."""
        return tuple((tick, change.robots_a, change.robots_b) for tick, change in self._merges)

    def resolved(self) -> tuple[tuple[IntArray, ...], ...]:
        """Return the label of each measurement, by tick and robot."""
        parents: dict[tuple[int, int], tuple[int, int]] = {}

        def root(name: tuple[int, int]) -> tuple[int, int]:
            while name in parents:
                name = parents[name]
            return name

        for _, pairs in self._joins:
            for one, other in pairs:
                first, second = root(one), root(other)
                if first != second:
                    parents[second] = first
        numbers: dict[tuple[int, int], int] = {}
        return tuple(
            tuple(
                np.array(
                    [NONE if name is None else numbers.setdefault(root(name), len(numbers)) for name in own],
                    dtype=np.int64,
                )
                for own in tick
            )
            for tick in self._names
        )


def maps_before_merges(report: TeamReport) -> list[int]:
    """Return the number of each robot's map in a tick after losses of contact, and before merges and undos."""
    maps = list(report.maps)
    for change in reversed(report.map_changes):
        if isinstance(change, LandmarkIdMap):
            a, b, joint = change.maps
            maps = [(a if k in change.robots_a else b) if held == joint else held for k, held in enumerate(maps)]
        elif isinstance(change, MergeUndone):
            maps = [change.maps[2] if held in change.maps else held for held in maps]
    return maps


def components(num_robots: int, merges: Iterable[tuple[int, Sequence[int], Sequence[int]]]) -> IntArray:
    """Return for each robot (K,) the first robot of its group after all merges.

    >>> components(4, [(10, (1,), (3,)), (20, (0,), (1, 3))]).tolist()
    [0, 0, 2, 0]
    """
    first = np.arange(num_robots)
    for _, a, b in merges:
        joined = np.isin(first, first[[*a, *b]])
        first[joined] = first[joined].min()
    return first
