"""Binary format of state trees. It holds data only: reading a file runs none of its content.

A tree consists of None, bools, ints, floats, texts, bytes, dicts, lists, tuples, sets, arrays of plain numbers, numpy
scalars, and objects of the classes that the caller lists (`StateTypes`). Parts that are shared in a tree are shared
after reading, too. Floats keep every bit. Arrays keep their memory layout and whether they are writable.

The bytes are the length of a table, the table as JSON, and the bytes of the arrays. Rows of the table are the parts of
the tree. Each row refers to earlier rows only, so that reading neither recurses nor loops. Arrays are not compressed
and do not overlap: a tree takes about as much memory as its file has bytes.
"""

import json
import math
import struct
from collections.abc import Callable, Iterable
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from stat import S_ISREG
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.random import SeedSequence
from numpy.typing import NDArray

from slam_backend.core.read_only import as_read_only
from slam_backend.core.state import Snapshot, is_stateful

ALIGNMENT = 64  # alignment of arrays [bytes]
MAX_BYTES = 1 << 30  # limit of a file [bytes]; a state has some megabytes
MAX_TABLE = 1 << 26  # limit of a table [bytes]; parsed, it takes up to twenty times as much memory
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


class StateType(NamedTuple):
    """Conversion of the objects of one class to parts and back.

    Attributes:
        name: Name of the class in files.
        apart: Function that returns the parts of an object; each part is a tree.
        build: Function that returns the object made of these parts, or raises a ValueError.
    """

    name: str
    apart: Callable[[Any], Iterable[Any]]
    build: Callable[..., Any]


class StateTypes:
    """Classes whose objects a tree may hold; no other class is written or called.

    Args:
        classes: Dataclasses, named tuples and enumerations. Their constructors rebuild them from their fields.
        special: Conversions of other classes.
    """

    def __init__(self, classes: Iterable[type] = (), special: dict[type, StateType] | None = None) -> None:
        self.by_class: dict[type, StateType] = {cls: _kind_of(cls) for cls in classes} | (special or {})
        self.by_name = {kind.name: kind for kind in self.by_class.values()}
        assert len(self.by_name) == len(self.by_class)

    def with_others(self, others: "StateTypes") -> Self:
        """Return the union of two sets of classes."""
        return type(self)((), self.by_class | others.by_class)


def _kind_of(cls: type) -> StateType:
    """Return the conversion of a class to its fields and back by its constructor."""
    if is_stateful(cls):
        names = list(cls.STATE.parts)  # type: ignore[attr-defined]
        build = getattr(cls, "from_parts", cls)
        return StateType(
            cls.__name__,
            lambda each: [getattr(each, name) for name in names],
            lambda *parts: build(**dict(zip(names, parts, strict=True))),
        )
    if issubclass(cls, Enum):
        return StateType(cls.__name__, lambda member: (member.value,), cls)
    if is_dataclass(cls):
        names = [field.name for field in fields(cls) if field.init]
        return StateType(
            cls.__name__,
            lambda each: [getattr(each, name) for name in names],
            lambda *parts: cls(**dict(zip(names, parts, strict=True))),
        )
    assert issubclass(cls, tuple)
    return StateType(cls.__name__, tuple, cls)


def sequence_parts(sequence: SeedSequence) -> tuple[Any, ...]:
    """Return the arguments that rebuild a seed sequence, its count of children included."""
    return sequence.entropy, sequence.spawn_key, sequence.pool_size, sequence.n_children_spawned


def sequence_of(entropy: Any, spawn_key: Any, pool_size: int, n_children_spawned: int) -> SeedSequence:
    """Return the seed sequence with these arguments, or raise a ValueError."""
    if not 4 <= pool_size <= 64:  # numpy would allocate any size
        raise ValueError(f"a seed sequence has a pool of {pool_size} words")
    return SeedSequence(entropy, spawn_key=spawn_key, pool_size=pool_size, n_children_spawned=n_children_spawned)


SEEDS = StateTypes(special={SeedSequence: StateType("SeedSequence", sequence_parts, sequence_of)})


class ForeignObjectError(ValueError):
    """Tree with an object that cannot be written: its class is not listed."""


# ---------------------------------------------------------------------- writing


class _Writer:
    """Writer of the table of a tree; it lists the arrays.

    Args:
        kinds: Classes that the tree may hold.
    """

    def __init__(self, kinds: StateTypes) -> None:
        self.rows: list[list[Any]] = []
        self.blobs: list[bytes | NDArray[Any]] = []
        self._kinds = kinds.by_class
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
        if cls in self._kinds:
            kind = self._kinds[cls]
            try:
                parts = list(kind.apart(value))
            except Exception as error:  # of any kind: the object may not come from a constructor of its class
                raise ForeignObjectError(f"a damaged {kind.name} ({error})") from error
            return ["object", kind.name, *(self._at(place, part) for place, part in enumerate(parts))]
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


def encode(tree: Any, kinds: StateTypes) -> bytes:
    """Return a tree as bytes.

    Raises:
        ForeignObjectError: If an object is neither plain data nor of the listed classes; the text says what and where.
    """
    writer = _Writer(kinds)
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
        kinds: Classes that the tree may hold.
    """

    def __init__(self, body: bytes, kinds: StateTypes) -> None:
        digits, newline, _ = body[:16].partition(b"\n")
        if not newline or not digits.isdigit() or not 0 < (length := int(digits)) <= MAX_TABLE:
            raise ValueError("no table")
        self._body, self._kinds = body, kinds.by_name
        self._at = len(digits) + 1 + length
        content = json.loads(body[len(digits) + 1 : self._at])
        if type(content) is not list or len(content) != 2 or type(content[0]) is not list:
            raise ValueError("no table of rows")
        self._rows, self._root = content
        self._parts: list[Any] = []

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

    def _built(self, tag: str, entries: list[Any]) -> Any:
        """Return the value of a row."""
        if tag == "array":
            return self._array(*entries)
        if tag == "dict":
            values = list(map(self._value, entries))
            return dict(zip(values[::2], values[1::2], strict=True))
        if tag in BUILT:
            return BUILT[tag](list(map(self._value, entries)))
        if tag == "object":
            name, *parts = entries
            return self._kinds[name].build(*map(self._value, parts))
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


def decode(body: bytes, kinds: StateTypes) -> Any:
    """Return the tree that `encode` wrote; the bytes are never executed.

    Raises:
        ValueError: If `encode` did not write the bytes for these kinds; the text says what was found.
    """
    try:
        return _Reader(body, kinds).tree()
    except Exception as error:  # damaged bytes, or values that constructors of the listed classes refuse
        raise ValueError(str(error) or type(error).__name__) from error


def read_file(path: Path) -> bytes:
    """Return the content of a regular file of bounded size.

    Raises:
        OSError: If it cannot be read, is not a regular file, or exceeds `MAX_BYTES`.
    """
    found = path.stat()
    if not S_ISREG(found.st_mode):
        raise OSError("not a regular file")
    if found.st_size > MAX_BYTES:
        raise OSError(f"the file has more than {MAX_BYTES >> 20} MiB")
    return path.read_bytes()
