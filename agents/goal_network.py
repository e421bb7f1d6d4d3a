"""Network of trained policies in numpy: its inputs, their scales and the action logits."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.validation import Float32Array
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
# Factors that scale the input vectors to the order of one.
VECTORS: dict[str, tuple[float, ...]] = {
    "pose_std": (2.0, 2.0, 10.0),
    "map_stats": (0.01, 5.0, 5.0, 0.1, 1.0, 0.25),
    "scan": (0.125,),
    "teammates": (0.1, 0.1, 1.0, 1.0, 2.0),
    "teammates_mask": (1.0,),
    "landmark_counts": (0.02,),
    "time_left": (0.01,),
}
FEATURE_SCALES: dict[str, float] = {
    "x": 0.1,
    "y": 0.1,
    "path_length": 0.1,
    "size": 0.25,
    "teammate_path_length": 1.0 / 60.0,
    "unknown_area": 0.05,
    "unseen_wall": 0.25,
    "weak_landmarks": 0.25,
    "uncertain_length": 0.1,
    "nearest_candidate": 0.1,
}  # 1 for the others
CANDIDATE_SCALE = tuple(FEATURE_SCALES.get(name, 1.0) for name in CANDIDATE_FEATURES)
GRID_SCALE = 1.0 / 255.0
PATCHES = (4, 3)  # sides of the non-overlapping patches of each convolution
CHANNELS = (16, 32)
CONTEXT = 64  # width of all other layers
VECTOR_SIZE = sum(int(np.prod(SHAPES[name])) for name in VECTORS)
PICTURE_SIZE = CHANNELS[1] * (48 // (PATCHES[0] * PATCHES[1])) ** 2


def logits(weights: Weights, observations: Mapping[str, NDArray[Any]]) -> Float32Array:
    """Return the logit of each action, (n, 1 + C) float32, for valid and invalid actions.

    A convolution of the local grid and the vectors give a context. One small network with shared weights scores each
    candidate from this context and the candidate's features, so that the result does not depend on the slot.

    Args:
        weights: Weights by the layer names of the learner.
        observations: (n, ...) arrays by name, as the environment returns them.
    """
    picture = observations["local_grid"] * np.float32(GRID_SCALE)
    for layer, patch in enumerate(PATCHES):
        picture = np.maximum(_convolve(picture, weights, f"picture.{2 * layer}", patch), 0.0)
    seen = np.maximum(_linear(weights, "picture_out", picture.reshape(len(picture), -1)), 0.0)
    vectors = [
        (observations[name] * np.array(scale, np.float32)).reshape(len(picture), -1) for name, scale in VECTORS.items()
    ]
    context = np.tanh(_linear(weights, "context", np.concatenate([seen, *vectors], axis=1)))
    candidates = observations["candidates"] * np.array(CANDIDATE_SCALE, np.float32)
    beside = _linear(weights, "slot", candidates) + _linear(weights, "slot_context", context)[:, None]
    hidden = np.tanh(_linear(weights, "slot_hidden", np.tanh(beside)))
    scores = _linear(weights, "slot_score", hidden)[..., 0]
    stay = _linear(weights, "stay_score", context)
    return np.concatenate([stay, scores], axis=1).astype(np.float32)


def _linear(weights: Weights, name: str, rows: NDArray[Any]) -> NDArray[Any]:
    product: NDArray[Any] = rows @ weights[f"{name}.weight"].T
    return product + weights[f"{name}.bias"] if f"{name}.bias" in weights else product


def _convolve(picture: NDArray[Any], weights: Weights, name: str, patch: int) -> NDArray[Any]:
    """Convolve without overlap (stride = patch): (n, c, h, w) becomes (n, channels, h / patch, w / patch)."""
    n, channels, height, width = picture.shape
    tiles = picture.reshape(n, channels, height // patch, patch, width // patch, patch).transpose(0, 2, 4, 1, 3, 5)
    kernel = weights[f"{name}.weight"]
    flat = tiles.reshape(n, height // patch, width // patch, -1) @ kernel.reshape(len(kernel), -1).T
    moved: NDArray[Any] = np.moveaxis(flat + weights[f"{name}.bias"], -1, 1)
    return moved
