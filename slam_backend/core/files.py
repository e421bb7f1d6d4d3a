"""Bounded input and atomic output of files. A path that is not a regular file is written into, never replaced."""

import errno
import os
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from os import PathLike
from pathlib import Path
from secrets import token_hex
from typing import Any

from slam_backend.core.validation import argument_error

READER_S = 10.0  # longest wait for a reader of a FIFO [s]
POLL_S = 0.02
OWN_DESCRIPTORS = ("/dev/fd", "/proc/self/fd")
IN_PLACE = (
    errno.EBUSY,
    errno.EPERM,
    errno.EACCES,
    errno.EROFS,
)  # writable files that cannot be replaced

MAX_BYTES = 1 << 30  # limit of a file that is read whole [bytes]

AnyPath = str | PathLike[str]


def write_file(path: AnyPath, content: str | bytes, name: str = "path") -> Path:
    """Write a file so that a reader finds the old content or the new one, never a part.

    The content of a regular or new file goes into a temporary file beside it, which is then renamed. Links are
    followed; an existing file keeps its permissions and its owner. A device, a FIFO or a descriptor of this process
    (`/dev/stdout`) is opened and written into. So is a regular file that cannot be replaced, for example one in a
    read-only folder.

    Args:
        path: The file.
        content: The whole content; text is encoded as UTF-8.
        name: The argument that gave the path, for the error.

    Returns:
        `path`.

    Raises:
        ValueError: If it cannot be written. A file that was to be replaced keeps its old content.
    """
    data = content.encode() if isinstance(content, str) else content
    checked = checked_path(path, name)
    with os_errors_as_argument_errors(path, name):
        _write(checked, data)
    return checked


def move_file(part: AnyPath, path: AnyPath, name: str = "path") -> None:
    """Move a finished file to a path, with the rules of `write_file`.

    Args:
        part: The finished file; it is removed even after an error. It should lie beside `resolved(path)`.
        path: The destination.
        name: The argument that gave the destination, for the error.

    Raises:
        ValueError: If the destination cannot be written.
    """
    try:
        with os_errors_as_argument_errors(path, name):
            target = _replaceable(path)
            if target is None or not _renamed(Path(part), target):
                _write_into(path, Path(part).read_bytes())
    finally:
        Path(part).unlink(missing_ok=True)


def append_text(path: AnyPath, text: str, name: str = "path") -> None:
    """Append text to a regular file, all of it or nothing; a missing file is created.

    Raises:
        ValueError: If it cannot be written; the file stays as it was.
    """
    with os_errors_as_argument_errors(path, name):
        number = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            before = os.fstat(number).st_size
            try:
                _write_all(number, text.encode())
            except BaseException:
                os.ftruncate(number, before)
                raise
        finally:
            os.close(number)


def check_writable(path: AnyPath, name: str) -> None:
    """Refuse a path that cannot be written, before the work whose result it receives; no file is changed.

    Raises:
        ValueError: If `write_file` could not write it now.
    """
    path = checked_path(path, name)
    with os_errors_as_argument_errors(path, name):
        if path.is_dir():
            raise argument_error(name, "a file", "a folder", f"Name a file in {str(path)!r}.")
        if (number := _own_descriptor(path)) is not None:
            os.fstat(number)
        else:
            try:
                os.stat(path)
            except FileNotFoundError:
                os.unlink(_new_part(resolved(path)))
            else:
                _check_access(path)


def resolved(path: AnyPath) -> Path:
    """Return the file that a path leads to, following links; it need not exist."""
    return Path(os.path.realpath(path))


def checked_path(path: Any, name: str = "path") -> Path:
    """Return a path that can name a file, or raise a `ValueError`."""
    if not isinstance(path, (str, PathLike)) or "\0" in str(path):
        raise argument_error(name, "the path of a file", path, "Give a text or a Path, without NUL characters.")
    return Path(path)


def missing_error(name: str, expected: str, path: AnyPath, more: str = "") -> ValueError:
    """Return the error of a path at which there is no file.

    Args:
        name: The argument that gave the path.
        expected: Description of the file.
        path: The path.
        more: Further advice, a full sentence.
    """
    got = "a folder" if Path(path).is_dir() else "no such file"
    return argument_error(name, expected, got, f"Check {str(path)!r}. {more}".rstrip())


@contextmanager
def os_errors_as_argument_errors(path: AnyPath, name: str) -> Iterator[None]:
    """Turn a system error within a block that writes a file into a `ValueError` with the reason."""
    try:
        yield
    except OSError as error:
        hint = f"The system says: {error.strerror or error}."
        raise argument_error(name, "a file that can be written", Path(path), hint) from error


def _write(path: AnyPath, data: bytes) -> None:
    """Write a file by renaming where possible, and otherwise into the existing file."""
    target = _replaceable(path)
    if target is None:
        _write_into(path, data)
        return
    try:
        part = _new_part(target)
    except OSError as error:
        if error.errno not in IN_PLACE or not target.exists():
            raise
        _write_into(target, data)
        return
    try:
        with part.open("wb") as stream:
            stream.write(data)
        if not _renamed(part, target):
            _write_into(target, data)
    finally:
        part.unlink(missing_ok=True)


def _replaceable(path: AnyPath) -> Path | None:
    """Return the regular or new file that a path leads to; None if the existing one must be written into.

    Raises:
        OSError: If the file is write-protected.
    """
    if _own_descriptor(path) is not None:
        return None
    try:
        found = os.stat(path)
    except FileNotFoundError:
        return resolved(path)
    target = resolved(path)
    # A link in /proc to an open file may give the name of another file, or of none.
    if not stat.S_ISREG(found.st_mode) or not target.exists() or not os.path.samestat(found, target.stat()):
        return None
    _check_access(target)  # renaming would replace a write-protected file
    return target


def _check_access(path: AnyPath) -> None:
    if not os.access(path, os.W_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))


def _new_part(target: Path) -> Path:
    """Make an empty temporary file beside a file, with the permissions of any new file."""
    part = target.with_name(f".{target.name[:40]}.{token_hex(8)}.part")
    os.close(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666))
    return part


def _renamed(part: Path, target: Path) -> bool:
    """Rename a finished file onto another, keeping the latter's permissions and owner; return whether it worked."""
    if target.exists():
        old, new = target.stat(), part.stat()
        if (old.st_uid, old.st_gid) != (new.st_uid, new.st_gid):
            try:
                os.chown(part, old.st_uid, old.st_gid)
            except PermissionError:
                return False
        part.chmod(stat.S_IMODE(old.st_mode))
    try:
        part.replace(target)
    except OSError as error:
        if error.errno in IN_PLACE and target.exists():  # busy: a file that is a mount point, as in a container
            return False
        raise
    return True


def _write_into(path: AnyPath, data: bytes) -> None:
    """Write into a device, a FIFO, an open descriptor, or a file that cannot be replaced."""
    number = _own_descriptor(path)
    # Duplicate the descriptor: opening its name would overwrite a file from its start that other output goes to.
    opened = _opened(path) if number is None else os.dup(number)
    try:
        _write_all(opened, data)
    finally:
        os.close(opened)


def _opened(path: AnyPath) -> int:
    """Open an existing file for writing; a FIFO waits for a reader."""
    mode = os.stat(path).st_mode
    if not stat.S_ISFIFO(mode):
        return os.open(path, os.O_WRONLY | os.O_CLOEXEC | os.O_NOCTTY | (os.O_TRUNC if stat.S_ISREG(mode) else 0))
    deadline = time.monotonic() + READER_S
    while True:
        try:
            number = os.open(path, os.O_WRONLY | os.O_CLOEXEC | os.O_NONBLOCK)
        except OSError as error:
            if error.errno != errno.ENXIO:
                raise
            if time.monotonic() > deadline:
                raise OSError(errno.ENXIO, f"nothing has read this FIFO for {READER_S:g} s", str(path)) from error
            time.sleep(POLL_S)
        else:
            os.set_blocking(number, True)
            return number


def _write_all(number: int, data: bytes) -> None:
    rest = memoryview(data)
    while rest:
        rest = rest[os.write(number, rest) :]


def _own_descriptor(path: AnyPath) -> int | None:
    """Return the number of the descriptor of this process that a path such as /dev/stdout leads to, or None."""
    folders = {os.path.realpath(folder) for folder in OWN_DESCRIPTORS}
    place = os.fspath(path)
    for _ in range(40):  # limit of links that the system follows
        folder, name = os.path.split(place)
        if name.isdecimal() and os.path.realpath(folder) in folders:
            return int(name)
        link = None
        with suppress(OSError):
            link = os.readlink(place)
        if link is None:
            return None
        place = os.path.join(folder, link)
    return None


def read_file(path: Path) -> bytes:
    """Return the content of a regular file of bounded size.

    Raises:
        OSError: If it cannot be read, is not a regular file, or exceeds `MAX_BYTES`.
    """
    found = path.stat()
    if not stat.S_ISREG(found.st_mode):
        raise OSError("not a regular file")
    if found.st_size > MAX_BYTES:
        raise OSError(f"the file has more than {MAX_BYTES >> 20} MiB")
    return path.read_bytes()
