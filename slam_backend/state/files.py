"""Files of states: a line that names kind and version, a line with their SHA-256, and the bytes of a tree."""

import hashlib
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from os import PathLike
from pathlib import Path
from typing import Any

from slam_backend.core.files import os_errors_as_argument_errors, read_file, write_file
from slam_backend.core.validation import argument_error
from slam_backend.state.codec import ForeignObjectError, decode, encode
from slam_backend.state.format import format_of


@cache
def version_of(kind: type) -> str:
    """Return the version of states of a class: number of their format and package version; both must agree."""
    try:
        package = version("vslam-env")
    except PackageNotFoundError:  # not installed: run from a source tree
        package = "source"
    return f"{format_of(kind)}/{package}"


def check_version(kind: type, name: str, found: Any) -> None:
    """Refuse a state of another version.

    Raises:
        ValueError: If it is one.
    """
    if found != version_of(kind):
        hint = "Use the version that made it; only the same version continues exactly."
        raise argument_error(name, f"a state of version {version_of(kind)!r}", found, hint)


def write_state(path: Any, magic: bytes, kind: type, tree: Any) -> None:
    """Write the state of an object; an interrupted write leaves no file or the old one.

    Args:
        path: The file.
        magic: Bytes by which such files are known.
        kind: Class of the object.
        tree: State of the object, as parts.

    Raises:
        ValueError: If the tree contains objects of other kinds, or the file cannot be written.
    """
    path = _checked_path(path)
    try:
        body = encode(tree)
    except ForeignObjectError as error:
        hint = "Your own objects are not stored: make the environment that loads the state with them."
        raise argument_error("state", "numbers, arrays and configurations of this package", str(error), hint) from error
    with os_errors_as_argument_errors(path, "path"):
        is_not_file = path.exists() and not path.is_file()
    if is_not_file:
        raise argument_error("path", "a file that can be written", path, "The path exists and is not a file.")
    write_file(path, magic + f"{version_of(kind)}\n{_fingerprint(body)}\n".encode() + body)


def read_state(path: Any, magic: bytes, kind: type, writer: str) -> Any:
    """Return the tree that `write_state` wrote; arguments as there, and the name of the public function that writes it.

    Raises:
        ValueError: If the file does not exist, contains no state, is damaged, or has another version.
    """
    path = _checked_path(path)
    try:
        content = read_file(path)
    except OSError as error:
        raise argument_error("path", "a state file", path, f"The system says: {error}.") from error
    head, _, body = content.partition(b"\n")
    if not head.startswith(magic):
        raise argument_error("path", "a state file", path, f"Write one with {writer}.")
    check_version(kind, str(path), head[len(magic) :].decode(errors="replace"))  # before decoding
    digest, _, body = body.partition(b"\n")
    if digest.decode(errors="replace") != _fingerprint(body):
        raise argument_error("path", "an intact state file", f"a damaged file {path}", "Save it again.")
    try:
        return decode(body)
    except ValueError as error:
        hint = f"Save it again; the reader says: {error}."
        raise argument_error("path", "a readable state file", path, hint) from error


def _fingerprint(body: bytes) -> str:
    return hashlib.sha256(body).hexdigest()


def _checked_path(path: Any) -> Path:
    """Return a valid file path, or raise."""
    if not isinstance(path, (str, PathLike)) or "\0" in str(path):
        raise argument_error("path", "the path of a file", path, "Give a string or a Path without NUL characters.")
    return Path(path)
