"""Tables of numbers in text files, and their order in time."""

import csv
import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.short_repr import short_repr
from slam_backend.core.text_files import parse_numbers, place, read_text
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

    Other columns, empty lines and lines that begin with `#` are skipped. Quoted entries may hold delimiters and line
    breaks.

    Args:
        path: Text file. The names may follow a `#`, and a line `sep=;` may come first, as Excel reads it.
        numbers: Names of k columns of numbers.
        labels: Names of l columns of words, such as a landmark's identity.
        delimiter: ",", ";" or a tab; None: the one of the line `sep=`, or else of the header line.

    Raises:
        ValueError: If the file is missing, not text or has no rows, a column is missing or repeated, a row has more
            entries than there are names, or an entry is missing, not a finite number or an empty label; the message
            names file, line and column.
    """
    file = Path(path)
    lines = read_text(file, kind="a CSV file").split("\n")
    wanted = (*numbers, *labels)
    first = next((number for number, line in enumerate(lines) if line.strip()), 0)
    if excel := re.fullmatch(r"\"?sep=(.)\"?\s*", lines[first], re.IGNORECASE):
        delimiter, lines[first] = delimiter or excel[1], ""
    header, delimiter = _header(file, lines, wanted, delimiter)
    names = _names(lines[header], delimiter)
    places = [_place(file, names, name) for name in wanted]
    values: list[list[float]] = []
    words: list[list[str]] = []
    for number, cells in _rows(file, lines, header + 1, delimiter):
        if any(cell.strip() for cell in cells[len(names) :]):
            expected = f"at most {len(names)} entries, one for each name,"
            hint = f"Correct {place(file, number)}: decimal commas, for example, need another delimiter."
            raise argument_error("path", expected, f"a row of {len(cells)}", hint)
        found = [cells[at].strip() if at < len(cells) else "" for at in places]
        for name, word in zip(wanted, found, strict=True):
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


def _header(file: Path, lines: list[str], wanted: tuple[str, ...], delimiter: str | None) -> tuple[int, str]:
    """Return the index of the line of names, the first without `#` unless one with `#` has all names, and delimiter."""
    for number, line in enumerate(lines):
        if not line.strip():
            continue
        used = delimiter or next((sign for sign in DELIMITERS if sign in line), ",")
        check_choice("delimiter", used, DELIMITERS)
        if not line.startswith("#") or set(wanted) <= set(_names(line, used)):
            return number, used
    raise argument_error("path", f"{file.name} with a line of names", "no such line", f"Check {str(file)!r}.")


def _names(line: str, delimiter: str) -> list[str]:
    """Return the names in a line, perhaps a comment."""
    return [
        name.strip() for name in next(csv.reader([line.lstrip("# ")], delimiter=delimiter, skipinitialspace=True), [])
    ]


def _rows(file: Path, lines: list[str], start: int, delimiter: str) -> Iterator[tuple[int, list[str]]]:
    """Yield number and cells of each row from line `start` on; a row begins after the end of the last one."""
    first = 0  # number of the line in which the row begins, 0 between rows

    def fed() -> Iterator[str]:
        nonlocal first
        for number, line in enumerate(lines[start:], start=start + 1):
            if first or (line.strip() and not line.startswith("#")):
                first = first or number
                yield line + "\n"

    try:
        for cells in csv.reader(fed(), delimiter=delimiter, skipinitialspace=True, strict=True):
            yield first, cells
            first = 0
    except csv.Error as error:
        hint = f"Correct {place(file, first)}: quotes must enclose an entry, and be closed."
        raise argument_error("path", "a CSV file", f"a syntax error: {error}", hint) from error


def _place(file: Path, names: list[str], wanted: str) -> int:
    """Return the index of a column."""
    if names.count(wanted) != 1:
        got = f"a line of names {', '.join(names)!r}"
        hint = f"Correct the line of names of {file}, or ask for the name that the column has."
        raise argument_error("path", f"{file.name} with one column {wanted!r}", got, hint)
    return names.index(wanted)


def _number(file: Path, number: int, name: str, word: str) -> float:
    """Return the finite number in a word."""
    found = parse_numbers([word])
    if found is None or not math.isfinite(found[0]):
        has_comma = re.fullmatch(r"[-+]?\d*,\d+([eE][-+]?\d+)?", word) is not None
        expected = "a decimal point, not a comma," if has_comma else "a finite number"
        raise _bad_entry(file, number, name, expected, repr(word))
    return found[0]


def _bad_entry(file: Path, number: int, name: str, expected: str, got: str) -> ValueError:
    """Return the error of a wrong entry of a file."""
    return argument_error("path", f"{expected} in column {name!r}", got, f"Correct {place(file, number)}.")
