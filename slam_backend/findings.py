"""`Findings`: what became of the measurements of one step, of all robots side by side; cut out for who asks."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple, Self

import numpy as np

from slam_backend._kernels import STOOD
from slam_backend._kernels.layout import ASSOCIATED, COUNT, CREATED, REJECTED
from slam_backend.errors import BoolArray, IntArray
from slam_backend.input_log import UNHEARD, StepInput, Turn


class Findings(NamedTuple):
    """What became of N robots' measurements in one step; nobody writes to it when the step is over.

    Attributes:
        told: (2, n) int64. Of all measurements used, one robot's after the other's: the landmark that each was taken
            for, and that which it created, as in `StepReport`.
        turns: Of each robot, as in `StepInput`.
        masks: By robot which of its measurements were used, as there.
    """

    told: IntArray
    turns: Sequence[Turn]
    masks: Mapping[int, BoolArray]

    @classmethod
    def none_yet(cls, inputs: StepInput) -> Self:
        """Return room for what becomes of some readings; until it is written all measurements are rejected."""
        told = np.empty((2, len(inputs.sightings)), np.int64)
        told.fill(REJECTED)
        return cls(told, inputs.turns, inputs.masks)

    @classmethod
    def gathered(cls, associations: Sequence[IntArray], created: Sequence[IntArray]) -> Self:
        """Return those of robots of each of which both are known, (n_i,) ids."""
        told = np.stack([np.concatenate(associations), np.concatenate(created)])
        turns, begin = [], 0
        for own in associations:
            turns.append((STOOD, begin, begin + len(own), False, False, len(own)))
            begin += len(own)
        return cls(told, turns, {})

    def close(self) -> None:
        """Let nobody write to it any more: reports and journals share it."""
        self.told.setflags(write=False)

    def num_given(self, row: int) -> int:
        """Return how many measurements a robot was given, used or not."""
        return max(self.turns[row][COUNT], 0)

    def associated(self, row: int) -> IntArray:
        """Return what the measurements (n_i,) of a robot were taken for; there are none of robot -1. A copy."""
        return self._cut(row, ASSOCIATED)

    def created(self, row: int) -> IntArray:
        """Return likewise which landmarks they created."""
        return self._cut(row, CREATED)

    def names_associated(self, row: int) -> list[int]:
        """Return the landmarks that measurements of a robot were taken for, in their order."""
        return self._names(row, ASSOCIATED)

    def names_created(self, row: int) -> list[int]:
        """Return likewise the landmarks that they created."""
        return self._names(row, CREATED)

    def _names(self, row: int, kind: int) -> list[int]:
        """Return the names among what became of the measurements of a robot."""
        _, begin, end, _, _, _ = self.turns[row] if row >= 0 else UNHEARD
        found: list[int] = self.told[kind, begin:end].tolist()
        return [name for name in found if name != REJECTED]

    def _cut(self, row: int, kind: int) -> IntArray:
        """Return what became of the measurements of a robot, -1 for those that were not used."""
        _, begin, end, _, _, _ = self.turns[row] if row >= 0 else UNHEARD
        used: IntArray = self.told[kind, begin:end].copy()
        if row not in self.masks:
            return used
        every: IntArray = np.full(len(self.masks[row]), REJECTED)
        every[self.masks[row]] = used
        return every
