"""Network of trained policies that drive: speed and turn from what a robot observes, in numpy or in jax.

Two layers of patches over the picture of the surroundings, then two hidden layers over it and all vectors. Functions
take the module of their arrays, so that the network is written once.
"""

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np

from agents.goal_network import CHANNELS, PATCHES
from agents.goal_network import SHAPES as GOAL_SHAPES
from vslam_env.belief.observation_keys import in_order_of_one

NAMES = ("local_grid", "pose_std", "map_stats", "scan", "teammates", "teammates_mask")
SHAPES: dict[str, tuple[int, ...]] = {name: GOAL_SHAPES[name] for name in NAMES}
HIDDEN = (128, 64)
NUM_OUTPUTS = 2  # speed and turn
PICTURE = CHANNELS[1] * (48 // (PATCHES[0] * PATCHES[1])) ** 2
NUM_FEATURES = PICTURE + sum(int(np.prod(SHAPES[name])) for name in NAMES[1:])


def weight_shapes(num_outputs: int = NUM_OUTPUTS) -> dict[str, tuple[int, ...]]:
    """Return the shapes of all weights, by layer."""
    shapes: dict[str, tuple[int, ...]] = {}
    depths = (SHAPES["local_grid"][0], *CHANNELS)
    widths = (NUM_FEATURES, *HIDDEN, num_outputs)
    for i, side in enumerate(PATCHES):
        shapes |= {f"picture.{i}.weight": (depths[i] * side**2, depths[i + 1]), f"picture.{i}.bias": (depths[i + 1],)}
    for i, (width, after) in enumerate(pairwise(widths)):
        shapes |= {f"layer.{i}.weight": (width, after), f"layer.{i}.bias": (after,)}
    return shapes | {"log_std": (num_outputs,)}


def outputs(weights: Mapping[str, Any], observations: Mapping[str, Any], xp: Any = np) -> Any:
    """Return the outputs (n, o) of the last layer: means of speed and turn for an actor.

    Args:
        weights: Weights by layer.
        observations: Arrays (n, ...) by name, as robots observe them.
        xp: Module of the arrays, `numpy` or `jax.numpy`.
    """
    picture = in_order_of_one("local_grid", observations["local_grid"], xp)
    count, depth, size, _ = picture.shape
    picture = xp.moveaxis(picture, 1, -1)
    for i, side in enumerate(PATCHES):
        size //= side
        patches = picture.reshape(count, size, side, size, side, depth)
        patches = xp.moveaxis(patches, 2, 3).reshape(count, size, size, side * side * depth)
        picture = xp.maximum(patches @ weights[f"picture.{i}.weight"] + weights[f"picture.{i}.bias"], 0.0)
        depth = CHANNELS[i]
    vectors = [in_order_of_one(name, observations[name], xp).reshape(count, -1) for name in NAMES[1:]]
    hidden = xp.concatenate([picture.reshape(count, -1), *vectors], axis=1)
    last = len(HIDDEN)
    for i in range(last):
        hidden = xp.tanh(hidden @ weights[f"layer.{i}.weight"] + weights[f"layer.{i}.bias"])
    return hidden @ weights[f"layer.{last}.weight"] + weights[f"layer.{last}.bias"]
