"""`GoalPPO`: MaskablePPO for `GoalPolicy`, whose loss may keep the policy near that of the model it began with.

The penalty is the Kullback-Leibler divergence from the start policy to the current one, as in Baker et al., "Video
PreTraining (VPT): learning to act by watching unlabeled online videos", NeurIPS 2022.
"""

from collections.abc import Mapping
from copy import deepcopy
from typing import Any

import numpy as np
import torch
from sb3_contrib import MaskablePPO
from stable_baselines3.common.utils import explained_variance
from torch.nn.functional import mse_loss

from agents.goal_network import Weights
from training.rl.network import GoalPolicy


class GoalPPO(MaskablePPO):  # type: ignore[misc]   # its types are not checked
    """PPO with masks for a `GoalPolicy`, with an optional anchor to the policy of the start model.

    Without a start model the updates are those of MaskablePPO. Clipping of values and a target of the KL divergence are
    not supported.

    Args:
        anchor: Weight of the penalty KL(start || policy) [1/nat], a mean over the decisions of a minibatch.
        value_rollouts: Number of first rollouts that train the value head alone; its weights are random at first.
        arguments: Arguments of MaskablePPO.
    """

    policy: GoalPolicy

    def __init__(self, *, anchor: float = 0.0, value_rollouts: int = 0, **arguments: Any) -> None:
        super().__init__(GoalPolicy, **arguments)
        self._anchor, self._value_rollouts = anchor, value_rollouts
        self._start: GoalPolicy | None = None

    def start_from(self, weights: Weights) -> None:
        """Begin with the actor of a model, and keep its policy for the penalty."""
        self.policy.load_actor(weights)
        if self._anchor:
            self._start = deepcopy(self.policy).requires_grad_(False)

    def start_state(self) -> dict[str, Any] | None:
        """Return the state dict of the start policy; None without an anchor."""
        return None if self._start is None else dict(self._start.state_dict())

    def set_start_state(self, state: Mapping[str, Any] | None) -> None:
        """Restore the start policy of `start_state`.

        Raises:
            RuntimeError: If there is a start policy in one of the two only, or it has other layers.
        """
        if (self._start is None) != (state is None):
            raise RuntimeError("the start policy is missing, or not expected")
        if self._start is not None:
            self._start.load_state_dict(state)

    def train(self) -> None:
        """Update actor and critic with the decisions of the last rollout."""
        policy, optimizer = self.policy, self.policy.optimizer
        policy.set_training_mode(True)
        self._update_learning_rate(optimizer)
        clip = self.clip_range(self._current_progress_remaining)
        trains_actor = self.num_timesteps > self._value_rollouts * self.n_steps * self.n_envs
        data = self._decisions()
        figures: dict[str, list[Any]] = {}
        for _ in range(self.n_epochs):
            order = np.random.permutation(len(data["actions"]))  # noqa: NPY002   # the learner uses the global generator
            for rows in torch.from_numpy(order).to(self.device).split(self.batch_size):
                batch = {name: values[rows] for name, values in data.items()}
                terms = self._losses(batch, clip, trains_actor)
                optimizer.zero_grad()
                terms["loss"].backward()
                torch.nn.utils.clip_grad_norm_(policy.parameters(), self.max_grad_norm)
                optimizer.step()
                for name, value in terms.items():
                    figures.setdefault(name, []).append(value.detach())
            self._n_updates += 1
        for name, values in figures.items():
            self.logger.record(f"train/{name}", float(torch.stack(values).mean()))
        values, returns = self.rollout_buffer.values.flatten(), self.rollout_buffer.returns.flatten()
        self.logger.record("train/explained_variance", explained_variance(values, returns))

    def _decisions(self) -> dict[str, Any]:
        """Return the rollout as tensors with a row for each decision (n, ...); observations by their names."""
        buffer = self.rollout_buffer
        named = {"old_log_probs": buffer.log_probs, "advantages": buffer.advantages, "returns": buffer.returns}
        found = {
            name: torch.as_tensor(buffer.swap_and_flatten(array), device=self.device)
            for name, array in (buffer.observations | named | {"actions": buffer.actions}).items()
        }
        found |= {name: found[name].flatten() for name in named}
        found["actions"] = found["actions"].long()
        if self._start is not None:
            parts = []
            with torch.no_grad():
                for rows in torch.arange(len(found["actions"]), device=self.device).split(self.batch_size):
                    parts.append(self._start.evaluate({name: found[name][rows] for name in buffer.observations})[1])
            found["start_log_probs"] = torch.cat(parts)
        return found

    def _losses(self, batch: Mapping[str, Any], clip: float, trains_actor: bool) -> dict[str, Any]:
        """Return `loss`, its terms and what describes the update, each a mean over a minibatch."""
        values, log_probs = self.policy.evaluate(batch, trains_actor)
        value_loss = mse_loss(batch["returns"], values)
        if not trains_actor:
            return {"loss": self.vf_coef * value_loss, "value_loss": value_loss}
        advantages = batch["advantages"]
        if len(advantages) > 1:  # a single decision has no standard deviation
            advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        log_ratio = log_probs.gather(1, batch["actions"]).squeeze(1) - batch["old_log_probs"]
        ratio = log_ratio.exp()
        gain = torch.min(advantages * ratio, advantages * ratio.clamp(1.0 - clip, 1.0 + clip)).mean()
        entropy = -(log_probs.exp() * log_probs).sum(1).mean()  # invalid actions have probability 0
        loss = -gain - self.ent_coef * entropy + self.vf_coef * value_loss
        terms = {"policy_gradient_loss": -gain, "entropy_loss": -entropy, "value_loss": value_loss}
        if self._start is not None:
            wished = batch["start_log_probs"]
            terms["anchor_kl"] = (wished.exp() * (wished - log_probs)).sum(1).mean()
            loss = loss + self._anchor * terms["anchor_kl"]
        moved = log_ratio.detach()
        terms["approx_kl"] = (moved.exp() - 1.0 - moved).mean()
        terms["clip_fraction"] = ((ratio.detach() - 1.0).abs() > clip).float().mean()
        return {"loss": loss, **terms}
