"""Binary format of state trees. It holds data only: reading a file runs none of its content.

A tree consists of None, bools, ints, floats, texts, bytes, dicts, lists, tuples, sets, arrays of plain numbers and
numpy scalars. Snapshots, records with a `STATE` and dataclasses of options are written as dicts of their parts: what
declares them builds them again (`slam_backend.state`). Parts that are shared in a tree are shared after reading,
too. Floats keep every bit. Arrays keep their memory layout and whether they are writable.

The bytes are the length of a table, the table as JSON, and the bytes of the arrays. Rows of the table are the parts of
the tree. Each row refers to earlier rows only, so that reading neither recurses nor loops. Arrays are not compressed
and do not overlap: a tree takes about as much memory as its file has bytes.
"""

import json
import math
import struct
from collections.abc import Callable
from dataclasses import is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.read_only import as_read_only
from slam_backend.state import Snapshot, is_stateful
from slam_backend.state.format import parts_of

ALIGNMENT = 64  # alignment of arrays [bytes]
MAX_TABLE = 1 << 26  # limit of a table [bytes]; parsed, it takes up to twenty times as much memory
MOST_VISITS = 1 << 27  # limit of the sum over all parts of their parts within, as often as they are shared
LARGEST_INT = 1 << 63  # larger ints are written as hexadecimal digits
DTYPES = {
    np.dtype(kind).newbyteorder("<").str: np.dtype(kind)
    for kind in ("?", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8")
}
SEQUENCES: dict[type, tuple[str, Callable[[list[Any]], Any]]] = {
    tuple: ("tuple", tuple),
    list: ("list", list),
    set: ("set", set),
    frozenset: ("frozenset", frozenset),
}
BUILT = dict(SEQUENCES.values())


class ForeignObjectError(ValueError):
    """Tree with an object that cannot be written."""


# ---------------------------------------------------------------------- writing


class _Writer:
    """Writer of the table of a tree; it lists the arrays."""

    def __init__(self) -> None:
        self.rows: list[list[Any]] = []
        self.blobs: list[bytes | NDArray[Any]] = []
        self._row_of: dict[int, Any] = {}  # row by `id` of an object; None while its parts are being written
        self._kept: list[Any] = []  # written objects, so that their `id` stays unique

    def entry(self, value: Any) -> Any:
        """Return the entry of a value in a row; each value that has parts becomes a row of its own."""
        cls = type(value)
        if value is None or cls is bool or cls is str:
            return value
        if cls is int:
            return value if -LARGEST_INT <= value < LARGEST_INT else self._row(["int", hex(value)])
        if cls is float:
            return value if math.isfinite(value) else self._row(["float", struct.pack("<d", value).hex()])
        key = id(value)
        if key in self._row_of:
            if self._row_of[key] is None:
                raise ForeignObjectError("a part that holds itself")
            return self._row_of[key]
        self._row_of[key] = None
        self._kept.append(value)
        entry = self._row_of[key] = self._row(self._written(value, cls))
        return entry

    def _row(self, row: list[Any]) -> list[int]:
        self.rows.append(row)
        return [len(self.rows) - 1]

    def _written(self, value: Any, cls: type) -> list[Any]:
        """Return the row of a value that has parts, after writing the rows of its parts."""
        if cls is np.ndarray:
            return self._array(value)
        if cls is dict or cls is Snapshot:
            row: list[Any] = ["dict"]
            for key, part in value.items():
                row += (self._at(key, key), self._at(key, part))
            return row
        if cls in SEQUENCES:
            parts = sorted(value, key=repr) if cls in (set, frozenset) else value  # equal sets have the same bytes
            return [SEQUENCES[cls][0], *(self._at(place, part) for place, part in enumerate(parts))]
        if cls is bytes:
            self.blobs.append(value)
            return ["bytes", len(value)]
        if isinstance(value, np.generic) and value.dtype.str in DTYPES:
            return ["number", value.dtype.str, value.tobytes().hex()]
        if is_stateful(cls) or is_dataclass(cls):
            try:
                parts = parts_of(value)
            except Exception as error:  # of any kind: the object may not come from a constructor of its class
                raise ForeignObjectError(f"a damaged {cls.__name__} ({error})") from error
            return self._written(parts, dict)
        raise ForeignObjectError(f"a {cls.__module__}.{cls.__qualname__}")

    def _at(self, place: Any, part: Any) -> Any:
        """Return the entry of a part; an error names its place."""
        try:
            return self.entry(part)
        except ForeignObjectError as error:
            raise ForeignObjectError(f"{error} in {place!r}" if isinstance(place, str) else str(error)) from None

    def _array(self, value: NDArray[Any]) -> list[Any]:
        if value.dtype.str not in DTYPES:
            raise ForeignObjectError(f"an array of {value.dtype}")
        by_columns = value.flags.f_contiguous and not value.flags.c_contiguous
        self.blobs.append(np.ascontiguousarray(value.T if by_columns else value))
        return ["array", value.dtype.str, list(value.shape), int(by_columns), int(value.flags.writeable)]


def encode(tree: Any) -> bytes:
    """Return a tree as bytes.

    Raises:
        ForeignObjectError: If an object is none of what a tree consists of; the text says what and where.
    """
    writer = _Writer()
    root = writer.entry(tree)
    table = json.dumps([writer.rows, root], separators=(",", ":"), allow_nan=False).encode()
    pieces: list[bytes | memoryview] = [f"{len(table)}\n".encode(), table]
    size = len(pieces[0]) + len(table)
    for blob in writer.blobs:
        start = -(-size // ALIGNMENT) * ALIGNMENT
        part = blob if isinstance(blob, bytes) else blob.reshape(-1).view(np.uint8).data if blob.size else b""
        pieces += (bytes(start - size), part)
        size = start + len(part)
    return b"".join(pieces)


# ---------------------------------------------------------------------- reading


class _Reader:
    """Reader of a tree, row by row.

    Args:
        body: Bytes that `encode` returned, or any others.
    """

    def __init__(self, body: bytes) -> None:
        digits, newline, _ = body[:16].partition(b"\n")
        if not newline or not digits.isdigit() or not 0 < (length := int(digits)) <= MAX_TABLE:
            raise ValueError("no table")
        self._body = body
        self._at = len(digits) + 1 + length
        content = json.loads(body[len(digits) + 1 : self._at])
        if type(content) is not list or len(content) != 2 or type(content[0]) is not list:
            raise ValueError("no table of rows")
        self._rows, self._root = content
        self._parts: list[Any] = []
        self._sizes: dict[int, int] = {}  # number of all parts within a part, by row
        self._visits = 0

    def tree(self) -> Any:
        """Return the tree."""
        for tag, *entries in self._rows:
            self._parts.append(self._built(tag, entries))
        if self._at != len(self._body):
            raise ValueError("bytes that belong to nothing")
        return self._value(self._root)

    def _value(self, entry: Any) -> Any:
        """Return the value of an entry."""
        if type(entry) is not list:
            return entry
        (row,) = entry
        if type(row) is not int or not 0 <= row < len(self._parts):
            raise ValueError(f"a row {row} before it is defined")
        return self._parts[row]

    def _values(self, entries: list[Any]) -> list[Any]:
        """Return the values of a row's entries, unless hashing or checking them would take for ever."""
        values = list(map(self._value, entries))
        size = 1 + sum(self._sizes.get(entry[0], 1) if type(entry) is list else 1 for entry in entries)
        self._sizes[len(self._parts)] = size
        self._visits += size
        if self._visits > MOST_VISITS:
            raise ValueError("parts that are shared too often")
        return values

    def _built(self, tag: str, entries: list[Any]) -> Any:
        """Return the value of a row."""
        if tag == "array":
            return self._array(*entries)
        if tag == "dict":
            values = self._values(entries)
            return dict(zip(values[::2], values[1::2], strict=True))
        if tag in BUILT:
            return BUILT[tag](self._values(entries))
        (first, *rest) = entries
        if tag == "int":
            return int(first, 16)
        if tag == "float":
            return struct.unpack("<d", bytes.fromhex(first))[0]
        if tag == "number":
            return DTYPES[first].type(np.frombuffer(bytes.fromhex(rest[0]), DTYPES[first].str.replace("b", "u"))[0])
        if tag == "bytes":
            return bytes(self._taken(first))
        raise ValueError(f"a row of kind {tag!r}")

    def _array(self, code: str, shape: list[int], by_columns: int, writeable: int) -> NDArray[Any]:
        dtype = DTYPES[code]
        if any(type(size) is not int or not 0 <= size < 1 << 40 for size in shape) or len(shape) > 8:
            raise ValueError(f"an array of shape {shape}")
        flat = np.frombuffer(self._taken(math.prod(shape) * dtype.itemsize), np.uint8)
        if code == "|b1" and flat.size and flat.max() > 1:
            raise ValueError("a truth value that is neither 0 nor 1")
        array = flat.view(dtype).reshape(shape[::-1] if by_columns else shape)
        array = (array.T if by_columns else array).copy("A")
        return array if writeable else as_read_only(array)

    def _taken(self, size: int) -> memoryview:
        """Return the next bytes after the table."""
        start = -(-self._at // ALIGNMENT) * ALIGNMENT
        if size < 0 or start + size > len(self._body):
            raise ValueError("arrays larger than the file")
        self._at = start + size
        return memoryview(self._body)[start : self._at]


def decode(body: bytes) -> Any:
    """Return the tree that `encode` wrote; the bytes are never executed.

    Raises:
        ValueError: If `encode` did not write the bytes; the text says what was found.
    """
    try:
        return _Reader(body).tree()
    except Exception as error:  # of any kind: the bytes may be damaged
        raise ValueError(str(error) or type(error).__name__) from error
