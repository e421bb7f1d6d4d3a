"""Disk cache of compiled kernels: several processes may use it at a time, and damaged files are compiled again."""

import logging
import pickle
from collections.abc import Iterator
from contextlib import contextmanager
from hashlib import sha256
from io import BytesIO
from pathlib import Path
from typing import Any

from numba.core.caching import FunctionCache, IndexDataCacheFile

LOGGER = logging.getLogger("slam_backend")
DIGEST = sha256().digest_size  # bytes at the end of each file; numba alone would not look at them


class KernelCache(FunctionCache):
    """The cache of one kernel: a place that cannot be written to costs time, and stops nothing.

    Args:
        cache: The cache that numba made; it has not read its files yet.
        stamp: Digest of what the kernel is compiled from; entries of another stamp are stale.
    """

    def __init__(self, cache: FunctionCache, stamp: Any) -> None:
        self.__dict__.update(cache.__dict__)
        self._cache_file: CheckedFile = CheckedFile(cache._cache_path, cache._impl.filename_base, stamp)  # type: ignore[no-untyped-call]

    @property
    def folder(self) -> str:
        """Folder of the cache's files."""
        return str(self._cache_path)

    def holds(self, signature: Any, codegen: Any) -> bool:
        """Return whether a kernel is kept for a signature; it is not read."""
        key = self._index_key(signature, codegen)  # type: ignore[no-untyped-call]
        return self._cache_file.holds(key)

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a kernel, if that can be: the disk may be full, or read-only by now."""
        try:
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]
        except OSError as error:
            LOGGER.debug("Not kept: %s: %s", self._name, error)


class CheckedFile(IndexDataCacheFile):
    """Index and data files of one kernel; a file that is not what was written counts as missing.

    Nothing of such a file is unpickled, let alone run. A data file is named after the stamp and the signature that it
    was compiled for, and is complete before the index refers to it. numba numbers its data files and writes the index
    first, so that one of two processes that save at the same time can find the other's machine code under its own
    signature; here a race costs an entry at worst.
    """

    def save(self, key: Any, data: Any) -> None:
        """Save the machine code of one signature."""
        digest = sha256(repr((self._source_stamp, key)).encode()).hexdigest()
        name = self._data_name_pattern.format(number=int(digest[:15], 16))
        self._save_data(name, (key, data))  # type: ignore[no-untyped-call]
        entries = self._load_index()
        if not entries:  # data of older sources are never read again
            for file in Path(self._cache_path).glob(f"{self._index_name.removesuffix('.nbi')}.*.nbc"):
                if file.name != name:
                    file.unlink(missing_ok=True)
        entries[key] = name
        self._save_index(entries)  # type: ignore[no-untyped-call]

    def load(self, key: Any) -> Any:
        """Return the kernel of a signature; None: there is none that can be used."""
        found = super().load(key)  # type: ignore[no-untyped-call]
        return found[1] if found is not None and found[0] == key else None

    def holds(self, key: Any) -> bool:
        """Return whether there is a file for a key."""
        name = self._load_index().get(key)
        return name is not None and Path(self._data_path(name)).exists()  # type: ignore[no-untyped-call]

    def _load_index(self) -> dict[Any, str]:
        content = _checked(self._index_path)
        if content is None:
            return {}
        stream = BytesIO(content)
        if pickle.load(stream) != self._version:
            return {}
        stamp, names = pickle.load(stream)
        return dict(names) if stamp == self._source_stamp else {}

    def _load_data(self, name: str) -> Any:
        content = _checked(self._data_path(name))  # type: ignore[no-untyped-call]
        if content is None:
            raise OSError(f"{name} is damaged")  # numba takes that for a file that is gone
        return pickle.loads(content)

    @contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[BytesIO]:
        with super()._open_for_write(filepath) as file:
            content = BytesIO()
            yield content
            file.write(content.getvalue() + sha256(content.getvalue()).digest())


def _checked(path: str) -> bytes | None:
    """Return the content of a file without the digest at its end; None: it cannot be read, or the two do not agree."""
    try:
        whole = Path(path).read_bytes()
    except OSError:
        return None
    content, digest = whole[:-DIGEST], whole[-DIGEST:]
    return content if sha256(content).digest() == digest else None
