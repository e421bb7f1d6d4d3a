"""Network of trained policies in numpy: its inputs, their scales and the action logits.

A robot, its candidates and its teammates are tokens. Layers of attention (Vaswani et al., "Attention is all you need",
NeurIPS 2017, with normalisation before each part) relate them; a pointer (Vinyals, Fortunato and Jaitly, "Pointer
networks", NeurIPS 2015) from the robot's token to the candidates gives the logits. Empty slots and absent teammates are
left out, so that the time depends on what there is.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.validation import BoolArray, Float32Array, IntArray
from vslam_env.belief.observation_keys import in_order_of_one
from vslam_env.navigation import CANDIDATE_FEATURES, NUM_CANDIDATES

Weights = Mapping[str, Float32Array]

SHAPES: dict[str, tuple[int, ...]] = {
    "local_grid": (3, 48, 48),
    "pose_std": (3,),
    "map_stats": (6,),
    "scan": (32,),
    "teammates": (7, 5),
    "teammates_mask": (7,),
    "landmark_counts": (5,),
    "time_left": (1,),
    "candidates": (NUM_CANDIDATES, len(CANDIDATE_FEATURES)),
    "action_mask": (1 + NUM_CANDIDATES,),
}
NAMES = tuple(SHAPES)
VECTORS = ("pose_std", "map_stats", "scan", "landmark_counts", "time_left")  # of the robot
PATCHES = (4, 3)  # sides of the non-overlapping patches of each convolution
CHANNELS = (16, 32)
WIDTH = 64  # of a token
NUM_HEADS = 4
NUM_LAYERS = 2
FEED_WIDTH = 128  # of the hidden layer behind each attention
EPSILON = 1e-5  # added to variances by the normalisation
INVALID = -1e8  # logit of an invalid action
VECTOR_SIZE = sum(int(np.prod(SHAPES[name])) for name in VECTORS)
PICTURE_SIZE = CHANNELS[1] * (48 // (PATCHES[0] * PATCHES[1])) ** 2


def weight_shapes() -> dict[str, tuple[int, ...]]:
    """Return the shapes of all weights, by the layer names of the learner."""
    side, second = PATCHES
    layers: dict[str, tuple[int, ...]] = {
        "picture.0": (CHANNELS[0], SHAPES["local_grid"][0], side, side),
        "picture.2": (CHANNELS[1], CHANNELS[0], second, second),
        "robot": (WIDTH, PICTURE_SIZE + VECTOR_SIZE),
        "candidate": (WIDTH, SHAPES["candidates"][1]),
        "teammate": (WIDTH, SHAPES["teammates"][1]),
        "last_norm": (WIDTH,),
        "query": (WIDTH, WIDTH),
        "key": (WIDTH, WIDTH),
        "stay": (1, WIDTH),
    }
    for layer in range(NUM_LAYERS):
        parts: dict[str, tuple[int, ...]] = {
            "norm": (WIDTH,), "query_key_value": (3 * WIDTH, WIDTH), "out": (WIDTH, WIDTH), "feed_norm": (WIDTH,),
            "feed_in": (FEED_WIDTH, WIDTH), "feed_out": (WIDTH, FEED_WIDTH),
        }  # fmt: skip
        layers |= {f"layers.{layer}.{name}": shape for name, shape in parts.items()}
    weights = {f"{name}.weight": shape for name, shape in layers.items()}
    return weights | {f"{name}.bias": shape[:1] for name, shape in layers.items()}


def logits(weights: Weights, observations: Mapping[str, NDArray[Any]]) -> Float32Array:
    """Return the logit of each action, (n, 1 + C) float32; `INVALID` for invalid ones.

    The result does not depend on the slots of the candidates, nor on the order of the teammates.

    Args:
        weights: Weights by the layer names of the learner.
        observations: (n, ...) arrays by name, as the environment returns them.
    """
    picture = in_order_of_one("local_grid", observations["local_grid"])
    n = len(picture)
    for layer, patch in enumerate(PATCHES):
        picture = np.maximum(_convolve(picture, weights, f"picture.{2 * layer}", patch), 0.0)
    vectors = [in_order_of_one(name, observations[name]).reshape(n, -1) for name in VECTORS]
    robot = _linear(weights, "robot", np.concatenate([picture.reshape(n, -1), *vectors], axis=1))
    is_valid, is_mate = observations["action_mask"][:, 1:] != 0, observations["teammates_mask"] != 0
    present = np.concatenate([np.ones((n, 1), np.bool_), is_valid, is_mate], axis=1)
    slots = _linear(weights, "candidate", in_order_of_one("candidates", observations["candidates"]))
    mates = _linear(weights, "teammate", in_order_of_one("teammates", observations["teammates"]))
    tokens = np.concatenate([robot[:, None], slots, mates], axis=1)[present]
    row, place = np.nonzero(present)[0], (present.cumsum(axis=1) - 1)[present]
    size = int(present.sum(axis=1).max())
    absent = np.arange(size) >= present.sum(axis=1, keepdims=True)
    for layer in range(NUM_LAYERS):
        tokens = tokens + _attention(weights, f"layers.{layer}", tokens, row, place, absent)
        hidden = _linear(weights, f"layers.{layer}.feed_in", _normalised(weights, f"layers.{layer}.feed_norm", tokens))
        tokens = tokens + _linear(weights, f"layers.{layer}.feed_out", np.maximum(hidden, 0.0))
    final = np.zeros((n, present.shape[1], WIDTH), np.float32)
    final[present] = _normalised(weights, "last_norm", tokens)
    queries, keys = _linear(weights, "query", final[:, 0]), _linear(weights, "key", final[:, 1 : 1 + NUM_CANDIDATES])
    scores = (keys @ queries[:, :, None])[..., 0] / np.float32(np.sqrt(WIDTH))
    stay = _linear(weights, "stay", final[:, 0])
    return np.concatenate([stay, np.where(is_valid, scores, np.float32(INVALID))], axis=1).astype(np.float32)


def _attention(
    weights: Weights, name: str, tokens: NDArray[Any], row: IntArray, place: IntArray, absent: BoolArray
) -> NDArray[Any]:
    """Attend within each observation.

    Args:
        weights: Weights by layer name.
        name: Name of the layer.
        tokens: (p, WIDTH) float32. Tokens of all observations.
        row: (p,) int64. Observation of each token.
        place: (p,) int64. Number of each token within its observation.
        absent: (n, m) bool. Places without a token.
    """
    n, size = absent.shape
    parts = np.zeros((n, size, 3, NUM_HEADS, WIDTH // NUM_HEADS), np.float32)
    mixed = _linear(weights, f"{name}.query_key_value", _normalised(weights, f"{name}.norm", tokens))
    parts[row, place] = mixed.reshape(-1, *parts.shape[2:])
    query, key, value = parts.transpose(2, 0, 3, 1, 4)
    scores = query @ key.swapaxes(-1, -2) / np.float32(np.sqrt(WIDTH // NUM_HEADS))
    scores = np.where(absent[:, None, None], np.float32(INVALID), scores)
    shares = np.exp(scores - scores.max(axis=-1, keepdims=True))
    seen = (shares / shares.sum(axis=-1, keepdims=True)) @ value
    return _linear(weights, f"{name}.out", seen.swapaxes(1, 2).reshape(n, size, WIDTH)[row, place])


def _normalised(weights: Weights, name: str, tokens: NDArray[Any]) -> NDArray[Any]:
    """Scale tokens to mean 0 and variance 1, and then by the weights."""
    centred = tokens - tokens.mean(axis=-1, keepdims=True)
    scaled = centred / np.sqrt((centred**2).mean(axis=-1, keepdims=True) + np.float32(EPSILON))
    normalised: NDArray[Any] = scaled * weights[f"{name}.weight"] + weights[f"{name}.bias"]
    return normalised


def _linear(weights: Weights, name: str, rows: NDArray[Any]) -> NDArray[Any]:
    product: NDArray[Any] = rows @ weights[f"{name}.weight"].T
    return product + weights[f"{name}.bias"]


def _convolve(picture: NDArray[Any], weights: Weights, name: str, patch: int) -> NDArray[Any]:
    """Convolve without overlap (stride = patch): (n, c, h, w) becomes (n, channels, h / patch, w / patch)."""
    n, channels, height, width = picture.shape
    tiles = picture.reshape(n, channels, height // patch, patch, width // patch, patch).transpose(0, 2, 4, 1, 3, 5)
    kernel = weights[f"{name}.weight"]
    flat = tiles.reshape(n, height // patch, width // patch, -1) @ kernel.reshape(len(kernel), -1).T
    moved: NDArray[Any] = np.moveaxis(flat + weights[f"{name}.bias"], -1, 1)
    return moved
