"""`GoalPolicy`: torch version of `agents.goal_network` with a value head, for MaskablePPO."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from sb3_contrib.common.maskable.policies import MaskableMultiInputActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from agents.goal_network import CANDIDATE_SCALE, CHANNELS, CONTEXT, PATCHES, PICTURE_SIZE, SHAPES, VECTOR_SIZE, VECTORS

NUM_SLOTS, NUM_FEATURES = SHAPES["candidates"]


class GoalFeatures(BaseFeaturesExtractor):  # type: ignore[misc]   # its types are not checked
    """Context of the robot, scaled candidates, and the mask of valid candidates."""

    def __init__(self, observation_space: Any) -> None:
        super().__init__(observation_space, CONTEXT + (NUM_FEATURES + 1) * NUM_SLOTS)
        first, second = PATCHES
        self.picture = nn.Sequential(
            nn.Conv2d(3, CHANNELS[0], first, first), nn.ReLU(), nn.Conv2d(CHANNELS[0], CHANNELS[1], second, second),
            nn.ReLU(),
        )  # fmt: skip
        self.picture_out = nn.Linear(PICTURE_SIZE, CONTEXT)
        self.context = nn.Linear(CONTEXT + VECTOR_SIZE, CONTEXT)
        for name, scale in {**VECTORS, "candidates": CANDIDATE_SCALE}.items():
            self.register_buffer(f"{name}_scale", torch.tensor(scale), persistent=False)

    def forward(self, observations: dict[str, Any]) -> Any:
        """Return (n, 64 + C x F + C): context, candidates row by row, mask of valid candidates."""
        seen = torch.relu(self.picture_out(self.picture(observations["local_grid"]).flatten(1)))
        vectors = [(observations[name] * getattr(self, f"{name}_scale")).flatten(1) for name in VECTORS]
        context = torch.tanh(self.context(torch.cat([seen, *vectors], dim=1)))
        candidates = observations["candidates"] * self.candidates_scale
        return torch.cat([context, candidates.flatten(1), observations["action_mask"][:, 1:]], dim=1)


class SlotScorer(nn.Module):  # type: ignore[misc]
    """Scores of the candidates by one shared network; the value uses its mean features over valid candidates."""

    latent_dim_pi = 1 + NUM_SLOTS
    latent_dim_vf = CONTEXT

    def __init__(self) -> None:
        super().__init__()
        self.slot = nn.Linear(len(CANDIDATE_SCALE), CONTEXT)
        self.slot_context = nn.Linear(CONTEXT, CONTEXT, bias=False)
        self.slot_hidden = nn.Linear(CONTEXT, CONTEXT)
        self.slot_score = nn.Linear(CONTEXT, 1)
        self.stay_score = nn.Linear(CONTEXT, 1)
        self.value_hidden = nn.Linear(2 * CONTEXT, CONTEXT)

    def forward(self, features: Any) -> tuple[Any, Any]:
        """Return logits (n, 1 + C) and features of the value head (n, 64)."""
        context, hidden, valid = self._look(features)
        return self._logits(context, hidden), self._value(context, hidden, valid)

    def forward_actor(self, features: Any) -> Any:
        """Return the logits only."""
        context, hidden, _ = self._look(features)
        return self._logits(context, hidden)

    def forward_critic(self, features: Any) -> Any:
        """Return the features of the value head only."""
        return self._value(*self._look(features))

    def _look(self, features: Any) -> tuple[Any, Any, Any]:
        context, candidates, valid = features.split([CONTEXT, NUM_FEATURES * NUM_SLOTS, NUM_SLOTS], dim=1)
        beside = self.slot(candidates.unflatten(1, (NUM_SLOTS, NUM_FEATURES))) + self.slot_context(context).unsqueeze(1)
        return context, torch.tanh(self.slot_hidden(torch.tanh(beside))), valid

    def _logits(self, context: Any, hidden: Any) -> Any:
        return torch.cat([self.stay_score(context), self.slot_score(hidden).squeeze(-1)], dim=1)

    def _value(self, context: Any, hidden: Any, valid: Any) -> Any:
        mean = (hidden * valid.unsqueeze(-1)).sum(1) / valid.sum(1, keepdim=True).clamp(min=1.0)
        return torch.tanh(self.value_hidden(torch.cat([context, mean], dim=1)))


class GoalPolicy(MaskableMultiInputActorCriticPolicy):  # type: ignore[misc]
    """Actor and critic for `goal` actions and dict observations."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs | {"features_extractor_class": GoalFeatures})

    def _build(self, lr_schedule: Any) -> None:
        """Make the layers and the optimiser; the scorer's outputs already are the logits."""
        self.mlp_extractor = SlotScorer()
        self.action_net = nn.Identity()
        self.value_net = nn.Linear(CONTEXT, 1)
        for module in (self.features_extractor, self.mlp_extractor):
            module.apply(lambda layer: self.init_weights(layer, gain=np.sqrt(2.0)))
        for layer in (self.mlp_extractor.slot_score, self.mlp_extractor.stay_score):
            self.init_weights(layer, gain=0.01)
        self.init_weights(self.value_net, gain=1.0)
        self.optimizer = self.optimizer_class(self.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)

    def actor_weights(self) -> dict[str, NDArray[np.float32]]:
        """Return copies of the weights that `agents.goal_network` needs, by layer name."""
        layers = {**self.features_extractor.state_dict(), **self.mlp_extractor.state_dict()}
        return {
            name: tensor.detach().cpu().numpy().copy()
            for name, tensor in layers.items()
            if not name.startswith("value_hidden")
        }
