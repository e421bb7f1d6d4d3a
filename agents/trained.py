"""Trained policies: networks of `vslam train` and `vslam train-batched`, evaluated by numpy alone."""

import hashlib
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents import driver_network
from agents.goal_network import NAMES, SHAPES, Weights, logits, weight_shapes
from slam_backend.core.array_files import read_arrays
from slam_backend.core.files import write_file
from slam_backend.core.validation import argument_error
from vslam_env.belief.observation import action_mask, observe
from vslam_env.belief.observation_keys import MASK
from vslam_env.belief.team_belief import Belief
from vslam_env.navigation import CANDIDATE_FEATURES

FORMAT = 3  # incremented when the network or the meaning of observations changes
SUFFIX = ".npz"
MODEL_FILE = "model" + SUFFIX
ABOUT = "about"
GOAL, DRIVER = "goal", "driver"  # networks: of goals, and of speed and turn
OWN_GOAL = CANDIDATE_FEATURES.index("own_goal")


class TrainedGoalPolicy:
    """A trained policy for `goal` actions; also the choice of goals for a `DrivingPolicy`.

    It takes from the belief what the observation lacks.

    Args:
        weights: Weights of the network, as `load_model` returns them.
        greedy: Whether to take the best action of the network; otherwise one is drawn from its distribution.
    """

    observation_keys = NAMES

    def __init__(self, weights: Weights, greedy: bool = False) -> None:
        self._weights = weights
        self._greedy = greedy
        self.reset()

    def reset(self) -> None:
        """Forget the last choice."""
        self._last = 0

    def act(self, observation: Any, belief: Belief, rng: np.random.Generator) -> int:
        """Return 0 to stay, or 1 + the slot of a valid candidate.

        Raises:
            ValueError: If an input of the network has another shape.
        """
        named = observation if isinstance(observation, Mapping) else {}
        missing = [name for name in NAMES if name not in named and name != MASK]
        if missing:
            named = {**named, **observe(belief, missing)}
        if MASK not in named:  # the robot drives itself; only it knows its goal
            candidates = np.array(named["candidates"])
            mask = action_mask(candidates)
            if self._last > 0:
                candidates[self._last - 1, OWN_GOAL] = mask[self._last]
            named = {**named, "candidates": candidates, MASK: mask}
        check_observation({name: np.shape(named[name]) for name in named})
        scores = logits(self._weights, {name: np.asarray(named[name])[None] for name in NAMES})[0]
        scores = np.where(named[MASK] != 0, scores, -np.inf)
        if self._greedy:
            self._last = int(scores.argmax())
        else:
            chances = np.exp(scores - scores.max())
            self._last = int(rng.choice(len(scores), p=chances / chances.sum()))
        return self._last


class TrainedDriver:
    """A trained policy for `continuous` actions, which decides every few ticks; a step of the environment is a tick.

    It takes from the belief what the observation lacks.

    Args:
        weights: Weights of the network, as `load_model` returns them.
        ticks: Ticks for which a decision holds, as in the training.
        greedy: Whether to take the mean of the network's distribution; otherwise an action is drawn from it.
    """

    observation_keys = driver_network.NAMES

    def __init__(self, weights: Weights, ticks: int, greedy: bool = False) -> None:
        self._weights, self._ticks, self._greedy = weights, ticks, greedy
        self.reset()

    def reset(self) -> None:
        """Forget the last decision."""
        self._age, self._action = 0, np.zeros(driver_network.NUM_OUTPUTS, np.float32)

    def act(self, observation: Any, belief: Belief, rng: np.random.Generator) -> NDArray[np.float32]:
        """Return speed and turn (2,) float32 in [-1, 1].

        Raises:
            ValueError: If an input of the network has another shape.
        """
        if self._age % self._ticks == 0:
            named = observation if isinstance(observation, Mapping) else {}
            missing = [name for name in driver_network.NAMES if name not in named]
            named = {**named, **observe(belief, missing)} if missing else named
            check_observation({name: np.shape(named[name]) for name in named}, driver_network.SHAPES)
            batch = {name: np.asarray(named[name])[None] for name in driver_network.NAMES}
            mean = driver_network.outputs(self._weights, batch)[0]
            drawn = 0.0 if self._greedy else np.exp(self._weights["log_std"]) * rng.standard_normal(len(mean))
            self._action = np.clip(mean + drawn, -1.0, 1.0).astype(np.float32)
        self._age += 1
        return self._action.copy()


def check_observation(
    shapes: Mapping[str, tuple[int, ...]], needed: Mapping[str, tuple[int, ...]] = SHAPES
) -> None:  # fmt: skip
    """Refuse observations that do not fit the input of a network.

    Args:
        shapes: Shapes of the arrays in the observation, by name.
        needed: Shapes of the inputs, by name.

    Raises:
        ValueError: If an array is missing or has another shape; the message names it.
    """
    for name, shape in needed.items():
        if shapes.get(name) != shape:
            hint = 'Use dict observations, observation_keys="goal" and the standard scan.'
            got = f"no {name!r}" if name not in shapes else f"shape {shapes[name]}"
            raise argument_error("observation", f"{name!r} of shape {shape}, as the model was trained on", got, hint)


def save_model(file: Path, weights: Weights, about: Mapping[str, Any]) -> None:
    """Write a model: its weights and its metadata, as plain arrays and JSON.

    Args:
        file: Path of the model; the file is replaced atomically.
        weights: Weights of the network.
        about: Metadata as plain values.

    Raises:
        ValueError: If the file cannot be written; an existing file is then unchanged.
    """
    arrays = {name: np.asarray(weights[name], np.float32) for name in sorted(weights)}
    metadata = {"format": FORMAT, "weights": _digest(arrays)} | dict(about)
    packed = io.BytesIO()
    np.savez(packed, allow_pickle=False, **{ABOUT: np.array(json.dumps(metadata))}, **arrays)
    write_file(file, packed.getvalue(), "file")


def load_model(path: str | Path, argument: str = "model") -> tuple[Weights, dict[str, Any]]:
    """Read a model that `save_model` wrote; no code from the file is run.

    Args:
        path: Path of the model, or of the run folder that contains it.
        argument: Name of the path in errors.

    Returns:
        The weights and the metadata.

    Raises:
        ValueError: If the file is missing, damaged or has another format.
    """
    file = Path(path) / MODEL_FILE if Path(path).is_dir() else Path(path)
    expected = "a model that vslam train wrote"
    if not file.is_file():
        raise argument_error(argument, expected, "no such file", f"Check {str(file)!r}.")
    try:
        arrays: dict[str, NDArray[Any]] = dict(read_arrays(file))
        about = json.loads(str(arrays.pop(ABOUT)))
        version, digest, _ = about["format"], about["weights"], about.keys()
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        hint = f"{str(file)!r} cannot be read. Copy it again, or train again."
        raise argument_error(argument, expected, "a broken file", hint) from error
    if version != FORMAT:
        hint = f"Train again, or use the release that wrote it, {about.get('version', 'unknown')}."
        raise argument_error(argument, f"one of format {FORMAT}", f"a model of format {version}", hint)
    if _digest(arrays) != digest:
        raise argument_error(
            argument, expected, "a broken file", f"{str(file)!r} was changed. Copy it again, or train again."
        )
    _check_weights(argument, file, arrays, about.get("network", GOAL))
    if not isinstance(about.get("environment"), str):
        hint = f"{str(file)!r} was made by another program. Train again."
        raise argument_error(argument, "the environment of its training", "no text 'environment'", hint)
    return arrays, about


def drives(path: str | Path, argument: str = "policy") -> bool:
    """Return whether a model drives by itself, False if there is none; arguments and errors as of `load_model`."""
    file = Path(path) / MODEL_FILE if Path(path).is_dir() else Path(path)
    return file.is_file() and load_model(file, argument)[1].get("network", GOAL) == DRIVER


def trained_policy(
    path: str | Path, argument: str = "model", greedy: bool = False
) -> TrainedGoalPolicy | TrainedDriver:
    """Return the policy of a model; arguments and errors as of `load_model`.

    Args:
        path: Path of the model, or of the run folder that contains it.
        argument: Name of the path in errors.
        greedy: Whether to take the best action of the network.
    """
    weights, about = load_model(path, argument)
    if about.get("network", GOAL) == DRIVER:
        return TrainedDriver(weights, int(about["ticks"]), greedy)
    return TrainedGoalPolicy(weights, greedy)


def _check_weights(argument: str, file: Path, arrays: Mapping[str, NDArray[Any]], network: Any) -> None:
    """Refuse weights that are not those of the network: others, missing ones, other shapes, or no finite numbers.

    Raises:
        ValueError: If they are not; the message names the first.
    """
    hint, known = (
        f"{str(file)!r} was made by another program. Train again.",
        {GOAL: weight_shapes, DRIVER: driver_network.weight_shapes},
    )
    if network not in known:
        raise argument_error(argument, f"a network {' or '.join(map(repr, known))}", network, hint)
    shapes = known[network]()
    for name in (*shapes, *arrays):
        expected = f"weights {name[:60]!r} of shape {shapes.get(name)}, float32" if name in shapes else "no others"
        if name not in shapes or name not in arrays:
            got = f"no {name!r}" if name in shapes else name
            raise argument_error(argument, expected, got, hint)
        if arrays[name].shape != shapes[name] or arrays[name].dtype != np.float32:
            raise argument_error(argument, expected, f"shape {arrays[name].shape}, {arrays[name].dtype}", hint)
        if not np.isfinite(arrays[name]).all():
            raise argument_error(argument, f"finite numbers in {name!r}", "NaN or infinity", hint)


def _digest(weights: Mapping[str, NDArray[Any]]) -> str:
    """Return a digest that identifies these weights."""
    digest = hashlib.sha256()
    for name in sorted(weights):
        digest.update(f"{name} {weights[name].shape} {weights[name].dtype}\n".encode())
        digest.update(np.ascontiguousarray(weights[name]).tobytes())
    return digest.hexdigest()
