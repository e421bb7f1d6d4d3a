"""Arrays that are handed out: who holds one can neither write to it nor make it writable."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Scalar = TypeVar("Scalar", bound=np.generic)


def as_read_only(array: NDArray[Scalar]) -> NDArray[Scalar]:
    """Return a view that follows the array's changes and refuses `flags.writeable = True`.

    numpy makes a view writable if the array that owns its memory is. The view lies on a read-only buffer, which is not.

    >>> view = as_read_only(np.zeros(2))
    >>> view.flags.writeable = True
    Traceback (most recent call last):
    ValueError: cannot set WRITEABLE flag to True of this array
    """
    return np.asarray(array.data.toreadonly())
