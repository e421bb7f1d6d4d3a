"""`ExplorationEnv`: the PettingZoo parallel environment."""

import copy
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from slam_backend.core.state_checks import refusing
from slam_backend.core.validation import bad_argument, check_choice, check_int
from vslam_env.actions import action_space, checked_actions
from vslam_env.config import EnvConfig
from vslam_env.driving import Drivers
from vslam_env.env_knowledge import STATE_PER_ROBOT, AgentID, EnvKnowledge
from vslam_env.episode import Episode, Tap
from vslam_env.infos import infos_of
from vslam_env.observation import observation_space
from vslam_env.observing import observations_of
from vslam_env.rendering import draw_frame
from vslam_env.reward import RewardSpec, evaluate, make_terms, totals
from vslam_env.scenes import scene_of
from vslam_env.setting import draw_setting
from vslam_env.snapshots import EnvState, check_parts, check_state, objects_of, sequence_state, state_version
from vslam_env.standing import Standing
from vslam_env.window import Window
from vslam_env.world import WorldSource, check_source, is_one_building

RENDER_MODES = ("human", "rgb_array")


class ExplorationEnv(EnvKnowledge):
    """Robots that do not know where they start explore a building, build maps, and merge these when they fit.

    `vslam_v0.parallel_env` describes the arguments; what is observed is described in `vslam_env.observation`.

    Attributes:
        config: All that defines this environment.
    """

    metadata: ClassVar[dict[str, Any]] = {
        "name": "vslam_env/Exploration-v0",
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
        self.max_cycles = config.max_cycles
        self._tap = Tap()  # kept apart, so that an episode does not keep its environment alive
        self._source: WorldSource = config.world if world is None else world
        check_source(self._source)
        if config.world_split is not None and is_one_building(self._source):
            cure = "Use a family, a folder or a function, or leave the split out."
            raise bad_argument("world_split", "None for a world of which there is one", config.world_split, cure)
        self._terms = make_terms(config.reward if reward is None else reward)
        self.config = dataclasses.replace(config, reward={term.name: term.weight for term in self._terms})
        self.possible_agents = config.agents
        self.agents: list[AgentID] = []
        self._shown_as = config.action_type == "goal", config.observation_type == "flat"
        self._observed = observation_space(config.scan.num_rays, config.scan.max_range, *self._shown_as)
        if config.observe_images and isinstance(self._observed, spaces.Dict):
            shape = (config.stereo.camera.height, config.stereo.camera.width, 1)
            image = spaces.Box(0, 255, shape, np.uint8)
            self._observed = spaces.Dict({**self._observed.spaces, "image": image})
        self.observation_spaces = dict.fromkeys(self.possible_agents, self._observed)
        self.action_spaces = {agent: action_space(config.action_type) for agent in self.possible_agents}
        size = STATE_PER_ROBOT * config.num_robots + 2
        self.state_space = spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self._nothing = [0.0] * config.num_robots
        self._root: np.random.SeedSequence | None = None
        self._episode: Episode | None = None
        self._cycle = 0
        self._standing: Standing  # set at a reset
        self._window = Window(self.metadata["name"])
        self._objects = objects_of(self._source, self._terms)

    # ------------------------------------------------------------------ PettingZoo

    def reset(
        self, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[dict[AgentID, Any], dict[AgentID, dict[str, Any]]]:
        """Build a new world, put the robots at their starts and let them take their first frame.

        Args:
            seed: Of this episode and, by continuation, of the following ones; None: go on, or begin anywhere.
            options: `"world_seed"`: int, of the layout and textures only. `"start_poses"`: (K, 3) [m, m, rad], world
                frame. Others are ignored.

        Returns:
            Observations and infos by agent.

        Raises:
            ValueError: If the seed, an option or the world is bad; the text says what would do. Nothing has changed
                then: a running episode goes on, and the next reset draws what it would have drawn.
        """
        if seed is not None:
            root = np.random.SeedSequence(check_int("seed", seed, 0, "Give an int >= 0, or None."))
        else:  # a copy: a reset that is refused leaves everything as it was
            root = np.random.SeedSequence() if self._root is None else copy.deepcopy(self._root)
        options = {} if options is None else options
        if not isinstance(options, Mapping):
            raise bad_argument("options", "a dict or None", options, "E.g. {'world_seed': 3}.")
        world_seed = options.get("world_seed")
        if world_seed is not None:
            check_int("options['world_seed']", world_seed, 0, "Give an int >= 0.")
        setting = draw_setting(self.config, self._source, root.spawn(1)[0], world_seed, options.get("start_poses"))
        episode = Episode(self.config, setting, self._tap)
        episode.begin()
        self._standing = episode.standing()
        self._root, self._episode, self._drivers = root, episode, Drivers(self.config)
        self.agents = self.possible_agents[:]
        self._cycle = 0
        nothing = dict.fromkeys((term.name for term in self._terms), self._nothing)
        return self._told(self._episode, nothing, [0] * len(self.agents))

    def step(
        self, actions: Mapping[AgentID, Any]
    ) -> tuple[
        dict[AgentID, Any],
        dict[AgentID, float],
        dict[AgentID, bool],
        dict[AgentID, bool],
        dict[AgentID, dict[str, Any]],
    ]:
        """Let all robots act for `decision_ticks` ticks.

        Args:
            actions: One action per agent.

        Returns:
            Observations, rewards, terminations, truncations and infos by agent.

        Raises:
            ValueError: If an agent is unknown or missing, or an action is outside its space; nothing has moved then.
            RuntimeError: Before the first reset, or after the end.
        """
        episode = self._running_episode("step")
        if not self.agents:
            raise RuntimeError("step: expected a running episode, got one that has ended. Call reset() first.")
        agents = self.agents
        chosen = checked_actions(actions, agents, self.config.action_type)
        invalid = self._drivers.carry_out(episode, chosen)
        before = self._standing
        self._standing = episode.standing()
        self._cycle += 1

        terms = evaluate(self._terms, before, self._standing, self.config.shared_reward)
        goal = self.config.stop_at_recall
        terminated = goal is not None and bool(self._standing.map_recalls.min() >= goal)
        truncated = not terminated and self._cycle >= self._max_cycles
        observations, infos = self._told(episode, terms, invalid)
        results = (
            observations,
            dict(zip(agents, totals(terms), strict=True)),
            dict.fromkeys(agents, terminated),
            dict.fromkeys(agents, truncated),
            infos,
        )
        if terminated or truncated:
            self.agents = []
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
        frame = draw_frame(scene_of(self._running_episode("render"), self._standing))
        if self.render_mode == "rgb_array":
            return frame
        self._window.show(frame)
        return None

    def close(self) -> None:
        """Close the window, if there is one."""
        self._window.close()

    # ------------------------------------------------------------------ snapshots

    def get_state(self) -> EnvState:
        """Return all that decides how the environment goes on: world, filters, random streams, resets to come.

        An environment that is set to it returns the same bytes for the same actions from there on. What never changes
        in an episode is shared with the environment, all else copied. `vslam_env.save_state` writes it to disk. The
        recorder, the window and what reward terms of your own remember are not part of it.
        """
        episode = self._episode
        return {
            "version": state_version(),
            "config": self.config,
            "objects": dict(self._objects),
            "root": sequence_state(self._root),
            "agents": tuple(self.agents),
            "cycle": 0 if episode is None else self._cycle,
            "episode": None if episode is None else episode.get_state(),
            "drivers": [] if episode is None else self._drivers.get_state(),
            "standing": None if episode is None else self._standing,
        }

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Go on exactly as the environment that gave `state`, be it of another seed, process, or day.

        Args:
            state: Of `get_state`; it can be used again.

        Raises:
            ValueError: If it is no state, one of another version of the package or of another configuration, or a part
                of it is damaged; the environment is then as before.
        """
        with refusing("state"):
            state = check_state(state, self.config, self._objects)
            root, setting = check_parts(state, self.config, self._episode)
        self._root, self.agents = root, []
        if setting is None:
            self._episode = None
            return
        if self._episode is None:
            self._episode = Episode(self.config, setting, self._tap)
        self._episode.set_state(state["episode"], setting)
        self._drivers = Drivers(self.config)
        self._drivers.set_state(state["drivers"])
        self._standing, self._cycle, self.agents = state["standing"], state["cycle"], list(state["agents"])

    def clone(self) -> "ExplorationEnv":
        """Return an independent environment in the same state, for looking ahead; without window and recorder."""
        mode = None if self.render_mode == "human" else self.render_mode
        twin = ExplorationEnv(self.config, self._source, self._terms, mode)
        twin.max_cycles = self.max_cycles
        twin.set_state(self.get_state())
        return twin

    def __deepcopy__(self, memo: Any) -> "ExplorationEnv":
        return self.clone()

    def __reduce__(self) -> tuple[Any, ...]:
        made_from = (self.config, self._source, self._terms, self.render_mode)
        return _unpickled, (made_from, self.max_cycles, self.get_state())

    # ------------------------------------------------------------------ within

    def _told(
        self, episode: Episode, terms: Mapping[str, Sequence[float]], invalid: list[int]
    ) -> tuple[dict[AgentID, Any], dict[AgentID, dict[str, Any]]]:
        """Return each agent's observation after the last tick, and its figures after a step that paid `terms`."""
        agents, belief = self.possible_agents, episode.belief
        observations = observations_of(agents, belief, episode.readings, *self._shown_as)
        return observations, infos_of(agents, belief.known_groups, self._standing, terms, invalid)


def _unpickled(made_from: tuple[Any, ...], max_cycles: int, state: EnvState) -> ExplorationEnv:
    """Return the environment that `ExplorationEnv.__reduce__` took apart."""
    env = ExplorationEnv(*made_from)
    env.max_cycles = max_cycles
    env.set_state(state)
    return env
