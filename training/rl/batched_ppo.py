"""PPO for batched teams: rollouts and updates are one compiled function (Schulman et al., arXiv 1707.06347).

All robots share one actor and one critic, which sees what its robot observes.
"""

import json
from collections.abc import Callable, Mapping
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

from agents.driver_network import NAMES, NUM_OUTPUTS, SHAPES, outputs, weight_shapes
from agents.trained import DRIVER, MODEL_FILE, check_observation, save_model
from slam_backend.core.array_files import read_arrays
from slam_backend.core.files import write_file
from slam_backend.core.validation import argument_error
from training.experiments.run_folder import installed_versions
from training.rl.batched_config import BatchedTrainConfig
from training.rl.config import SPLIT_TRY
from vslam_env.batched.environment import BatchedExploration

CHECKPOINT_FILE = "checkpoint.npz"
MARK, KEY = "mark", "key"
MOST_GRADIENT = 0.5  # norm to which gradients are clipped
VALUE_WEIGHT = 0.5
Weights = dict[str, Array]
Row = Mapping[str, float]


class Learner(NamedTuple):
    """All that a training changes.

    Attributes:
        weights: Weights of the actor and of the critic, by name.
        optimiser: State of Adam.
        state, observations: States of the environments, and arrays (n, K, ...) by name.
        key: Key of all that follows.
    """

    weights: dict[str, Weights]
    optimiser: Any
    state: Any
    observations: dict[str, Array]
    key: Array


class Decisions(NamedTuple):
    """Decisions of a rollout, arrays (T, n, K, ...), with advantages and the returns that the critic shall tell."""

    observations: dict[str, Array]
    actions: Array
    log_probabilities: Array
    advantages: Array
    returns: Array


def first_weights(key: Array, num_outputs: int, std: float) -> Weights:
    """Return random weights with variances by their number of inputs; the last layer is near zero."""
    shapes = weight_shapes(num_outputs)
    last = [name for name in shapes if name.endswith("weight")][-1]
    weights = {}
    for name, own in zip(shapes, jax.random.split(key, len(shapes)), strict=True):
        gain = 0.01 if name == last else np.sqrt(2.0)
        drawn = gain * jax.random.normal(own, shapes[name]) / np.sqrt(shapes[name][0])
        weights[name] = drawn if name.endswith("weight") else jnp.zeros(shapes[name])
    return weights | {"log_std": jnp.full(num_outputs, np.log(std))}


def log_probability(actor: Weights, means: Array, actions: Array) -> Array:
    """Return the log density (...) of actions (..., 2) about means."""
    off = (actions - means) / jnp.exp(actor["log_std"])
    return -(0.5 * off**2 + actor["log_std"] + 0.5 * np.log(2.0 * np.pi)).sum(axis=-1)


def of_all(weights: Weights, observations: Mapping[str, Array]) -> Array:
    """Return the outputs (..., o) of a network for observations (..., shape)."""
    before = observations["scan"].shape[:-1]
    flat = {name: observations[name].reshape(-1, *SHAPES[name]) for name in NAMES}
    return outputs(weights, flat, jnp).reshape(*before, -1)


def advantages_of(rewards: Array, values: Array, dones: Array, last: Array, config: BatchedTrainConfig) -> Array:
    """Return the generalised advantage estimates (T, n, K) (Schulman et al., arXiv 1506.02438).

    Args:
        rewards, values, dones: (T, n, K). Rewards of the decisions, values before them, and ends of episodes.
        last: (n, K). Values after the last decision.
        config: Discount and lambda.
    """

    def earlier(following: tuple[Array, Array], step: tuple[Array, Array, Array]) -> tuple[tuple[Array, Array], Array]:
        advantage, value_after = following
        reward, value, done = step
        surprise = reward + config.gamma * value_after * (1.0 - done) - value
        advantage = surprise + config.gamma * config.gae_lambda * (1.0 - done) * advantage
        return (advantage, value), advantage

    found: Array = jax.lax.scan(earlier, (jnp.zeros_like(last), last), (rewards, values, dones), reverse=True)[1]
    return found


def loss_of(weights: dict[str, Weights], part: Decisions, config: BatchedTrainConfig) -> Array:
    """Return the loss of decisions (m, K, ...): clipped objective, errors of the values, and entropy."""
    actor, critic = weights["actor"], weights["critic"]
    now = log_probability(actor, of_all(actor, part.observations), part.actions)
    ratio = jnp.exp(now - part.log_probabilities)
    gain = (part.advantages - part.advantages.mean()) / (part.advantages.std() + 1e-8)
    clipped = jnp.clip(ratio, 1.0 - config.clip, 1.0 + config.clip)
    errors = (of_all(critic, part.observations)[..., 0] - part.returns) ** 2
    return (
        -jnp.minimum(ratio * gain, clipped * gain).mean() + VALUE_WEIGHT * errors.mean()
        - config.entropy * actor["log_std"].sum()
    )  # fmt: skip


def make_env(config: BatchedTrainConfig) -> BatchedExploration:
    """Return the environment of a training, whose worlds are drawn here.

    Raises:
        ValueError: If it cannot be batched, the batch does not fit into the memory, or the network needs another scan.
    """
    env = BatchedExploration(
        config.environment(), num_worlds=config.num_worlds, first_seed=config.seed, rows=config.rows
    )  # fmt: skip
    check_observation({name: box.shape for name, box in env.observation_space("robot_0").items()}, SHAPES)
    env.check_batch(config.batch)
    return env


class BatchedTraining:
    """A training of batched teams, rollout by rollout.

    Args:
        config: Configuration.
        env: Environment of `make_env`.
        folder: Run folder, for the checkpoint and the model.

    Attributes:
        config: The configuration.
        env: The environment, without a batch.
        rows: Figures of the rollouts so far.
    """

    def __init__(self, config: BatchedTrainConfig, env: BatchedExploration, folder: Path) -> None:
        self.config, self.env, self.rows, self._folder = config, env, list[Row](), folder
        self._adam = optax.chain(optax.clip_by_global_norm(MOST_GRADIENT), optax.adam(config.learning_rate, eps=1e-5))
        self._update: Callable[[Learner], tuple[Learner, dict[str, Array]]] = jax.jit(
            self._updated, donate_argnums=0
        )  # fmt: skip
        of_actor, of_critic, of_start, key = jax.random.split(jax.random.key(config.seed), 4)
        weights = {
            "actor": first_weights(of_actor, NUM_OUTPUTS, config.std), "critic": first_weights(of_critic, 1, 1.0)
        }  # fmt: skip
        self._learner = Learner(weights, self._adam.init(weights), *self._begun(of_start), key)

    @property
    def weights(self) -> dict[str, np.ndarray]:
        """Weights of the actor."""
        return {name: np.asarray(values) for name, values in self._learner.weights["actor"].items()}

    def update(self) -> Row:
        """Play a rollout and learn from it.

        Returns:
            `steps`, decisions of all robots so far; of the episodes that ended in the rollout: their number `episodes`,
            and means of their `return` [m], and of `map_error`, `map_recall` and `merges` at their ends.
        """
        self._learner, told = self._update(self._learner)
        row = {name: float(value) for name, value in told.items()}
        decisions = self.config.batch * self.config.steps * self.config.robots
        self.rows.append({"steps": float((len(self.rows) + 1) * decisions)} | row)
        return self.rows[-1]

    def save(self) -> None:
        """Write the model, and the checkpoint with which `restore` continues."""
        config = self.config
        environment = config.environment()
        split = None if environment.world_split is None else SPLIT_TRY
        about = {
            "version": installed_versions()["vslam-env"], "network": DRIVER, "ticks": config.decision_ticks,
            "environment": environment.replace(world_split=split).to_toml(), "steps": self.rows[-1]["steps"],
            "seed": config.seed, "config": config.to_mapping(),
        }  # fmt: skip
        save_model(self._folder / MODEL_FILE, self.weights, about)
        leaves = jax.tree.leaves((self._learner.weights, self._learner.optimiser))
        mark = json.dumps({"config": config.to_mapping(), "seed": config.seed, "rows": self.rows})
        packed = BytesIO()
        arrays = {f"leaf.{i}": np.asarray(leaf) for i, leaf in enumerate(leaves)}
        key = np.asarray(jax.random.key_data(self._learner.key))
        np.savez(packed, allow_pickle=False, **{MARK: np.array(mark), KEY: key}, **arrays)
        write_file(self._folder / CHECKPOINT_FILE, packed.getvalue(), "out")

    def restore(self) -> None:
        """Continue from the checkpoint of the folder, with new episodes.

        Raises:
            ValueError: If it is missing or broken, or belongs to another configuration.
        """
        file, expected = self._folder / CHECKPOINT_FILE, "the checkpoint of a training"
        if not file.is_file():
            hint = f"There is no {str(file)!r}: the run ended before its first checkpoint. Train again."
            raise argument_error("resume", expected, "no such file", hint)
        kept = (self._learner.weights, self._learner.optimiser)
        try:
            arrays = dict(read_arrays(file))
            mark = json.loads(str(arrays.pop(MARK)))
            key = jax.random.wrap_key_data(jnp.asarray(arrays.pop(KEY)))
            leaves = [arrays[f"leaf.{i}"] for i in range(len(arrays))]
            if [np.shape(leaf) for leaf in jax.tree.leaves(kept)] != [leaf.shape for leaf in leaves]:
                raise ValueError("other weights")
            same, rows = (mark["config"], mark["seed"]) == (self.config.to_mapping(), self.config.seed), mark["rows"]
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            hint = f"{str(file)!r} cannot be used. Train again."
            raise argument_error("resume", expected, "a broken file", hint) from error
        if not same:
            hint = "Restore the config.toml of the folder, or train again."
            raise argument_error("resume", "a checkpoint of the folder's configuration", "one of another", hint)
        weights, optimiser = jax.tree.unflatten(jax.tree.structure(kept), [jnp.asarray(leaf) for leaf in leaves])
        of_start, key = jax.random.split(key)
        self._learner, self.rows = Learner(weights, optimiser, *self._begun(of_start), key), list(rows)

    def _begun(self, key: Array) -> tuple[Any, dict[str, Array]]:
        """Return states and observations of a batch of new episodes."""
        observed, state = jax.jit(jax.vmap(self.env.reset))(jax.random.split(key, self.config.batch))
        return state, self._of_robots(observed)

    def _of_robots(self, observed: Mapping[str, Mapping[str, Array]]) -> dict[str, Array]:
        """Return observations by name (n, K, ...)."""
        return {name: jnp.stack([observed[agent][name] for agent in self.env.agents], axis=1) for name in NAMES}

    def _updated(self, learner: Learner) -> tuple[Learner, dict[str, Array]]:
        """Return the learner after a rollout and the steps of the optimiser, and figures of the rollout."""
        config, (of_rollout, of_order, key) = self.config, jax.random.split(learner.key, 3)
        played = (learner.state, learner.observations)
        (state, observations), (decisions, told) = jax.lax.scan(
            partial(self._decide, learner.weights), played, jax.random.split(of_rollout, config.steps)
        )
        last = of_all(learner.weights["critic"], observations)[..., 0]
        advantages = advantages_of(told["rewards"], decisions.returns, told["dones"], last, config)
        decisions = decisions._replace(advantages=advantages, returns=advantages + decisions.returns)
        rows = jax.tree.map(lambda values: values.reshape(-1, *values.shape[2:]), decisions)
        order = jnp.concatenate([
            jax.random.permutation(own, config.steps * config.batch)
            for own in jax.random.split(of_order, config.epochs)
        ]).reshape(config.epochs * config.minibatches, -1)  # fmt: skip

        def descend(so_far: tuple[Any, Any], part: Array) -> tuple[tuple[Any, Any], None]:
            weights, optimiser = so_far
            minibatch = jax.tree.map(lambda values: values[part], rows)
            slope = jax.grad(loss_of)(weights, minibatch, config)
            change, optimiser = self._adam.update(slope, optimiser, weights)
            return (optax.apply_updates(weights, change), optimiser), None

        (weights, optimiser), _ = jax.lax.scan(descend, (learner.weights, learner.optimiser), order)
        return Learner(weights, optimiser, state, observations, key), _figures(told)

    def _decide(
        self, weights: dict[str, Weights], before: tuple[Any, dict[str, Array]], key: Array
    ) -> tuple[tuple[Any, dict[str, Array]], tuple[Decisions, dict[str, Array]]]:  # fmt: skip
        """Return states and observations after a decision; the decision, with values as returns; and its outcome."""
        (state, observations), (of_action, of_step) = before, jax.random.split(key)
        actor = weights["actor"]
        means = of_all(actor, observations)
        actions = means + jnp.exp(actor["log_std"]) * jax.random.normal(of_action, means.shape)
        given = {agent: actions[:, robot] for robot, agent in enumerate(self.env.agents)}
        keys = jax.random.split(of_step, self.config.batch)
        observed, state, rewards, dones, infos = jax.vmap(self.env.step)(keys, state, given)
        values = of_all(weights["critic"], observations)[..., 0]
        by_robot = jnp.stack([rewards[agent] for agent in self.env.agents], axis=1)
        chosen = Decisions(
            observations, actions, log_probability(actor, means, actions), jnp.zeros_like(values), values
        )
        alone = infos["group"] == jnp.arange(self.env.num_agents)
        told = infos | {
            "rewards": by_robot, "merges": self.env.num_agents - alone.sum(axis=1),
            "dones": jnp.repeat(dones["__all__"][:, None], self.env.num_agents, axis=1).astype(jnp.float32),
        }  # fmt: skip
        return (state, self._of_robots(observed)), (chosen, told)


def _figures(told: Mapping[str, Array]) -> dict[str, Array]:
    """Return means over the episodes that ended in a rollout; zeros without one."""
    ended = told["dones"][..., 0]
    count = ended.sum()

    def at_ends(values: Array) -> Array:
        """Return the mean of values (T, n) at the ends of episodes."""
        return (ended * values).sum() / jnp.maximum(count, 1.0)

    errors = at_ends(told["map_error"].mean(axis=-1))
    return {
        "episodes": count, "return": told["rewards"].mean(axis=(1, 2)).sum(), "map_error": errors,
        "map_recall": at_ends(told["map_recall"].mean(axis=-1)), "merges": at_ends(told["merges"]),
    }  # fmt: skip
