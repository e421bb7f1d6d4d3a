"""`Labels`: decisions of a teacher with what the robot observed, stored compactly in files."""

import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.goal_network import SHAPES
from slam_backend.core.array_files import read_arrays
from slam_backend.core.files import write_file
from slam_backend.core.validation import Float32Array, IntArray, argument_error

FORMAT = 3  # incremented when the content of files or the meaning of observations changes
GRID = "local_grid"
BIT_AXES = {GRID: 2, "action_mask": 1, "teammates_mask": 1}  # axes along which arrays of bits are packed
ABOUT = "about"
MOST = 6e4  # largest number in a file
HINT = "Delete it, or use another folder."


@dataclass(frozen=True, eq=False)
class Labels:
    """n decisions, with the inputs of the network only, in 2 kB each.

    Attributes:
        packed: Arrays by the names of `agents.goal_network.SHAPES`: grids as bits, eight rows of an image in a row of
            bytes (n, 3, 6, 48) uint8, which are compressed best; masks as bits (n, bytes) uint8; other numbers as
            (n, ...) float16 with 6 bits of mantissa, exact to 0.8 %.
        chosen: (n,) int64. Action of the teacher.
        preferences: (n, 1 + C) float32. Logarithms of the teacher's preferences, 0 for the best, -inf for actions that
            it did not consider.
    """

    packed: dict[str, NDArray[Any]]
    chosen: IntArray
    preferences: Float32Array

    def __len__(self) -> int:
        return len(self.chosen)

    def take(self, rows: IntArray) -> "Labels":
        """Return copies of some labels."""
        packed = {name: values[rows] for name, values in self.packed.items()}
        return Labels(packed, self.chosen[rows], self.preferences[rows])

    def inputs(self, rows: IntArray | slice) -> dict[str, NDArray[Any]]:
        """Return the inputs (m, ...) of the network for m labels, with the types that the environment returns."""
        found: dict[str, NDArray[Any]] = {}
        for name, shape in SHAPES.items():
            values, axis = self.packed[name][rows], BIT_AXES.get(name)
            if axis is None:
                found[name] = values.astype(np.float32)
            else:
                bits = np.unpackbits(values, axis=axis, count=shape[axis - 1])
                found[name] = bits * np.uint8(255) if name == GRID else bits.view(np.int8)
        return found


def pack(seen: Mapping[str, NDArray[Any]], chosen: IntArray, preferences: Float32Array) -> Labels:
    """Return labels for observations (n, ...) as the environment returned them."""
    packed: dict[str, NDArray[Any]] = {}
    for name in SHAPES:
        values, axis = np.asarray(seen[name]), BIT_AXES.get(name)
        packed[name] = _rounded(values) if axis is None else np.packbits(values != 0, axis=axis)
    return Labels(packed, chosen, preferences)


def write_labels(file: Path, labels: Labels, about: Mapping[str, Any]) -> int:
    """Write labels atomically, and return the size of the file [bytes].

    Args:
        file: The file. It is smallest if labels of one robot follow each other.
        labels: The labels.
        about: Environment, seed and name of the file, as plain values, which `read_labels` compares.

    Raises:
        ValueError: If the file cannot be written.
    """
    arrays = {name: _planes(values) if values.dtype == np.float16 else values for name, values in labels.packed.items()}
    arrays |= {"chosen": labels.chosen.astype(np.uint8), "preferences": labels.preferences.astype(np.float16)}
    stream = io.BytesIO()
    metadata = np.array(json.dumps({"format": FORMAT, **about}))
    np.savez_compressed(stream, allow_pickle=False, **{ABOUT: metadata}, **arrays)
    write_file(file, stream.getvalue(), "out")
    return stream.tell()


def read_labels(file: Path, about: Mapping[str, Any]) -> Labels:
    """Read labels of `write_labels`; no code from the file is run.

    Args:
        file: The file.
        about: Environment, seed and name that the file must have.

    Raises:
        ValueError: If the file is missing, damaged, of another format, or belongs to something else.
    """
    expected = "labels that vslam train wrote"
    if not file.is_file():
        raise argument_error("labels", expected, "no such file", f"Check {str(file)!r}.")
    try:
        arrays = dict(read_arrays(file))
        found = json.loads(str(arrays.pop(ABOUT)))
        version = found.pop("format")
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise argument_error("labels", expected, "a broken file", f"{str(file)!r} cannot be read. {HINT}") from error
    if version != FORMAT:
        raise argument_error("labels", f"those of format {FORMAT}", f"format {version}", f"See {str(file)!r}. {HINT}")
    for name, value in about.items():
        if found.get(name) != value:
            hint = f"{str(file)!r} was made in another run. {HINT}"
            raise argument_error("labels", f"those of this {name}", f"those of another {name}", hint)
    try:
        return _unpacked(arrays)
    except (ValueError, KeyError, TypeError) as error:
        hint = f"{str(file)!r} has other arrays. {HINT}"
        raise argument_error("labels", expected, "another file", hint) from error


def joined(parts: Sequence[Labels]) -> Labels:
    """Return all labels together."""
    return Labels(
        {name: np.concatenate([part.packed[name] for part in parts]) for name in SHAPES},
        np.concatenate([part.chosen for part in parts]),
        np.concatenate([part.preferences for part in parts]),
    )


def _unpacked(arrays: Mapping[str, NDArray[Any]]) -> Labels:
    """Return the labels of the arrays in a file."""
    chosen, preferences = arrays["chosen"].astype(np.int64), arrays["preferences"].astype(np.float32)
    n, num_actions = len(chosen), SHAPES["action_mask"][0]
    if preferences.shape != (n, num_actions) or chosen.ndim != 1 or ((chosen < 0) | (chosen >= num_actions)).any():
        raise ValueError("labels of other actions")
    if not (preferences <= 0.0).all() or not np.isfinite(preferences[np.arange(n), chosen]).all():  # False for NaN
        raise ValueError("preferences that are no logarithms")
    packed: dict[str, NDArray[Any]] = {}
    for name, shape in SHAPES.items():
        axis, expected = BIT_AXES.get(name), [n, *shape]
        packed[name] = arrays[name] if axis is not None else _from_planes(arrays[name])
        if axis is not None:
            expected[axis] = -(-expected[axis] // 8)
        dtype = np.float16 if axis is None else np.uint8
        if packed[name].dtype != dtype or packed[name].shape != tuple(expected):
            raise ValueError(f"{name} of another shape")
        if not np.isfinite(packed[name]).all():
            raise ValueError(f"{name} with NaN or infinity")
    return Labels(packed, chosen, preferences)


def _rounded(values: NDArray[Any]) -> NDArray[np.float16]:
    """Return values as float16 whose last four bits are zero; large ones become the largest one."""
    halves = np.clip(values, -MOST, MOST).astype(np.float16).view(np.uint16)
    return np.asarray((halves + np.uint16(8)) & np.uint16(0xFFF0)).view(np.float16)


def _planes(values: NDArray[np.float16]) -> NDArray[np.uint8]:
    """Return the high and the low bytes of (n, ...) numbers apart, (2, ..., n), which are compressed better."""
    moved = np.ascontiguousarray(np.moveaxis(values.astype("<f2"), 0, -1))
    return np.ascontiguousarray(np.moveaxis(moved.view(np.uint8).reshape(*moved.shape, 2), -1, 0))


def _from_planes(planes: NDArray[np.uint8]) -> NDArray[np.float16]:
    """Return the inverse of `_planes`."""
    if planes.dtype != np.uint8 or len(planes) != 2:
        raise ValueError("no planes of bytes")
    joint = np.ascontiguousarray(np.moveaxis(planes, 0, -1)).view("<f2")[..., 0]
    return np.ascontiguousarray(np.moveaxis(joint, -1, 0).astype(np.float16))
