"""Reader of untrusted archives of arrays (.npz): it runs no code and bounds the memory."""

import io
import zipfile
from collections.abc import Iterable
from math import prod
from pathlib import Path

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from slam_backend.core.files import MAX_BYTES, read_file

HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
KINDS = "biufUS"  # dtype kinds of numbers and texts; objects would be pickles
ARCHIVE = b"PK"  # first bytes
COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # zipfile unpacks a part of these, but all of other members


class UnreadableArchiveError(ValueError):
    """File that is not an intact archive of plain arrays."""


class OtherKindError(UnreadableArchiveError):
    """File that is no archive at all."""


def read_arrays(path: Path, names: Iterable[str] | None = None) -> dict[str, NDArray[np.generic]]:
    """Return arrays of an archive by name.

    Args:
        path: File that `numpy.savez` or `numpy.savez_compressed` wrote.
        names: Names of the arrays wanted; None: all. Missing arrays are left out.

    Raises:
        UnreadableArchiveError: If the file is no such archive, is damaged, holds other data than numbers and texts, or
            unpacks to more than `MAX_BYTES`, or is compressed as numpy does not.
        OtherKindError: If it is no archive.
    """
    try:
        content = read_file(path)
        if not content.startswith(ARCHIVE):
            raise OtherKindError("it is no archive")
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = {member.filename.removesuffix(".npy"): member for member in archive.infolist()}
            wanted = {name: members[name] for name in (members if names is None else names) if name in members}
            if sum(member.file_size for member in wanted.values()) > MAX_BYTES:
                raise UnreadableArchiveError(f"it unpacks to more than {MAX_BYTES >> 20} MiB")
            return {name: _array(archive, member) for name, member in wanted.items()}
    except UnreadableArchiveError:
        raise
    except Exception as error:  # any error of zipfile, zlib or numpy for damaged bytes
        raise UnreadableArchiveError(str(error) or type(error).__name__) from error


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> NDArray[np.generic]:
    """Return an array, after checking its compression, and its size against its header."""
    if member.compress_type not in COMPRESSIONS:
        raise UnreadableArchiveError(f"{member.filename} is compressed by another method than numpy's")
    with archive.open(member) as stream:
        shape, by_columns, dtype = HEADERS[npy.read_magic(stream)](stream)
        if dtype.kind not in KINDS or dtype.hasobject:
            raise UnreadableArchiveError(f"{member.filename} holds {dtype}")
        size = prod(shape) * dtype.itemsize
        if min(shape, default=0) < 0 or size > member.file_size:
            raise UnreadableArchiveError(f"{member.filename} says that it has the shape {shape}")
        content = stream.read(size + 1)
    if len(content) != size:
        raise UnreadableArchiveError(f"{member.filename} has {len(content)} bytes of {size}")
    return np.frombuffer(content, dtype).reshape(shape, order="F" if by_columns else "C").copy("A")
