"""Runner for one episode of an environment with given policies, and its record for tables and figures."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from agents.policy import Policy
from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import FloatArray, IntArray, argument_error
from slam_backend.fastslam.consistency import Consistency
from slam_backend.geometry import between, wrap_angle
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.metrics import nees
from slam_backend.team.reports import MergeEvent, PairAttempts, count_attempts
from slam_backend.trajectory import dead_reckoning
from training.episodes.guard import GuardedTeam
from training.experiments.output.logs import LOGGER
from vslam_env.belief.readings import Readings
from vslam_env.config import TICK
from vslam_env.environment import ExplorationEnv
from vslam_env.rendering import Scene

FALSE_MERGE_M, FALSE_MERGE_DEG = 0.5, 5.0
KNOWN = 1e-6  # a pose with a smaller standard deviation in any direction is known exactly [m, rad]


def is_false_merge(error_m: float, error_deg: float) -> bool:
    """Return whether the errors of a merge exceed the thresholds of a false merge."""
    return error_m > FALSE_MERGE_M or error_deg > FALSE_MERGE_DEG


@dataclass(frozen=True, slots=True)
class MergeRecord:
    """One merge, compared with the ground truth."""

    tick: int  # Ticks since the reset
    time: float  # Time since the reset [s]
    robots_a: tuple[int, ...]  # Group whose map frame is kept
    robots_b: tuple[int, ...]  # Other group
    landmarks: int  # Number of matched landmarks of the two maps
    error_m: float  # Error of the translation between the two map frames [m]
    error_deg: float  # Error of the rotation between them, >= 0 [degrees]
    undone: float | None = None  # Time at which the merge was undone [s]; None: it was not

    @property
    def is_false(self) -> bool:
        """Whether the errors exceed the thresholds of a false merge."""
        return is_false_merge(self.error_m, self.error_deg)


@short_repr
@dataclass(frozen=True, slots=True, eq=False)
class EpisodeRecord:
    """Record of an episode of K robots and T steps."""

    times: FloatArray  # (T + 1,) float64 [s]. Times of the reset and of each step.
    true_poses: FloatArray  # (K, T + 1, 3) float64 [m, m, rad], world frame
    estimated: FloatArray  # (K, T + 1, 3) float64 [m, m, rad]. Pose estimates at the time, start frames.
    reckoned: FloatArray  # (K, T + 1, 3) float64 [m, m, rad]. Dead reckoning, start frames.
    map_errors: FloatArray  # (K, T + 1) float64 [m]
    nees: FloatArray  # (K, T + 1) float64 [-]. NEES of the poses, ideally 3; NaN where a pose is known exactly
    coverage: FloatArray  # (T + 1,) float64 [-]
    overlap: float  # Share of the seen floor that at least two robots have seen
    merges: tuple[MergeRecord, ...]  # Merges in order
    attempts: int  # Number of alignment attempts
    pairs: tuple[PairAttempts, ...]  # Outcomes of these attempts, by pairs of groups
    groups: tuple[tuple[int, ...], ...]  # Robots that share a map at the end
    infos: tuple[Mapping[str, Any], ...]  # Last info of each robot
    # Map of each robot just before its first merge, start frame; the final map if it never merged
    own_maps: tuple[LandmarkMap, ...]
    alone_until: tuple[float | None, ...]  # Time of each robot's first merge [s], or None
    # True landmarks (n,) int64 of the landmarks in each robot's map, the claims of `map_rmse`
    map_claims: tuple[IntArray, ...]
    maps: tuple[LandmarkMap, ...]  # Final map of each robot, start frame
    true_landmarks: FloatArray  # (N, 3) float64 [m], world frame
    consistency: tuple[Consistency, ...]  # Consistency of each robot's filter at the end
    scene: Scene  # Last scene: truth and maps in the world frame
    complete: bool  # Whether the episode ran to its end


@dataclass(frozen=True, slots=True, eq=False)
class Progress:
    """Progress of an episode."""

    step: int  # Completed steps; 0 after the reset
    time: float  # Time since the reset [s]
    infos: Mapping[str, Mapping[str, Any]]  # Infos of all agents, as the environment returned them
    new_merges: tuple[MergeRecord, ...]  # Merges of this step
    observations: Mapping[str, Any] = field(default_factory=dict)  # Observations of all agents
    # Of all agents, none after the reset:
    actions: Mapping[str, Any] = field(default_factory=dict)
    rewards: Mapping[str, float] = field(default_factory=dict)
    terminations: Mapping[str, bool] = field(default_factory=dict)
    truncations: Mapping[str, bool] = field(default_factory=dict)


def run_episode(
    env: ExplorationEnv, policies: Mapping[str, Policy] | GuardedTeam, seed: int,
    on_step: Callable[[Progress], None] = lambda progress: None, should_stop: Callable[[], bool] = lambda: False,
    options: Mapping[str, Any] | None = None,
) -> EpisodeRecord:  # fmt: skip
    """Run one episode to its end, or until `should_stop`.

    Args:
        env: Environment. A recorder that it already has also receives the readings.
        policies: Policy of each agent, or all of them; policies see observations and beliefs, never infos.
        seed: Seed of the reset and of the policies' random draws, which are independent streams.
        on_step: Function called after the reset and after each step; it may inspect the environment.
        options: Options of the reset.

    Raises:
        ValueError: If an agent has no policy, or a policy fails (`PolicyError`).
    """
    agents = list(env.possible_agents)
    if isinstance(policies, GuardedTeam):
        team = policies
    else:
        missing = [agent for agent in agents if agent not in policies]
        if missing:
            raise argument_error("policies", "a policy for each agent", f"no policy for {missing}", "Add them.")
        team = GuardedTeam(policies, type(policies[agents[0]]).__name__, env.config.action_type)
    *streams, team_stream = np.random.SeedSequence([seed, len(agents)]).spawn(len(agents) + 1)
    rngs = {agent: np.random.default_rng(stream) for agent, stream in zip(agents, streams, strict=True)}
    team_rng = np.random.default_rng(team_stream)
    odometry: list[FloatArray] = []
    other = env.recorder

    def record(readings: tuple[Readings, ...]) -> None:
        odometry.append(np.stack([np.zeros(3) if r.odometry is None else r.odometry for r in readings]))
        if other is not None:
            other(readings)

    env.recorder = record
    try:
        observations, infos = env.reset(seed=seed, options=options)
        team.reset()
        log = _Log(env, infos)
        on_step(Progress(0, 0.0, infos, (), observations))
        while env.agents and not should_stop():
            actions = team.act_all(observations, {agent: env.belief(agent) for agent in env.agents}, rngs, team_rng)
            log.before_step()
            observations, rewards, terminations, truncations, infos = env.step(actions)
            progress = log.after_step(infos, len(odometry) - 1)
            on_step(
                replace(
                    progress, observations=observations, actions=actions, rewards=rewards, terminations=terminations,
                    truncations=truncations,
                )
            )  # fmt: skip
        return log.finish(np.array(odometry))
    finally:
        env.recorder = other


def describe_event(event: MergeEvent, numbers: Sequence[int] | None = None) -> str:
    """Describe an event of the team in one line.

    Args:
        numbers: Numbers of the robots; None: their indices.
    """
    sides = [", ".join(str(robot if numbers is None else numbers[robot]) for robot in side)
             for side in (event.robots_a, event.robots_b)]  # fmt: skip
    both = f"{sides[0]} and {sides[1]}"
    shared = len(event.alignment.inliers)
    if event.kind == "merge":
        return f"maps of {both} merged on {shared} landmarks"
    if event.kind == "undo":
        return f"merge of {both} undone"
    if event.alignment.success:
        return f"maps of {both} aligned on {shared} landmarks"
    return f"maps of {both} not aligned: {event.alignment.reason}"


class _Log:
    """Collector of the record, step by step."""

    def __init__(self, env: ExplorationEnv, infos: Mapping[str, Mapping[str, Any]]) -> None:
        self._env, self._agents = env, list(env.possible_agents)
        self._starts = env.true_start_poses
        self._ticks: list[int] = []
        self._true: list[FloatArray] = []
        self._estimated: list[FloatArray] = []
        self._errors: list[list[float]] = []
        self._covariances: list[FloatArray] = []
        self._coverage: list[float] = []
        self._merges: list[MergeRecord] = []
        self._events = 0
        self._maps: dict[int, LandmarkMap] = {}
        self._alone_until: dict[int, float] = {}
        self._infos = infos
        self._enter(infos, 0)

    def before_step(self) -> None:
        """Store the maps of the robots that have not merged yet."""
        for robot, agent in enumerate(self._agents):
            if robot not in self._alone_until:
                self._maps[robot] = self._env.belief(agent).map

    def after_step(self, infos: Mapping[str, Mapping[str, Any]], tick: int) -> Progress:
        """Record a step that ended at `tick`."""
        self._enter(infos, tick)
        events = self._env.events[self._events :]
        self._events += len(events)
        merges = tuple(self._merge_record(event) for event in events if event.kind == "merge")
        for merge in merges:
            for robot in merge.robots_a + merge.robots_b:
                self._alone_until.setdefault(robot, merge.time)
        self._merges.extend(merges)
        for event in events:
            LOGGER.debug("%.1f s: %s", event.step * TICK, describe_event(event))
            if event.kind == "undo":
                self._record_undo(event)
        return Progress(len(self._ticks) - 1, tick * TICK, infos, merges)

    def finish(self, odometry: FloatArray) -> EpisodeRecord:
        """Return the record.

        Args:
            odometry: (ticks + 1, K, 3) float64 [m, m, rad]. Odometry readings of all ticks; zero for the reset.
        """
        ticks = np.array(self._ticks)
        reckoned = [dead_reckoning(np.zeros(3), odometry[1:, robot])[ticks] for robot in range(len(self._agents))]
        last = {robot: self._env.belief(agent) for robot, agent in enumerate(self._agents)}
        episode, ground_truth = self._env.episode, self._env.episode.ground_truth
        maps = {**self._maps, **{r: belief.map for r, belief in last.items() if r not in self._alone_until}}
        return EpisodeRecord(
            times=ticks * TICK, true_poses=np.stack(self._true, axis=1), estimated=np.stack(self._estimated, axis=1),
            reckoned=np.stack(reckoned), map_errors=np.array(self._errors).T, nees=self._nees(),
            coverage=np.array(self._coverage), overlap=episode.coverage.overlap(episode.belief.grids),
            merges=tuple(self._merges), attempts=sum(event.kind == "attempt" for event in self._env.events),
            pairs=count_attempts(self._env.events), groups=tuple(sorted({belief.group for belief in last.values()})),
            infos=tuple(dict(self._infos[agent]) for agent in self._agents),
            own_maps=tuple(maps[robot] for robot in range(len(self._agents))),
            alone_until=tuple(self._alone_until.get(robot) for robot in range(len(self._agents))),
            map_claims=tuple(ground_truth.true_ids(robot, belief.map.ids) for robot, belief in last.items()),
            maps=tuple(belief.map for belief in last.values()), true_landmarks=self._env.true_landmarks,
            consistency=tuple(map(self._env.episode.belief.team.consistency, last)), scene=self._env.scene(),
            complete=not self._env.agents,
        )  # fmt: skip

    def _nees(self) -> FloatArray:
        """Return the NEES (K, T + 1) of the poses, NaN where a pose is known exactly, as at the start."""
        errors = np.stack(self._estimated, axis=1) - between(self._starts[:, None], np.stack(self._true, axis=1))
        errors[..., 2] = wrap_angle(errors[..., 2])
        covariances = np.stack(self._covariances, axis=1)
        values = np.full(errors.shape[:-1], np.nan)
        uncertain = np.linalg.eigvalsh(covariances)[..., 0] > KNOWN**2
        values[uncertain] = nees(errors[uncertain], covariances[uncertain])
        return values

    def _enter(self, infos: Mapping[str, Mapping[str, Any]], tick: int) -> None:
        self._infos = infos
        self._ticks.append(tick)
        beliefs = [self._env.belief(agent) for agent in self._agents]
        self._true.append(self._env.true_poses)
        self._estimated.append(np.stack([belief.pose for belief in beliefs]))
        self._covariances.append(np.stack([belief.covariance for belief in beliefs]))
        self._errors.append([float(infos[agent]["map_error"]) for agent in self._agents])
        self._coverage.append(float(infos[self._agents[0]]["coverage"]))

    def _record_undo(self, event: MergeEvent) -> None:
        """Record the undo of the last merge between two groups."""
        pair = event.robots_a, event.robots_b
        last = max(i for i, merge in enumerate(self._merges) if (merge.robots_a, merge.robots_b) == pair)
        self._merges[last] = replace(self._merges[last], undone=event.step * TICK)

    def _merge_record(self, event: MergeEvent) -> MergeRecord:
        """Compare a merge with the true transform between the start poses of the two map frames."""
        truth = between(self._starts[min(event.robots_a)], self._starts[min(event.robots_b)])
        error = between(truth, event.alignment.transform)
        return MergeRecord(
            tick=event.step, time=event.step * TICK, robots_a=event.robots_a, robots_b=event.robots_b,
            landmarks=len(event.alignment.inliers), error_m=float(np.hypot(error[0], error[1])),
            error_deg=float(abs(np.degrees(error[2]))),
        )  # fmt: skip
