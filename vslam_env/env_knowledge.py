"""What can be asked of an environment: spaces, beliefs, the truth. `ExplorationEnv` adds what changes it."""

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from slam_backend.core.validation import FloatArray, bad_argument, check_int
from slam_backend.fastslam.reports import MergeEvent
from vslam_env.belief import Belief
from vslam_env.episode import Episode, Recorder, Tap
from vslam_env.readings import Readings
from vslam_env.rendering import Scene
from vslam_env.scenes import scene_of
from vslam_env.standing import Standing
from vslam_env.world import World

AgentID = str
STATE_PER_ROBOT = 12


class EnvKnowledge(ParallelEnv[AgentID, Any, Any]):  # type: ignore[misc]   # PettingZoo has no type information
    """All that can be asked of an environment.

    Attributes:
        possible_agents: Names of the robots.
        observation_spaces: By name.
        action_spaces: By name.
        _tap: Where readings can be listened to.
        _episode: The running one; None before the first reset.
        _standing: How the team stood after the last step or reset.
    """

    possible_agents: list[AgentID]
    observation_spaces: dict[AgentID, spaces.Space[Any]]
    action_spaces: dict[AgentID, spaces.Space[Any]]
    _tap: Tap
    _episode: Episode | None
    _standing: Standing
    _max_cycles: int

    def observation_space(self, agent: AgentID) -> spaces.Space[Any]:
        """Return the space of an agent's observations; always the same object."""
        self._index(agent)
        return self.observation_spaces[agent]

    def action_space(self, agent: AgentID) -> spaces.Space[Any]:
        """Return the space of an agent's actions; always the same object."""
        self._index(agent)
        return self.action_spaces[agent]

    def state(self) -> NDArray[np.float32]:
        """Return the truth for centralised critics, as one float32 vector.

        Per robot: true pose (x, y, cos, sin, world frame), pose as estimated (x, y, cos, sin, laid at the true start),
        map error, map recall, heading error, first robot of its group; then coverage and merges of the team.
        """
        episode = self._running_episode("state")
        true, believed = episode.true_path[-1], episode.believed_poses()
        rows = [np.column_stack([poses[:, :2], np.cos(poses[:, 2]), np.sin(poses[:, 2])]) for poses in (true, believed)]
        standing = self._standing
        frames = [group[0] for group in episode.belief.known_groups]
        scored = np.column_stack([standing.map_errors, standing.map_recalls, standing.heading_errors, frames])
        return np.concatenate([np.hstack([*rows, scored]).ravel(), [standing.coverage, standing.merges]]).astype(
            np.float32
        )

    # ------------------------------------------------------------------ beyond PettingZoo

    def belief(self, agent: AgentID) -> Belief:
        """Return what an agent's robot believes; it holds nothing of the truth."""
        return self._running_episode("belief").belief.belief(self._index(agent))

    @property
    def events(self) -> tuple[MergeEvent, ...]:
        """All attempts and merges since the reset, in order."""
        return self._running_episode("events").belief.events

    @property
    def readings(self) -> tuple[Readings, ...]:
        """What each robot perceived in the last tick."""
        return self._running_episode("readings").readings.of_each()

    @property
    def world(self) -> World:
        """The true world of this episode, its landmarks included."""
        return self._running_episode("world").world

    @property
    def true_landmarks(self) -> FloatArray:
        """(N, 3) float64 [m], world frame. The landmarks that count, those that some robot could ever see; a copy."""
        return self._running_episode("true_landmarks").ledger.true_positions.copy()

    @property
    def true_poses(self) -> FloatArray:
        """(K, 3) float64 [m, m, rad], world frame."""
        return self._running_episode("true_poses").true_poses

    @property
    def true_start_poses(self) -> FloatArray:
        """(K, 3) float64 [m, m, rad], world frame."""
        return self._running_episode("true_start_poses").true_starts.copy()

    @property
    def episode(self) -> Episode:
        """The running episode, for diagnosis: the simulator's books, paths, seeds."""
        return self._running_episode("episode")

    @property
    def recorder(self) -> Recorder | None:
        """A function to be called with the readings of every tick, those of the reset included; may be assigned."""
        return self._tap.recorder

    @recorder.setter
    def recorder(self, recorder: Recorder | None) -> None:
        if recorder is not None and not callable(recorder):
            raise bad_argument("recorder", "a function or None", recorder, "It is called with a tuple of Readings.")
        self._tap.recorder = recorder

    @property
    def max_cycles(self) -> int:
        """After so many steps the episode is truncated; may be assigned."""
        return self._max_cycles

    @max_cycles.setter
    def max_cycles(self, max_cycles: int) -> None:
        self._max_cycles = check_int("max_cycles", max_cycles, 1, "Give a number of steps.")

    def scene(self) -> Scene:
        """Return what a picture shows now."""
        return scene_of(self._running_episode("scene"), self._standing)

    def _running_episode(self, name: str) -> Episode:
        if self._episode is None:
            raise RuntimeError(f"{name}: expected a running episode, got none. Call reset() first.")
        return self._episode

    def _index(self, agent: AgentID) -> int:
        if not isinstance(agent, str) or agent not in self.possible_agents:
            raise bad_argument("agent", f"one of {self.possible_agents}", agent, "Use a name of possible_agents.")
        return self.possible_agents.index(agent)
