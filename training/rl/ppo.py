"""`Training`: PPO with masks for `GoalPolicy`, which may stay near the policy of the model it began with.

The penalty is the Kullback-Leibler divergence from the start policy to the current one, as in Baker et al., "Video
PreTraining (VPT): learning to act by watching unlabeled online videos", NeurIPS 2022.

From top to bottom: the learner, what watches it, and the training.
"""

import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import deepcopy
from functools import partial
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import torch
from sb3_contrib import MaskablePPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.utils import explained_variance, update_learning_rate
from torch.nn.functional import mse_loss

from agents.goal_network import SHAPES, Weights
from agents.trained import load_model
from slam_backend.core.validation import IntArray
from slam_backend.state import checked_stream
from training.rl.checkpoint import BOARD, as_arrays, as_tensors, check_device, restoring, save_run
from training.rl.config import SPLIT_TRAIN, TrainConfig
from training.rl.network import GoalPolicy, check_finite
from training.rl.true_state import STATE, WithTrueState
from training.vec_env import ExplorationVecEnv, make_vec_env

# A value head that leaves the actor's layers alone learns from their features, which is cheap: many small steps.
VALUE_PASSES, VALUE_BATCH, VALUE_RATE = 4, 720, 1e-3
EPSILON = 1e-5  # of Adam, as Stable-Baselines3 has it
CHUNK = 1440  # decisions that are encoded at once
USED = (*SHAPES, STATE)  # observations of actor and critic
LAST = ("map_error", "map_recall", "map_precision", "coverage", "merges", "collisions")  # final values of an episode
Row = dict[str, float]


class Update:
    """Call of a function in a thread of its own, with as many threads of torch as the caller has.

    Args:
        function: Function that ends early when its argument, an event, is set.
    """

    def __init__(self, function: Callable[[Event], dict[str, float]]) -> None:
        self._stops = Event()
        pool = ThreadPoolExecutor(1, "update", torch.set_num_threads, (torch.get_num_threads(),))
        self._future = pool.submit(function, self._stops)
        pool.shutdown(wait=False)

    def result(self) -> dict[str, float]:
        """Wait for the end, and return the result or raise the error."""
        return self._future.result()

    def cancel(self) -> None:
        """Let the function end early, and wait for it."""
        self._stops.set()
        self._future.exception()


class GoalPPO(MaskablePPO):  # type: ignore[misc]   # its types are not checked
    """PPO with masks for a `GoalPolicy`, with an optional anchor to the policy of the start model.

    Without a start model updates are those of MaskablePPO. After one, an update runs while the next rollout is played
    by the policy before it, which the probability ratios of PPO take into account. Clipping of values and a target of
    the KL divergence are not supported.

    Args:
        anchor: Weight of the penalty KL(start || policy) [1/nat], a mean over the decisions of a minibatch.
        value_rollouts: Number of first rollouts after a start model that train the value head alone, which is random at
            first.
        arguments: Arguments of MaskablePPO.

    Attributes:
        trained: Policy with the weights of all finished updates; `policy` plays.
    """

    policy: GoalPolicy

    def __init__(self, *, anchor: float = 0.0, value_rollouts: int = 0, **arguments: Any) -> None:
        super().__init__(GoalPolicy, **arguments)
        self._anchor, self._value_rollouts = anchor, value_rollouts
        self.trained = deepcopy(self.policy)
        self._value_optimizer: torch.optim.Optimizer | None = None  # None: the loss has the error of the values
        self._start: GoalPolicy | None = None
        self._update: Update | None = None

    def start_from(self, weights: Weights) -> None:
        """Begin with the actor of a model, and keep its policy for the penalty.

        The value head then has an optimiser of its own and leaves the layers of the actor alone: its gradients, at
        first several times those of the actor, would change what the actor can do already.
        """
        self.policy.load_actor(weights)
        self.trained.load_actor(weights)
        actor, head = self.trained.parts()
        self.trained.optimizer = torch.optim.Adam(actor, lr=self.lr_schedule(1.0), eps=EPSILON)
        self._value_optimizer = torch.optim.Adam(head, lr=VALUE_RATE, eps=EPSILON)
        if self._anchor:
            self._start = deepcopy(self.policy).requires_grad_(False)

    def get_state(self) -> dict[str, Any]:
        """Return weights and optimiser, once the update that is running has ended."""
        self.finish_update()
        return {
            "playing": self.policy.state_dict(), "trained": self.trained.state_dict(),
            "optimizer": self.trained.optimizer.state_dict(),
            "value_optimizer": None if self._value_optimizer is None else self._value_optimizer.state_dict(),
            "start": None if self._start is None else self._start.state_dict(),
        }  # fmt: skip

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Restore a state of `get_state`.

        Raises:
            RuntimeError: If it has other layers, or there is a start policy in one of the two only.
        """
        if (self._start is None) != (state["start"] is None):
            raise RuntimeError("the start policy is missing, or not expected")
        self.policy.load_state_dict(state["playing"])
        self.trained.load_state_dict(state["trained"])
        self.trained.optimizer.load_state_dict(state["optimizer"])
        if self._value_optimizer is not None:
            self._value_optimizer.load_state_dict(state["value_optimizer"])
        if self._start is not None:
            self._start.load_state_dict(state["start"])

    def learn(self, *arguments: Any, **named: Any) -> "GoalPPO":
        """Learn as MaskablePPO does; at the end the policy has all updates."""
        super().learn(*arguments, **named)
        self.finish_update()
        self._take_over()
        return self

    def train(self) -> None:
        """Update actor and critic with the decisions of the last rollout.

        After a start model the update is only begun here, and runs while the next rollout is played by the policy
        before it: steps are small. It uses numpy's random numbers and the rollout torch's, so that neither depends on
        which of them is faster.
        """
        self.finish_update()
        self._take_over()
        left, n = self._current_progress_remaining, self.n_steps * self.n_envs
        self._update_learning_rate(self.trained.optimizer)
        actor_orders = [np.random.permutation(n) for _ in range(self.n_epochs)]  # noqa: NPY002
        if self._value_optimizer is None:
            value_orders = []
        else:
            update_learning_rate(self._value_optimizer, left * VALUE_RATE)
            value_orders = [np.random.permutation(n) for _ in range(VALUE_PASSES)]  # noqa: NPY002
            if self.num_timesteps <= self._value_rollouts * n:
                actor_orders = []
        orders = actor_orders, value_orders
        self._update = Update(partial(self._train, self._decisions(), orders, self.clip_range(left)))
        values, returns = self.rollout_buffer.values.flatten(), self.rollout_buffer.returns.flatten()
        self.logger.record("train/explained_variance", explained_variance(values, returns))
        self._n_updates += self.n_epochs
        if self._value_optimizer is None:
            self.finish_update()
            self._take_over()

    def finish_update(self) -> None:
        """Wait for the update that is running, and record its figures."""
        if self._update is not None:
            figures, self._update = self._update.result(), None
            for name, value in figures.items():
                self.logger.record(f"train/{name}", value)

    def close(self) -> None:
        """End the update that is running, after its current minibatch, and discard it."""
        if self._update is not None:
            self._update.cancel()
            self._update = None

    # ------------------------------------------------------------------ within

    def _take_over(self) -> None:
        """Let the policy that plays have the trained weights."""
        self.policy.load_state_dict(self.trained.state_dict())

    def _train(
        self, data: dict[str, Any], orders: tuple[Sequence[IntArray], Sequence[IntArray]], clip: float, stops: Event
    ) -> dict[str, float]:
        """Update the trained policy with decisions, and return mean figures.

        Args:
            data: Decisions (n, ...) of a rollout.
            orders: Order (n,) of the decisions in each pass of the actor, and in each of a value head of its own.
            clip: Clip range of the probability ratio.
            stops: Event that ends the update early.
        """
        self.trained.set_training_mode(True)
        figures: dict[str, list[Any]] = {}

        def descend(loss: Any, optimizer: Any) -> None:
            optimizer.zero_grad()
            loss.backward()
            for group in optimizer.param_groups:
                torch.nn.utils.clip_grad_norm_(group["params"], self.max_grad_norm)
            optimizer.step()

        actor_orders, value_orders = orders
        if self._start is not None and actor_orders:
            data["start_log_probs"] = self._by_chunks(data, self._start_log_probs)
        for rows in self._minibatches(actor_orders, self.batch_size):
            if stops.is_set():
                return {}
            terms = self._losses({name: values[rows] for name, values in data.items()}, clip)
            descend(terms["loss"], self.trained.optimizer)
            for name, value in terms.items():
                figures.setdefault(name, []).append(value.detach())
        features = self._by_chunks(data, self.trained.encode) if value_orders else torch.empty(0)
        for rows in self._minibatches(value_orders, VALUE_BATCH):
            if stops.is_set():
                return {}
            loss = mse_loss(data["returns"][rows], self.trained.values(features[rows]))
            descend(loss, self._value_optimizer)
            figures.setdefault("value_loss", []).append(loss.detach())
        return {name: float(torch.stack(values).mean()) for name, values in figures.items()}

    def _minibatches(self, orders: Sequence[IntArray], size: int) -> Iterator[Any]:
        """Yield the rows of each minibatch of all passes."""
        for order in orders:
            yield from torch.from_numpy(order).to(self.device).split(size)

    def _by_chunks(self, data: Mapping[str, Any], function: Callable[[dict[str, Any]], Any]) -> Any:
        """Return what a function of observations returns for all decisions, without gradients."""
        observed = {name: values for name, values in data.items() if name in USED}
        rows = torch.arange(len(data["actions"]), device=self.device).split(CHUNK)
        with torch.no_grad():
            return torch.cat([function({name: values[part] for name, values in observed.items()}) for part in rows])

    def _start_log_probs(self, observed: Mapping[str, Any]) -> Any:
        """Return the log probabilities (n, 1 + C) of the start policy."""
        assert self._start is not None
        return self._start.log_probs(self._start.encode(observed))

    def _decisions(self) -> dict[str, Any]:
        """Return the rollout as tensors with a row for each decision (n, ...); observations by their names."""
        buffer = self.rollout_buffer
        named = {"old_log_probs": buffer.log_probs, "advantages": buffer.advantages, "returns": buffer.returns}
        observed = {name: array for name, array in buffer.observations.items() if name in USED}
        decisions = {
            name: torch.as_tensor(buffer.swap_and_flatten(array), device=self.device)
            for name, array in (observed | named | {"actions": buffer.actions}).items()
        }
        decisions |= {name: decisions[name].flatten() for name in named}
        decisions["actions"] = decisions["actions"].long()
        return decisions

    def _losses(self, batch: Mapping[str, Any], clip: float) -> dict[str, Any]:
        """Return `loss`, its terms and what describes the update, each a mean over a minibatch."""
        features = self.trained.encode(batch)
        log_probs, advantages = self.trained.log_probs(features), batch["advantages"]
        if len(advantages) > 1:  # a single decision has no standard deviation
            advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        log_ratio = log_probs.gather(1, batch["actions"]).squeeze(1) - batch["old_log_probs"]
        ratio = log_ratio.exp()
        gain = torch.min(advantages * ratio, advantages * ratio.clamp(1.0 - clip, 1.0 + clip)).mean()
        entropy = -(log_probs.exp() * log_probs).sum(1).mean()  # invalid actions have probability 0
        loss = -gain - self.ent_coef * entropy
        terms = {"policy_gradient_loss": -gain, "entropy_loss": -entropy}
        if self._value_optimizer is None:
            terms["value_loss"] = mse_loss(batch["returns"], self.trained.values(features))
            loss = loss + self.vf_coef * terms["value_loss"]
        if self._start is not None:
            wished = batch["start_log_probs"]
            terms["anchor_kl"] = (wished.exp() * (wished - log_probs)).sum(1).mean()
            loss = loss + self._anchor * terms["anchor_kl"]
        moved = log_ratio.detach()
        terms["approx_kl"] = (moved.exp() - 1.0 - moved).mean()
        terms["clip_fraction"] = ((ratio.detach() - 1.0).abs() > clip).float().mean()
        return {"loss": loss, **terms}


class TrainingCallback(BaseCallback):  # type: ignore[misc]   # its types are not checked
    """Callback that summarises the episodes of each rollout, and saves and stops between rollouts only.

    Attributes:
        rows: One row per rollout: `steps`, and means over its finished episodes of `return`, the final values `LAST`,
            `invalid_actions` and the sum of each reward term.
        stopped: Whether the training was stopped early.
    """

    def __init__(self, env: ExplorationVecEnv, save: Callable[[], None], every: int) -> None:
        super().__init__()
        self._save, self._every = save, every
        self._tell: Callable[[Row], None] = lambda row: None
        self._should_stop: Callable[[], bool] = lambda: False
        self._count: Callable[[int], None] = lambda decisions: None
        self.rows: list[Row] = []
        self._sums: list[dict[str, float]] = [{} for _ in range(env.num_envs)]
        self._ended: list[Row] = []
        self._begun = 0
        self.stopped = False

    def listen(
        self,
        on_update: Callable[[Row], None],
        should_stop: Callable[[], bool],
        on_step: Callable[[int], None] = lambda decisions: None,
    ) -> None:
        """Set the functions called between rollouts: to report a rollout, and to ask whether to stop.

        Args:
            should_stop: Function called between two rollouts; if it returns true, a checkpoint is saved and the
                training ends.
        """
        self._tell, self._should_stop, self._count = on_update, should_stop, on_step

    def get_state(self) -> dict[str, Any]:
        """Return the state of the callback."""
        return {"rows": [dict(row) for row in self.rows], "sums": [dict(sums) for sums in self._sums]}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Restore a state of `get_state`."""
        self.rows, self._sums = [dict(row) for row in state["rows"]], [dict(sums) for sums in state["sums"]]
        self._begun = len(self.rows)

    def _on_rollout_start(self) -> None:
        self._ended = []
        done = len(self.rows)
        if done > self._begun:
            self.stopped = self._should_stop()
            if self.stopped or done % self._every == 0:
                self._save()

    def _on_step(self) -> bool:
        if self.stopped:
            return False  # this step is discarded: the checkpoint was saved before it
        for slot, (info, done) in enumerate(zip(self.locals["infos"], self.locals["dones"], strict=True)):
            sums = self._sums[slot]
            for name, value in info.items():
                if name.startswith("reward/") or name == "invalid_action":
                    sums[name] = sums.get(name, 0.0) + value
            if done:
                self._ended.append(_finished(sums, info))
                self._sums[slot] = {}
        self._count(self.model.num_timesteps)
        return True

    def _on_rollout_end(self) -> None:
        row: Row = {"steps": float(self.model.num_timesteps)}
        for name in self._ended[0] if self._ended else ():
            row[name] = float(np.mean([episode[name] for episode in self._ended]))
            self.logger.record(f"episode/{name}", row[name])
        self.rows.append(row)
        self._tell(row)


def _finished(sums: Mapping[str, float], info: Mapping[str, Any]) -> Row:
    """Return the metrics of a finished episode: return, final values, and the sum of each reward term."""
    terms = {name: value for name, value in sums.items() if name.startswith("reward/")}
    last = {name: float(info[name]) for name in LAST}
    return {"return": sum(terms.values()), **last, "invalid_actions": sums["invalid_action"], **terms}


class Training:
    """Training in its own folder.

    All sums run on one thread: two trainings of one configuration give the same weights, whether interrupted or not and
    for any number of processes, on the same machine with the same packages.

    Args:
        folder: Folder of checkpoint, model and TensorBoard curves.
        workers: Number of processes that step the environments; 0: this process.
        device: Torch device: `"cpu"`, `"cuda"` or one of several GPUs.
        cluster: Address of a Ray cluster that steps the environments; 0 workers are then one per core.

    Attributes:
        model: The learner.
        watch: Callback that reports progress and stops the training.

    Raises:
        ValueError: If the device does not exist, the environment cannot be built, or the cluster cannot be used.
    """

    def __init__(
        self, config: TrainConfig, folder: Path, workers: int = 0, device: str = "cpu", cluster: str | None = None
    ) -> None:
        check_device(device)
        torch.set_num_threads(1)
        self.config, self._folder = config, folder
        self.env = make_vec_env(
            config.make_env_configs(SPLIT_TRAIN), config.envs, workers, cluster=cluster, monitor=False,
            wrap=WithTrueState,
        )  # fmt: skip
        self.model = GoalPPO(
            env=self.env, learning_rate=lambda left: left * config.learning_rate, n_steps=config.max_cycles,
            batch_size=config.batch, n_epochs=config.epochs, gamma=config.gamma, gae_lambda=config.gae_lambda,
            clip_range=config.clip, ent_coef=config.entropy, seed=config.seed, device=device, anchor=config.anchor,
            value_rollouts=config.value_rollouts,
        )  # fmt: skip
        if config.start_file is not None:
            self.model.start_from(load_model(config.start_file)[0])
        self.watch = TrainingCallback(self.env, self.save, config.checkpoint_updates)

    @property
    def rows(self) -> list[Row]:
        """One row per rollout so far."""
        return self.watch.rows

    def run(self) -> bool:
        """Train to the end, or until the callback stops the training; save a checkpoint and the model.

        Returns:
            Whether the training is complete.
        """
        left = self.config.updates * self.config.rollout - self.model.num_timesteps
        if left > 0:
            self.model.set_logger(configure(str(self._folder / BOARD), [BOARD]))
            self.model.learn(left, callback=self.watch, reset_num_timesteps=self.model._last_obs is None)
            self.model.logger.close()
            if not self.watch.stopped:
                self.save()
        return not self.watch.stopped

    def save(self) -> None:
        """Write the checkpoint and the current model."""
        model = self.model
        content = {
            "learner": as_arrays(model.get_state()),
            "counts": (model.num_timesteps, model._n_updates, model._current_progress_remaining),
            "last": (model._last_obs, model._last_episode_starts),
            "environments": self.env.get_state(),
            "watch": self.watch.get_state(),
            "draws": {
                "python": random.getstate(),
                "numpy": np.random.get_state(legacy=False),  # noqa: NPY002   # the learner uses the global generator
                "torch": as_arrays(torch.get_rng_state()),
                "cuda": as_arrays(_cuda_state()),
            },
        }
        save_run(self._folder, self.config, content, model.trained.actor_weights(), int(model.num_timesteps))

    def restore(self, kept: Mapping[str, Any]) -> None:
        """Resume from a checkpoint of `stored_checkpoint`.

        Raises:
            ValueError: If a part does not fit this training.
        """
        with restoring():
            self._go_on_from(kept)

    def _go_on_from(self, kept: Mapping[str, Any]) -> None:
        """Load the parts of a checkpoint."""
        model, draws = self.model, kept["draws"]
        model.set_state(as_tensors(kept["learner"]))
        check_finite(model.trained)
        model.num_timesteps, model._n_updates, model._current_progress_remaining = kept["counts"]
        model._last_obs, model._last_episode_starts = kept["last"]
        self.env.set_state(kept["environments"])
        self.watch.set_state(kept["watch"])
        random.setstate(draws["python"])
        checked_stream("draws", {name: draws["numpy"][name] for name in ("bit_generator", "state")})
        np.random.set_state(draws["numpy"])  # noqa: NPY002
        torch.set_rng_state(as_tensors(draws["torch"]))
        if draws["cuda"] is not None and torch.cuda.is_available():
            torch.cuda.set_rng_state_all(as_tensors(draws["cuda"]))

    def close(self) -> None:
        """Close the environments and their processes, and end an update that is running."""
        self.model.close()
        self.env.close()


def _cuda_state() -> Any:
    return torch.cuda.get_rng_state_all() if torch.cuda.is_available() else None
