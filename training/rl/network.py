"""`GoalPolicy`: torch version of `agents.goal_network` with a value head, for MaskablePPO and for imitation.

The actor uses what a robot observes. Where observations have the true state (`training.rl.true_state`), the value head
uses it as well (Pinto et al., "Asymmetric actor critic for image-based robot learning", RSS 2018).
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from sb3_contrib.common.maskable.policies import MaskableMultiInputActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from agents.goal_network import (
    CHANNELS,
    FEED_WIDTH,
    INVALID,
    NUM_HEADS,
    NUM_LAYERS,
    PATCHES,
    PICTURE_SIZE,
    SHAPES,
    VECTOR_SIZE,
    VECTORS,
    WIDTH,
    Weights,
)
from agents.trained import check_observation
from training.rl.true_state import STATE
from vslam_env.belief.observation_keys import SCALES

GROUP = 60  # observations that attention pads to the same number of tokens
NUM_SLOTS, NUM_FEATURES = SHAPES["candidates"]
VALUE_WIDTH = 128  # of the hidden layers of the value head
KEPT = (1 + NUM_SLOTS) * WIDTH + NUM_SLOTS  # features without the true state


class Group(NamedTuple):
    """Observations with about as many tokens, which attention pads to the same number."""

    place: Any  # (q,) int64. Places of their tokens among n x m
    absent: Any  # (n, m) bool. Places without a token


def _groups(counts: Any) -> list[Group]:
    """Return groups of observations with numbers of tokens (n,) in ascending order."""
    groups = []
    for part in counts.split(GROUP):
        is_token = torch.arange(int(part[-1]), device=part.device) < part.unsqueeze(1)
        groups.append(Group(is_token.flatten().nonzero().squeeze(1), ~is_token))
    return groups


class AttentionLayer(nn.Module):  # type: ignore[misc]   # its types are not checked
    """Attention within each observation and a hidden layer, each with normalisation before and a shortcut."""

    def __init__(self) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(WIDTH)
        self.query_key_value = nn.Linear(WIDTH, 3 * WIDTH)
        self.out = nn.Linear(WIDTH, WIDTH)
        self.feed_norm = nn.LayerNorm(WIDTH)
        self.feed_in = nn.Linear(WIDTH, FEED_WIDTH)
        self.feed_out = nn.Linear(FEED_WIDTH, WIDTH)

    def forward(self, tokens: Any, groups: Sequence[Group]) -> Any:
        """Return new tokens (p, WIDTH), from those of all observations; see `agents.goal_network`."""
        mixed = self.query_key_value(self.norm(tokens)).split([len(group.place) for group in groups])
        seen = torch.cat([_attend(part, group) for part, group in zip(mixed, groups, strict=True)])
        tokens = tokens + self.out(seen)
        return tokens + self.feed_out(torch.relu(self.feed_in(self.feed_norm(tokens))))


def _attend(mixed: Any, group: Group) -> Any:
    """Return what the tokens of a group (q, WIDTH) see, from their queries, keys and values (q, 3 x WIDTH)."""
    n, size = group.absent.shape
    parts = mixed.new_zeros(n * size, 3 * WIDTH).index_copy(0, group.place, mixed)
    query, key, value = parts.view(n, size, 3, NUM_HEADS, WIDTH // NUM_HEADS).permute(2, 0, 3, 1, 4)
    scores = query @ key.transpose(-1, -2) / (WIDTH // NUM_HEADS) ** 0.5
    shares = scores.masked_fill(group.absent[:, None, None], INVALID).softmax(dim=-1)
    return (shares @ value).transpose(1, 2).reshape(n * size, WIDTH).index_select(0, group.place)


class GoalFeatures(BaseFeaturesExtractor):  # type: ignore[misc]
    """Tokens of the robot and of its candidates after attention, the mask of valid candidates, and the true state."""

    def __init__(self, observation_space: Any) -> None:
        check_observation({name: box.shape for name, box in getattr(observation_space, "spaces", {}).items()})
        super().__init__(observation_space, KEPT + _state_size(observation_space))
        first, second = PATCHES
        self.picture = nn.Sequential(
            nn.Conv2d(3, CHANNELS[0], first, first), nn.ReLU(), nn.Conv2d(CHANNELS[0], CHANNELS[1], second, second),
            nn.ReLU(),
        )  # fmt: skip
        self.robot = nn.Linear(PICTURE_SIZE + VECTOR_SIZE, WIDTH)
        self.candidate = nn.Linear(NUM_FEATURES, WIDTH)
        self.teammate = nn.Linear(len(SCALES["teammates"]), WIDTH)
        self.layers = nn.ModuleList(AttentionLayer() for _ in range(NUM_LAYERS))
        self.last_norm = nn.LayerNorm(WIDTH)
        for name in (*VECTORS, "candidates", "teammates"):
            self.register_buffer(f"{name}_scale", torch.tensor(SCALES[name]), persistent=False)

    def forward(self, observations: dict[str, Any]) -> Any:
        """Return (n, (1 + C) x WIDTH + C + S): tokens of robot and candidates (0 if invalid), mask, true state."""
        picture = self.picture(observations["local_grid"]).flatten(1)
        vectors = [(observations[name] * getattr(self, f"{name}_scale")).flatten(1) for name in VECTORS]
        robot = self.robot(torch.cat([picture, *vectors], dim=1)).unsqueeze(1)
        slots = self.candidate(observations["candidates"] * self.candidates_scale)
        mates = self.teammate(observations["teammates"] * self.teammates_scale)
        valid = observations["action_mask"][:, 1:]
        present = torch.cat([torch.ones_like(valid[:, :1]), valid, observations["teammates_mask"]], dim=1) != 0
        counts, order = present.sum(1).sort(stable=True)
        row, column = present[order].nonzero(as_tuple=True)
        places = order[row] * present.shape[1] + column  # of tokens, by the number of tokens of their observation
        tokens = torch.cat([robot, slots, mates], dim=1).flatten(0, 1).index_select(0, places)
        groups = _groups(counts)
        for layer in self.layers:
            tokens = layer(tokens, groups)
        final = tokens.new_zeros(present.numel(), WIDTH).index_copy(0, places, self.last_norm(tokens))
        final = final.view(*present.shape, WIDTH)
        truth = [observations[STATE]] if STATE in observations else []
        return torch.cat([final[:, : 1 + NUM_SLOTS].flatten(1), valid, *truth], dim=1)


def _state_size(space: Any) -> int:
    """Return S, the length of the true state in the observations; 0 if they have none."""
    return int(space[STATE].shape[0]) if STATE in space.spaces else 0


class SlotPointer(nn.Module):  # type: ignore[misc]
    """Logits of the candidates by a pointer from the robot; the value uses the mean of the valid candidates.

    Args:
        state_size: S, the length of the true state, which the value uses as well; 0: there is none.
    """

    latent_dim_pi = 1 + NUM_SLOTS
    latent_dim_vf = VALUE_WIDTH

    def __init__(self, state_size: int) -> None:
        super().__init__()
        self.value_state = nn.Linear(state_size, WIDTH) if state_size else None
        self.query = nn.Linear(WIDTH, WIDTH)
        self.key = nn.Linear(WIDTH, WIDTH)
        self.stay = nn.Linear(WIDTH, 1)
        size = (2 + (state_size > 0)) * WIDTH
        self.value_hidden = nn.Sequential(
            nn.Linear(size, VALUE_WIDTH), nn.ReLU(), nn.Linear(VALUE_WIDTH, VALUE_WIDTH), nn.Tanh()
        )

    def forward(self, features: Any) -> tuple[Any, Any]:
        """Return logits (n, 1 + C) and features of the value head (n, VALUE_WIDTH)."""
        return self.forward_actor(features), self.forward_critic(features)

    def forward_actor(self, features: Any) -> Any:
        """Return the logits only."""
        robot, slots, valid, _ = _split(features)
        scores = (self.key(slots) @ self.query(robot).unsqueeze(2)).squeeze(2) / WIDTH**0.5
        return torch.cat([self.stay(robot), scores.masked_fill(valid == 0, INVALID)], dim=1)

    def forward_critic(self, features: Any) -> Any:
        """Return the features of the value head (n, VALUE_WIDTH) only."""
        robot, slots, valid, state = _split(features)
        mean = slots.sum(1) / valid.sum(1, keepdim=True).clamp(min=1.0)  # invalid slots are 0
        truth = [] if self.value_state is None else [torch.relu(self.value_state(state))]
        return self.value_hidden(torch.cat([robot, mean, *truth], dim=1))


def _split(features: Any) -> tuple[Any, Any, Any, Any]:
    sizes = [WIDTH, NUM_SLOTS * WIDTH, NUM_SLOTS, features.shape[1] - KEPT]
    robot, slots, valid, state = features.split(sizes, dim=1)
    return robot, slots.unflatten(1, (NUM_SLOTS, WIDTH)), valid, state


class GoalPolicy(MaskableMultiInputActorCriticPolicy):  # type: ignore[misc]
    """Actor and critic for `goal` actions and dict observations."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs | {"features_extractor_class": GoalFeatures})

    def _build(self, lr_schedule: Any) -> None:
        """Make the layers and the optimiser; the pointer's outputs already are the logits."""
        self.mlp_extractor = SlotPointer(_state_size(self.observation_space))
        self.action_net = nn.Identity()
        self.value_net = nn.Linear(VALUE_WIDTH, 1)
        for module in (self.features_extractor, self.mlp_extractor):
            module.apply(lambda layer: self.init_weights(layer, gain=1.0))
        for layer in (self.mlp_extractor.query, self.mlp_extractor.stay):
            self.init_weights(layer, gain=0.01)  # all actions are about equally probable at first
        self.init_weights(self.value_net, gain=1.0)
        self.optimizer = self.optimizer_class(self.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)

    def logits(self, observations: dict[str, Any]) -> Any:
        """Return the logits (n, 1 + C) of observations as float tensors; grids from 0 to 1."""
        return self.mlp_extractor.forward_actor(self.features_extractor(observations))

    def encode(self, observations: Mapping[str, Any]) -> Any:
        """Return features (n, f) of observations: tensors (n, ...) by name, as the environment returns them."""
        inputs = {name: observations[name] for name in (*SHAPES, STATE) if name in observations}
        inputs["local_grid"] = observations["local_grid"] / 255.0
        return self.features_extractor(inputs)

    def log_probs(self, features: Any) -> Any:
        """Return log probabilities of all actions (n, 1 + C), about -1e8 for invalid ones."""
        return self.mlp_extractor.forward_actor(features).log_softmax(1)

    def values(self, features: Any) -> Any:
        """Return values (n,)."""
        return self.value_net(self.mlp_extractor.forward_critic(features)).squeeze(1)

    def parts(self) -> tuple[list[Any], list[Any]]:
        """Return the parameters of the actor with the shared layers, and those of the value head alone."""
        parts: tuple[list[Any], list[Any]] = ([], [])
        for name, tensor in self.named_parameters():
            parts[".value_" in f".{name}"].append(tensor)
        return parts

    def load_actor(self, weights: Weights) -> None:
        """Take the weights of `agents.goal_network`; those of the value head stay as they are."""
        own = {**self.features_extractor.state_dict(), **self.mlp_extractor.state_dict()}
        with torch.no_grad():
            for name, values in weights.items():
                own[name].copy_(torch.from_numpy(np.array(values)))

    def actor_weights(self) -> dict[str, NDArray[np.float32]]:
        """Return copies of the weights that `agents.goal_network` needs, by layer name."""
        return actor_part({name: tensor.detach().cpu().numpy() for name, tensor in self.state_dict().items()})


def actor_part(state: Mapping[str, Any]) -> dict[str, NDArray[np.float32]]:
    """Return copies of the weights that `agents.goal_network` needs, by layer name, of a policy's state dict."""
    weights: dict[str, NDArray[np.float32]] = {}
    for name, values in state.items():
        part, _, layer = name.partition(".")
        if part in ("features_extractor", "mlp_extractor") and not layer.startswith("value_"):
            weights[layer] = np.array(values, np.float32)
    return weights


def check_finite(policy: GoalPolicy) -> None:
    """Refuse parameters that are not finite, of which nothing can be learned.

    Raises:
        ValueError: If there are any.
    """
    if not all(bool(torch.isfinite(values).all()) for values in policy.parameters()):
        raise ValueError("weights with NaN or infinity")
