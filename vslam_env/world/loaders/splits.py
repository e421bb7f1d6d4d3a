"""Worlds for training, validation and tests that never meet: ranges of world seeds, and files of a folder by turns."""

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
TURN = 10  # of ten files in a row the first is for tests, the second for validation, the rest for training


def draw_world_seed(split: str, rng: np.random.Generator) -> int:
    """Draw a world seed of a split.

    Args:
        split: A key of `SPLITS`.
        rng: Source of the draw.

    Raises:
        ValueError: If there is no such split.
    """
    first, end = SPLITS[check_choice("world_split", split, tuple(SPLITS))]
    return int(rng.integers(first, end))


def files_of_split(files: Sequence[Path], split: str) -> list[Path]:
    """Return the files of a folder, in order, that belong to a split.

    Args:
        files: All of the folder, in a fixed order; at least one.
        split: A key of `SPLITS`.

    Raises:
        ValueError: If there is no such split, or it has no file.
    """
    turns = {"test": range(1), "validation": range(1, 2), "train": range(2, TURN)}
    turn = turns[check_choice("world_split", split, tuple(SPLITS))]
    chosen = [file for index, file in enumerate(files) if index % TURN in turn]
    if not chosen:
        cure = "Put three files or more there; ten give one each for test and validation, and eight for training."
        folder = files[0].parent
        raise argument_error("world_split", f"files for {split!r} in {folder}", f"a folder of {len(files)}", cure)
    return chosen
