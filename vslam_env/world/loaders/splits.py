"""Disjoint splits of worlds for training, validation and tests: ranges of world seeds, and files in turn."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from slam_backend.core.validation import argument_error, check_choice

# Seeds of layout and textures, from (included) to (excluded).
SPLITS: dict[str, tuple[int, int]] = {
    "train": (20_000, 2**31),
    "validation": (10_000, 20_000),
    "test": (0, 10_000),
}
TURN = 10  # of ten consecutive files the first is for tests, the second for validation, the others for training


def draw_world_seed(split: str, rng: np.random.Generator) -> int:
    """Draw a world seed of a split.

    Args:
        split: A key of `SPLITS`.
        rng: Source of the draw.

    Raises:
        ValueError: If the split is unknown.
    """
    first, end = SPLITS[check_choice("world_split", split, tuple(SPLITS))]
    return int(rng.integers(first, end))


def files_of_split(files: Sequence[Path], split: str) -> list[Path]:
    """Return the files of a folder that belong to a split, in order.

    Args:
        files: All files of the folder in a fixed order, at least one.
        split: A key of `SPLITS`.

    Raises:
        ValueError: If the split is unknown or has no file.
    """
    turns = {"test": range(1), "validation": range(1, 2), "train": range(2, TURN)}
    turn = turns[check_choice("world_split", split, tuple(SPLITS))]
    chosen = [file for index, file in enumerate(files) if index % TURN in turn]
    if not chosen:
        hint = "Provide at least three files; ten give one each for test and validation, and eight for training."
        folder = files[0].parent
        raise argument_error("world_split", f"files for {split!r} in {folder}", f"a folder of {len(files)}", hint)
    return chosen
