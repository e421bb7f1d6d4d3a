"""PettingZoo parallel environment."""

import copy
import dataclasses
import warnings
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from slam_backend.core.compilation.compiler import expect
from slam_backend.core.validation import FloatArray, argument_error, check_choice, check_int, did_you_mean
from slam_backend.state import Snapshot, accepted, restore, take
from slam_backend.team.reports import MergeEvent
from vslam_env.actions import action_space, checked_actions
from vslam_env.belief.observation import flatten, observation_space, observe_team
from vslam_env.belief.observation_keys import MASK
from vslam_env.belief.readings import Readings
from vslam_env.belief.team_belief import Belief, TeamBelief
from vslam_env.config import TICK, TICKS_PER_SECOND, EnvConfig
from vslam_env.evaluation.team_metrics import TeamMetrics
from vslam_env.rendering import Scene, draw_frame
from vslam_env.rendering.from_episode import build_scene
from vslam_env.rendering.window import Window
from vslam_env.reward import RewardSpec, evaluate, make_terms, reads_beliefs, reads_coverage, totals
from vslam_env.simulation.controllers import ActionExecutor
from vslam_env.simulation.episode import Episode, ReadingsHook, Recorder
from vslam_env.simulation.memory import memory_errors_as_argument_errors
from vslam_env.simulation.scenario import sample_scenario
from vslam_env.snapshots import EnvParts, EnvState, check_state, snapshot_objects, state_sizes, state_version
from vslam_env.world import World, WorldSource, check_source, is_single_layout

AgentID = str
STATE_PER_ROBOT = 12
STATE_POSITIONS = 0, 4  # first columns of the true and the estimated position in a robot's part of `state()`
RESET_OPTIONS = ("world_seed", "start_poses")
PROBE = "options"  # option with which the test suite of PettingZoo resets any environment
RENDER_MODES = ("human", "rgb_array")


class ExplorationEnv(ParallelEnv[AgentID, Any, Any]):  # type: ignore[misc]   # PettingZoo has no type information
    """Multi-robot exploration of a building: robots with unknown starts build maps and merge them after alignment.

    Numbers are the defaults of `EnvConfig`; `vslam_v1.parallel_env` takes the most common options as arguments. A tick
    is 0.1 s, a step `decision_ticks` ticks: 1, or 10 with `goal` actions.

    **World.** Each reset draws walls from the world family, landmarks on all wall faces (1.4 per metre, each with a
    descriptor), starts at least 5 m apart without a shared view, and a bias of each robot's odometry. A robot is a disc
    of 0.2 m radius with odometry, a camera that measures up to 5 landmarks per tick within 8 m, a range scan and a bump
    sensor; all but the last are noisy. It does not know where the others started: each group of robots has a filter
    and a map of its own, and groups in contact merge once their maps can be aligned.

    **Actions.** Out-of-space actions raise an error before anything moves.

    | `action_type` | space | meaning |
    |---|---|---|
    | `continuous` | `Box(-1, 1, (2,), float32)` | speed, -1: 0.3 m/s back, 1: 1 m/s ahead; turn, 1: 1.5 rad/s left |
    | `discrete` | `Discrete(4)` | 0 stay, 1 ahead at 1 m/s, 2 turn left, 3 turn right at 1.5 rad/s |
    | `goal` | `Discrete(33)` | 0 stay, k: drive to the last observation's candidate k - 1; acts as 0 where masked |

    **Observations** are float32 unless said, in estimated frames, and depend on the robot's own readings and received
    messages alone. The start frame is the robot's start pose; the robot frame has x ahead and y to the left.
    `observation_keys` chooses among these keys; what none of them shows is not computed.

    | key | shape | content | bounds |
    |---|---|---|---|
    | `pose` | (3,) | x, y [m], theta [rad], start frame | +-400, pi |
    | `pose_std` | (3,) | one sigma of each [m, m, rad] | 400, pi |
    | `map_stats` | (6,) | landmarks; mean, largest sigma [m]; mean count; ESS/M; group size | 1e4, 10, 10, 1e4, 1, 8 |
    | `local_grid` | (3, 48, 48) uint8 | free, occupied, landmarks; cells of 0.2 m, robot heading up | 0, 255 |
    | `scan` | (32,) | ranges from right to left over the camera's field of view [m] | 0, 8 |
    | `candidates` | (32, 17) | columns `CANDIDATE_FEATURES`, robot frame; zeros in empty slots | +-400 |
    | `teammates` | (7, 5) | x, y [m], cos and sin of the heading, robot frame; one sigma of the position [m] | +-400 |
    | `teammates_mask` | (7,) int8 | which rows hold a robot of the same group | 0, 1 |
    | `landmark_counts` | (5,) | landmarks measured up to 2, 4, 8, 16, and more times | 0, 10000 |
    | `time_left` | (1,) | until the episode is truncated [s] | 0, 1e6 |
    | `global_grid` | (3, 48, 48) uint8 | shares of free, occupied and looked-at cells of all that was seen | 0, 255 |
    | `global_grid_frame` | (3,) | x, y of its middle, start frame, and size of its cells [m] | +-400 |
    | `action_mask` | (33,) int8 | `goal` actions only: which actions are valid | 0, 1 |

    Rows of `teammates` belong to the other robots in ascending order, whatever their group; rows of robots outside the
    group are zero. The sigma of a landmark is the root of its mean variance. Values are clipped to the bounds.

    **Reward.** By default the decrease [m] of the robot's map error E, which compares its map in its own start frame
    with the true landmarks and charges missed, false and duplicate ones (`slam_backend.metrics.map_error`): a map that
    gets better pays, a wrong merge costs, and an episode returns the first E minus the last. `vslam_env.reward` has
    further terms.

    **End.** All agents truncate together after `max_cycles` steps, which are 100 s. They terminate together if
    `stop_at_recall` is set and the map of each robot has that share of the landmarks.

    >>> from vslam_env import vslam_v1
    >>> env = vslam_v1.parallel_env("hall", num_robots=2, max_seconds=0.3)
    >>> observations, infos = env.reset(seed=1)
    >>> while env.agents:
    ...     actions = {agent: env.action_space(agent).sample() for agent in env.agents}
    ...     observations, rewards, terminations, truncations, infos = env.step(actions)
    >>> truncations
    {'robot_0': True, 'robot_1': True}

    Args:
        config: Configuration of the environment.
        world: World or source of worlds; None: that of the configuration.
        reward: Weights of terms by name, or custom terms; None: those of the configuration.
        render_mode: `"human"`, `"rgb_array"` or None.

    Attributes:
        config: Configuration of the environment.
        possible_agents: Names of the robots.
        observation_spaces: Observation spaces by agent.
        action_spaces: Action spaces by agent.
    """

    STATE = EnvParts.STATE

    possible_agents: list[AgentID]
    observation_spaces: dict[AgentID, spaces.Space[Any]]
    action_spaces: dict[AgentID, spaces.Space[Any]]

    metadata: ClassVar[dict[str, Any]] = {
        "name": "vslam_env/Exploration",
        "render_modes": list(RENDER_MODES),
        "render_fps": 10,
        "is_parallelizable": True,
    }

    def __init__(
        self,
        config: EnvConfig,
        world: WorldSource | None = None,
        reward: RewardSpec | None = None,
        render_mode: str | None = None,
    ) -> None:
        if render_mode is not None:
            check_choice("render_mode", render_mode, RENDER_MODES, "Choose one of these, or None.")
        self.render_mode = render_mode
        self.max_cycles = config.num_cycles
        self._hook = ReadingsHook()  # separate object, so that an episode does not keep its environment alive
        self._source: WorldSource = config.world if world is None else world
        check_source(self._source)
        if config.world_split is not None and is_single_layout(self._source):
            hint = "Use a family, a folder or a function, or omit the split."
            raise argument_error("world_split", "None for a single layout", config.world_split, hint)
        self._terms = make_terms(config.reward if reward is None else reward)
        self.config = dataclasses.replace(config, reward={term.name: term.weight for term in self._terms})
        self.possible_agents = config.agents
        self.agents: list[AgentID] = []
        self._shown_as = config.observed, config.observation_type == "flat"
        scan, (keys, is_flat) = config.scan, self._shown_as
        self._observed = observation_space(keys, scan.num_rays, scan.max_range, is_flat)
        if config.observe_images and isinstance(self._observed, spaces.Dict):
            shape = (config.stereo.camera.height, config.stereo.camera.width, 1)
            image = spaces.Box(0, 255, shape, np.uint8)
            self._observed = spaces.Dict({**self._observed.spaces, "image": image})
        self.observation_spaces = dict.fromkeys(self.possible_agents, self._observed)
        self.action_spaces = {agent: action_space(config.action_type) for agent in self.possible_agents}
        size = STATE_PER_ROBOT * config.num_robots + 2
        self.state_space = spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self._nothing = [0.0] * config.num_robots
        self._reads_beliefs = any(map(reads_beliefs, self._terms))
        self._reads_coverage = config.action_type == "goal" or any(map(reads_coverage, self._terms))
        self._root: np.random.SeedSequence | None = None
        self._episode: Episode | None = None
        self._is_whole = True  # False while the episode changes, and after a change that was cut short
        self._cycle = 0
        self._executor = ActionExecutor(self.config)
        self._team_metrics: TeamMetrics  # set at a reset
        self._window = Window(self.metadata["name"])
        self._objects, self._version = snapshot_objects(self._source, self._terms), state_version()

    # ------------------------------------------------------------------ PettingZoo

    def reset(
        self, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[dict[AgentID, Any], dict[AgentID, dict[str, Any]]]:
        """Build a new world, place the robots at their starts and take the first measurements.

        Args:
            seed: Seed of this and all following episodes; None: continue the seed sequence, or start an arbitrary one.
            options: `"world_seed"`: int, seed of layout and textures only. `"start_poses"`: (K, 3) [m, m, rad], world
                frame. Any other key causes a warning.

        Returns:
            Observations and infos by agent.

        Raises:
            ValueError: If the seed, an option or the world is invalid. The environment is then unchanged: a running
                episode continues, and the next reset draws the same random numbers.
        """
        if seed is not None:
            root = np.random.SeedSequence(check_int("seed", seed, 0, "Give an int >= 0, or None."))
        else:  # a copy: a failed reset changes nothing
            root = np.random.SeedSequence() if self._root is None else copy.deepcopy(self._root)
        options = {} if options is None else options
        if not isinstance(options, Mapping):
            raise argument_error("options", "a dict or None", options, "For example {'world_seed': 3}.")
        for name in options:
            if name not in RESET_OPTIONS and name != PROBE:  # wrappers may pass theirs, so that it is no error
                hint = f"{did_you_mean(name, RESET_OPTIONS)}Options are {' and '.join(RESET_OPTIONS)}."
                warnings.warn(f"reset ignores the option {name!r}. {hint}", stacklevel=2)
        world_seed = options.get("world_seed")
        if world_seed is not None:
            check_int("options['world_seed']", world_seed, 0, "Give an int >= 0.")
        expect(partial(_signatures_of, self.config))
        with memory_errors_as_argument_errors():
            scenario, streams = sample_scenario(
                self.config, self._source, root.spawn(1)[0], world_seed, options.get("start_poses")
            )
        episode = Episode(self.config, scenario, streams, self._hook)
        episode.begin()
        metrics = episode.team_metrics(self._reads_beliefs)
        self._is_whole = False
        self._root, self._episode, self._executor = root, episode, ActionExecutor(self.config)
        self._team_metrics = metrics
        self.agents = self.possible_agents[:]
        self._cycle = 0
        nothing = dict.fromkeys((term.name for term in self._terms), self._nothing)
        results = self._observe(self._episode, nothing, [0] * len(self.agents))
        self._is_whole = True
        return results

    def step(
        self, actions: Mapping[AgentID, Any]
    ) -> tuple[
        dict[AgentID, Any],
        dict[AgentID, float],
        dict[AgentID, bool],
        dict[AgentID, bool],
        dict[AgentID, dict[str, Any]],
    ]:
        """Execute the actions of all robots for `decision_ticks` ticks.

        In the last step of an episode filters with a smoother are rejuvenated before the maps are scored;
        `running_cost` charges the maps before that.

        Args:
            actions: One action per agent.

        Returns:
            Observations, rewards, terminations, truncations and infos by agent.

        Raises:
            ValueError: If an agent is unknown or missing, or an action is outside its space; nothing is changed then.
            RuntimeError: Before the first reset, after the end of the episode, or after a step that was cut short by
                an exception, such as KeyboardInterrupt; `reset` and `set_state` then start from a whole state.
        """
        episode = self._running_episode("step")
        self.check_whole("step")
        if not self.agents:
            raise RuntimeError("step: expected a running episode, got one that has ended. Call reset() first.")
        agents = self.agents
        chosen = checked_actions(actions, agents, self.config.action_type)
        self._is_whole = False
        invalid = self._executor.execute(episode, chosen)
        before = self._team_metrics
        ticks = self.config.ticks_per_step
        is_new_second = episode.tick // TICKS_PER_SECOND > (episode.tick - ticks) // TICKS_PER_SECOND
        self._team_metrics = episode.team_metrics(self._reads_beliefs, self._reads_coverage or is_new_second)
        self._cycle += 1

        recall = self.config.stop_at_recall
        terminated = recall is not None and bool(self._team_metrics.map_recalls.min() >= recall)
        truncated = not terminated and self._cycle >= self._max_cycles
        if terminated or truncated:  # the maps that are handed in are smoothed up to the last tick
            episode.belief.rejuvenate()
            self._team_metrics = episode.team_metrics(self._reads_beliefs)
        terms = evaluate(self._terms, before, self._team_metrics, self.config.shared_reward)
        observations, infos = self._observe(episode, terms, invalid)
        results = (
            observations,
            dict(zip(agents, totals(terms), strict=True)),
            dict.fromkeys(agents, terminated),
            dict.fromkeys(agents, truncated),
            infos,
        )
        if terminated or truncated:
            self.agents = []
        self._is_whole = True
        if self.render_mode == "human":
            self.render()
        return results

    def render(self) -> NDArray[np.uint8] | None:
        """Return a picture (720, 960, 3) uint8 with `"rgb_array"`; show it with `"human"` and return None.

        Raises:
            RuntimeError: Before the first reset.
        """
        if self.render_mode is None:
            return None
        frame = draw_frame(build_scene(self._running_episode("render"), self._team_metrics))
        if self.render_mode == "rgb_array":
            return frame
        self._window.show(frame)
        return None

    def close(self) -> None:
        """Close the window, if there is one."""
        self._window.close()

    def observation_space(self, agent: AgentID) -> spaces.Space[Any]:
        """Return the space of an agent's observations; always the same object."""
        self._index(agent)
        return self.observation_spaces[agent]

    def action_space(self, agent: AgentID) -> spaces.Space[Any]:
        """Return the space of an agent's actions; always the same object."""
        self._index(agent)
        return self.action_spaces[agent]

    def state(self) -> NDArray[np.float32]:
        """Return the true state for centralised critics, as one float32 vector.

        Per robot: true pose (x, y, cos, sin, world frame), estimated pose (x, y, cos, sin, moved by the true start
        pose), map error, map recall, heading error, first robot of its group; then coverage and merges of the team.
        """
        episode = self._running_episode("state")
        both = episode.true_path[-1], episode.estimated_poses()
        rows = [np.column_stack([poses[:, :2], np.cos(poses[:, 2]), np.sin(poses[:, 2])]) for poses in both]
        metrics, coverage = self._team_metrics, episode.coverage.share_now(episode.belief.grids)
        frames = [group[0] for group in episode.belief.known_groups]
        scores = np.column_stack([metrics.map_errors, metrics.map_recalls, metrics.heading_errors, frames])
        state = np.concatenate([np.hstack([*rows, scores]).ravel(), [coverage, metrics.merges]])
        return np.asarray(state, dtype=np.float32)

    # ------------------------------------------------------------------ extensions

    def belief(self, agent: AgentID) -> Belief:
        """Return the belief of an agent's robot, which contains no ground truth."""
        beliefs = self._running_episode("belief").belief
        beliefs.set_seconds_left(self._seconds_left)
        return beliefs.belief(self._index(agent))

    @property
    def events(self) -> tuple[MergeEvent, ...]:
        """All merge attempts, merges and rollbacks since the reset, in order."""
        return self._running_episode("events").belief.team.events

    @property
    def readings(self) -> tuple[Readings, ...]:
        """Readings of each robot in the last tick."""
        return self._running_episode("readings").readings.per_robot()

    @property
    def world(self) -> World:
        """True world of this episode, including its landmarks."""
        return self._running_episode("world").world

    @property
    def true_landmarks(self) -> FloatArray:
        """(N, 3) float64 [m], world frame. Copy of the positions of the observable landmarks."""
        return self._running_episode("true_landmarks").ground_truth.true_positions.copy()

    @property
    def true_poses(self) -> FloatArray:
        """(K, 3) float64 [m, m, rad], world frame. True poses after the last tick."""
        return self._running_episode("true_poses").true_poses

    @property
    def true_start_poses(self) -> FloatArray:
        """(K, 3) float64 [m, m, rad], world frame. True poses at the reset."""
        return self._running_episode("true_start_poses").true_starts.copy()

    @property
    def episode(self) -> Episode:
        """Running episode, for diagnosis: ground-truth association, paths, seeds."""
        return self._running_episode("episode")

    @property
    def recorder(self) -> Recorder | None:
        """Callback for the readings of every tick, including the reset; may be assigned."""
        return self._hook.recorder

    @recorder.setter
    def recorder(self, recorder: Recorder | None) -> None:
        if recorder is not None and not callable(recorder):
            raise argument_error("recorder", "a function or None", recorder, "It receives a tuple of Readings.")
        self._hook.recorder = recorder

    @property
    def max_cycles(self) -> int:
        """Number of steps after which the episode is truncated; may be assigned."""
        return self._max_cycles

    @max_cycles.setter
    def max_cycles(self, max_cycles: int) -> None:
        self._max_cycles = check_int("max_cycles", max_cycles, 1, "Give a number of steps.")

    def scene(self) -> Scene:
        """Return the content of a picture of the current tick."""
        return build_scene(self._running_episode("scene"), self._team_metrics)

    # ------------------------------------------------------------------ snapshots

    def get_state(self) -> Snapshot:
        """Return the complete state: world, filters, random streams and the seed sequence of later resets.

        An environment that restores it returns the same bytes for the same actions. The state cannot be changed;
        `dict(state)` makes a copy that can. `vslam_env.save_state` writes the state to disk. The recorder, the window
        and the internal state of custom reward terms are not included.

        Raises:
            RuntimeError: After a step that was cut short by an exception.
        """
        self.check_whole("get_state")
        return take(self)

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Restore a state of `get_state` and continue it exactly, also in another process.

        Args:
            state: Result of `get_state`; it can be restored repeatedly.

        Raises:
            ValueError: If the state is malformed, or from another version or configuration; the environment is then
                unchanged.
        """
        episode = self._episode if self._is_whole else None  # the parts of an episode cut short are not reused
        sizes = state_sizes(self.config, None if episode is None else episode.scenario)
        snapshot = accepted(type(self), "state", check_state(state, self.config, self._objects), sizes)
        if (kept := snapshot["episode"]) is not None and (episode is None or episode.scenario is not kept["scenario"]):
            episode = Episode(self.config, kept["scenario"], {}, self._hook)
        self._is_whole = False
        self._episode = episode
        restore(self, snapshot)
        if self._episode is not None:
            self._team_metrics = self._episode.team_metrics(self._reads_beliefs, False)
        self._is_whole = True

    def check_whole(self, name: str) -> None:
        """Raise a RuntimeError, as of the method `name`, after a step that was cut short by an exception."""
        if not self._is_whole:
            got = "that of a step cut short by an exception. Call reset() or set_state()."
            raise RuntimeError(f"{name}: expected a whole state, got {got}")

    def clone(self) -> "ExplorationEnv":
        """Return an independent environment in the same state, without window and recorder."""
        mode = None if self.render_mode == "human" else self.render_mode
        clone = ExplorationEnv(self.config, self._source, self._terms, mode)
        clone.max_cycles = self.max_cycles
        clone.set_state(self.get_state())
        return clone

    def __deepcopy__(self, memo: Any) -> "ExplorationEnv":
        return self.clone()

    def __reduce__(self) -> tuple[Any, ...]:
        arguments = (self.config, self._source, self._terms, self.render_mode)
        return _unpickled, (arguments, self.max_cycles, self.get_state())

    # ------------------------------------------------------------------ helpers

    def _observe(
        self, episode: Episode, terms: Mapping[str, Sequence[float]], invalid: list[int]
    ) -> tuple[dict[AgentID, Any], dict[AgentID, dict[str, Any]]]:
        """Return observations and infos by agent after the last tick; `terms` are the reward terms of the step."""
        agents, belief = self.possible_agents, episode.belief
        belief.set_seconds_left(self._seconds_left)
        observations = build_observations(agents, belief, *self._shown_as, episode.readings.images)
        return observations, build_infos(agents, belief.known_groups, self._team_metrics, terms, invalid)

    @property
    def _seconds_left(self) -> float:
        """Time until the episode is truncated [s]."""
        return max(self._max_cycles - self._cycle, 0) * self.config.ticks_per_step * TICK

    def _running_episode(self, name: str) -> Episode:
        if self._episode is None:
            raise RuntimeError(f"{name}: expected a running episode, got none. Call reset() first.")
        return self._episode

    def _index(self, agent: AgentID) -> int:
        if not isinstance(agent, str) or agent not in self.possible_agents:
            raise argument_error("agent", f"one of {self.possible_agents}", agent, "Use a name of possible_agents.")
        return self.possible_agents.index(agent)


def _unpickled(arguments: tuple[Any, ...], max_cycles: int, state: EnvState) -> ExplorationEnv:
    """Rebuild an environment from the parts of `ExplorationEnv.__reduce__`."""
    env = ExplorationEnv(*arguments)
    env.max_cycles = max_cycles
    env.set_state(state)
    return env


def build_infos(
    agents: Sequence[str],
    groups: Sequence[tuple[int, ...]],
    metrics: TeamMetrics,
    terms: Mapping[str, Sequence[float]],
    invalid: Sequence[int],
) -> dict[str, dict[str, Any]]:
    """Return the infos by agent; `map_rmse` is the cutoff of the map error while no landmark is matched.

    `collisions` (ticks), `distance` [m], `bytes_sent` and `merges` count since the reset.

    Args:
        agents: Names of the K robots.
        groups: Known group members of each robot, itself included.
        metrics: Current metrics of the team.
        terms: Weighted reward terms of the step by name, each with one value per robot.
        invalid: 1 for each robot whose action was masked, else 0.
    """
    scores, counts = metrics.per_robot, metrics.counts
    infos: dict[str, dict[str, Any]] = {}
    for robot, agent in enumerate(agents):
        group = groups[robot]
        infos[agent] = info = {
            "map_error": scores.map_errors[robot],
            "map_rmse": scores.map_rmses[robot],
            "map_recall": scores.map_recalls[robot],
            "map_precision": scores.map_precisions[robot],
            "pose_error": scores.pose_errors[robot],
            "heading_error": scores.heading_errors[robot],
            "coverage": metrics.coverage,
            "group": group[0],
            "group_size": len(group),
            "merges": metrics.merges,
            "collisions": counts.collisions[robot],
            "distance": scores.distances[robot],
            "bytes_sent": counts.bytes_sent[robot],
            "invalid_action": invalid[robot],
        }
        for name, rewards in terms.items():
            info["reward/" + name] = rewards[robot]
    return infos


def build_observations(
    agents: Sequence[str],
    belief: TeamBelief,
    keys: Sequence[str],
    flat: bool,
    images: Sequence[NDArray[np.uint8]] | None = None,
) -> dict[str, Any]:
    """Return the observations by agent after a tick.

    Args:
        agents: Names of the K robots.
        belief: Belief of the team.
        keys: Keys to observe, in their order.
        flat: Whether an observation is one vector instead of named arrays.
        images: (H, W) uint8. Left image of each robot, if images are observed.

    Returns:
        New arrays by name, see `ExplorationEnv`; if flat, one vector, or with an action mask
        `{"observation", "action_mask"}`.
    """
    named = observe_team(belief.view(keys), keys)
    if images is not None:
        for observation, image in zip(named, images, strict=True):
            observation["image"] = image[:, :, None].copy()
    if not flat:
        return dict(zip(agents, named, strict=True))
    return {
        agent: {"observation": flatten(each), MASK: each[MASK]} if MASK in each else flatten(each)
        for agent, each in zip(agents, named, strict=True)
    }


def _signatures_of(config: EnvConfig) -> dict[str, list[str]]:
    """Return the signatures of the kernels that an environment needs."""
    from vslam_env._warm_up import signatures_of  # which imports this module

    return signatures_of(config)
