"""Rows of a log in order of time: rows a little out of order are sorted, larger jumps back are damage."""

import numpy as np

from slam_backend.errors import FloatArray, IntArray

MOST_JITTER = 1.0  # [s]; loggers that write from several threads swap rows by tenths of a second, no more


def steps_back(times: FloatArray) -> FloatArray:
    """Return how far each row lies before the latest row above it, 0 where it does not.

    Args:
        times: (n,) float64 [s], in the order of the file.

    >>> steps_back(np.array([1.0, 3.0, 2.5, 3.5])).tolist()
    [0.0, 0.0, 0.5, 0.0]
    """
    return np.asarray(np.maximum.accumulate(times) - times)


def time_order(name: str, times: FloatArray) -> tuple[IntArray, str]:
    """Return the rows in order of time, and what was done in a few words.

    Args:
        name: The file, as the words shall call it.
        times: (n,) float64 [s], in the order of the file. `steps_back` is at most `MOST_JITTER` in each row; a reader
            refuses the file before.

    Returns:
        Rows (n,), earliest first; rows of one time keep the order of the file. The words are empty if that is the
        order of the file.

    >>> time_order("a.dat", np.array([1.0, 3.0, 2.5, 3.0]))
    (array([0, 2, 1, 3]), 'a.dat (1 row, up to 0.500 s back)')
    """
    back = steps_back(times)
    count = int(np.count_nonzero(back))
    words = f"{name} ({count} row{'s' if count > 1 else ''}, up to {back.max():.3f} s back)" if count else ""
    return np.argsort(times, kind="stable").astype(np.int64), words


def sorted_note(words: list[str]) -> tuple[str, ...]:
    """Return one line about all files that were sorted; no line if there are none.

    Args:
        words: Remarks that `time_order` said of each file.
    """
    told = [word for word in words if word]
    return (f"Sorted by time: {', '.join(told)}.",) if told else ()
