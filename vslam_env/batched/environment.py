"""Batched exploration with the interface of JaxMARL: pure functions of a key and a state, mapped by `jax.vmap`."""

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from slam_backend.core.validation import argument_error, check_int
from vslam_env.actions import DISCRETE_COMMANDS, MAX_REVERSE
from vslam_env.batched import episode as episodes
from vslam_env.batched.episode import Episode, Rules
from vslam_env.batched.observation import in_start_frame, relative
from vslam_env.batched.world import Scene
from vslam_env.belief._observation_kernels import GRID_ON
from vslam_env.belief.observation import GRIDS, flatten
from vslam_env.belief.observation_keys import key_spaces
from vslam_env.config import EnvConfig
from vslam_env.navigation.planning import MAX_SPEED, MAX_TURN
from vslam_env.simulation.memory import available_memory
from vslam_env.simulation.scenario import sample_scenario

COPIES = 6  # of a state that a compiled step holds at once

Observations = dict[str, Any]


class Box(NamedTuple):
    """Arrays of numbers within bounds."""

    low: np.ndarray
    high: np.ndarray
    dtype: Any

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of an array."""
        return tuple(self.low.shape)

    def sample(self, key: Array) -> Array:
        """Return an array drawn uniformly."""
        drawn = jax.random.uniform(key, self.shape, minval=self.low.astype(float), maxval=self.high.astype(float))
        return drawn.astype(self.dtype)

    def contains(self, value: Array) -> Array:
        """Return whether an array lies within the bounds."""
        return (value >= self.low).all() & (value <= self.high).all()


class Discrete(NamedTuple):
    """Integers from 0 to n - 1."""

    n: int
    dtype: Any = jnp.int32

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of a number."""
        return ()

    def sample(self, key: Array) -> Array:
        """Return a number drawn uniformly."""
        return jax.random.randint(key, (), 0, self.n, self.dtype)

    def contains(self, value: Array) -> Array:
        """Return whether a number is one of them."""
        return (value >= 0) & (value < self.n)


class State(NamedTuple):
    """State of an environment: an episode, the number () of its world, and the steps () since the reset."""

    episode: Episode
    world: Array
    step: Array


class BatchedExploration:
    """Exploration of worlds drawn by the environment, by robots with a Gaussian belief; see `docs/how-to/batched.md`.

    Rewards, observations and actions are those of `vslam_env.vslam_v1`. A `discrete` or `continuous` action beyond its
    space is clipped, because learners draw from Gaussians. Infos are arrays (K,).

    Args:
        config: Configuration; what batched teams cannot do is refused by its name.
        num_worlds: Number of worlds W from which each reset draws one.
        first_seed: World i is that of `reset(seed=first_seed + i)` of the environment, with its starts and biases.
        rows: Number R of landmarks for which a team's belief has room; further ones are ignored. A state takes about
            4 (8 K + 2 R)^2 bytes, 1.1 MB for three robots and R = 256.

    Attributes:
        config: The configuration.
        rules: Constants of all episodes.
        scenes: The worlds, arrays with a first dimension W.
        agents: Names of the robots.
        num_agents: Number of robots K.

    Raises:
        ValueError: If the configuration needs what batched teams cannot do, a number is out of range, or jax computes
            with 64 bits.
    """

    def __init__(self, config: EnvConfig, *, num_worlds: int = 64, first_seed: int = 0, rows: int = 384) -> None:
        if jax.config.jax_enable_x64:
            raise argument_error(
                "jax_enable_x64", "False", True, "Batched teams compute with 32 bits: leave JAX_ENABLE_X64 unset."
            )
        check_int("num_worlds", num_worlds, 1, "Draw at least one world.")
        check_int("first_seed", first_seed, 0, "Use 0 or a positive number.")
        check_int("rows", rows, 16, "Make room for the landmarks of a world.")
        self.config, self.rules = config, Rules.of(config, rows)
        self.scenes = scenes(config, num_worlds, first_seed)
        self.agents, self.num_agents = config.agents, config.num_robots
        self._is_flat = config.observation_type == "flat"
        boxes = key_spaces(config.scan.num_rays, config.scan.max_range)
        self._boxes = {key: Box(boxes[key].low, boxes[key].high, boxes[key].dtype) for key in config.observed}

    @property
    def name(self) -> str:
        """Name of the environment."""
        return "vslam_env/BatchedExploration"

    @property
    def agent_classes(self) -> dict[str, list[str]]:
        """Names of the robots by class: all are alike."""
        return {"robot": self.agents}

    def observation_space(self, agent: str) -> Any:
        """Return a `Box`, or a dict of these by key if observations have names."""
        self._check_agent(agent)
        if not self._is_flat:
            return self._boxes
        low, high = (flatten({key: getattr(box, end) for key, box in self._boxes.items()}) for end in ("low", "high"))
        return Box(low, high, np.float32)

    def action_space(self, agent: str) -> Any:
        """Return a `Box` (2,), or a `Discrete`."""
        self._check_agent(agent)
        if self.config.action_type == "discrete":
            return Discrete(len(DISCRETE_COMMANDS))
        return Box(np.full(2, -1.0, np.float32), np.ones(2, np.float32), np.float32)

    @partial(jax.jit, static_argnums=0)
    def reset(self, key: Array) -> tuple[Observations, State]:
        """Return the observations and the state at the start of an episode in a world that is drawn.

        Args:
            key: Key of all that is drawn.
        """
        of_world, of_episode = jax.random.split(key)
        world = jax.random.randint(of_world, (), 0, len(self.scenes.starts))
        started: tuple[Observations, State] = self.reset_in(world, of_episode)
        return started

    @partial(jax.jit, static_argnums=0)
    def reset_in(self, world: Array, key: Array) -> tuple[Observations, State]:
        """Return the observations and the state at the start of an episode in a world.

        Args:
            world: () int32. Number of the world, from 0 to W - 1.
            key: Key of all that is drawn.
        """
        state = State(
            episodes.reset(self._scene(world), key, self.rules), jnp.asarray(world, jnp.int32), jnp.zeros((), jnp.int32)
        )
        return self.get_obs(state), state

    @partial(jax.jit, static_argnums=0)
    def step(
        self, key: Array, state: State, actions: Mapping[str, Array], reset_state: State | None = None
    ) -> tuple[Observations, State, dict[str, Array], dict[str, Array], dict[str, Array]]:
        """Return what follows after a step; at the end of an episode the next one begins.

        Args:
            key: Key of all that is drawn.
            state: State before.
            actions: Actions by agent.
            reset_state: State with which the next episode begins; None: that of a reset.

        Returns:
            Observations, state, rewards, dones (also for `__all__`) and infos, see `step_env`; after the last step of
            an episode observations and state are those of the next one.
        """
        of_step, of_reset = jax.random.split(key)
        observations, after, rewards, dones, infos = self.step_env(of_step, state, actions)
        fresh = self.reset(of_reset) if reset_state is None else (self.get_obs(reset_state), reset_state)
        observations, after = jax.tree.map(
            lambda new, old: jnp.where(dones["__all__"], new, old), fresh, (observations, after)
        )
        return observations, after, rewards, dones, infos

    def step_env(
        self, key: Array, state: State, actions: Mapping[str, Array]
    ) -> tuple[Observations, State, dict[str, Array], dict[str, Array], dict[str, Array]]:
        """Return observations, state, rewards, dones and infos after a step, without a reset.

        Infos, each (K,): `map_error`, `map_rmse` [m] and `map_recall`; `pose_error` [m]; `group`, the first robot of
        each robot's group; `landmarks` of its map.
        """
        commands = jnp.stack([self._command(actions[agent]) for agent in self.agents])
        scene = self._scene(state.world)
        episode, earned = episodes.step(state.episode, commands, scene, key, self.rules)
        after = State(episode, state.world, state.step + 1)
        is_over = after.step >= self.rules.cycles
        dones = dict.fromkeys([*self.agents, "__all__"], is_over)
        return self.get_obs(after), after, self._by_agent(earned), dones, self._infos(episode, scene)

    def get_obs(self, state: State) -> Observations:
        """Return the observations by agent: vectors, or dicts by key if observations have names."""
        rows = episodes.seen(state.episode, self.rules)
        if not self._is_flat:
            return {agent: {key: rows[key][i] for key in rows} for i, agent in enumerate(self.agents)}
        parts = [
            (rows[key] / GRID_ON if key in GRIDS else rows[key]).reshape(self.num_agents, -1).astype(jnp.float32)
            for key in rows
        ]
        return self._by_agent(jnp.concatenate(parts, axis=1))

    def get_avail_actions(self, state: State) -> dict[str, Array]:
        """Return which actions are available: all."""
        count = len(DISCRETE_COMMANDS) if self.config.action_type == "discrete" else 2
        return {agent: jnp.ones(count, jnp.bool_) for agent in self.agents}

    def check_batch(self, batch: int) -> None:
        """Refuse a batch whose states would not fit into the memory of the device, before anything is compiled.

        Raises:
            ValueError: If they would not, or the batch is not positive.
        """
        check_int("batch", batch, 1, "Run at least one environment.")
        _, state = jax.eval_shape(self.reset, jax.random.key(0))
        each = COPIES * sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(state))
        free = free_memory()
        if free is not None and batch * each > free:
            raise argument_error(
                "batch", f"at most {free // each} in {free / 1e9:.1f} GB of free memory", batch,
                f"Use fewer, or fewer than {self.rules.rows} rows.",
            )  # fmt: skip

    def _check_agent(self, agent: str) -> None:
        if agent not in self.agents:
            raise argument_error("agent", f"one of {self.agents}", agent, "Use a name of env.agents.")

    def _by_agent(self, rows: Array) -> dict[str, Array]:
        return {agent: rows[i] for i, agent in enumerate(self.agents)}

    def _scene(self, world: Array) -> Scene:
        scene: Scene = jax.tree.map(lambda values: values[world], self.scenes)
        return scene

    def _command(self, action: Array) -> Array:
        """Return the forward speed and the turn rate of an action (2,) [m/s, rad/s]."""
        if self.config.action_type == "discrete":
            commands = jnp.asarray(DISCRETE_COMMANDS, jnp.float32)
            return commands[jnp.clip(jnp.reshape(action, ()), 0, len(commands) - 1)]
        speed, turn = jnp.clip(jnp.reshape(action, 2), -1.0, 1.0)
        return jnp.stack([speed * jnp.where(speed > 0.0, MAX_SPEED, MAX_REVERSE), turn * MAX_TURN])

    def _infos(self, episode: Episode, scene: Scene) -> dict[str, Array]:
        belief, scores = episode.belief, episode.scores
        away = jax.vmap(relative)(scene.starts, episode.poses)[:, :2]
        robots = jnp.arange(self.num_agents)
        believed = jax.vmap(in_start_frame, (None, 0, 0))(belief.robots, robots, robots)[:, :2]
        confirmed = belief.counts >= self.rules.confirm_after
        return {
            "map_error": scores.map_errors, "map_rmse": scores.map_rmses, "map_recall": scores.map_recalls,
            "pose_error": jnp.linalg.norm(away - believed, axis=1), "group": belief.groups,
            "landmarks": (confirmed & (belief.owners == belief.groups[:, None])).sum(axis=1),
        }  # fmt: skip


def scenes(config: EnvConfig, num_worlds: int, first_seed: int) -> Scene:
    """Return worlds of the environment with starts and biases, arrays with a first dimension W; see `Scene`."""
    drawn = [
        sample_scenario(config, config.world, np.random.SeedSequence(first_seed + i).spawn(1)[0])[0]
        for i in range(num_worlds)
    ]
    walls = max(len(each.world.walls) for each in drawn)
    landmarks = max(len(each.observable_landmarks) for each in drawn)
    stacked: Scene = jax.tree.map(lambda *values: jnp.stack(values), *[Scene.of(d, walls, landmarks) for d in drawn])
    return stacked


def free_memory() -> int | None:
    """Return the free memory of the device [bytes]; None where it does not say."""
    device = jax.devices()[0]
    if device.platform == "cpu":
        return available_memory()
    told = device.memory_stats() or {}
    return told["bytes_limit"] - told["bytes_in_use"] if "bytes_limit" in told else None
