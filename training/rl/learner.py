"""`GoalPPO`: MaskablePPO for `GoalPolicy`, whose loss may keep the policy near that of the model it began with.

The penalty is the Kullback-Leibler divergence from the start policy to the current one, as in Baker et al., "Video
PreTraining (VPT): learning to act by watching unlabeled online videos", NeurIPS 2022.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import deepcopy
from functools import partial
from threading import Event
from typing import Any

import numpy as np
import torch
from sb3_contrib import MaskablePPO
from stable_baselines3.common.utils import explained_variance, update_learning_rate
from torch.nn.functional import mse_loss

from agents.goal_network import SHAPES, Weights
from slam_backend.core.validation import IntArray
from training.rl.network import GoalPolicy
from training.rl.true_state import STATE

# A value head that leaves the actor's layers alone learns from their features, which is cheap: many small steps.
VALUE_PASSES, VALUE_BATCH, VALUE_RATE = 4, 720, 1e-3
EPSILON = 1e-5  # of Adam, as Stable-Baselines3 has it
CHUNK = 1440  # decisions that are encoded at once
USED = (*SHAPES, STATE)  # observations of actor and critic


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
