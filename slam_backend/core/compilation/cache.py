"""Disk cache of compiled kernels, safe for concurrent processes; damaged files are compiled again.

A kernel is looked up in the user's own cache first, then among those that the package `vslam-env-kernels` ships. Files
are named after all inputs of the compilation, so that a stale file is never found.
"""

import os
import pickle
import stat
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Any

from numba.core import sigutils
from numba.core.caching import NullCache
from numba.core.compiler import CompileResult
from numba.core.registry import CPUDispatcher
from numba.core.serialize import dumps
from numba.misc.appdirs import AppDirs

from slam_backend.core.address_space import check_address_space
from slam_backend.core.compilation.shipped import CONFIG, shipped_kernels, warn_once
from slam_backend.core.compilation.stamp import stamp_of, types_text

DIGEST = sha256().digest_size  # bytes at the end of each file
SUFFIX = ".nbc"
NOT_KEPT = "Compiled kernels are not kept ({}): each process compiles them."
NOT_PRIVATE = "it belongs to another user, or others may write to it"
PYTHON = f"{sys.implementation.cache_tag}{getattr(sys, 'abiflags', '')}"


class KernelCache(NullCache):
    """Disk cache of one kernel. Without a usable folder each process compiles the kernel.

    Args:
        kernel: Kernel; the functions that it calls need not be defined yet.
    """

    def __init__(self, kernel: CPUDispatcher) -> None:
        self._kernel = kernel
        self._stamp = ""

    @property
    def cache_path(self) -> str | None:
        """Folder of the user's cache for this kernel; None: no usable folder."""
        folder = cache_folder(Path(self._kernel.py_func.__code__.co_filename).parent, CONFIG.CACHE_DIR)
        return None if folder is None else str(folder)

    def file_name(self, signature: Any, target: tuple[str, ...]) -> str:
        """Return the name of the file that holds a kernel.

        Args:
            signature: Argument types.
            target: Triple, processor and features, as the code generator names them.
        """
        return f"{self._start(signature, target)}{self.stamp[:32]}{SUFFIX}"

    @property
    def stamp(self) -> str:
        """Digest of all inputs of the compilation, computed on first use."""
        if not self._stamp:
            self._stamp = stamp_of(self._kernel)
        return self._stamp

    def holds(self, signature: Any, codegen: Any) -> bool:
        """Return whether a usable kernel is cached or shipped for a signature, without unpickling it."""
        return any(_read(file) is not None for file in self._files(signature, codegen))

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the kernel of a signature; None: no usable one, even with all that the program expects."""
        from slam_backend.core.compilation.compiler import compile_expected  # which builds on this module

        check_address_space()
        target_context.refresh()
        found = self._load(sig, target_context)
        if found is None and compile_expected():
            found = self._load(sig, target_context)
        return found

    def _load(self, sig: Any, target_context: Any) -> Any:
        """Return the kernel of a signature; None: no usable one."""
        for file in self._files(sig, target_context.codegen()):
            content = _read(file)
            if content is not None:
                name, reduced = pickle.loads(content)
                if name == file.name:
                    return CompileResult._rebuild(target_context, *reduced)  # type: ignore[no-untyped-call]
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save a kernel if possible: there may be no folder, or the disk may be full."""
        folder = self.cache_path
        if data.library.has_dynamic_globals:
            return
        if folder is None:
            warn_once("not kept", NOT_KEPT.format("no folder can be written"))
            return
        target = data.codegen.magic_tuple()
        name = self.file_name(sig, target)
        try:
            _write(Path(folder) / name, dumps((name, data._reduce())))  # type: ignore[no-untyped-call]
        except OSError as error:
            warn_once("not kept", NOT_KEPT.format(error))
            return
        for file in Path(folder).glob(f"{self._start(sig, target)}*{SUFFIX}"):  # of older sources
            if file.name != name:
                file.unlink(missing_ok=True)

    def _files(self, signature: Any, codegen: Any) -> Iterator[Path]:
        """Yield the possible files of a kernel: the user's own, and the shipped one."""
        folder = self.cache_path
        if folder is not None:
            yield Path(folder) / self.file_name(signature, codegen.magic_tuple())
        shipped = shipped_kernels()
        if shipped is not None:
            yield shipped.folder / self.file_name(signature, shipped.target)

    def _start(self, signature: Any, target: tuple[str, ...]) -> str:
        """Return the part of a file's name that does not depend on the stamp."""
        function = self._kernel.py_func
        name = f"{function.__module__}.{function.__qualname__}"
        arguments, _ = sigutils.normalize_signature(signature)  # type: ignore[no-untyped-call]
        digest = sha256(repr((name, types_text(arguments), *target, PYTHON)).encode()).hexdigest()
        return f"{name.rpartition('.')[2].strip('<>')}-{digest[:32]}."


# ---------------------------------------------------------------------- folders and files


@lru_cache
def cache_folder(sources: Path, chosen: str = "") -> Path | None:
    """Return the folder of the cached kernels of a folder of sources; None: no usable folder.

    Kernels are code: the folder belongs to the user, and no other user may write to it.

    Args:
        sources: Folder of sources.
        chosen: Preferred folder; empty: none.
    """
    name = f"{sources.name}_{sha256(str(sources.absolute()).encode()).hexdigest()[:32]}"
    places = [sources / "__pycache__", Path(_user_cache()) / name]
    if chosen:
        places.insert(0, Path(chosen) / name)
    for place in places:
        with suppress(OSError):
            place.mkdir(mode=0o700, parents=True, exist_ok=True)
            if not is_private(place.stat(), _is_own_group):
                warn_once("refused", f"Kernels are not kept in {place}: {NOT_PRIVATE}.")
            elif os.access(place, os.W_OK | os.X_OK):
                return place
    return None


def _user_cache() -> str:
    """Return the user's folder for numba's caches of all projects."""
    return str(AppDirs(appname="numba", appauthor=False).user_cache_dir)  # type: ignore[no-untyped-call]


def is_private(status: os.stat_result, may_write: Any = lambda group, user: False) -> bool:
    """Return whether a file or folder belongs to the user, and only the user may write to it.

    Args:
        status: Status of the file or folder.
        may_write: Function of the numbers of a group and of the user: whether the group is the user's own.
    """
    if not hasattr(os, "geteuid"):  # Windows
        return True
    if status.st_uid != os.geteuid() or status.st_mode & stat.S_IWOTH:
        return False
    return not status.st_mode & stat.S_IWGRP or bool(may_write(status.st_gid, status.st_uid))


def _is_own_group(group: int, user: int) -> bool:
    """Return whether a group has a user's name and no other members, as many systems create for each user."""
    import grp
    import pwd

    try:
        name, members = pwd.getpwuid(user).pw_name, grp.getgrgid(group)
    except KeyError:
        return False
    return members.gr_name == name and set(members.gr_mem) <= {name}


def _read(file: Path) -> bytes | None:
    """Return the content of a file without its digest; None: it is missing, damaged or not the user's."""
    shipped = shipped_kernels()
    is_shipped = shipped is not None and file.parent == shipped.folder
    try:
        with open(file, "rb") as stream:
            if not (is_shipped or is_private(os.fstat(stream.fileno()))):
                warn_once("refused", f"{file} is not read: {NOT_PRIVATE}.")
                return None
            whole = stream.read()
    except OSError:
        return None
    content, digest = whole[:-DIGEST], whole[-DIGEST:]
    if sha256(content).digest() != digest:
        warn_once("damaged", f"{file} is damaged: the kernel is compiled again.")
        return None
    return content


def _write(file: Path, content: bytes) -> None:
    """Write a file atomically, with a digest at its end."""
    number, temporary = tempfile.mkstemp(dir=file.parent, prefix=f"{file.stem[:40]}.", suffix=".tmp")
    try:
        with open(number, "wb") as stream:
            stream.write(content + sha256(content).digest())
        os.replace(temporary, file)
    except BaseException:
        with suppress(OSError):
            os.unlink(temporary)
        raise
