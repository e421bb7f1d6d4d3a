"""`TrainedGoalPolicy`: plays a network that `vslam train` taught; numpy alone, so that no learner need be installed."""

import hashlib
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.goal_network import NAMES, SHAPES, Weights, logits
from slam_backend.core.array_files import read_arrays
from slam_backend.core.files import write_file
from slam_backend.core.validation import argument_error
from vslam_env.belief.team_belief import Belief

FORMAT = 1  # raised when the network, or what observations mean, changes
SUFFIX = ".npz"
MODEL_FILE = "model" + SUFFIX
ABOUT = "about"


class TrainedGoalPolicy:
    """A trained policy for `goal` actions and dict observations.

    Args:
        weights: Of the network, as `load_model` returns them.
        greedy: Whether to take the action that the network holds for best; else one drawn from its distribution.
    """

    def __init__(self, weights: Weights, greedy: bool = False) -> None:
        self._weights = weights
        self._greedy = greedy

    def reset(self) -> None:
        """Nothing is remembered."""

    def act(self, observation: Any, belief: Belief, rng: np.random.Generator) -> int:
        """Return 0 to stay, or 1 + the slot of a valid candidate.

        Raises:
            ValueError: If the observation lacks what the network was trained on.
        """
        check_observation({name: np.shape(observation[name]) for name in observation})
        scores = logits(self._weights, {name: np.asarray(observation[name])[None] for name in NAMES})[0]
        scores = np.where(observation["action_mask"] != 0, scores, -np.inf)
        if self._greedy:
            return int(scores.argmax())
        chances = np.exp(scores - scores.max())
        return int(rng.choice(len(scores), p=chances / chances.sum()))


def check_observation(shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Refuse observations on which no trained network can have been trained.

    Args:
        shapes: Of the named arrays.

    Raises:
        ValueError: If one is missing or has another shape; the text names it.
    """
    for name, shape in SHAPES.items():
        if shapes.get(name) != shape:
            cure = "Use goal actions, dict observations and the standard scan."
            got = f"no {name!r}" if name not in shapes else f"shape {shapes[name]}"
            raise argument_error("observation", f"{name!r} of shape {shape}, as the model was trained on", got, cure)


def save_model(file: Path, weights: Weights, about: Mapping[str, Any]) -> None:
    """Write a model: its weights and what is to be known about it, as plain arrays and JSON.

    Args:
        file: Where to; it is replaced as a whole.
        weights: Of the network.
        about: Plain values.

    Raises:
        ValueError: If the file cannot be written; an old one of that name is then unchanged.
    """
    arrays = {name: np.asarray(weights[name], np.float32) for name in sorted(weights)}
    told = {"format": FORMAT, "weights": _digest(arrays)} | dict(about)
    packed = io.BytesIO()
    np.savez(packed, allow_pickle=False, **{ABOUT: np.array(json.dumps(told))}, **arrays)
    write_file(file, packed.getvalue(), "file")


def load_model(path: str | Path) -> tuple[Weights, dict[str, Any]]:
    """Read a model that `save_model` wrote; nothing of the file is run.

    Args:
        path: The file, or the run folder that holds it.

    Returns:
        The weights, and what was told about them.

    Raises:
        ValueError: If the file is missing, damaged or of another version.
    """
    file = Path(path) / MODEL_FILE if Path(path).is_dir() else Path(path)
    expected = "a model that vslam train wrote"
    if not file.is_file():
        raise argument_error("model", expected, "no such file", f"Check {str(file)!r}.")
    try:
        arrays: dict[str, NDArray[Any]] = dict(read_arrays(file))
        about = json.loads(str(arrays.pop(ABOUT)))
        version, digest = about["format"], about["weights"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        cure = f"{str(file)!r} cannot be read: copy or train it anew."
        raise argument_error("model", expected, "a broken file", cure) from error
    if version != FORMAT:
        cure = f"Train it anew, or use the release that made it, {about.get('version', 'unknown')}."
        raise argument_error("model", f"one of format {FORMAT}", f"a model of format {version}", cure)
    if _digest(arrays) != digest:
        raise argument_error("model", expected, "a broken file", f"{str(file)!r} was changed: copy or train it anew.")
    return arrays, about


def _digest(weights: Mapping[str, NDArray[Any]]) -> str:
    """Return what tells these weights from all others."""
    told = hashlib.sha256()
    for name in sorted(weights):
        told.update(f"{name} {weights[name].shape} {weights[name].dtype}\n".encode())
        told.update(np.ascontiguousarray(weights[name]).tobytes())
    return told.hexdigest()
