"""Tables of numbers in text files, and their order in time."""

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import FloatArray, IntArray, argument_error, check_choice

MOST_JITTER = 1.0  # [s]; multi-threaded loggers swap rows by tenths of a second only


def steps_back(times: FloatArray) -> FloatArray:
    """Return the time of each row before the latest row above it, 0 for rows in order.

    Args:
        times: (n,) float64 [s], in the order of the file.

    >>> steps_back(np.array([1.0, 3.0, 2.5, 3.5])).tolist()
    [0.0, 0.0, 0.5, 0.0]
    """
    return np.asarray(np.maximum.accumulate(times) - times)


def time_order(name: str, times: FloatArray) -> tuple[IntArray, str]:
    """Return the rows in order of time, and a remark about the sorting.

    Args:
        name: Name of the file in the remark.
        times: (n,) float64 [s], in the order of the file. `steps_back` is at most `MOST_JITTER`, checked by the reader.

    Returns:
        Rows (n,), earliest first; rows of equal times keep the order of the file. The remark is empty if the file was
        in order.

    >>> time_order("a.dat", np.array([1.0, 3.0, 2.5, 3.0]))
    (array([0, 2, 1, 3]), 'a.dat (1 row, up to 0.500 s back)')
    """
    back = steps_back(times)
    count = int(np.count_nonzero(back))
    words = f"{name} ({count} row{'s' if count > 1 else ''}, up to {back.max():.3f} s back)" if count else ""
    return np.argsort(times, kind="stable").astype(np.int64), words


def sorted_note(words: list[str]) -> tuple[str, ...]:
    """Return one line about all sorted files; no line if there are none.

    Args:
        words: Remarks of `time_order` about each file.
    """
    remarks = [word for word in words if word]
    return (f"Sorted by time: {', '.join(remarks)}.",) if remarks else ()


DELIMITERS = (",", ";", "\t")


@short_repr
class CsvTable(NamedTuple):
    """Columns of a CSV file with n rows.

    Attributes:
        numbers: (n, k) float64. Finite numbers.
        labels: (n, l) str. Non-empty words without surrounding blanks.
    """

    numbers: FloatArray
    labels: NDArray[np.str_]


def read_csv(
    path: str | Path, numbers: Sequence[str], labels: Sequence[str] = (), delimiter: str | None = None
) -> CsvTable:
    """Read columns of a CSV file with a header line.

    Other columns, empty lines and, below the header, lines that begin with `#` are skipped.

    Args:
        path: UTF-8 file; `#` before the first name is dropped.
        numbers: Names of k columns of numbers.
        labels: Names of l columns of words, such as a landmark's identity.
        delimiter: ",", ";" or a tab; None: the delimiter of the header line.

    Raises:
        ValueError: If the file is missing, not text or has no rows, a column is missing or repeated, or an entry is
            missing, not a finite number or an empty label; the message names file, line and column.
    """
    file = Path(path)
    if not file.is_file():
        raise argument_error("path", "a CSV file", "no such file", f"Check {str(file)!r}.")
    try:
        lines = file.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise argument_error(
            "path", f"{file.name} in UTF-8", "a file in another encoding", f"Save {file} in UTF-8."
        ) from error
    first = next((number for number, line in enumerate(lines) if line.strip()), None)
    if first is None:
        raise argument_error("path", f"{file.name} with a line of names", "no lines", f"{file} is empty.")
    if delimiter is None:
        delimiter = next((sign for sign in DELIMITERS if sign in lines[first]), ",")
    check_choice("delimiter", delimiter, DELIMITERS)
    names = [name.strip() for name in next(csv.reader([lines[first].lstrip("# ")], delimiter=delimiter))]
    places = [_place(file, names, name) for name in (*numbers, *labels)]
    values: list[list[float]] = []
    words: list[list[str]] = []
    for number, line in enumerate(lines[first + 1 :], start=first + 2):
        if not line.strip() or line.startswith("#"):
            continue
        cells = next(csv.reader([line], delimiter=delimiter))
        found = [cells[place].strip() if place < len(cells) else "" for place in places]
        for name, word in zip((*numbers, *labels), found, strict=True):
            if not word:
                raise _bad_entry(file, number, name, "an entry", "no entry")
        values.append([_number(file, number, name, word) for name, word in zip(numbers, found, strict=False)])
        words.append(found[len(numbers) :])
    if not values:
        raise argument_error("path", f"{file.name} with rows", "no rows", f"{file} ends after its line of names.")
    return CsvTable(
        np.array(values, dtype=np.float64).reshape(len(values), len(numbers)),
        np.array(words, dtype=np.str_).reshape(len(words), len(labels)),
    )


def _place(file: Path, names: list[str], wanted: str) -> int:
    """Return the index of a column."""
    if names.count(wanted) != 1:
        got = f"a line of names {', '.join(names)!r}"
        hint = f"Correct the first line of {file}, or ask for the name that the column has."
        raise argument_error("path", f"{file.name} with one column {wanted!r}", got, hint)
    return names.index(wanted)


def _number(file: Path, number: int, name: str, word: str) -> float:
    """Return the finite number in a word."""
    try:
        value = math.nan if "_" in word else float(word)  # Python accepts 1_000, which is damage in a log
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise _bad_entry(file, number, name, "a finite number", repr(word))
    return value


def _bad_entry(file: Path, number: int, name: str, expected: str, got: str) -> ValueError:
    """Return the error of a wrong entry of a file."""
    return argument_error("path", f"{expected} in column {name!r}", got, f"Correct line {number} of {file}.")
